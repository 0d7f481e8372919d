"""Single values put over a configuration, as `--set KEY=VALUE` and sweeps do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from runner.config.document import Document, Place, Problem, read_yaml
from runner.config.file import ExperimentFile
from runner.config.model import OWN_SECTIONS
from runner.config.values import MAX_DEPTH, Path, Section
from runner.errors import ConfigError

_RIVALS = {"seed": ("seeds",), "seeds": ("seed",), "mode": ("tables", "rewards")}
"""What a file can say instead of a key: an override of the key takes its place."""


def override(document: Document, overrides: Sequence[str]) -> None:
    """Put every `KEY=VALUE` of `overrides` into `document`, whose value must be a mapping.

    A key on the way to KEY that holds something else than a mapping becomes one. A section that the
    document does not mention starts from its default, so that only the value named is changed.
    """
    put(document, [_parse(text) for text in overrides])


def put(document: Document, values: Sequence[tuple[tuple[str, ...], Document]]) -> None:
    """Put values at paths of `document`, as `override` does; each knows its places itself."""
    assigned: set[str] = set()
    for path, read in values:
        assigned.add(path[0])
        for rival in _rivals(path, read.value):
            if rival not in assigned:
                _forget(document, rival)
        for length in range(1, len(path)):
            if not isinstance(_at(document.value, path[:length]), Mapping | list | tuple):
                start = {} if path[0] in document.value else _default(path[0])
                place = {here: place for here, place in read.places.items() if not here}
                _assign(document, path[:length], Document(start, place))
        _assign(document, path, read)


def _rivals(path: tuple[str, ...], value: object) -> tuple[str, ...]:
    """Return the keys that an override makes void: with another algorithm, the sections of all others."""
    if path == ("algorithm",):
        return tuple(key for key, (algorithm, _) in OWN_SECTIONS.items() if algorithm != value)
    return _RIVALS.get(path[0], ())


_LONGEST = 80


def _parse(text: str) -> tuple[tuple[str, ...], Document]:
    shown = text if len(text) <= _LONGEST else text[:_LONGEST] + "…"
    source = "--set " + (shown if shown.isprintable() else repr(shown))
    key, separator, value = text.partition("=")
    path = tuple(key.strip().split("."))
    if not separator or not all(path):
        raise ConfigError(f"{source}: expected KEY=VALUE, such as epsilon=0.2 or evaluation.trials=50")
    if len(path) > MAX_DEPTH:
        raise ConfigError(f"{source}: expected a key of at most {MAX_DEPTH} parts")
    read = read_yaml(value, source, lines=False)
    read.places[()] = Place(source)
    return path, read


def _forget(document: Document, key: str) -> None:
    document.value = {other: value for other, value in document.value.items() if other != key}
    document.problems = _without(document.problems, (key,))


def _assign(document: Document, path: tuple[str, ...], read: Document) -> None:
    for old in [place for place in document.places if place[: len(path)] == path]:
        del document.places[old]
    document.value = _with(document.value, path, read.value)
    document.places |= {(*path, *below): place for below, place in read.places.items()}
    document.problems = _without(document.problems, path)
    document.problems += [problem._replace(path=(*path, *problem.path)) for problem in read.problems]


def _without(problems: list[Problem], path: Path) -> list[Problem]:
    """Return `problems` but those of the value at `path`; one with its own place is the text's, and stays."""
    return [problem for problem in problems if problem.place or problem.path[: len(path)] != path]


def _with(value: object, path: Path, new: object) -> Any:
    """Return a copy of `value` with `new` at `path`; only what lies on the path is copied."""
    if not path:
        return new
    key, below = path[0], path[1:]
    if isinstance(value, list | tuple) and (at := _position(key, value)) is not None:
        return [*value[:at], _with(value[at], below, new), *value[at + 1 :]]
    mapping = dict(value) if isinstance(value, Mapping) else {}
    return {**mapping, key: _with(mapping.get(key), below, new)}


def _at(value: Any, path: Path) -> Any:
    for part in path:
        if isinstance(value, Mapping):
            value = value.get(part)
        elif isinstance(value, list | tuple) and _position(part, value) is not None:
            value = value[int(part)]
        else:
            return None
    return value


def _position(part: str | int, items: Sequence[object]) -> int | None:
    """Return `part` as a position in `items`, if it is one."""
    text = str(part)
    return int(text) if text.isascii() and text.isdecimal() and int(text) < len(items) else None


def _default(key: str) -> dict[str, Any]:
    field = ExperimentFile.model_fields.get(key)
    default = field.default if field else None
    return default.model_dump(mode="json", exclude_unset=True) if isinstance(default, Section) else {}
