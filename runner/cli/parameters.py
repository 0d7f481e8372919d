"""What is typed for arguments and options, and how it completes: runs, trials, ranges of episodes, spots."""

from __future__ import annotations

from typing import Any

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
        """Return the ids and names that begin so, the newest first; paths, once there is a slash."""
        from runner.catalogue.finding import candidates
        from runner.runs import recordings_folder

        if "/" in incomplete or "\\" in incomplete:
            return [CompletionItem(incomplete, type="file")]
        try:
            runs = candidates(recordings_folder(ctx.params.get("recordings")))
        except RunnerError:
            return []
        found = {"@latest": "the newest run"} if runs else {}
        found |= {run.run_id: f"{run.name}, seed {run.seed}" for run in runs}
        names = [run.name for run in runs]
        found |= {name: "the run of this name" for name in names if names.count(name) == 1}
        found |= {f"{name}@latest": "the newest of this name" for name in names if names.count(name) > 1}
        return [
            CompletionItem(name, help=text) for name, text in found.items() if name.startswith(incomplete)
        ]


class TrialName(click.ParamType):  # type: ignore[type-arg,unused-ignore]  # generic in newer versions only
    """`N:TRIAL`, a trial of the evaluation after N training episodes."""

    name = "N:TRIAL"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int]:
        """Return both numbers."""
        if isinstance(value, tuple):
            return value
        after, colon, trial = value.partition(":")
        if not after.isdecimal() or (colon and not trial.isdecimal()):
            self.fail(f"found {value!r}, expected N:TRIAL, such as 3000:0", param, ctx)
        return int(after), int(trial or 0)


class EpisodeRanges(click.ParamType):  # type: ignore[type-arg,unused-ignore]  # generic in newer versions only
    """`0:20,49980:50000`: ranges of episodes; a single number is that episode."""

    name = "ranges"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[tuple[int, int | None], ...]:
        """Return (start, stop) of each range; an open end is None."""
        if isinstance(value, tuple):
            return value
        return tuple(self._range(part.strip(), param, ctx) for part in value.split(","))

    def _range(
        self, text: str, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int | None]:
        start, colon, stop = text.partition(":")
        known = all(number == "" or number.isdecimal() for number in (start, stop))
        if not known or not (start or colon):
            self.fail(f"found {text!r}, expected START:STOP or N, such as 0:20,49980:50000", param, ctx)
        first = int(start or 0)
        return first, (int(stop) if stop else None) if colon else first + 1


class Numbers(click.ParamType):  # type: ignore[type-arg,unused-ignore]  # generic in newer versions only
    """Numbers parted by commas."""

    name = "numbers"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, ...]:
        """Return the numbers."""
        if isinstance(value, tuple):
            return value
        parts = [part.strip() for part in value.split(",")]
        if not all(part.isdecimal() for part in parts):
            self.fail(f"found {value!r}, expected numbers such as 1000,49000", param, ctx)
        return tuple(int(part) for part in parts)


class SpotName(click.ParamType):  # type: ignore[type-arg,unused-ignore]  # generic in newer versions only
    """`EPISODE:T`, or `eval:N:TRIAL:T`."""

    name = "spot"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, ...]:
        """Return (episode, t) or (N, trial, t)."""
        if isinstance(value, tuple):
            return value
        parts = value.removeprefix("eval:").split(":")
        wanted = 3 if value.startswith("eval:") else 2
        if not 1 <= len(parts) <= wanted or not all(part.isdecimal() for part in parts):
            self.fail(f"found {value!r}, expected EPISODE:T such as 120:5, or eval:N:TRIAL:T", param, ctx)
        return tuple(int(part) for part in parts) + (0,) * (wanted - len(parts))
