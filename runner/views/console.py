"""`console`: what the process that recorded a run printed."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Final

from runner.analysis.sections import Grid, Section
from runner.util.humanize import counted, duration
from runner.views.view import ReadyAnswer, View, view_input

if TYPE_CHECKING:
    from runner.recording.console import ConsoleLine
    from runner.recording.reader import Recording

_BOTH: Final = "both"
_STREAMS: Final = (_BOTH, "stdout", "stderr")
_NONE: Final = (
    "No output was recorded. What the runner itself prints is never recorded, and nothing is if `console` "
    "is off."
)


def console(
    recording: Recording,
    search: str = view_input(
        "search", "Only lines with this text, in any case.", default="", metavar="TEXT", label="Text"
    ),
    stream: str = view_input(
        "stream",
        "Only lines of stdout, or of stderr.  [default: both]",
        default=_BOTH,
        label="Stream",
        values=_STREAMS,
    ),
    limit: int = view_input(
        "limit",
        "Maximum number of rows, 0 for all.  [default: 1000]",
        kind=int,
        default=1000,
        maximum=10**9,
    ),
) -> ReadyAnswer:
    """Show what the process that recorded RUN printed: the last lines of its output, or of those with a text.

    Each line has the time at which it began and about the number of steps taken until then, interpolated
    between samples of the clock. A progress bar has its last state; 10 MB are recorded.

    Examples:
      dualtaxi console @latest
      dualtaxi console cartpole --search nan
      dualtaxi console cartpole --stream stderr --limit 20
    """
    from runner.recording.console import read_console
    from runner.recording.machine import read_clock

    lines = read_console(recording, read_clock(recording))
    matching = [
        line for line in lines if search.casefold() in line.text.casefold() and stream in (_BOTH, line.stream)
    ]
    shown = matching[-limit:]
    data = {"lines": [asdict(line) for line in shown], "found": len(matching), "total": len(lines)}
    return ReadyAnswer(data, [_table(shown, len(matching), len(lines))])


def _table(lines: list[ConsoleLine], found: int, total: int) -> Section:
    """Return a table of the last lines of those found."""
    if not lines:
        return Section("Output", ["No line was found." if total else _NONE])
    sentence = counted(found, "line")
    if found > len(lines):
        sentence = f"The last {len(lines):,} of {sentence}"
    if found < total:
        sentence += f" found, of {total:,}"
    streams = [line.stream or "note" for line in lines]
    rows = [
        (duration(line.seconds), f"{line.position:,}", stream, line.text)
        for line, stream in zip(lines, streams, strict=True)
    ]
    grid = Grid(("time", "about step", "stream", "output"), rows, streams=streams)
    return Section("Output", [f"{sentence}."], [grid])


VIEW: Final = View(
    "console",
    "Console",
    console,
    button="Search",
    has_default=True,
    is_live=True,
)
