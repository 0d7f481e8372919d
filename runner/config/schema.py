"""The JSON Schema of a configuration file, and problems in its terms: what was found, and what it allows."""

from __future__ import annotations

import contextlib
import copy
import functools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from runner.config.document import Document, Path, Place, Problem, value_at
from runner.config.model import KEYS, SECTION_OF, ExperimentFile
from runner.config.sections import REFUSED
from runner.errors import ConfigError, ConfigProblem, RunnerError, nearest, shortened
from runner.util.values import Json, JsonView

Schema = JsonView


def json_schema() -> Json:
    """Return the JSON Schema (draft 2020-12) of what a YAML file may contain, shorthands included."""
    return copy.deepcopy(_schema())


@functools.cache
def _schema() -> Json:
    from pydantic.json_schema import GenerateJsonSchema

    schema = ExperimentFile.model_json_schema()
    for model in (schema, *schema["$defs"].values()):
        for value in model["properties"].values():
            value.pop("title", None)
            if model is schema and value.get("default", ...) is None:
                del value["default"]
    return {
        "$schema": GenerateJsonSchema.schema_dialect,
        "title": "Experiment",
        "description": schema["description"],
        "type": "object",
        "additionalProperties": False,
        "properties": {key: schema["properties"][key] for key in KEYS},
        "required": schema["required"],
        "$defs": schema["$defs"],
    }


def without_references(schema: JsonView) -> Schema:
    """Return a schema with each `$ref` followed and its name as `ref`; it must not contain itself."""

    def followed(node: Any) -> Any:
        if isinstance(node, list):
            return [followed(item) for item in node]
        if not isinstance(node, dict):
            return node
        if "$ref" in node:
            name = node["$ref"].rpartition("/")[2]
            return {"ref": name, **followed(schema["$defs"][name])}
        return {key: followed(value) for key, value in node.items() if key != "$defs"}

    result: Schema = followed(schema)
    return result


@functools.cache
def _without_references() -> Schema:
    return without_references(_schema())


def schema_at(location: tuple[str | int, ...], schema: Schema | None = None) -> Schema:
    """Return the schema of the value at `location`, or an empty one; `schema` is a configuration's if None.

    Besides keys and list positions, a location may name the branch of a union on its way: the model's
    name for a mapping, the JSON type for anything else.
    """
    node = _without_references() if schema is None else schema
    for part in location:
        node = next((inner for branch in branches(node) for inner in _inside(branch, part)), {})
    return node


def branches(node: Schema) -> Iterator[Schema]:
    """Yield the alternatives that a schema without references offers."""
    alternatives = node.get("oneOf", node.get("anyOf"))
    if alternatives is None:
        yield node
        return
    for alternative in alternatives:
        yield from branches(alternative)


def _inside(branch: Schema, part: str | int) -> Iterator[Schema]:
    if isinstance(part, int):
        positions = branch.get("prefixItems", ())
        if part < len(positions):
            yield positions[part]
        elif "items" in branch:
            yield branch["items"]
    elif part in branch.get("properties", ()):
        yield branch["properties"][part]
    elif part == branch.get("ref", branch.get("type")):
        yield branch
    elif isinstance(branch.get("additionalProperties"), dict):
        yield branch["additionalProperties"]


def keys_of(node: Schema) -> list[str]:
    """Return the keys that a schema allows in a mapping."""
    return list(dict.fromkeys(key for branch in branches(node) for key in branch.get("properties", ())))


def choices_of(node: Schema) -> list[str]:
    """Return the texts that a schema allows."""
    return [choice for branch in branches(node) for choice in _choices(branch)]


def _choices(branch: Schema) -> list[str]:
    return list(branch.get("enum", [branch["const"]] if "const" in branch else []))


def expected(node: Schema) -> str:
    """Return a short description of the values that a schema allows: `a number from 0 to 1`."""
    simple, kinds, mappings = [], [], []
    for branch in branches(node):
        properties = branch.get("properties", {})
        if "schedule" in properties:
            kinds.append(properties["schedule"]["const"])
        elif properties:
            mappings.append("a mapping with " + ", ".join(properties))
        else:
            simple.append(_simple(branch))
    schedules = [f"a mapping with schedule: {_either(kinds)}"] if kinds else []
    simple.sort(key=lambda text: text == "null")
    return _either([*dict.fromkeys(simple), *schedules, *mappings])


def _either(alternatives: list[str]) -> str:
    *most, last = alternatives or ["something else"]
    return f"{', '.join(most)} or {last}" if most else last


def _simple(branch: Schema) -> str:  # noqa: PLR0911 - one line a kind
    if choices := _choices(branch):
        return _either(list(map(repr, choices)))
    if "prefixItems" in branch:
        return "[" + ", ".join(map(_simple, branch["prefixItems"])) + "]"
    match branch.get("type"):
        case "integer":
            return "a whole number" + _range(branch)
        case "number":
            return "a number" + _range(branch)
        case "array":
            return f"a list [{expected(branch['items'])}, ...]"
        case "string":
            return str(
                branch.get("patternErrorMessage", "text, not empty" if "minLength" in branch else "text")
            )
        case kind:
            mapping = "a mapping, not empty" if "minProperties" in branch else "a mapping"
            return {"boolean": "true or false", "object": mapping, "null": "null"}.get(str(kind), "a value")


def _bound(number: float) -> str:
    if number < 0:
        return f"-{_bound(-number)}"
    if isinstance(number, int) and number >= 10**9:
        exponent = len(str(number)) - 1
        return f"10^{exponent}" if number == 10**exponent else f"2^{number.bit_length()} - 1"
    return f"{number:,}"


def _range(branch: Schema) -> str:
    low, above = branch.get("minimum"), branch.get("exclusiveMinimum")
    high = branch.get("maximum")
    if low is not None and high is not None:
        return f" from {_bound(low)} to {_bound(high)}"
    if above is not None and high is not None:
        return f" above {above} and at most {_bound(high)}"
    return ""


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
