"""The options of `record`, checked."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal, TypedDict

import numpy as np

from runner.config.loading import packing_from
from runner.config.sections import RecordingSection
from runner.errors import ConfigError, nearest
from runner.loops.description import Described
from runner.loops.makers import why_not_certain
from runner.loops.values import warn_user
from runner.recording.maker import EnvironmentMaker
from runner.runs.redaction import redacted_settings
from runner.runs.run import Run
from runner.runs.shards import find_joined
from runner.util.extras import require
from runner.util.jsonable import as_json, as_mapping
from runner.util.values import Json, JsonView, checked_run_name, is_whole

MADE_BY: Final = "runner.record"
ALL_INFO: Final = "*"
"""Among the names of info fields: all of them."""
PACKING: Final = ("compression", "level", "index", "chunk_steps", "code", "system", "console")
_ARGUMENTS: Final = ("recordings", "make", "frames_of", "phase", "autoreset_mode")
"""The other arguments of functions that record: one of them may be meant by a misspelt name."""
_AS_GIVEN: Final = ("name", "frames_every", "frame_format", "shard", "steps", "on_error", "run_id")
_DEFAULT_PACKING: Final = RecordingSection()
Arguments = dict[str, Any]
"""Arguments of a function that records, by name."""
_STEPS: Final = ("all", "actions", "none")


class PackingOptions(TypedDict, total=False):
    """What is recorded of steps and of the code, and how it is packed, as `runner.record` explains."""

    steps: Literal["all", "actions", "none"]
    compression: str
    level: int | None
    index: str
    chunk_steps: int
    code: bool
    system: bool
    console: bool
    run_id: str


class OwnRunOptions(PackingOptions, total=False):
    """The arguments of a process that begins a run."""

    name: str | None
    seed: int | None
    config: object
    on_error: Literal["raise", "warn"]


class _CalledOptions(TypedDict, total=False):
    """The arguments of `runner.record` that need an environment which is called."""

    info: Sequence[str]
    frames_every: int
    frame_format: str


class RunOptions(OwnRunOptions, total=False):
    """The arguments of `runner.record` that serve every way to record."""

    join: Run | str | os.PathLike[str] | Literal[True] | None
    shard: str | None


class RecordOptions(RunOptions, _CalledOptions, total=False):
    """The arguments of `runner.record` that serve every environment which is called."""


class CallbackOptions(OwnRunOptions, _CalledOptions, total=False):
    """The arguments of `runner.record` and `record_vector` that the adapters of libraries take too."""

    frames_of: int | Sequence[int] | None
    make: str | Callable[[], object] | None


@dataclass(frozen=True)
class Options:
    """How a loop is recorded."""

    recordings: str | os.PathLike[str] | None
    seed: int | None
    settings: object
    """The user's own settings as JSON holds them."""
    info: tuple[str, ...]
    name: str | None = None
    frames_every: int = 0
    frame_format: str = "png"
    frames_of: tuple[int, ...] | None = None
    """The environments of a vector that are drawn; None for all."""
    packing: RecordingSection = field(default_factory=RecordingSection)
    join: Run | None = None
    """The run that this process records a shard of."""
    shard: str | None = None
    steps: str = "all"
    """What is recorded of a step: `all`, `actions` or `none`."""
    on_error: str = "raise"
    run_id: str | None = None
    """The id of the run, from `new_run_id`; another one is made if it is taken by then."""

    def __post_init__(self) -> None:
        expectations = (
            ("name", "text", self.name is None or isinstance(self.name, str)),
            (
                "seed",
                "a whole number from 0, or None",
                self.seed is None or is_whole(self.seed, 0, 2**64 - 1),
            ),
            ("info", "names of fields", all(isinstance(name, str) for name in self.info)),
            ("frames_every", "a whole number from 0", is_whole(self.frames_every, 0, 2**31)),
            ("frame_format", "png or jpeg", self.frame_format in ("png", "jpeg")),
            ("steps", "all, actions or none", self.steps in _STEPS),
            ("on_error", "raise or warn", self.on_error in ("raise", "warn")),
        )
        for key, expected, holds in expectations:
            if not holds:
                raise ConfigError(f"{key}: found {getattr(self, key)!r}, expected {expected}")
        checked_run_name(self.name)

    def for_environment(self, maker: EnvironmentMaker) -> Options:
        """Return these options, with whole steps where actions alone are too few and `on_error` is "warn".

        Raises:
            ConfigError: they are too few: the environment may not be made again.
        """
        reason = why_not_certain(maker) if self.steps == "actions" else ""
        if not reason:
            return self
        lost = f"all else would be lost, as the environment cannot be made again for certain: {reason}"
        if self.on_error == "raise":
            raise ConfigError(f'steps: found "actions", expected "all": {lost}.')
        warn_user(f'steps: found "actions", recorded are whole steps: {lost}.')
        return replace(self, steps="all")

    def config(self, described: Described) -> Json:
        """Return the configuration that the recording carries.

        Raises:
            ConfigError: the steps of this environment, or of a shard, cannot be left out.
        """
        if self.steps != "all" and (described.layout.varies or self.join is not None):
            reason = "a shard has whole steps" if self.join else "the environment's values vary in size"
            raise ConfigError(f"steps: found {self.steps!r}, expected all: {reason}.")
        return {
            "name": self.name or described.env_id.rpartition("/")[2].rpartition(":")[2],
            "made_by": MADE_BY,
            "env": {"id": described.env_id, "kwargs": described.kwargs},
            "seeds": [] if self.seed is None else [self.seed],
            "config": self.settings,
            "info": list(self.info),
            "frames": {"every": self.frames_every, "format": self.frame_format}
            | ({} if self.frames_of is None else {"environments": list(self.frames_of)}),
            "recording": self.packing.model_dump(mode="json") | {"steps": self.steps},
        }


