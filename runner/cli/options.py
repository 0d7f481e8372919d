"""The types of arguments and options, how they complete, and those that several commands share."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click
from click.shell_completion import CompletionItem

from runner.errors import RunnerError
from runner.util.values import Json

if TYPE_CHECKING:
    from runner.analysis.axes import Axis
    from runner.analysis.step_reference import StepRef

EXPORTS: Final = Path("exports")
"""Where commands write files by default; Git ignores it in a clone."""

Decorator = Callable[[Callable[..., Any]], Any]
Ranges = tuple[tuple[int, int | None], ...]
"""Ranges of episodes: the first, and the one after the last or None."""

# --- types ------------------------------------------------------------------------------------------------


class Completed(click.ParamType):  # type: ignore[type-arg,unused-ignore]  # generic in newer versions only
    """Text that completes to the names which a function returns, each with an explanation."""

    def __init__(self, name: str, complete: Callable[[click.Context, str], Mapping[str, str]]) -> None:
        self.name, self.complete = name, complete

    def shell_complete(
        self,
        ctx: click.Context,
        param: click.Parameter,  # noqa: ARG002
        incomplete: str,
    ) -> list[CompletionItem]:
        """Return the names that begin with the incomplete word."""
        names = self.complete(ctx, incomplete)
        return [
            CompletionItem(name, help=text) for name, text in names.items() if name.startswith(incomplete)
        ]


class Parsed(click.ParamType):  # type: ignore[type-arg,unused-ignore]  # generic in newer versions only
    """Text that a function parses; the function raises ValueError or RunnerError."""

    def __init__(self, name: str, expected: str, parse: Callable[[str], Any]) -> None:
        self.name, self.expected, self.parse = name, expected, parse

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the parsed value."""
        try:
            return self.parse(value) if isinstance(value, str) else value
        except ValueError:
            self.fail(f"found {value!r}, expected {self.expected}", param, ctx)
        except RunnerError as error:
            self.fail(str(error), param, ctx)


class RunName(Completed):
    """The name of a run; completes ids and names, and paths after a slash."""

    def __init__(self) -> None:
        super().__init__("run", _runs)

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Return ids and names, newest first."""
        if "/" in incomplete or "\\" in incomplete:
            return [CompletionItem(incomplete, type="file")]
        return super().shell_complete(ctx, param, incomplete)


def _runs(ctx: click.Context, incomplete: str) -> Mapping[str, str]:
    from runner.runs.resolve import completions
    from runner.runs.run import recordings_folder

    try:
        return completions(incomplete, recordings_folder(ctx.params.get("recordings")))
    except RunnerError:
        return {}


class ConfigName(click.Path):
    """A file, or the name of a shipped `experiment` or `sweep`; completes both."""

    def __init__(self, kind: str = "experiment") -> None:
        super().__init__(path_type=Path)
        self.kind = kind

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Return the shipped names, and have the shell add files."""
        from runner.config.shipped import shipped

        names = {each.name for each in shipped().values() if each.kind == self.kind}
        own = [item for item in SHIPPED.shell_complete(ctx, param, incomplete) if item.value in names]
        return [*own, *super().shell_complete(ctx, param, incomplete)]


def _shipped(_ctx: click.Context, _incomplete: str) -> Mapping[str, str]:
    from runner.config.shipped import shipped

    return {each.name: each.about for each in shipped().values()}


def _filter_words(_ctx: click.Context, incomplete: str) -> Mapping[str, str]:
    from runner.runs.catalogue.columns import FIELDS, SETTING, STATUSES

    if incomplete.startswith("status:"):
        return {f"status:{status}": "" for status in STATUSES}
    words = {f"{name}:": field.meaning for name, field in FIELDS.items()}
    return words | {SETTING: "a value of the configuration, such as config.discount"}


def _settings(_ctx: click.Context, _incomplete: str) -> Mapping[str, str]:
    from runner.config import json_schema

    return {f"{key}=": text for key, text in _keys(json_schema()).items()}


def _keys(schema: Json, part: Json | None = None, prefix: str = "") -> dict[str, str]:
    """Return the paths of a schema's values, sections included, and what each means."""
    keys = {}
    for name, value in (schema if part is None else part).get("properties", {}).items():
        path = f"{prefix}{name}"
        keys[path] = str(value.get("description", ""))
        for kind in (value, *value.get("anyOf", ())):
            if reference := kind.get("$ref"):
                section = schema["$defs"][reference.rpartition("/")[2]]
                keys |= _keys(schema, section, f"{path}.")
    return keys


def _number(text: str) -> int:
    """Return a number from 0; `int` would accept signs, blanks and underscores."""
    if not text.strip().isdecimal():
        raise ValueError(text)
    return int(text)


