"""Stored JSON as typed records: the annotations of a class say what each of its values must be."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Annotated, Final, TypeVar

import msgspec

from runner.errors import RecordingError, shortened
from runner.util.values import MAX_TEXT

_T = TypeVar("_T")
_QUOTED: Final = 60
"""Characters of a wrong value that a message quotes."""
_WORDS: Final = {
    "str": "a text",
    "int": "a whole number",
    "float": "a number",
    "object": "an object",
    "array": "a list",
    "|": "or",
    "Expected": "expected",
}
"""A word in messages of `msgspec` -> the same in those of other checks."""

Count = Annotated[int, msgspec.Meta(ge=0, le=2**62)]
Text = Annotated[str, msgspec.Meta(max_length=MAX_TEXT)]


def require_keys(values: Mapping[str, object], keys: Iterable[str], where: str) -> None:
    """Refuse a JSON object that lacks a key which a type has a default for.

    Raises:
        RecordingError: it does; the message begins with `where`.
    """
    if missing := [key for key in keys if key not in values]:
        raise RecordingError(f"{where}: found no {missing[0]}, expected {', '.join(keys)}.")


def stored_as(kind: type[_T], value: object, where: str) -> _T:
    """Return a JSON value, which anyone may have written, as a dataclass, TypedDict or other annotated type.

    Keys that the type does not have are ignored.

    Raises:
        RecordingError: a value is missing or impossible; the message begins with `where`.
    """
    try:
        return msgspec.convert(value, kind)
    except (msgspec.ValidationError, UnicodeEncodeError) as error:  # a key may have half a character
        raise RecordingError(f"{where}: {mistake_in_words(error, value)}.") from error


def mistake_in_words(error: Exception, value: object) -> str:
    """Return what was found and expected, from an error of `msgspec` on this value."""
    problem, _, place = str(error).partition(" - at ")
    for key in re.findall(r"\w+", place):  # of `$.vector.wrappers[3]`
        if isinstance(value, Mapping) and key in value:
            value = value[key]
        elif isinstance(value, list | tuple) and key.isdecimal():
            value = value[int(key)]
    problem = problem.replace("Object missing required field", "found none, expected the key")
    problem = re.sub(" matching regex .*", " of another form", problem)
    words = " ".join(
        _WORDS.get(word, word) for word in problem.partition(", got ")[0].replace("`", "").split()
    )
    if place:
        at = place.replace("$.", "").replace("`", "")
        words = f"found {shortened(repr(value), _QUOTED)} as {at}, {words}"
    return words
