"""Values as a loop gives them: copied, converted to arrays, or refused."""

from __future__ import annotations

import copy
import sys
import warnings
from pathlib import Path
from typing import Final

import numpy as np

from runner.errors import ConfigError
from runner.recording import schema
from runner.recording.gym_values import SCALARS
from runner.recording.spaces import Value
from runner.util.arrays import Array

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