def _trial(text: str) -> tuple[int, int]:
    after, colon, trial = text.partition(":")
    return _number(after), _number(trial) if colon else 0


def _ranges(text: str) -> Ranges:
    ranges = []
    for part in text.split(","):
        start, colon, stop = part.strip().partition(":")
        first = 0 if colon and not start else _number(start)
        end = first + 1 if not colon else _number(stop) if stop else None
        ranges.append((first, end))
    return tuple(ranges)


def _pair(text: str, limit: int) -> tuple[int, int]:
    first, _, second = text.partition("x")
    if not 1 <= _number(first) <= limit >= _number(second) >= 1:
        raise ValueError(text)
    return _number(first), _number(second)


def _step(text: str) -> StepRef:
    from runner.analysis.step_reference import StepRef

    return StepRef.parse(text)


def _place(text: str) -> int | StepRef:
    from runner.analysis.step_reference import parse_step

    return parse_step(text)


def _target(text: str) -> tuple[str, float]:
    from runner.analysis.series import parse_target  # loads NumPy

    return parse_target(text)


def _axis(text: str) -> Axis:
    from runner.analysis.axes import axis_of  # loads NumPy

    return axis_of(text)


SHIPPED: Final = Completed("name", _shipped)
SETTING: Final = Completed("setting", _settings)
FILTER_WORD: Final = Completed("filter", _filter_words)
TRIAL: Final = Parsed("N:TRIAL", "N:TRIAL, such as 3000:0", _trial)
RANGES: Final = Parsed("ranges", "START:STOP or N, such as 0:20,49980:50000", _ranges)
NUMBERS: Final = Parsed(
    "numbers", "numbers such as 1000,49000", lambda text: tuple(map(_number, text.split(",")))
)
PICTURE_SIZE: Final = Parsed(
    "WxH", "WIDTHxHEIGHT up to 8192x8192, such as 1600x900", lambda text: "{}x{}".format(*_pair(text, 8192))
)
GRID: Final = Parsed("RxC", "ROWSxCOLUMNS up to 8x8, such as 3x3", lambda text: _pair(text, 8))
TARGET: Final = Parsed("METRIC=LEVEL", "METRIC=LEVEL such as success_percent=80", _target)
AXIS: Final = Parsed("axis", "episodes, steps, updates or time", _axis)
STEP: Final = Parsed("step", "EPISODE:T, or eval:N:TRIAL:T", _step)
PLACE: Final = Parsed("step", "EPISODE:T, the number of a training step, or eval:N:TRIAL:T", _place)
DIRECTORY: Final = click.Path(file_okay=False, path_type=Path)
FILE: Final = click.Path(dir_okay=False, path_type=Path)
COUNT: Final = click.IntRange(1)
INDEX: Final = click.IntRange(0)

# --- arguments --------------------------------------------------------------------------------------------

run_argument: Final = click.argument("run_name", metavar="RUN", type=RunName())
runs_argument: Final = click.argument("run_names", metavar="RUN...", nargs=-1, required=True, type=RunName())
config_argument: Final = click.argument("config", metavar="CONFIG", type=ConfigName())
filter_argument: Final = click.argument("words", metavar="[FILTER]...", nargs=-1, type=FILTER_WORD)

# --- options ----------------------------------------------------------------------------------------------

recordings_option: Final = click.option(
    "--recordings",
    type=DIRECTORY,
    metavar="DIR",
    help="The folder of runs.  [default: $DUALTAXI_RECORDINGS, or ./recordings]",
)


def _folders(_ctx: click.Context, _param: click.Parameter, value: tuple[Path, ...]) -> tuple[Path, ...]:
    from runner.runs.run import recordings_folder

    return value or (recordings_folder(),)


folders_option: Final = click.option(
    "--recordings",
    type=DIRECTORY,
    metavar="DIR",
    multiple=True,
    callback=_folders,
    help="A folder of runs; may be repeated.  [default: $DUALTAXI_RECORDINGS, or ./recordings]",
)
set_option: Final = click.option(
    "--set",
    "overrides",
    multiple=True,
    type=SETTING,
    metavar="KEY=VALUE",
    help="Override a value of the configuration, such as evaluation.trials=50; may be repeated.",
)
json_option: Final = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
markdown_option: Final = click.option("--markdown", "as_markdown", is_flag=True, help="Print Markdown.")
html_option: Final = click.option(
    "--html", type=click.Path(path_type=Path), metavar="FILE", help="Write an HTML page instead."
)
force_option: Final = click.option("--force", is_flag=True, help="Replace existing output.")
accept_changes_option: Final = click.option(
    "--accept-changes",
    is_flag=True,
    help="Resume although code, environment, file or numerical libraries have changed.",
)


