"""What adapters have in common: the versions of libraries that were tested, arguments, settings."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from typing import Final, Unpack

import numpy as np

from runner.errors import ConfigError
from runner.loops.makers import checked_make
from runner.loops.options import Arguments, CallbackOptions, options_of, settings_in
from runner.loops.values import warn_user
from runner.util.extras import require
from runner.util.values import Json, is_whole

_MAX_TEXT: Final = 1_000
_MAX_DEPTH: Final = 10


def require_tested(module: str, extra: str, tested: tuple[str, str]) -> None:
    """Import the library of an adapter; warn if its version is not one of those that were tested.

    Args:
        module: the library's module, such as `stable_baselines3`.
        extra: the extra of the project that installs it.
        tested: the first and the last version that were tested, such as ("2.6", "2.9"); every version that
            begins with the last one counts.

    Raises:
        MissingExtra: it is not installed.
    """
    version = str(require(module, extra=extra, purpose=f"runner.integrations.{extra}").__version__)
    low, high = (_numbers(text) for text in tested)
    numbers = _numbers(version)
    if numbers[: len(low)] < low or numbers[: len(high)] > high:
        warn_user(
            f"runner.integrations.{extra}: found {module} {version}, tested are {tested[0]} to "
            f"{tested[1]}. Check the first recording."
        )


def _numbers(version: str) -> tuple[int, ...]:
    """Return the numbers that a version begins with."""
    return tuple(map(int, re.findall(r"\d+", re.match(r"[\d.]*", version)[0])))  # type: ignore[index]


class Callback:
    """The arguments of a `Recording` that a library calls back, checked before it does.

    A class of an adapter derives from this first, and from the library's class of callbacks.

    Raises:
        ConfigError: an argument cannot be used.
        MissingExtra: frames need Pillow, which is not installed.
    """

    def __init__(
        self,
        recordings: str | os.PathLike[str] | None = None,
        *,
        checkpoint_every: int = 0,
        **options: Unpack[CallbackOptions],
    ) -> None:
        super().__init__()
        options_of(recordings, options, valid=CallbackOptions.__annotations__)
        if not is_whole(checkpoint_every, 0, 2**62):
            raise ConfigError(f"checkpoint_every: found {checkpoint_every!r}, expected a whole number from 0")
        self._recordings = recordings
        self._checkpoint_every = checkpoint_every
        self._options: Arguments = {name: value for name, value in options.items() if value is not None}
        if make := checked_make(options.get("make")):
            self._options["make"] = make

    def _arguments(self, settings: Json, seed: int | None) -> Arguments:
        """Return the arguments of `runner.record`: those given, and what the library knows."""
        config = {**settings, **settings_in(self._options.get("config"))}
        return {"seed": seed} | self._options | {"config": config}


def as_setting(value: object, depth: int = 0) -> object:
    """Return a library's setting as JSON holds it; what JSON cannot hold, such as a class, by its name."""
    if isinstance(value, int | float | str | np.generic | np.ndarray | None):
        return value
    if isinstance(value, Mapping) and depth < _MAX_DEPTH:
        return {str(key): as_setting(part, depth + 1) for key, part in value.items()}
    if isinstance(value, set | frozenset):
        value = sorted(value, key=repr)
    if isinstance(value, list | tuple) and depth < _MAX_DEPTH:
        return [as_setting(part, depth + 1) for part in value]
    if callable(value):
        return getattr(value, "__qualname__", type(value).__name__)
    text = str(value)
    return type(value).__name__ if " at 0x" in text else text[:_MAX_TEXT]
