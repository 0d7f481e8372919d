"""Pydantic's errors in terms of a configuration: one line for each value."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from runner.config.document import Document, Place, Problem
from runner.config.model import SECTION_OF
from runner.config.schema import Schema, choices_of, expected, keys_of, schema_at
from runner.config.values import REFUSED, Path, value_at
from runner.errors import ConfigError, ConfigProblem, RunnerError, nearest, shortened

_LONGEST = 60
_MOST = 200
_UNKNOWN = "extra_forbidden"
_FOLLOWS = "default_factory_not_called"
"""The type of the error of a default that depends on another value, whose own error is reported."""
_BRANCHES = frozenset(
    (
        "integer",
        "number",
        "array",
        "Linear",
        "Exponential",
        "Piecewise",
        "RandomTable",
        "RunTable",
        "SeedRange",
        "Range",
        "path",
        "mapping",
    )
)
"""Names in a location that stand for the branch of a union; none is a key."""

_ELSEWHERE: Final[dict[str, str]] = {
    **dict.fromkeys(("alpha", "learning_rate", "lr"), "step_size"),
    **dict.fromkeys(("gamma", "discount_factor"), "discount"),
    **dict.fromkeys(("eps", "exploration_rate"), "epsilon"),
    **dict.fromkeys(("environment", "env_id", "env_name"), "env"),
    **dict.fromkeys(("eval", "eval_every"), "evaluation"),
    **dict.fromkeys(("decay", "decay_rate"), "factor"),
    **dict.fromkeys(("end", "min", "minimum"), "floor"),
    **{section.algorithm: key for key, section in SECTION_OF.items()},
}
"""Names of keys in other programs and in textbooks, and algorithms by the key of their section."""


def problems_in(error: ValidationError, value: object, schema: Schema | None = None) -> list[Problem]:
    """Return the problems of `value`, without those that are only a consequence of others.

    Args:
        schema: its schema, without references; that of a configuration unless given.
    """
    details = error.errors(include_url=False, include_input=False)
    paths = [_path(detail) for detail in details]
    unknown = [path for path, detail in zip(paths, details, strict=True) if detail["type"] == _UNKNOWN]
    problems = []
    for path, detail in zip(paths, details, strict=True):
        if detail["type"] == _FOLLOWS:
            continue
        near = [other[-1] for other in unknown if other[:-1] == path[:-1]]
        if detail["type"] == "missing" and any(_hint(str(key), [str(path[-1])]) for key in near):
            continue
        if detail["type"] == "too_short" and any(other[:-1] == path for other in paths if other):
            continue
        problems.append(_problem(path, detail, value, schema))
    return problems


def refuse(problems: Sequence[Problem], document: Document) -> ConfigError:
    """Return the error that lists `problems` in the order of the text, at most 200 of them."""
    first: dict[tuple[Path, Place | None], Problem] = {}
    for problem in problems:
        first.setdefault((problem.path, problem.place), problem)
    placed = [(problem.place or document.place(problem.path), problem) for problem in first.values()]
    placed.sort(key=lambda pair: pair[0][1:] if pair[0] and pair[0].line else (10**9, 0))
    lines = [_line(place, problem) for place, problem in placed[:_MOST]]
    if len(placed) > _MOST:
        lines.append(f"... and {len(placed) - _MOST} more")
    located = (
        ConfigProblem(_dotted(problem.path), *(place[1:] if place else (0, 0)), problem.message)
        for place, problem in placed[:_MOST]
    )
    return ConfigError("\n".join(lines), tuple(located))


@contextlib.contextmanager
def problems_at(key: Path, document: Document, *kinds: type[RunnerError]) -> Iterator[None]:
    """Raise an error of these kinds in the block as a problem of a key, with its line."""
    try:
        yield
    except kinds as error:
        raise refuse([Problem(key, str(error))], document) from None


def found(value: object) -> str:  # noqa: PLR0911 - one line a kind
    """Return `value` for a message: short, on one line, in YAML's terms."""
    match value:
        case None:
            return "null"
        case bool():
            return str(value).lower()
        case int() if value.bit_length() > 128:
            return f"a whole number of {value.bit_length()} bits"
        case float() if value in (float("inf"), float("-inf")) or value != value:  # noqa: PLR0124 - NaN
            return f"{value}".replace("inf", ".inf").replace("nan", ".nan")
        case int() | float():
            return str(value)
        case str():
            return repr(shortened(value, _LONGEST))
        case Mapping():
            names = ", ".join(map(_key, value))
            return shortened(f"a mapping with {names}", _LONGEST) if value else "an empty mapping"
        case list() | tuple():
            return f"a list of {len(value)}" if value else "an empty list"
        case _:
            return f"a Python {type(value).__name__}"


def _problem(path: Path, detail: ErrorDetails, value: object, schema: Schema | None) -> Problem:
    if detail["type"] == REFUSED:
        return Problem(path, detail["msg"])
    around = schema_at(detail["loc"][:-1], schema)
    if detail["type"] == _UNKNOWN:
        keys = keys_of(around)
        return Problem(path, "unknown key." + (_hint(str(path[-1]), keys) or f" Known: {', '.join(keys)}"))
    if detail["type"] == "invalid_key":
        return Problem((*path[:-1], str(path[-1])), "unknown key, which is not even text")
    here = schema_at(detail["loc"], schema)
    if detail["type"] == "missing":
        if not isinstance(path[-1], int):
            return Problem(path, f"missing, expected {expected(here)}")
        path = path[:-1]
        here = around
    value = value_at(value, path)
    hint = nearest(value, choices_of(here)) if isinstance(value, str) else ""
    return Problem(path, f"found {found(value)}, expected {expected(here)}{'.' if hint else ''}{hint}")


def _path(detail: ErrorDetails) -> Path:
    """Return the keys of an error's location, without branches of unions, with the path of a refusal."""
    location = detail["loc"]
    below: Path = detail["ctx"]["path"] if detail["type"] == REFUSED else ()
    last = len(location) - 1 if detail["type"] == _UNKNOWN else -1
    keys = [part for index, part in enumerate(location) if index == last or part not in _BRANCHES]
    return (*keys, *below)


def _hint(key: str, known: Sequence[str]) -> str:
    """Return a hint at the known key that was probably meant."""
    other = _ELSEWHERE.get(key.lower())
    return f" Did you mean {other!r}?" if other in known else nearest(key, known)


def _line(place: Place | None, problem: Problem) -> str:
    return ": ".join(filter(None, (place and str(place), _dotted(problem.path), problem.message)))


def _dotted(path: Path) -> str:
    parts = [f"[{part}]" if isinstance(part, int) else f".{_key(part)}" for part in path]
    return "".join(parts).removeprefix(".")


def _key(key: object) -> str:
    plain = isinstance(key, str) and key.isprintable() and not set(key) & set(". :'\"[]")
    return shortened(str(key) if plain and key else repr(key), _LONGEST)