def _trusted(_context: click.Context, _option: click.Parameter, value: bool) -> bool:
    """Find modules in the current folder too, as Python does for a script there."""
    if value and str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))
    return value


trust_option: Final = click.option(
    "--trust",
    is_flag=True,
    callback=_trusted,
    help="Import what the recording names, also from the current folder: run code that you trust only.",
)
checkpoint_option: Final = click.option(
    "--checkpoint", metavar="[NAME]@STEP", help="The last checkpoint at or before this step, of this name."
)
policy_option: Final = click.option(
    "--policy", metavar="MODULE:FUNCTION", help="Your function that makes a policy of a checkpoint."
)
axis_option: Final = click.option(
    "--axis",
    type=AXIS,
    default="episodes",
    show_default=True,
    metavar="episodes|steps|updates|time",
    help="Read metrics over training episodes, training steps, updates as a loop logged them, or wall time.",
)
normalise_option: Final = click.option(
    "--normalise",
    metavar="FILE|minmax",
    help="Compare over environments, by a table of random and expert scores, or the worst and best values.",
)
all_option: Final = click.option(
    "--all", "everything", is_flag=True, help="Include everything, not only a selection."
)
episode_option: Final = click.option(
    "--episode", type=INDEX, metavar="N", help="A training episode, counted from 0."
)
episodes_option: Final = click.option(
    "--episodes", type=RANGES, metavar="RANGES", help="Episodes, such as 0:20,49980:50000."
)
trial_option: Final = click.option(
    "--eval",
    "trial",
    type=TRIAL,
    metavar="N:TRIAL",
    help="A trial, counted from 0, of the evaluation after N training episodes.",
)
best_option: Final = click.option("--best", is_flag=True, help="The episode of the highest return.")
worst_option: Final = click.option("--worst", is_flag=True, help="The episode of the lowest return.")


def require_one_choice(**choices: object) -> None:
    """Refuse options that exclude each other, given by name; None and False are not given.

    Raises:
        UsageError: there is more than one.
    """
    given = [f"--{name}" for name, value in choices.items() if value is not None and value is not False]
    if len(given) > 1:
        raise click.UsageError(f"{' and '.join(given[:2])} exclude each other: choose one.")


def output_option(default: Path | str, metavar: str = "FILE") -> Decorator:
    """Return the option -o, with a default path, or a text that describes the default."""
    kind = "file" if metavar.startswith("FILE") else "folder"
    return click.option(
        "-o",
        "--output",
        type=click.Path(path_type=Path),
        default=default if isinstance(default, Path) else None,
        metavar=metavar,
        help=f"The {kind} to write.  [default: {default}]",
    )


def writing_options(default: Path | str, metavar: str = "FILE") -> Decorator:
    """Return the options of a command that writes files made from runs; arguments as for `output_option`."""

    def add(command: Callable[..., Any]) -> Callable[..., Any]:
        for option in (json_option, recordings_option, force_option, output_option(default, metavar)):
            command = option(command)
        return command

    return add


def limit_option(default: int | str) -> Decorator:
    """Return the option --limit, with a default number of rows, or a text that describes the default."""
    return click.option(
        "--limit",
        type=INDEX,
        default=default if isinstance(default, int) else None,
        metavar="N",
        help=f"Maximum number of rows, 0 for all.  [default: {default}]",
    )


def workers_option(default: int | str) -> Decorator:
    """Return the option --workers, with a default number, or a text that describes the default."""
    return click.option(
        "--workers",
        type=click.IntRange(1, 1024),
        default=default if isinstance(default, int) else None,
        metavar="N",
        help=f"Number of runs to do in parallel.  [default: {default}]",
    )


ray_option: Final = click.option(
    "--ray",
    is_flag=False,
    flag_value="",
    metavar="[ADDRESS]",
    help="Run on Ray: on the cluster at ADDRESS, or on this machine.",
)


def target_option(multiple: bool) -> Decorator:
    """Return the option --target: a level of a metric; runs are compared when they first reach it."""
    return click.option(
        "--target",
        "targets" if multiple else "target",
        multiple=multiple,
        metavar="METRIC=LEVEL",
        type=TARGET,
        help="Compare when this level is first reached, such as success_percent=80"
        + ("; may be repeated." if multiple else "."),
    )


def selection_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that select the steps to export."""
    for option in (
        trust_option,
        click.option(
            "--frames",
            is_flag=True,
            help="Draw pictures of a loop's selected episodes, by its environment, which is made again.",
        ),
        all_option,
        click.option("--every", type=COUNT, metavar="N", help="Every Nth training episode."),
        click.option(
            "--evaluations",
            type=NUMBERS,
            metavar="N[,N]",
            help="The trials of the evaluations after N training episodes.",
        ),
        episodes_option,
    ):
        command = option(command)
    return command
