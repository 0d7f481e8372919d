"""Progress lines on a terminal's stderr, which disappear at the end; elsewhere a line a minute."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Final

from runner.cli.output import console, say
from runner.util.humanize import number, size

if TYPE_CHECKING:
    from runner.execution.session import Progress

REDRAWS_PER_SECOND: Final = 5
BAR_WIDTH: Final = 12
"""Leaves space at the edge: the terminal's echo of Ctrl-C would break a full line and leave it there."""

LINE_SECONDS: Final = 60.0
"""How often a line is printed where stderr is no terminal, so that a log shows that work goes on."""

_BAR: Final = "bar"
_SPINNER: Final = "spinner"
_LABEL: Final = "{task.description}"
"""The label, which is no part of a format string: it may name a file with braces."""
_DRAWN: Final = (_BAR, _SPINNER, "speed", "left", "elapsed")
"""Columns that need a terminal."""


@contextlib.contextmanager
def progress_line(label: str, episodes: int) -> Iterator[Callable[[Progress], None]]:
    """Yield the function that a job reports its progress to."""
    first: list[tuple[float, int]] = []  # when new steps began, and the steps then

    def report(progress: Progress) -> None:
        now = time.monotonic()
        steps = progress.train_steps + progress.eval_steps
        if not first or steps == first[0][1]:  # of a resumed run: while what is recorded is retrained
            first[:] = [(now, steps)]
        seconds = now - first[0][0]
        speed = (steps - first[0][1]) / seconds if seconds else None
        update(completed=progress.episode, facts=progress_facts(progress, speed))

    columns = [_LABEL, _BAR, "{task.completed:,}/{task.total:,}", "{task.fields[facts]}", "left"]
    with _line(label, columns if label else columns[1:], total=episodes, facts="") as update:
        yield report


@contextlib.contextmanager
def steps_line(label: str) -> Iterator[Callable[[int], None]]:
    """Yield a function that is called with the number of steps done."""
    with _line(label, [_SPINNER, _LABEL, "{task.completed:,} steps"]) as update:
        yield lambda steps: update(completed=steps)


@contextlib.contextmanager
def stage_line(stage: str) -> Iterator[Callable[[str], None]]:
    """Show what is being done and for how long; yield a function that is called with the next stage."""
    with _line(stage, [_SPINNER, _LABEL, "elapsed"]) as update:
        yield lambda text: update(description=text, refresh=True)


@contextlib.contextmanager
def bytes_line(label: str) -> Iterator[Callable[[int, int], None]]:
    """Yield a function that is called with the bytes done and their total."""
    with _line(label, [_LABEL, _BAR, "bytes", "speed", "left"]) as update:
        yield lambda done, total: update(completed=done, total=total)


@contextlib.contextmanager
def count_line(what: str, total: int) -> Iterator[Callable[[int], None]]:
    """Yield a function that is called with the number done."""
    of_all = " of {task.total:,}" if total else ""
    with _line("", [_BAR, f"{{task.completed:,}}{of_all} {what}", "left"], total=total or None) as update:
        yield lambda done: update(completed=done)


@contextlib.contextmanager
def total_line() -> Iterator[Callable[[int, int, str], None]]:
    """Yield a function that is called with the number done, the total so far, and what is counted."""
    columns = [_BAR, "{task.completed:,}/{task.total:,} {task.fields[what]}", "left"]
    with _line("", columns, total=0, what="") as update:
        yield lambda done, total, what: update(completed=done, total=total, what=what)


@contextlib.contextmanager
def _line(
    label: str, names: list[str], total: float | None = None, **fields: Any
) -> Iterator[Callable[..., None]]:
    """Yield the function that updates a line of columns; without a terminal, prints it now and then.

    The columns are names of the table below, or format strings, which use the label and the fields; `total`
    is None if it is unknown.
    """
    if not sys.stderr.isatty():
        yield _plain_line(names, description=label, total=total, **fields)
        return
    from rich import progress

    columns = {
        _BAR: progress.BarColumn(bar_width=BAR_WIDTH),
        _SPINNER: progress.SpinnerColumn(),
        "bytes": progress.DownloadColumn(),
        "speed": progress.TransferSpeedColumn(),
        "left": progress.TimeRemainingColumn(compact=True),
        "elapsed": progress.TimeElapsedColumn(),
    }
    with progress.Progress(
        *(columns.get(name) or progress.TextColumn(name, markup=False) for name in names),
        console=console(stderr=True),
        transient=True,
        refresh_per_second=REDRAWS_PER_SECOND,
    ) as line:
        yield partial(line.update, line.add_task(label, total=total, **fields))


def _plain_line(names: list[str], **values: Any) -> Callable[..., None]:
    """Return the function that updates a line which is printed now and then, as text."""
    task = SimpleNamespace(completed=0, **values, fields=values)
    texts = {"bytes": "{task.completed:,} of {task.total:,} bytes", **dict.fromkeys(_DRAWN, "")}
    template = "  ".join(filter(None, (texts.get(name, name) for name in names)))
    print_seldom = seldom(lambda: say(template.format(task=task)))

    def update(**values: Any) -> None:
        vars(task).update(values)
        task.fields.update(values)
        print_seldom()

    return update


def seldom(function: Callable[..., None]) -> Callable[..., None]:
    """Return a function that calls another one at most every `LINE_SECONDS`, and not at once."""
    due = time.monotonic() + LINE_SECONDS

    def call(*values: object) -> None:
        nonlocal due
        if time.monotonic() >= due:
            due = time.monotonic() + LINE_SECONDS
            function(*values)

    return call


def progress_facts(progress: Progress, speed: float | None) -> str:
    """Return steps per second, the latest success rate and the size so far."""
    parts = []
    if speed is not None:
        parts.append(f"{speed / 1e6:.1f}M steps/s" if speed >= 1e6 else f"{speed / 1e3:.0f}k steps/s")
    if progress.evaluations:
        parts.append(f"success {number(progress.evaluations[-1]['success_percent'], 0)} %")
    return "  ".join([*parts, size(progress.bytes_written)])
