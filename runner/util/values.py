"""Checks and conversions of plain values: texts, names of runs, whole numbers, JSON."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import re
from collections.abc import Mapping
from typing import Any, Final, TypeGuard

from runner.errors import ConfigError

Json = dict[str, Any]
"""An object parsed from JSON or YAML: what it holds is checked where it is used."""
JsonView = Mapping[str, Any]
"""The same, only to be read."""
Ranges = tuple[tuple[int, int | None], ...]
"""Start and stop of each range; None is the end."""
MAX_TEXT: Final = 200
"""The most characters of a short text."""
_PLAIN: Final = frozenset((str, int, float, bool, type(None)))
MAX_JSON_DEPTH: Final = 100
"""How deep the values of a JSON file may be nested."""
NAME_PATTERN: Final = r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}$"
NAME_EXPECTED: Final = "1 to 100 letters, digits, '_', '.' or '-', not starting with '.' or '-'"
RUN_NAME_PATTERN: Final = r"^[A-Za-z0-9_][A-Za-z0-9_.+/-]{0,99}$"
"""Names of runs; a configuration's name, from which folders are named, has no `+` and no `/`."""
RUN_NAME_EXPECTED: Final = (
    "1 to 100 letters, digits, '_', '.', '-', '+' or '/', not starting with one of the last four"
)


def checked_name(name: str | None) -> str | None:
    """Return the name if a configuration can have it.

    Raises:
        ConfigError: it cannot.
    """
    if name is not None and not re.fullmatch(NAME_PATTERN, name):
        raise ConfigError(f"name: found {name!r}, expected {NAME_EXPECTED}")
    return name


def checked_run_name(name: str | None) -> str | None:
    """Return the name if a recorded loop, or a renamed run, can have it, such as `ALE/Pong-v5__ppo+1`.

    Raises:
        ConfigError: it cannot.
    """
    if name is not None and not re.fullmatch(RUN_NAME_PATTERN, name):
        raise ConfigError(f"name: found {name!r}, expected {RUN_NAME_EXPECTED}")
    return name


def is_text(value: object) -> TypeGuard[str]:
    """Return whether this is a short, printable text."""
    return isinstance(value, str) and 0 < len(value) <= MAX_TEXT and value.isprintable()


def is_whole(value: object, low: int, high: int) -> TypeGuard[int]:
    """Return whether this is an integer from `low` to `high`."""
    return isinstance(value, int) and not isinstance(value, bool) and low <= value <= high


def is_number(value: object) -> TypeGuard[float]:
    """Return whether this is a finite number."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    with contextlib.suppress(OverflowError):  # of an integer beyond all floats
        return math.isfinite(value)
    return False


def is_utf8(text: str) -> bool:
    """Return whether a text can be encoded in UTF-8; a file name that was decoded with surrogates cannot."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def as_utf8(text: str) -> str:
    r"""Return a text that can be encoded in UTF-8; other bytes become escapes such as `\xe9`."""
    return text.encode(errors="surrogateescape").decode(errors="backslashreplace")


def flatten(
    values: Mapping[str, object], keep_empty: bool = False, prefix: str = "", separator: str = "."
) -> dict[str, object]:
    """Return the values in nested mappings by dotted key, such as `evaluation.trials`.

    Args:
        keep_empty: whether an empty mapping counts as a value.
        prefix: what every key begins with.
        separator: what stands between the keys of nested mappings.
    """
    flat: dict[str, object] = {}
    for key, value in values.items():
        if isinstance(value, Mapping) and (value or not keep_empty):
            flat |= flatten(value, keep_empty, f"{prefix}{key}{separator}", separator)
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def is_too_deep(value: object, depth: int = 0) -> bool:
    """Return whether a JSON value is nested more than `MAX_JSON_DEPTH` deep, counted from `depth`."""
    level = [value]
    while level:
        if depth > MAX_JSON_DEPTH:
            return True
        inner: list[object] = []
        for item in level:
            if isinstance(item, Mapping):
                inner += item.values()
            elif isinstance(item, list):
                inner += item
        parts = (item for item in inner if item.__class__ not in _PLAIN)
        level = [item for item in parts if isinstance(item, Mapping | list)]
        depth += 1
    return False


def finite(value: object) -> Any:
    """Return a value as JSON can hold it: NaN and infinities None, arrays lists, dataclasses objects."""
    if isinstance(value, Mapping):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if callable(to_list := getattr(value, "tolist", None)):  # an array, without an import of NumPy
        return finite(to_list())
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: finite(getattr(value, field.name)) for field in dataclasses.fields(value)}
    return value


def without_surrogates(value: object, source: str | bytes) -> Any:
    r"""Return a parsed JSON value with texts that can be encoded in UTF-8.

    An escape such as `\ud800` gives half a character, which cannot be written to a page, file or terminal; it
    is replaced by a question mark.

    Args:
        value: the parsed value.
        source: the JSON it was parsed from, in which such an escape is looked for first.
    """
    escape = b"\\ud" if isinstance(source, bytes) else "\\ud"
    return _replaced(value) if escape in source.lower() else value  # type: ignore[operator]


def _replaced(value: object) -> object:
    if isinstance(value, str):
        return value.encode(errors="replace").decode()
    if isinstance(value, list):
        return [_replaced(item) for item in value]
    if isinstance(value, dict):
        return {_replaced(key): _replaced(item) for key, item in value.items()}
    return value


def whole_number(text: str) -> int:
    """Return a number from 0; `int` would accept signs, blanks and underscores.

    Raises:
        ValueError: the text is none.
    """
    if not text.strip().isdecimal():
        raise ValueError(text)
    return int(text)


def ranges_in(text: str) -> Ranges:
    """Return the ranges in a text such as `0..20,40,49980..`, the stop not included.

    A single number is a range of one; `0:20` is `0..20`.

    Raises:
        ValueError: the text is no list of ranges.
    """
    ranges = []
    for part in text.split(","):
        start, colon, stop = part.strip().replace("..", ":").partition(":")
        first = 0 if colon and not start else whole_number(start)
        last = whole_number(stop) if stop else None
        ranges.append((first, last if colon else first + 1))
    return tuple(ranges)