def options_of(
    recordings: str | os.PathLike[str] | None,
    given: Mapping[str, object],
    frames_of: tuple[int, ...] | None = None,
    valid: Iterable[str] = RecordOptions.__annotations__,
) -> Options:
    """Return the options for the arguments of `record`.

    Args:
        frames_of: the environments of a vector that are drawn; None for all.
        valid: the names of the arguments that the function has.

    Raises:
        ConfigError: an argument is unknown or cannot be used.
    """
    options: Arguments = dict(given)
    if unknown := sorted(set(options) - {*valid}):
        names = [name for name in valid if name != "run_id"]
        hint = "" if unknown[0] in _ARGUMENTS else nearest(unknown[0], (*names, *_ARGUMENTS))
        raise ConfigError(f"found the argument {unknown[0]!r}, expected one of {', '.join(names)}.{hint}")
    packing: Arguments = {name: options[name] for name in PACKING if name in options}
    if options.get("steps") == "actions":  # an index of messages would take more than they do
        packing = {"index": "chunk"} | packing
    info = options.get("info", ())
    config = options.get("config")
    seed = options.get("seed")
    if isinstance(info, str) and info != ALL_INFO:
        raise ConfigError(f"info: found {info!r}, expected a list of names, such as [{info!r}]")
    try:
        settings = redacted_settings(as_json(settings_in(config)))
        json.dumps(settings, ensure_ascii=False).encode()
    except (RecursionError, ValueError) as error:
        raise ConfigError(
            f"config: found what JSON cannot hold ({error}), expected text, numbers, lists and mappings."
        ) from error
    if options.get("frames_every"):
        pillow()
    join = options.pop("join", None)
    shard = options.get("shard")
    if join is None and shard is not None:
        raise ConfigError(f"shard: found {shard!r} without join, expected the run to join: join=RUN")
    if join is not None and (options.get("name") is not None or seed is not None or settings):
        raise ConfigError(
            "join: found name, seed or config, expected none of them: the run has them already. The process "
            "is named by shard."
        )
    given_as_is = {name: options[name] for name in _AS_GIVEN if name in options}
    return Options(
        recordings=recordings,
        seed=seed.item() if isinstance(seed, np.integer) else seed,
        settings=settings,
        info=tuple(info),
        frames_of=frames_of,
        packing=packing_from(packing) if packing else _DEFAULT_PACKING,
        join=None if join is None else find_joined(join, recordings),
        **given_as_is,
    )


def settings_in(config: object) -> JsonView:
    """Return the user's own settings in a mapping, a dataclass or a namespace; none in None.

    Raises:
        ConfigError: it is something else.
    """
    mapping = as_mapping({} if config is None else config)
    if mapping is None:
        raise ConfigError(
            f"config: found {type(config).__name__}, expected a mapping, a dataclass or a namespace"
        )
    return mapping


def pillow() -> Any:
    """Return the module `PIL.Image`."""
    return require("PIL.Image", extra="plots", purpose="recording frames")
