"""The output of the process that records: stdout and stderr by line, of a progress bar its last state.

`Tee` replaces the method `write` of `sys.stdout` and `sys.stderr` while a run is recorded: the stream writes
first, as ever, and its text is kept for the recording. So nothing is swallowed or delayed, and the streams
stay the same objects. What is written to other objects, or by a library in C to the descriptors, is not seen.
"""

from __future__ import annotations

import contextlib
import re
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.machine import Clock
from runner.recording.reader import Recording

STREAMS: Final = ("", "stdout", "stderr")
"""The streams by number; 0 is the recorder's own note."""
MAX_CONSOLE_BYTES: Final = 10 << 20
"""The most text of a run that is recorded."""
_MAX_READ: Final = 4 * MAX_CONSOLE_BYTES
"""The most text that is read; a run that was resumed has more than one session's."""
_LINE_BYTES: Final = 64
"""Counted for each line, so that the number of lines is bounded as well."""
_MAX_COLUMNS: Final = 4096
"""A longer line continues in the next one."""
_MAX_WAITING: Final = 4 << 20
"""The most characters that wait to be taken, with `_LINE_BYTES` for each line; what is beyond is left out."""
_WINDOW: Final = 64
"""How many lines above the last one the cursor can still reach."""
_FIRST_SECONDS: Final = 2.0
"""A line without an end, such as a progress bar, is recorded when it is this old."""
_AGAIN_SECONDS: Final = 10.0
"""A line that changed after it was recorded is recorded again this long after it."""
_MAX_MESSAGE: Final = 1 << 16

_PIECE: Final = re.compile(
    rf"(?P<text>[^\x00-\x08\x0a-\x1f\x7f-\x9f]{{1,{_MAX_COLUMNS}}})"
    r"|\x1b\[(?P<count>\d{0,5})(?P<act>[ABGK])"
    r"|\x1b\[[0-9;?]*[ -/]*[@-~]"  # colours and all else
    r"|\x1b\][^\x07\x1b]*(?:\x07|\x1b\\)?"  # a title or a link
    r"|\x1b[ -/]*[0-~]?"
    r"|[\x00-\x1f\x7f-\x9f]"
)
"""Text without control characters other than tabs, a sequence of the terminal, or a control character."""
_NOTE: Final = f"Console output beyond {MAX_CONSOLE_BYTES >> 20} MB is not recorded."


Stream = Any
"""A text stream, or an object of somebody's own in its place."""
Write = Callable[..., object]
"""A method `write` of a stream."""


class Tee:
    """Keeps what is written to `sys.stdout` and `sys.stderr`, between `start` and `stop`."""

    def __init__(self) -> None:
        self._writes: deque[tuple[float, int, str]] = deque()
        self._waiting = self._left_out = 0
        self._is_on = False
        self._streams: list[tuple[int, Stream]] = []
        self._patched: deque[tuple[Stream, Write | None, Write]] = deque(maxlen=64)
        """Streams, the method that each had as its own attribute (None if it had not), and the one it has."""
        self._local = threading.local()
        self._shell: Any = None

    def start(self) -> None:
        """Keep what is written from now on."""
        self._is_on = True
        both = sys.stderr is not sys.stdout
        self._streams = [(1, sys.stdout), *([(2, sys.stderr)] if both else [])]
        self.patch()
        with contextlib.suppress(Exception):  # IPython replaces the methods as well, in each cell
            self._shell = sys.modules["IPython"].get_ipython()
            self._shell.events.register("pre_execute", self.patch)

    def patch(self) -> None:
        """Replace the methods, also of streams whose methods somebody has replaced since."""
        if self._is_on:
            for number, stream in self._streams:
                with contextlib.suppress(Exception):  # None, or a stream of somebody's own that forbids it
                    before = vars(stream).get("write")
                    if getattr(before, "tee", None) is not self:
                        write = self._writer(number, stream.write)
                        stream.write = write
                        self._patched.append((stream, before, write))

    def _writer(self, number: int, original: Write) -> Write:
        """Return a method `write` that calls the original one, and keeps the text."""
        local = self._local

        def write(text: str, *more: object, **options: object) -> object:
            if getattr(local, "is_writing", False):  # another such method calls this one
                return original(text, *more, **options)
            local.is_writing = True
            try:
                written = original(text, *more, **options)
            finally:
                local.is_writing = False
            if self._is_on and isinstance(text, str):
                size = len(text) + _LINE_BYTES * text.count("\n")
                if self._waiting + size > _MAX_WAITING:
                    self._left_out += len(text)
                else:
                    self._waiting += size
                    self._writes.append((time.monotonic(), number, text))
            return written

        write.tee = self  # type: ignore[attr-defined]
        return write

    def stop(self) -> None:
        """Keep nothing more; give the streams their methods back, unless somebody has replaced them since."""
        self._is_on = False
        if self._shell is not None:
            with contextlib.suppress(Exception):
                self._shell.events.unregister("pre_execute", self.patch)
        for stream, before, write in reversed(self._patched):
            with contextlib.suppress(Exception):
                if vars(stream).get("write") is not write:
                    continue
                if before is None:
                    del stream.write
                else:
                    stream.write = before
        self._patched.clear()

    def take(self) -> list[tuple[float, int, str]]:
        """Return (time of `time.monotonic`, stream, text) of what was written since the last call."""
        writes = [self._writes.popleft() for _ in range(len(self._writes))]
        if left_out := self._left_out:
            note = f"{left_out:,} characters are left out here: too many were printed in a second.\n"
            writes.append((time.monotonic(), 0, note))
        self._waiting = self._left_out = 0
        return writes


