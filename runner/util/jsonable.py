"""Any Python value as JSON can hold it: arrays, dataclasses, namespaces and other settings."""

from __future__ import annotations

import binascii
import dataclasses
import math
import os
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from types import SimpleNamespace
from typing import Any, Final

import numpy as np

from runner.util.arrays import Array
from runner.util.values import Json

MAX_VALUES: Final = 4_000_000
_MAX_REPR: Final = 10_000
_MAX_LISTED: Final = 64
"""The most numbers of an array that are written as a list where arrays may be packed."""
_COLLECTIONS: Final[Mapping[type, str]] = {tuple: "$tuple", set: "$set", frozenset: "$frozenset"}
_INEXACT: Final = "$inexact"


def as_json(value: object, packs: bool = False) -> Any:
    """Return a value as JSON can hold it; what it cannot hold as its `repr`.

    Arrays and sets become lists, dataclasses and namespaces mappings, paths text; NaN and infinities become
    text.

    Args:
        packs: write arrays of more than 64 numbers as their bytes, which `unpacked` returns exactly.

    Raises:
        ValueError: the value contains itself, or more than 4,000,000 values.
        RecursionError: it is nested too deeply.
    """
    return _Conversion(packs).of(value)


def is_packed(value: object) -> bool:
    """Return whether a value is an array that is written as its bytes where arrays may be packed."""
    return isinstance(value, np.ndarray) and value.dtype.kind in "biuf" and value.size > _MAX_LISTED


def packed(array: Array) -> Json:
    """Return an array as JSON: its dtype, its shape, and its bytes in C order as base64."""
    data = binascii.b2a_base64(array.tobytes(), newline=False).decode()
    return {"dtype": array.dtype.str, "shape": list(array.shape), "base64": data}


def unpacked(value: Any) -> Any:
    """Return JSON with each array that `packed` wrote as an array again.

    Raises:
        ValueError: an object has the keys of a packed array, and is none.
    """
    if isinstance(value, list):
        return [unpacked(part) for part in value]
    if not isinstance(value, dict):
        return value
    if value.keys() != {"dtype", "shape", "base64"}:
        return {key: unpacked(part) for key, part in value.items()}
    return _array_of(value)


def _array_of(value: Any) -> Array:
    try:
        dtype = np.dtype(value["dtype"])
        if dtype.kind not in "biuf":
            raise ValueError(f"found {dtype}, expected numbers")
        return np.frombuffer(binascii.a2b_base64(value["base64"]), dtype).reshape(value["shape"]).copy()
    except (KeyError, TypeError, SyntaxError) as error:  # the last of a dtype such as ","
        raise ValueError(f"found {error}, expected dtype, shape and base64 of an array") from error


def exact_json(value: Any) -> Any:
    """Return a value as JSON from which `restored` makes the same one.

    What JSON lacks is an object with one key, such as `{"$tuple": [1, 2]}`. What `restored` could not make
    is written as by `as_json`, and `is_exact` is then false.

    Raises:
        ValueError: the value contains itself, or more than 4,000,000 values.
        RecursionError: it is nested too deeply.
    """
    as_json(value)  # raises for what stands for endless JSON
    return _exact(value)


def _exact(value: Any) -> Any:
    kind = type(value)
    if value is None or kind in (bool, int, str) or (kind is float and math.isfinite(value)):
        return value
    if kind is list:
        return [_exact(part) for part in value]
    if kind is dict and all(type(key) is str and not key.startswith("$") for key in value):
        return {key: _exact(part) for key, part in value.items()}
    content: object
    if kind in _COLLECTIONS:
        parts = value if kind is tuple else sorted(value, key=repr)
        tag = _COLLECTIONS[kind]
        content = [_exact(part) for part in parts]
    elif kind is dict:
        tag = "$dict"
        content = [[_exact(key), _exact(part)] for key, part in value.items()]
    elif kind is float:
        tag = "$float"
        content = repr(value)
    elif (kind is np.ndarray or isinstance(value, np.generic)) and value.dtype.kind in "biuf":
        tag = "$array" if kind is np.ndarray else "$number"
        content = packed(value)
    else:
        tag = _INEXACT
        content = as_json(value)
    return {tag: content}


def is_exact(text: str) -> bool:
    """Return whether a JSON text of `exact_json` holds the value exactly."""
    return f'{{"{_INEXACT}": ' not in text  # in a text within it the quotes are escaped


_RESTORED: Final[Mapping[str, Callable[[Any], object]]] = {
    **{tag: kind for kind, tag in _COLLECTIONS.items()},
    "$float": float,
    "$dict": dict,
    "$array": _array_of,
    "$number": lambda content: _array_of(content)[()],
    _INEXACT: lambda content: content,
}


def restored(value: Any) -> Any:
    """Return the value that `exact_json` wrote.

    Raises:
        ValueError: `exact_json` writes no such JSON.
    """
    if isinstance(value, list):
        return [restored(part) for part in value]
    if not isinstance(value, dict):
        return value
    tag, content = next(iter(value.items()), ("", None))
    if len(value) > 1 or tag not in _RESTORED:
        return {key: restored(part) for key, part in value.items()}
    try:
        return _RESTORED[tag](restored(content))
    except (TypeError, OverflowError) as error:
        raise ValueError(f"found {error}, expected the content of {tag}") from error


def as_mapping(value: object) -> Mapping[Any, Any] | None:
    """Return the fields of a mapping, dataclass, namespace or Pydantic model; None for anything else."""
    if isinstance(value, Mapping):
        return value
    if isinstance(value, Namespace | SimpleNamespace):
        return vars(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if callable(dump := getattr(value, "model_dump", None)) and not isinstance(value, type):
        dumped = dump()
        return dumped if isinstance(dumped, Mapping) else None
    return None


class _Conversion:
    """One conversion, bounded: a graph of few objects can stand for endless JSON."""

    def __init__(self, packs: bool) -> None:
        self._packs = packs
        self._left = MAX_VALUES
        self._path: set[int] = set()

    def of(self, value: Any) -> Any:
        self._count(1)
        if isinstance(value, Enum):
            value = value.value
        elif self._packs and is_packed(value):
            return packed(value)
        elif isinstance(value, np.generic | np.ndarray) and value.dtype.kind in "biufU":
            self._count(value.size)
            value = value.tolist()
        elif isinstance(value, os.PathLike):
            value = os.fspath(value)
        elif isinstance(value, set | frozenset):
            value = sorted(value, key=repr)  # their own order differs between processes
        if value is None or isinstance(value, int | str):
            return value
        if isinstance(value, float):
            return value if math.isfinite(value) else repr(value)
        if id(value) in self._path:
            raise ValueError(f"a {type(value).__name__} contains itself")
        self._path.add(id(value))
        try:
            if (fields := as_mapping(value)) is not None:
                return {str(key): self.of(part) for key, part in fields.items()}
            if isinstance(value, Sequence) and not isinstance(value, bytes | bytearray | memoryview):
                return [self.of(part) for part in value]
            return _repr(value)
        finally:
            self._path.discard(id(value))

    def _count(self, values: int) -> None:
        self._left -= values
        if self._left < 0:
            raise ValueError(f"it holds more than {MAX_VALUES:,} values")


def _repr(value: object) -> str:
    try:
        return repr(value)[:_MAX_REPR]
    except Exception:  # a repr is foreign code, and no reason to fail
        return f"<{type(value).__name__}>"
