"""What is typed for arguments and options, and how it completes: runs, trials, ranges of episodes, spots."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import click
from click.shell_completion import CompletionItem

from runner.errors import RunnerError


class RunName(click.ParamType):  # type: ignore[type-arg,unused-ignore]  # generic in newer versions only
    """The name of a run; completes ids and names."""

    name = "run"

    def shell_complete(
        self,
        ctx: click.Context,
        param: click.Parameter,  # noqa: ARG002
        incomplete: str,
    ) -> list[CompletionItem]:
        """Return ids and names that begin so, the newest first; paths, once there is a slash."""
        from runner.runs.resolve import completions
        from runner.runs.run import recordings_folder

        if "/" in incomplete or "\\" in incomplete:
            return [CompletionItem(incomplete, type="file")]
        try:
            found = completions(incomplete, recordings_folder(ctx.params.get("recordings")))
        except RunnerError:
            return []
        return [CompletionItem(name, help=text) for name, text in found.items()]


class ShippedName(click.ParamType):  # type: ignore[type-arg,unused-ignore]  # generic in newer versions only
    """The name of a shipped experiment or sweep."""

    name = "name"

    def shell_complete(
        self,
        ctx: click.Context,  # noqa: ARG002
        param: click.Parameter,  # noqa: ARG002
        incomplete: str,
    ) -> list[CompletionItem]:
        """Return the names that begin so."""
        from runner.config.shipped import shipped

        return [
            CompletionItem(each.name, help=each.about)
            for each in shipped().values()
            if each.name.startswith(incomplete)
        ]


class FilterWord(click.ParamType):  # type: ignore[type-arg,unused-ignore]  # generic in newer versions only
    """A word of a filter such as `status:finished`; completes fields and statuses."""

    name = "filter"

    def shell_complete(
        self,
        ctx: click.Context,  # noqa: ARG002
        param: click.Parameter,  # noqa: ARG002
        incomplete: str,
    ) -> list[CompletionItem]:
        """Return the fields that begin so, each with its colon; after `status:` the statuses."""
        from runner.runs.catalogue.columns import FIELDS, SETTING, STATUSES

        words = {f"{name}:": field.meaning for name, field in FIELDS.items()}
        words[SETTING] = "a value of the configuration, such as config.discount"
        if incomplete.startswith("status:"):
            words = {f"status:{status}": "" for status in STATUSES}
        return [
            CompletionItem(word, help=text) for word, text in words.items() if word.startswith(incomplete)
        ]


class Setting(click.ParamType):  # type: ignore[type-arg,unused-ignore]  # generic in newer versions only
    """`KEY=VALUE` of a configuration; completes the keys."""

    name = "setting"

    def shell_complete(
        self,
        ctx: click.Context,  # noqa: ARG002
        param: click.Parameter,  # noqa: ARG002
        incomplete: str,
    ) -> list[CompletionItem]:
        """Return the keys that begin so, each with its equals sign."""
        from runner.config import json_schema

        keys = _keys(json_schema())
        return [
            CompletionItem(f"{key}=", help=text) for key, text in keys.items() if key.startswith(incomplete)
        ]


def _keys(schema: dict[str, Any], part: dict[str, Any] | None = None, prefix: str = "") -> dict[str, str]:
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


class ConfigName(click.Path):
    """A file, or the name of a shipped experiment; completes both.

    Args:
        kind: which shipped ones are completed: `experiment` or `sweep`.
    """

    def __init__(self, kind: str = "experiment") -> None:
        super().__init__(path_type=Path)
        self.kind = kind

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Return the shipped names that begin so, and have the shell add files."""
        from runner.config.shipped import shipped

        kinds = {each.name: each.kind for each in shipped().values()}
        names = ShippedName().shell_complete(ctx, param, incomplete)
        own = [item for item in names if kinds[item.value] == self.kind]
        return [*own, *super().shell_complete(ctx, param, incomplete)]


class _Numbers(click.ParamType):  # type: ignore[type-arg,unused-ignore]  # generic in newer versions only
    """Numbers written in one text."""

    expected: ClassVar[str]
    """How they are written."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[Any, ...]:
        """Return the numbers in a text."""
        try:
            return self.parsed(value)
        except ValueError:
            self.fail(f"found {value!r}, expected {self.expected}", param, ctx)

    def parsed(self, text: str) -> tuple[Any, ...]:
        """Return the numbers in a text.

        Raises:
            ValueError: it is not written as it should be.
        """
        raise NotImplementedError


def _number(text: str) -> int:
    """Return a number from 0; `int` would take signs, blanks and underscores."""
    if not text.isdecimal():
        raise ValueError(text)
    return int(text)


class TrialName(_Numbers):
    """`N:TRIAL`, a trial of the evaluation after N training episodes."""

    name = "N:TRIAL"
    expected = "N:TRIAL, such as 3000:0"

    def parsed(self, text: str) -> tuple[int, int]:
        """Return both numbers; the first trial, if none is said."""
        after, colon, trial = text.partition(":")
        return _number(after), _number(trial) if colon else 0


class EpisodeRanges(_Numbers):
    """`0:20,49980:50000`: ranges of episodes; a single number is that episode."""

    name = "ranges"
    expected = "START:STOP or N, such as 0:20,49980:50000"

    def parsed(self, text: str) -> tuple[tuple[int, int | None], ...]:
        """Return (start, stop) of each range; an open end is None."""
        return tuple(self._range(part.strip()) for part in text.split(","))

    def _range(self, text: str) -> tuple[int, int | None]:
        start, colon, stop = text.partition(":")
        first = 0 if colon and not start else _number(start)
        if not colon:
            return first, first + 1
        return first, _number(stop) if stop else None


class NumberList(_Numbers):
    """Numbers parted by commas."""

    name = "numbers"
    expected = "numbers such as 1000,49000"

    def parsed(self, text: str) -> tuple[int, ...]:
        """Return the numbers."""
        return tuple(_number(part.strip()) for part in text.split(","))


class PictureSize(click.ParamType):  # type: ignore[type-arg,unused-ignore]  # generic in newer versions only
    """`WxH`, the width and height of a picture in pixels."""

    name = "WxH"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Return the size as the viewer takes it."""
        width, _, height = str(value).partition("x")
        if not (width.isdecimal() and height.isdecimal() and 1 <= int(width) <= 8192 >= int(height) >= 1):
            self.fail(f"found {value!r}, expected WIDTHxHEIGHT up to 8192x8192, such as 1600x900", param, ctx)
        return str(value)


class StepReference(click.ParamType):  # type: ignore[type-arg,unused-ignore]  # generic in newer versions only
    """A step of an episode: `EPISODE:T`, or `eval:N:TRIAL:T`."""

    name = "step"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, ...]:
        """Return (episode, t) or (N, trial, t)."""
        from runner.analysis.step_reference import parse_step_reference

        try:
            return parse_step_reference(value)
        except RunnerError as error:
            self.fail(str(error), param, ctx)