@dataclass
class _Row:
    """A line on the screen."""

    begun: float
    text: str = ""
    is_new: bool = True
    """Whether it changed since it was recorded."""
    recorded: float | None = None


class Screen:
    """The lines of one stream: text after a carriage return or a move of the cursor replaces its line."""

    def __init__(self) -> None:
        self._rows: dict[int, _Row] = {}
        self._row = self._last = 0
        self._replaces = False
        """Whether the next text replaces what its line has."""

    def write(self, now: float, text: str) -> None:
        """Show text that was written at some time."""
        for piece in _PIECE.finditer(text):
            act = piece["act"] or piece[0]
            count = int(piece["count"] or 1)
            row = self._rows.setdefault(self._row, _Row(now))
            if piece["text"]:
                line = ("" if self._replaces else row.text) + piece["text"]
                row.text = line[:_MAX_COLUMNS]
                row.is_new = True
                self._replaces = False
                if len(line) > _MAX_COLUMNS:
                    self._move_to(self._row + 1)
                    self._rows[self._row] = _Row(now, line[_MAX_COLUMNS:])
                    self._replaces = False
            elif act == "\n":
                self._move_to(self._row + 1)
            elif act == "A":
                self._move_to(max(self._row - count, self._last - _WINDOW + 1, 0))
            elif act == "B":
                self._move_to(min(self._row + count, self._last))
            elif act in ("\r", "G"):
                self._replaces = True
            elif act == "\b" or (act == "K" and (self._replaces or count == 2)):
                row.text = row.text[:-1] if act == "\b" else ""
                row.is_new = True

    def _move_to(self, row: int) -> None:
        self._row = row
        self._last = max(self._last, row)
        self._replaces = True

    def take(self, now: float, is_last: bool = False) -> Iterator[tuple[float, int, str]]:
        """Yield (when it was begun, number, text) of the lines that are to be recorded now."""
        for number, row in list(self._rows.items()):
            if row.recorded is None:
                due = number < self._last or now - row.begun > _FIRST_SECONDS
            else:
                due = now - row.recorded > _AGAIN_SECONDS
            if (
                row.is_new
                and (due or is_last)
                and (row.text or row.recorded is not None or number < self._last)
            ):
                row.is_new = False
                row.recorded = now
                yield row.begun, number, row.text.expandtabs().rstrip()
            if number <= self._last - _WINDOW and not row.is_new:
                del self._rows[number]


class ConsoleLog:
    """What of the output goes into one recording; `redact` returns a line without secrets."""

    def __init__(self, redact: Callable[[str], str]) -> None:
        self._redact = redact
        self._screens = {number: Screen() for number in range(len(STREAMS))}
        self._bytes = 0
        self.is_full = False
        """Whether nothing more is recorded."""

    def write(self, now: float, stream: int, text: str) -> None:
        """Take in text that was written at some time."""
        if not self.is_full:
            self._screens[stream].write(now, text)

    def take(self, now: float, is_last: bool = False) -> Iterator[tuple[float, dict[str, object]]]:
        """Yield when they were begun, and the fields `stream`, `line` and `text` of the lines to record."""
        if not self.is_full:
            for stream, screen in self._screens.items():
                for begun, line, text in screen.take(now, is_last):
                    encoded = self._redact(text).encode(errors="replace")  # no surrogates
                    self._bytes += len(encoded) + _LINE_BYTES
                    yield begun, {"stream": stream, "line": line, "text": encoded.decode()}
                    if self._bytes > MAX_CONSOLE_BYTES:
                        self.is_full = True
                        yield now, {"line": -1, "text": _NOTE}
                        return


@dataclass(frozen=True)
class ConsoleLine:
    """A line of output."""

    seconds: float
    """When it began, in seconds of the run, as in its clock."""
    position: int
    """The number of steps executed until then; without a clock, until it was recorded."""
    stream: str
    """`stdout`, `stderr`, or empty for a note of the recorder."""
    text: str


def read_console(recording: Recording, clock: Clock | None) -> list[ConsoleLine]:
    """Return the recorded output of a run, in the order in which lines began.

    Raises:
        RecordingError: a line is damaged.
    """
    lines: dict[tuple[float, int, int], ConsoleLine] = {}
    left = _MAX_READ
    for count, fields in enumerate(recording.table(schema.CONSOLE_TOPIC).decoded(max_bytes=_MAX_MESSAGE)):
        number, started, seconds = (fields[name] for name in ("stream", "started", "seconds"))
        if number >= len(STREAMS) or not abs(seconds) < float("inf"):
            raise RecordingError(
                f"{recording.path}: {schema.CONSOLE_TOPIC.name}: found stream {number} after {seconds} s in "
                f"message {count}, expected one of the streams 0 to {len(STREAMS) - 1}."
            )
        left -= len(fields["text"]) + _LINE_BYTES
        if left < 0:
            lines[started, 0, -1] = ConsoleLine(seconds, 0, STREAMS[0], _NOTE)
            break
        position = fields["log_time"] // schema.STEP_NANOSECONDS
        if clock is not None:
            seconds += clock.earlier.get(started, 0.0)
            position = int(np.interp(seconds, clock.seconds, clock.positions))
        line = ConsoleLine(seconds, position, STREAMS[number], fields["text"])
        lines[started, number, fields["line"]] = line
    return sorted(lines.values(), key=lambda line: line.seconds)
