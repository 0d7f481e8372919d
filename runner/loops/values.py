"""Values on their way into a recording, checked: rewards, logged numbers, arrays."""

from __future__ import annotations

import copy
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from runner.errors import ConfigError, RecordingError
from runner.recording import schema
from runner.recording.gym_values import SCALARS, only_number
from runner.recording.spaces import Value
from runner.util.arrays import Array
from runner.util.jsonable import as_mapping
from runner.util.packing import MAX_CHUNK_BYTES
from runner.util.values import is_utf8

MAX_ARRAY_BYTES: Final = MAX_CHUNK_BYTES - (1 << 16)
_PACKAGE: Final = str(Path(__file__).parents[1])
UNCHANGEABLE: Final = frozenset((bool, int, float, str, type(None), *SCALARS))
"""Classes of values that nobody can change in place."""


def as_given(action: Value) -> Value:
    """Return a copy of an action before a step, as an environment may change its arrays in place."""
    kind = action.__class__
    if kind in UNCHANGEABLE:
        return action
    if kind is np.ndarray:
        return action.copy()
    if kind is dict:
        return {key: as_given(part) for key, part in action.items()}
    try:
        return copy.deepcopy(action)
    except Exception:  # such as a tensor with a gradient: it is recorded, or refused, as it is after the step
        return action


def logged_number(name: str, value: Any) -> float:
    """Return a logged number, which may stand in an array of one.

    Raises:
        ConfigError: it is not a number.
    """
    try:
        if callable(detach := getattr(value, "detach", None)):  # a tensor of PyTorch
            value = detach()
        is_array = np.size(value) == 1 and np.ndim(value)
        return float(only_number(value, name) if is_array else value)
    except (TypeError, ValueError, OverflowError, RuntimeError, RecordingError) as error:
        raise ConfigError(
            f"log: found {type(value).__name__} for {name!r}, expected a number that a float64 holds, "
            "text, an array of numbers or a picture."
        ) from error


def check_log_name(name: object, value: object) -> None:
    """Refuse a name that a logged value cannot have.

    Raises:
        ConfigError: it is empty, or not text.
    """
    if name == "":
        raise ConfigError(f"log: found an empty name for {value!r}, expected a name that is not empty")
    if not isinstance(name, str) or not is_utf8(name):
        raise ConfigError(f"log: found the name {name!r} for {value!r}, expected text that is valid Unicode")


def arrays_of(name: str, value: object) -> Iterator[tuple[str, Array]]:
    """Yield the arrays of a snapshot: the value itself, or the arrays of a mapping as `name/key`.

    Raises:
        ConfigError: a value holds something else than numbers, or too many.
    """
    if not isinstance(name, str) or not is_utf8(name):
        raise ConfigError(f"snapshot: found the name {name!r}, expected an array of numbers and a name.")
    if (inside := as_mapping(value)) is not None:
        for key, part in inside.items():
            yield from arrays_of(f"{name}/{key}", part)
        return
    values = numbers_of(value, "snapshot", f"for {name!r}", "an array of numbers")
    if values.nbytes > MAX_ARRAY_BYTES:
        raise ConfigError(
            f"snapshot: found {values.nbytes:,} bytes for {name!r}, expected at most "
            f"{MAX_ARRAY_BYTES:,}; record it in parts."
        )
    yield name, values.astype(values.dtype.newbyteorder("<"), copy=False)


def numbers_of(value: object, where: str, purpose: str, expected: str) -> Array:
    """Return an array of numbers of at most 64 bits; the other arguments are for the error.

    Raises:
        ConfigError: it holds something else.
    """
    try:
        values = as_array(value)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        what = f"found no array of numbers {purpose} ({error})"
        raise ConfigError(f"{where}: {what}, expected {expected}") from error
    if values.dtype.kind not in "biuf" or values.dtype.itemsize > 8:
        what = f"found {type(value).__name__} of {values.dtype} {purpose}"
        raise ConfigError(f"{where}: {what}, expected {expected}")
    return values


def as_array(value: object) -> Array:
    """Return an array or tensor as NumPy's; the short floats that NumPy lacks become float32, exactly."""
    if callable(detach := getattr(value, "detach", None)):
        tensor = detach().cpu()
        is_short = "bfloat16" in str(tensor.dtype) or "float8" in str(tensor.dtype)
        value = tensor.float() if is_short else tensor
    values = np.asarray(value, order="C")
    if values.dtype.kind == "V" and values.dtype.name.startswith(("bfloat16", "float8")):
        return values.astype(np.float32)
    return values


def check_phase(phase: str) -> None:
    """Refuse what is not a phase.

    Raises:
        ConfigError: it is not.
    """
    if phase not in schema.PHASES:
        raise ConfigError(f"phase: found {phase!r}, expected one of {', '.join(schema.PHASES)}")


def warn_user(message: str) -> None:
    """Warn of something in the user's loop, at the line of the loop and not in this package."""
    level = 1
    frame = sys._getframe()
    while frame.f_back is not None and frame.f_code.co_filename.startswith(_PACKAGE):
        level += 1
        frame = frame.f_back
    warnings.warn(message, RuntimeWarning, stacklevel=level)
