"""What a view consists of: a function, the inputs that people give it, and words for its page."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, BinaryIO, Final, Literal

from runner.analysis.sections import Answer, Section
from runner.errors import ConfigError, ExitCode

if TYPE_CHECKING:
    from runner.recording.reader import Recording
    from runner.util.values import Json


Given = tuple[tuple[str, object], ...]
"""Inputs of a view by the name of their parameter."""


PAGE: Final = ".html"
"""Ending of a file that has all that the text has."""
Lines = Callable[..., AbstractContextManager[Callable[..., None]]]
"""Takes what is being done; shows until it is left how far that is, and yields a function to report it."""


@contextmanager
def _nothing(*_: object) -> Iterator[Callable[..., None]]:
    yield lambda *_: None


@dataclass(frozen=True)
class ShownProgress:
    """What shows the progress of a computation, and prints notices: a command, else nothing."""

    say: Callable[[str], None] = lambda _: None
    stage: Lines = _nothing
    """The function takes the next stage."""
    steps: Lines = _nothing
    """The function takes the number of steps done."""
    bytes: Lines = _nothing
    """The function takes the bytes done, and all."""
    count: Lines = _nothing
    """Takes the number of all, too; the function takes the number done."""
    episodes: Lines = _nothing
    """Takes the number of all, too; the function takes the progress of a job."""


NO_PROGRESS: Final = ShownProgress()


@dataclass(frozen=True)
class ReadyAnswer(Answer):
    """An answer of parts that were made together."""

    data: Json = field(default_factory=dict)
    text: Iterable[Section] = ()
    file: Callable[[], str] = str
    """Returns the text of the file."""
    contents: str = ""
    limits: Sequence[str] = ()
    lines: Mapping[str, Iterable[str]] = field(default_factory=dict)
    remarks: Iterable[str] = ()
    exit_code: int = ExitCode.OK

    def as_json(self) -> Json:
        """Return the data."""
        return self.data

    def sections(self) -> Iterable[Section]:
        """Return the text."""
        return self.text

    def write(self, stream: BinaryIO) -> None:
        """Write the file."""
        stream.write(self.file().encode(errors="replace"))


@dataclass(frozen=True)
class Input:
    """An input of a view: an option of its command, a parameter of its route, a field of its page."""

    name: str
    """As people write it: `from` is the option `--from` and the parameter `from`."""
    help: str
    kind: type = str
    default: str | float | bool | None = None
    required: bool = False
    metavar: str = ""
    max_length: int = 1000
    """The most characters, or the most values if it is `multiple`."""
    lines: int = 1
    """Height of the field."""
    multiple: bool = False
    """Whether it may be repeated."""
    is_file: bool = False
    """Whether the command takes the path of a file instead of its text."""
    check: Callable[[str], object] | None = None
    """Raises a `RunnerError` if a text is no value of it, so that the command can name its option."""
    minimum: int = 0
    maximum: int | None = None
    label: str = ""
    """Label of the field; empty if the page has none."""
    placeholder: str = ""
    """Hint in an empty field; of one with values, the text for none of them."""
    button: str = ""
    """Text of a button that sends the form with this flag."""
    values: Collection[str] = ()
    """The values that it takes, or what the page calls each of them; empty if it takes others, too."""
    choices: Callable[[Recording], Sequence[str]] | None = None
    """Returns the texts that the field of the page offers, if those are not the values."""


def view_input(name: str, text: str, **attributes: Any) -> Any:
    """Return the default of a parameter that is an `Input`, explained by a text."""
    return Input(name, text, **attributes)


_DEFAULT_ROWS: Final = 1000
_MAX_ROW: Final = 2**62
START: Final = Input("start", "The first row, from 0.", kind=int, default=0, maximum=_MAX_ROW)
STOP: Final = Input(
    "stop",
    f"The first row not included.  [default: {_DEFAULT_ROWS:,} more]",
    kind=int,
    maximum=_MAX_ROW,
)


PHASES: Final = {"train": "training", "eval": "evaluation"}
"""Values of an input, and what pages call them."""
EVERYTHING: Final = view_input("all", "Include everything, not only a selection.", kind=bool, default=False)
ONLY_HERE: Final = view_input("", "")
"""Declares an input that only the command has: the option that commands share under this name."""


def rows_in(start: int, stop: int | None) -> range:
    """Return the numbers of the rows from `START` to `STOP`.

    Raises:
        ConfigError: there cannot be any.
    """
    if stop is not None and stop < start:
        raise ConfigError(f"stop: found {stop:,}, expected a number from {start:,}, the start.")
    return range(start, start + _DEFAULT_ROWS if stop is None else stop)


@dataclass(frozen=True)
class View:
    """A question about recorded runs."""

    name: str
    """Name of the command, such as `sweep show` in a group; last part of the addresses of route and page."""
    title: str
    compute: Callable[..., Any]
    """Takes the subject, the inputs and, if it is slow, `progress`; returns an `Answer`."""
    subject: Literal[
        "recording", "run", "pair", "runs", "any run", "file", "folder", "folders", "sweep", "environment"
    ] = "recording"
    """What the function takes first. Commands and the service have `recording`, an open one; `run`, to read
    files next to its recording (its answers may hold paths, so they are not cached and have no API route);
    `pair` and `runs`, a list of two or more. Commands alone have `any run`, which may lack its recording;
    `file`, a path and its run or None; `folder` and `folders` of runs; `sweep`, a name and its folder of
    runs; and `environment`, an MDP."""
    button: str = ""
    """Text of the button that sends the form; empty if the page has none."""
    lead: str = ""
    """What the page says first."""
    list_title: str = ""
    """Title of the list of the help that the page shows; empty if it shows none."""
    page_values: Given = ()
    """Arguments of the function that a page gives instead of a person."""
    needs: Literal["", "checkpoints", "episodes", "tables", "training"] = ""
    """What a run needs for a tab of this page: checkpoints, an environment, Q-tables, or a training that
    the runner can repeat."""
    rows_per_page: int = 0
    """Rows of each page of a long list, a function with the inputs `START` and `STOP`; else 0."""
    is_live: bool = False
    """Whether the answer changes while the run is running, so that the page loads it again."""
    has_default: bool = False
    """Whether the page has an answer before anything is asked."""
    file_ending: str = ""
    """Ending of the file that the answer can be written as, such as `PAGE`; empty if there is none."""
    file_flags: tuple[str, ...] = ("-o", "--output")
    """The option that takes the file."""
    file_help: str = ""
    """What is in the file, unless it is a page."""
    forms: tuple[str, ...] = ("json", "markdown")
    """The options of the command for other forms than text, see `Answer.lines`."""
    exclusive_spool: bool = False
    """Whether the function writes large temporary files, so that one computation runs at a time."""
    refusal: Callable[[Recording], str] | None = None
    """Returns why no question about a job can be answered, shown instead of the form; empty if some can."""

    @cached_property
    def inputs(self) -> Mapping[str, Input]:
        """The inputs, by the name of their parameter."""
        return {name: default for name, default in self._defaults.items() if isinstance(default, Input)}

    @property
    def shows_progress(self) -> bool:
        """Whether the function shows its progress."""
        return "progress" in self._defaults

    @property
    def is_served(self) -> bool:
        """Whether it has a route or a page."""
        subjects = ("recording", "run", "pair", "runs")
        return self.subject in subjects and ONLY_HERE not in self.inputs.values()

    @property
    def has_tab(self) -> bool:
        """Whether it is a tab on the pages of a run."""
        return self.is_served and self.subject in ("recording", "run")

    @cached_property
    def _defaults(self) -> dict[str, object]:
        return {
            parameter.name: parameter.default
            for parameter in inspect.signature(self.compute).parameters.values()
        }

    @property
    def help(self) -> str:
        """The help of the command."""
        return inspect.getdoc(self.compute) or ""

    @property
    def list_rows(self) -> dict[str, str]:
        """The rows of the list that the page shows: what may be written, and what it means."""
        lines = self.help.partition(f"{self.list_title}:\n")[2].partition("\n\n")[0].splitlines()
        return dict(re.split(" {2,}", line.strip(), maxsplit=1) for line in lines if self.list_title)

    @property
    def words(self) -> dict[str, str]:
        """The names in that list, such as `q` of `q[S, A]`, and their meanings."""
        return {
            word: meaning
            for names, meaning in self.list_rows.items()
            for word in re.findall(r"[\w.]+", names)
            if word.islower() and "." not in word
        }
