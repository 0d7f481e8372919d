"""How a loop is recorded, as its user asked."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from runner.config.loading import packing_from
from runner.config.sections import Recording
from runner.errors import ConfigError
from runner.loops.spaces import Described, as_json, as_mapping
from runner.util.values import is_whole

MADE_BY: Final = "runner.record"
ALL_INFO: Final = "*"
"""Among the names of info fields: all of them."""


@dataclass(frozen=True)
class Plan:
    """What a user asked for."""

    recordings: str | os.PathLike[str] | None = None
    name: str | None = None
    seed: int | None = None
    config: Mapping[Any, Any] = field(default_factory=dict)
    info: tuple[str, ...] = ()
    frames_every: int = 0
    frame_format: str = "png"
    packing: Recording = field(default_factory=Recording)

    def mapping(self, described: Described) -> dict[str, Any]:
        """Return the configuration that the recording carries.

        Raises:
            ConfigError: it cannot be used.
        """
        self._check()
        return {
            "name": self.name or described.env_id.rpartition("/")[2].rpartition(":")[2],
            "made_by": MADE_BY,
            "env": {"id": described.env_id, "kwargs": described.kwargs},
            "seeds": [] if self.seed is None else [self.seed],
            "config": self._settings(),
            "info": list(self.info),
            "frames": {"every": self.frames_every, "format": self.frame_format},
            "recording": self.packing.model_dump(mode="json"),
        }

    def _settings(self) -> Any:
        """Return the user's own settings as JSON holds them."""
        try:
            settings = as_json(self.config)
            json.dumps(settings, ensure_ascii=False).encode()
        except (RecursionError, ValueError) as error:
            raise ConfigError(
                f"config: found what JSON cannot hold ({error}), expected text, numbers, lists and mappings."
            ) from error
        return settings

    def _check(self) -> None:
        from runner.util.values import checked_run_name

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
        )
        for key, expected, holds in expectations:
            if not holds:
                raise ConfigError(f"{key}: found {getattr(self, key)!r}, expected {expected}")
        checked_run_name(self.name)


def plan_of(
    recordings: str | os.PathLike[str] | None,
    name: str | None,
    seed: int | None,
    config: object,
    info: Sequence[str],
    frames_every: int,
    frame_format: str,
    packing: Mapping[str, Any],
) -> Plan:
    """Return the plan for the arguments of `record`.

    Raises:
        ConfigError: there is no such argument, or Pillow is missing for frames.
    """
    given: Any = seed
    known = ("compression", "level", "index", "chunk_steps")
    if unknown := set(packing) - set(known):
        raise ConfigError(f"found the argument {sorted(unknown)[0]!r}, expected one of {', '.join(known)}")
    if isinstance(info, str) and info != ALL_INFO:
        raise ConfigError(f"info: found {info!r}, expected a list of names, such as [{info!r}]")
    settings = as_mapping({} if config is None else config)
    if settings is None:
        raise ConfigError(
            f"config: found {type(config).__name__}, expected a mapping, a dataclass or a namespace"
        )
    if frames_every:
        from runner.loops.frames import pillow

        pillow()
    return Plan(
        recordings=recordings,
        name=name,
        seed=given.item() if isinstance(given, np.integer) else given,
        config=settings,
        info=tuple(info),
        frames_every=frames_every,
        frame_format=frame_format,
        packing=packing_from(packing),
    )
