"""What adapters have in common: tested versions, arguments, settings, environments made in workers."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final, Self, Unpack

import numpy as np

from runner.errors import ConfigError
from runner.loops.env import record
from runner.loops.makers import checked_make
from runner.loops.options import Arguments, CallbackOptions, RecordOptions, options_of, settings_in
from runner.loops.recorded import Recorded
from runner.loops.values import warn_user
from runner.runs.run import Run
from runner.util.extras import require
from runner.util.values import Json, is_whole

OF_THE_RUN: Final = ("name", "seed", "config", "run_id")
"""The arguments of `runner.record` that a process which joins a run does not give."""
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


class Workers:
    """Records the environments that a library makes by a function, in this process or in others, as one run.

    `train` makes an environment that joins the run: give it to the library in the place of the function.
    `recorded` is what `runner.record` returns, for `log` and `checkpoint`; it takes no steps. Close the
    workers, then this; it is a context manager.

    Args:
        make: makes an environment; it has to be sent to the workers, as without recording.
        recordings: as for `runner.record`.
        options: the others of `runner.record`.

    Raises:
        ConfigError: an argument cannot be used.
        EnvironmentNotUsable: a space cannot be recorded.
        StorageError: the recordings folder cannot be written.
    """

    record: Callable[..., Any] = staticmethod(record)
    """Records an environment of the library, with the arguments of `runner.record`."""

    def __init__(
        self,
        make: Callable[[], Any],
        recordings: str | os.PathLike[str] | None = None,
        **options: Unpack[RecordOptions],
    ) -> None:
        self._env = self.record(make(), recordings, **options)  # it may close itself when it is collected
        self.recorded = self.inside(self._env)
        shared = {name: value for name, value in options.items() if name not in OF_THE_RUN}
        self.train = partial(_made, self.record, make, join=self.run, **shared)

    @staticmethod
    def inside(env: Any) -> Recorded:
        """Return the recorded environment inside of one of the library."""
        return env  # type: ignore[no-any-return]

    @property
    def run(self) -> Run:
        """The run; it has a `summary` once it is closed."""
        return self.recorded.run

    def close(self) -> None:
        """Put together what the workers recorded, and close the run as finished."""
        self.recorded.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self.recorded.__exit__(*raised)


def _made(record: Callable[..., Any], make: Callable[[], Any], **options: object) -> Any:
    """Return a recorded environment; called in the process of a worker."""
    return record(make(), **options)
