"""The progress line of a run: on a terminal's stderr, gone when the run is over."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Final

from runner.cli.output import number, size

if TYPE_CHECKING:
    from runner.execution import Progress

REDRAWS_A_SECOND: Final = 5
BAR_WIDTH: Final = 12
"""Short of the edge, where the terminal's echo of Ctrl-C would break the line and leave it behind."""


@contextlib.contextmanager
def progress_line(label: str, episodes: int) -> Iterator[Callable[[Progress], None]]:
    """Give what `run_job` reports to: it keeps the line up to date, where there is a terminal."""
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich import progress as rich_progress
    from rich.console import Console

    columns = [
        *([rich_progress.TextColumn(label, markup=False)] if label else []),
        rich_progress.BarColumn(bar_width=BAR_WIDTH),
        rich_progress.TextColumn("{task.completed:,}/{task.total:,}"),
        rich_progress.TextColumn("{task.fields[facts]}", markup=False),
        rich_progress.TimeRemainingColumn(compact=True),
    ]
    with rich_progress.Progress(
        *columns,
        console=Console(stderr=True, highlight=False),
        transient=True,
        refresh_per_second=REDRAWS_A_SECOND,
    ) as bar:
        task = bar.add_task("", total=episodes, facts="")
        speed = _Speed()

        def report(progress: Progress) -> None:
            bar.update(task, completed=progress.episode, facts=facts_in_words(progress, speed.of(progress)))

        yield report


@contextlib.contextmanager
def steps_line(label: str) -> Iterator[Callable[[int], None]]:
    """Give what is told the steps done so far: it keeps a line of them, where there is a terminal."""
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich import progress as rich_progress
    from rich.console import Console

    columns = [
        rich_progress.SpinnerColumn(),
        rich_progress.TextColumn(label, markup=False),
        rich_progress.TextColumn("{task.completed:,} steps"),
    ]
    drawn = Console(stderr=True, highlight=False)
    with rich_progress.Progress(
        *columns, console=drawn, transient=True, refresh_per_second=REDRAWS_A_SECOND
    ) as bar:
        task = bar.add_task("", total=None)
        yield lambda steps: bar.update(task, completed=steps)


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
    """Return steps a second, the latest finish percent and the size so far."""
    facts = []
    if speed is not None:
        facts.append(f"{speed / 1e6:.1f}M steps/s" if speed >= 1e6 else f"{speed / 1e3:.0f}k steps/s")
    if progress.evaluations:
        facts.append(f"finish {number(progress.evaluations[-1]['finish_percent'], 0)} %")
    return "  ".join([*facts, size(progress.bytes_written)])


@contextlib.contextmanager
def bytes_line(label: str) -> Iterator[Callable[[int, int], None]]:
    """Give what is told the bytes done and their number: a line of them, where there is a terminal."""
    if not sys.stderr.isatty():
        yield lambda _, __: None
        return
    from rich import progress as rich_progress
    from rich.console import Console

    columns = (
        rich_progress.TextColumn(label, markup=False),
        rich_progress.BarColumn(bar_width=BAR_WIDTH),
        rich_progress.DownloadColumn(),
        rich_progress.TransferSpeedColumn(),
        rich_progress.TimeRemainingColumn(compact=True),
    )
    with rich_progress.Progress(
        *columns, console=Console(stderr=True), transient=True, refresh_per_second=REDRAWS_A_SECOND
    ) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


@contextlib.contextmanager
def counting(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """Give what is called with how many are done: it keeps a line up to date, where there is a terminal."""
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich import progress as rich_progress
    from rich.console import Console

    columns = (
        rich_progress.BarColumn(bar_width=BAR_WIDTH),
        rich_progress.TextColumn(f"{{task.completed:,}} {what}", markup=False),
        rich_progress.TimeRemainingColumn(compact=True),
    )
    with rich_progress.Progress(
        *columns, console=Console(stderr=True), transient=True, refresh_per_second=REDRAWS_A_SECOND
    ) as bar:
        task = bar.add_task("", total=total or None)
        yield lambda done: bar.update(task, completed=done)
