"""The types of arguments and options: how they are parsed, and how they complete."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click
from click.shell_completion import CompletionItem

from runner.errors import RunnerError
from runner.runs.catalogue import columns
from runner.runs.resolve import completions
from runner.runs.run import recordings_folder
from runner.util.values import Json, ranges_in, whole_number

if TYPE_CHECKING:
    from runner.analysis.episodes import EpisodeRef


class Completed(click.ParamType):  # type: ignore[type-arg,unused-ignore]  # generic in newer versions only
    """Text that completes to the names which a function returns, each with an explanation."""

    def __init__(self, name: str, complete: Callable[[click.Context, str], Mapping[str, str]]) -> None:
        self.name = name
        self.complete = complete

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

    def __init__(self, name: str, expected: str, parse: Callable[[str], object]) -> None:
        self.name = name
        self.expected = expected
        self.parse = parse

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> object:
        """Return the parsed value."""
        try:
            return self.parse(value) if isinstance(value, str) else value
        except ValueError:
            self.fail(f"found {value!r}, expected {self.expected}", param, ctx)
        except RunnerError as error:
            self.fail(str(error), param, ctx)


class Number(click.FloatRange):
    """A number between two bounds, a whole one unless another type is named."""

    name = "n"  # in capitals what help shows

    def __init__(
        self, lowest: float, highest: float | None = None, kind: type = int, above: bool = False
    ) -> None:
        super().__init__(lowest, highest, min_open=above)
        self.lowest = lowest
        self.highest = math.inf if highest is None else highest
        self.kind = kind

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number."""
        try:
            number = self.kind(value)
        except ValueError:
            number = math.nan
        is_enough = self.lowest < number if self.min_open else self.lowest <= number
        if not (is_enough and number <= self.highest and number < math.inf):
            kind = "a whole number" if self.kind is int else "a number"
            lowest = f"{'above' if self.min_open else 'from'} {self.lowest}"
            highest = "" if self.max is None else f" to {self.max}"
            self.fail(f"found {value!r}, expected {kind} {lowest}{highest}", param, ctx)
        return number


class RunName(Completed):
    """The name of a run, or of runs by a filter; completes ids and names, and paths after a slash."""

    def __init__(self, or_filter: bool = False) -> None:
        super().__init__("run", _runs)
        self.or_filter = or_filter

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Return ids and names, newest first; without any, the fields of a filter."""
        if "/" in incomplete or "\\" in incomplete:
            return [CompletionItem(incomplete, type="file")]
        names = super().shell_complete(ctx, param, incomplete)
        return names if names or not self.or_filter else FILTER_WORD.shell_complete(ctx, param, incomplete)

    def get_missing_message(self, param: click.Parameter, ctx: click.Context | None) -> str:  # noqa: ARG002
        """Return where names of runs are found."""
        return "`dualtaxi ls` lists the runs; @latest is the newest."


def _runs(ctx: click.Context, incomplete: str) -> Mapping[str, str]:
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

        names = {experiment.name for experiment in shipped().values() if experiment.kind == self.kind}
        completions = [item for item in SHIPPED.shell_complete(ctx, param, incomplete) if item.value in names]
        return [*completions, *super().shell_complete(ctx, param, incomplete)]

    def get_missing_message(self, param: click.Parameter, ctx: click.Context | None) -> str:  # noqa: ARG002
        """Return where names of configurations are found."""
        return f"`dualtaxi config ls` lists the shipped {self.kind}s."


def _shipped(_ctx: click.Context, _incomplete: str) -> Mapping[str, str]:
    from runner.config.shipped import shipped

    return {experiment.name: experiment.about for experiment in shipped().values()}


def expression_text(name: str, words: Mapping[str, str]) -> Completed:
    """Return the type of an expression, which completes the words in it, each with its meaning."""

    def complete(_ctx: click.Context, incomplete: str) -> Mapping[str, str]:
        before = re.sub(r"[\w.]*$", "", incomplete)
        if "status" in words and re.search(r"\bstatus *[!=]= *[\"']$", before):
            return {f"{before}{status}{before[-1]}": "" for status in columns.STATUSES}
        return {before + word: meaning for word, meaning in words.items()}

    return Completed(name, complete)


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


def _pair(text: str, limit: int) -> tuple[int, int]:
    first, _, second = text.partition("x")
    if not 1 <= whole_number(first) <= limit >= whole_number(second) >= 1:
        raise ValueError(text)
    return whole_number(first), whole_number(second)


def _step(text: str) -> EpisodeRef:
    from runner.analysis.episodes import EpisodeRef  # loads NumPy

    return EpisodeRef.parse(text)


def _episode(text: str) -> EpisodeRef:
    """Return the reference to an episode, which names no step of it."""
    try:
        episode = _step(text)
    except RunnerError:
        raise ValueError(text) from None
    if episode.t or episode.word == "step":
        raise ValueError(text)
    return episode


def _trial(text: str) -> EpisodeRef:
    try:
        return _step(f"eval:{text}")
    except RunnerError:
        raise ValueError(text) from None


SHIPPED: Final = Completed("name", _shipped)
SETTING: Final = Completed("setting", _settings)
FILTER_WORD: Final = expression_text(
    "filter",
    {name: field.meaning for name, field in columns.FIELDS.items()}
    | {columns.SETTING: "a value of the configuration, such as config.discount"},
)
EPISODE: Final = Parsed(
    "episode", "N, train:N, eval:N:TRIAL, typical, best, worst or last, without a step", _episode
)
TRIAL: Final = Parsed("N:TRIAL", "N:TRIAL, such as 3000:0", lambda text: _episode(f"eval:{text}"))
TRIAL_FROM_STEP: Final = Parsed("N:TRIAL", "N:TRIAL or N:TRIAL:T, such as 3000:0", _trial)
RANGES: Final = Parsed("ranges", "START..STOP or N, such as 0..20,49980..50000", ranges_in)
NUMBERS: Final = Parsed(
    "numbers", "numbers such as 1000,49000", lambda text: tuple(map(whole_number, text.split(",")))
)
PICTURE_SIZE: Final = Parsed(
    "WxH", "WIDTHxHEIGHT up to 8192x8192, such as 1600x900", lambda text: "{}x{}".format(*_pair(text, 8192))
)
GRID: Final = Parsed("RxC", "ROWSxCOLUMNS up to 8x8, such as 3x3", lambda text: _pair(text, 8))
STEP: Final = Parsed("step", "EPISODE:T, step:N, eval:N:TRIAL:T, typical, best, worst or last", _step)
PATH: Final = click.Path(path_type=Path)
DIRECTORY: Final = click.Path(file_okay=False, path_type=Path)
FILE: Final = click.Path(dir_okay=False, path_type=Path)
COUNT: Final = Number(1)
INDEX: Final = Number(0)
