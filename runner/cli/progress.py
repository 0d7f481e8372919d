"""How far something is: a line on a terminal's stderr, gone when it is over."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from runner.cli.output import number, size

if TYPE_CHECKING:
    from runner.execution.session import Progress

REDRAWS_A_SECOND: Final = 5
BAR_WIDTH: Final = 12
"""Short of the edge, where the terminal's echo of Ctrl-C would break the line and leave it behind."""


@contextlib.contextmanager
def progress_line(label: str, episodes: int) -> Iterator[Callable[[Progress], None]]:
    """Give what `run_job` reports to: it keeps the line up to date, where there is a terminal."""
    speed = _Speed()
    with _line(
        lambda rich: [
            *([rich.TextColumn(label, markup=False)] if label else []),
            rich.BarColumn(bar_width=BAR_WIDTH),
            rich.TextColumn("{task.completed:,}/{task.total:,}"),
            rich.TextColumn("{task.fields[facts]}", markup=False),
            rich.TimeRemainingColumn(compact=True),
        ],
        total=episodes,
        facts="",
    ) as update:

        def report(progress: Progress) -> None:
            if update is not None:
                update(completed=progress.episode, facts=facts_in_words(progress, speed.of(progress)))

        yield report


@contextlib.contextmanager
def steps_line(label: str) -> Iterator[Callable[[int], None]]:
    """Give what is told the steps done so far: it keeps a line of them, where there is a terminal."""
    with _line(
        lambda rich: [
            rich.SpinnerColumn(),
            rich.TextColumn(label, markup=False),
            rich.TextColumn("{task.completed:,} steps"),
        ]
    ) as update:
        yield lambda steps: update(completed=steps) if update is not None else None


@contextlib.contextmanager
def stage_line(stage: str) -> Iterator[Callable[[str], None]]:
    """Show on a terminal what is being done and for how long, where there is nothing to count.

    Yields:
        A function that is called with the next stage, such as `drawing`.
    """
    with _line(
        lambda rich: [
            rich.SpinnerColumn(),
            rich.TextColumn("{task.description}", markup=False),
            rich.TimeElapsedColumn(),
        ]
    ) as update:
        if update is not None:
            update(description=stage, refresh=True)
        yield lambda text: update(description=text, refresh=True) if update is not None else None


@contextlib.contextmanager
def bytes_line(label: str) -> Iterator[Callable[[int, int], None]]:
    """Give what is told the bytes done and their number: a line of them, where there is a terminal."""
    with _line(
        lambda rich: [
            rich.TextColumn(label, markup=False),
            rich.BarColumn(bar_width=BAR_WIDTH),
            rich.DownloadColumn(),
            rich.TransferSpeedColumn(),
            rich.TimeRemainingColumn(compact=True),
        ]
    ) as update:
        yield lambda done, total: update(completed=done, total=total) if update is not None else None


@contextlib.contextmanager
def counting(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """Give what is called with how many are done: it keeps a line up to date, where there is a terminal."""
    with _line(
        lambda rich: [
            rich.BarColumn(bar_width=BAR_WIDTH),
            rich.TextColumn(f"{{task.completed:,}} {what}", markup=False),
            rich.TimeRemainingColumn(compact=True),
        ],
        total=total or None,
    ) as update:
        yield lambda done: update(completed=done) if update is not None else None


@contextlib.contextmanager
def waiting(label: str) -> Iterator[None]:
    """Show a spinner with a label and the time elapsed, where there is a terminal."""
    with _line(
        lambda rich: [
            rich.SpinnerColumn(),
            rich.TextColumn(label, markup=False),
            rich.TimeElapsedColumn(),
        ]
    ):
        yield


@contextlib.contextmanager
def _line(
    columns: Callable[[Any], list[Any]], total: float | None = None, **fields: Any
) -> Iterator[Callable[..., None] | None]:
    """Give what updates a line of columns, made of what `rich.progress` has; None without a terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich import progress
    from rich.console import Console

    with progress.Progress(
        *columns(progress),
        console=Console(stderr=True, highlight=False),
        transient=True,
        refresh_per_second=REDRAWS_A_SECOND,
    ) as drawn:
        yield partial(drawn.update, drawn.add_task("", total=total, **fields))


class _Speed:
    """Steps a second since the first report: what came before was not learning."""

    def __init__(self) -> None:
        self._first: tuple[float, int] | None = None

    def of(self, progress: Progress) -> float | None:
        """Return the speed, None as long as there is nothing to say."""
        now, steps = time.monotonic(), progress.train_steps + progress.eval_steps
        if self._first is None:
            self._first = now, steps
        seconds = now - self._first[0]
        return (steps - self._first[1]) / seconds if seconds else None


def facts_in_words(progress: Progress, speed: float | None) -> str:
    """Return steps a second, the latest success percent and the size so far."""
    facts = []
    if speed is not None:
        facts.append(f"{speed / 1e6:.1f}M steps/s" if speed >= 1e6 else f"{speed / 1e3:.0f}k steps/s")
    if progress.evaluations:
        facts.append(f"success {number(progress.evaluations[-1]['success_percent'], 0)} %")
    return "  ".join([*facts, size(progress.bytes_written)])
