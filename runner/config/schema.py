"""The JSON Schema of a configuration file, and short descriptions of what it allows for a value."""

from __future__ import annotations

import copy
import functools
from collections.abc import Iterator
from typing import Any

from runner.config.model import KEYS, ExperimentFile
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
