"""The base of a configuration's models: sections, errors with a path, free values.

A section is a frozen mapping of known keys. A refusal is a validator's own error with the path of the key
that it is about. Free values are the arguments of an environment: anything that JSON and YAML can hold.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler
from pydantic_core import CoreSchema, PydanticCustomError

REFUSED = "refused"
"""The type of the errors of `refusal`; their message is shown to users unchanged."""

Path = tuple[str | int, ...]
"""The place of a value in a configuration: keys and list positions from the top."""

MAX_DEPTH = 50
"""The deepest nesting of values, which also stops a value that contains itself."""

Count = Annotated[int, Field(ge=1, le=10**12)]
"""A number of episodes or steps, bounded so that sums and products of them fit in 64 bits."""

Fraction = Annotated[float, Field(ge=0, le=1)]


T = TypeVar("T")


class _NotNull:
    """Validates `X | None` as X: None is the default of a key that is left out, and no value of its own."""

    def __get_pydantic_core_schema__(self, source: object, handler: GetCoreSchemaHandler) -> CoreSchema:
        return handler.generate_schema(get_args(source)[0])


Optional = Annotated[T | None, _NotNull()]
"""A key that may be left out, but not be null."""


class ConfigSection(BaseModel):
    """A frozen mapping of a configuration; unknown keys, wrong types, NaN and infinity are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


def refusal(path: Path, message: str) -> PydanticCustomError:
    """Return the error a validator raises to refuse the value at `path` below its own."""
    return PydanticCustomError(REFUSED, "{message}", {"message": message, "path": path})


class FrozenMapping(Mapping[str, Any]):
    """A read-only mapping that can be hashed, pickled and unpacked with `**`."""

    __slots__ = ("_items",)

    def __init__(self, items: Mapping[str, Any]) -> None:
        self._items = dict(items)

    def __getitem__(self, key: str) -> object:
        return self._items[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self._items)

    def __len__(self) -> int:
        return len(self._items)

    def __hash__(self) -> int:
        return hash(frozenset(self._items.items()))

    def __repr__(self) -> str:
        return repr(self._items)


def frozen(value: object, path: Path = ()) -> object:
    """Return `value` with read-only mappings and lists; refuse what JSON cannot hold."""
    if len(path) > MAX_DEPTH:
        raise refusal(path[:1], f"nested deeper than {MAX_DEPTH} levels")
    if isinstance(value, Mapping):
        return FrozenMapping({_text(key, path): frozen(item, (*path, key)) for key, item in value.items()})
    if isinstance(value, list | tuple):
        return tuple(frozen(item, (*path, position)) for position, item in enumerate(value))
    if isinstance(value, str):
        return _text(value, path)
    if isinstance(value, int) and not -(2**63) <= value < 2**64:
        raise refusal(path, "found a whole number of more than 64 bits, expected one that fits")
    if value is None or isinstance(value, int) or (isinstance(value, float) and math.isfinite(value)):
        return value
    what = "a number that is not finite" if isinstance(value, float) else f"a Python {type(value).__name__}"
    raise refusal(path, f"found {what}, expected text, a number, true, false, null, a list or a mapping")


def plain(value: object) -> Any:
    """Return a frozen value as dictionaries and lists, which the caller may change."""
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return value


def value_at(value: object, path: Path) -> object:
    """Return the value at a path, whose list positions may be text; None if there is none."""
    for part in path:
        if isinstance(value, Mapping):
            value = value.get(part)
        elif isinstance(value, list | tuple) and (at := position_in(value, part)) is not None:
            value = value[at]
        else:
            return None
    return value


def position_in(items: Sequence[object], part: str | int) -> int | None:
    """Return a part of a path as a position in `items`, if it is one."""
    text = str(part)
    return int(text) if text.isascii() and text.isdecimal() and int(text) < len(items) else None


def _text(value: object, path: Path) -> str:
    if not isinstance(value, str):
        raise refusal(path, f"found the key {value!r}, expected text")
    try:
        value.encode()
    except UnicodeEncodeError:
        raise refusal(path, f"found {value!r}, expected text that UTF-8 can hold") from None
    return value
