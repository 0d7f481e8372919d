"""The family of errors that users can correct.

Each message says what was found, what was expected and what to do next; the command line prints it
without a traceback and exits with `exit_code`.

    RunnerError
    ├── ConfigError          a configuration is not valid (the message has file, line and key)
    ├── EnvironmentNotUsable an environment is unknown, or has no transition table
    ├── CannotRedo           a loop's environment cannot be made again here, or not drawn
    ├── RecordingError       a recording is damaged, of another program, or of an unknown version
    │   ├── OtherVersion     a recording has another version of the format
    │   ├── NotInRecording   a recording has no such episode, evaluation, trial or step
    │   └── CutOff           a recording ends in the middle, as after a killed process
    ├── Diverged             a recording differs from what its job produces
    ├── RunNotFound          no run, or more than one, matches a name
    ├── StorageError         a file or folder cannot be written, or the disk is full
    ├── OutOfResources       the system gives no more memory or open files
    └── MissingExtra         an optional package is not installed
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from enum import IntEnum
from typing import Final, NamedTuple

MAX_MESSAGE: Final = 10_000
"""Maximum characters of an error that are stored with a run."""


class ExitCode(IntEnum):
    """The exit codes of all commands; `dualtaxi --help` lists them with these explanations."""

    explanation: str

    def __new__(cls, code: int, explanation: str) -> ExitCode:
        """Make a code with its explanation."""
        member = int.__new__(cls, code)
        member._value_, member.explanation = code, explanation
        return member

    OK = 0, "success"
    DIFFERENT = 1, "a difference, a problem, a full disk, or a server that does not respond"
    USAGE = 2, "wrong usage or input"
    INTERRUPTED = 130, "interrupted"


class RunnerError(Exception):
    """Base of all errors that a user can correct; commands exit with `exit_code`."""

    exit_code: int = ExitCode.USAGE


class ConfigProblem(NamedTuple):
    """A problem with one value of a configuration; line and column count from 1, or are 0 without a file."""

    path: str
    line: int
    column: int
    message: str


class ConfigError(RunnerError):
    """A configuration is not valid; the message lists every problem, one per line."""

    def __init__(self, message: str, problems: Sequence[ConfigProblem] = ()) -> None:
        super().__init__(message)
        self.problems = tuple(problems)


class EnvironmentNotUsable(RunnerError):
    """An environment is not registered, cannot be made, or has no transition table."""


class CannotRedo(RunnerError):
    """A loop's environment cannot be made again here, or its episodes cannot be repeated or drawn."""


class RecordingError(RunnerError):
    """A recording cannot be read: it is damaged, of another program, or of an unknown version."""


class OtherVersion(RecordingError):
    """A recording has another version of the format than this program reads."""


class NotInRecording(RecordingError):
    """A recording has no such episode, evaluation, trial or step."""


class CutOff(RecordingError):
    """A recording ends in the middle, as after a killed process; everything before is whole."""


class Diverged(RunnerError):
    """A recording differs from what its job produces; the attributes hold the first difference."""

    exit_code = ExitCode.DIFFERENT

    def __init__(
        self,
        topic: str,
        field: str,
        found: object,
        expected: object,
        episode: int | None = None,
        step: int | None = None,
    ) -> None:
        self.topic = topic
        self.field = field
        self.found = found
        self.expected = expected
        self.episode = episode
        self.step = step
        places = (("episode", episode), ("step", step))
        place = "".join(f", {name} {number}" for name, number in places if number is not None)
        super().__init__(f"{topic}{place}: {field}: found {found}, expected {expected}")


class RunNotFound(RunnerError):
    """A name matches no run, or several."""


class StorageError(RunnerError):
    """A file or folder cannot be written, or the disk is full."""

    exit_code = ExitCode.DIFFERENT


class OutOfResources(RunnerError):
    """The system gives this process no more memory, threads or open files."""

    exit_code = ExitCode.DIFFERENT


class MissingExtra(RunnerError):
    """An optional package is not installed; the message says how to install it."""


def full_message(error: BaseException) -> str:
    """Return the message of an error and the notes added to it, a line each."""
    return "\n".join([str(error), *getattr(error, "__notes__", [])])


def nearest(name: str, known: Iterable[str]) -> str:
    """Return ` Did you mean 'x'?` for the known name nearest to `name`, or an empty string."""
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.6)
    return f" Did you mean {close[0]!r}?" if close else ""


def shortened(text: str, limit: int) -> str:
    """Return a text of at most `limit` characters, which ends with an ellipsis if it was longer."""
    return text if len(text) <= limit else f"{text[: limit - 1]}…"


def truncated_message(error: BaseException | str) -> str:
    """Return the message of an error, at most `MAX_MESSAGE` characters of it, to store with a run."""
    return shortened(str(error), MAX_MESSAGE)
