"""YAML: read into plain values, with the place of each in the text, and written from plain values.

The scalars are those of YAML 1.2's core schema, which editors use too: `1e-3` is a number, `no` and
`2026-11-01` are text. The values are null, booleans, numbers, text, lists and mappings.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import yaml

from runner.errors import ConfigError, shortened

Path = tuple[str | int, ...]
"""The place of a value in a configuration: keys and list positions from the top."""
MAX_DEPTH = 50
"""The deepest nesting of values, which also stops a value that contains itself."""
MAX_NODES = 100_000
"""The most values of a text, with its aliases expanded."""

_LONGEST = 60
_TAG: Final = "tag:yaml.org,2002:"
_INT: Final = re.compile(r"^(?:[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+)$")
_SCALARS: Final = (
    ("null", re.compile(r"^(?:~|null|Null|NULL|)$"), ["~", "n", "N", ""]),
    ("bool", re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$"), list("tTfF")),
    ("int", _INT, list("-+0123456789")),
    (
        "float",
        re.compile(
            r"^(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
            r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
        ),
        list("-+.0123456789"),
    ),
)
"""Name -> what its text looks like, and the characters that it may begin with."""


class Place(NamedTuple):
    """The origin of a value: a file with line and column (from 1), or an override with neither."""

    source: str
    line: int = 0
    column: int = 0

    def __str__(self) -> str:
        return f"{self.source}:{self.line}:{self.column}" if self.line else self.source


class Problem(NamedTuple):
    """The reason why the value at `path` cannot be used; `place` if it is not the place of the value."""

    path: Path
    message: str
    place: Place | None = None


@dataclass
class Document:
    """Plain values, their places, and the problems of the text itself."""

    value: Any
    places: dict[tuple[str, ...], Place] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)

    def place(self, path: Path) -> Place | None:
        """Return the place of the value at `path`, or of the nearest value around it."""
        keys = tuple(map(str, path))
        around = (self.places.get(keys[:length]) for length in range(len(keys), -1, -1))
        return next((place for place in around if place), None)


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


class _Loader(yaml.SafeLoader):
    """PyYAML's parser with the scalars of YAML 1.2 and bounds on depth and number of values."""

    yaml_implicit_resolvers: dict[str, object] = {}  # noqa: RUF012 - PyYAML's own way to configure a class

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth = 0
        self._nodes = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        self._nodes += 1
        self._depth += 1
        mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
        if self._depth > MAX_DEPTH:
            raise yaml.MarkedYAMLError(problem=f"nested deeper than {MAX_DEPTH} levels", problem_mark=mark)
        if self._nodes > MAX_NODES:
            raise yaml.MarkedYAMLError(problem=f"more than {MAX_NODES} values", problem_mark=mark)
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node


for _name, _pattern, _first in _SCALARS:
    _Loader.add_implicit_resolver(_TAG + _name, _pattern, _first)


def read_yaml(text: str, source: str, *, lines: bool = True) -> Document:
    """Return the values of a text; errors name `source`, with line and column unless `lines` is false."""
    try:
        node = _Loader(text).get_single_node()
        builder = _Builder(source, lines)
        value = builder.value(node, ()) if node is not None else None
        builder.places.setdefault((), Place(source, 1, 1) if lines else Place(source))  # of an empty text
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = Place(source, mark.line + 1, mark.column + 1) if mark and lines else Place(source)
        raise ConfigError(
            f"{place}: cannot be read as YAML: {(error.problem or error.context or '').removeprefix('but ')}"
        ) from None
    except yaml.reader.ReaderError as error:
        before = text[: error.position]
        line = before.count("\n") + 1
        column = error.position - before.rfind("\n")
        place = Place(source, line, column) if lines else Place(source)
        raise ConfigError(f"{place}: cannot be read as YAML: the character U+{error.character:04X}") from None
    return Document(value, builder.places, builder.problems)


class _Builder:
    """Turns nodes into plain values, and keeps the place of each."""

    def __init__(self, source: str, lines: bool) -> None:
        self.source = source
        self.lines = lines
        self.places: dict[tuple[str, ...], Place] = {}
        self.problems: list[Problem] = []
        self.built = 0

    def value(self, node: yaml.Node, path: Path) -> Any:
        self.built += 1
        if self.built > MAX_NODES or len(path) > MAX_DEPTH:
            problem = "aliases make it too large: more than " + (
                f"{MAX_NODES} values" if self.built > MAX_NODES else f"{MAX_DEPTH} levels"
            )
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)
        self.places.setdefault(tuple(map(str, path)), self._place(node))
        tag_name = node.tag.removeprefix(_TAG)
        if isinstance(node, yaml.MappingNode) and tag_name == "map":
            return self._mapping(node, path)
        if isinstance(node, yaml.SequenceNode) and tag_name == "seq":
            return [self.value(item, (*path, position)) for position, item in enumerate(node.value)]
        if isinstance(node, yaml.ScalarNode) and tag_name in _KINDS:
            return self._scalar(node, tag_name, path)
        tag = _shown("!!" + tag_name if tag_name != node.tag else node.tag)
        self.problems.append(Problem(path, f"found the tag {tag}, expected a plain value without a tag"))
        return None

    def _mapping(self, node: yaml.MappingNode, path: Path) -> dict[str, object]:
        built: dict[str, object] = {}
        for key_node, value_node in node.value:
            place = self._place(key_node)
            key = self._key(key_node, path)
            if key is None:
                continue
            below = (*path, key)
            if key in built:
                first = self.places[tuple(map(str, below))]
                message = f"given twice; first in line {first.line}" if first.line else "given twice"
                self.problems.append(Problem(below, message, place))
                continue
            self.places[tuple(map(str, below))] = place
            built[key] = self.value(value_node, below)
        return built

    def _key(self, node: yaml.Node, path: Path) -> str | None:
        if not isinstance(node, yaml.ScalarNode):
            message = "found a list or mapping for a key, expected text"
        elif node.value == "<<" and node.style is None:
            message = "found the merge key <<, expected the keys themselves"
        elif node.tag != _TAG + "str":
            message = f"found the key {_shown(node.value)}, expected text: quote it"
        else:
            return str(node.value)
        self.problems.append(Problem(path, message, self._place(node)))
        return None

    def _scalar(self, node: yaml.ScalarNode, kind: str, path: Path) -> object:
        convert, description = _KINDS[kind]
        try:
            return convert(node.value)
        except (ValueError, KeyError):
            self.problems.append(Problem(path, f"found {_shown(node.value)}, which is no {description}"))
            return None

    def _place(self, node: yaml.Node) -> Place:
        if not self.lines:
            return Place(self.source)
        return Place(self.source, node.start_mark.line + 1, node.start_mark.column + 1)


def _shown(text: str) -> str:
    short = shortened(text, _LONGEST)
    return short if short.isprintable() else repr(short)


def _whole_number(text: str) -> int:
    if not _INT.match(text):
        raise ValueError(text)
    return int(text, 0) if text.startswith(("0o", "0x")) else int(text)


def _number(text: str) -> float:
    return float(re.sub(r"^([-+]?)\.(inf|nan)$", r"\1\2", text.lower()))


_NULL = dict.fromkeys(("", "~", "null"))
_BOOL = {"true": True, "false": False}
_KINDS: dict[str, tuple[Callable[[str], object], str]] = {
    "null": (lambda text: _NULL[text.lower()], "null"),
    "bool": (lambda text: _BOOL[text.lower()], "true or false"),
    "int": (_whole_number, "whole number of a usable size"),
    "float": (_number, "number"),
    "str": (str, "text"),
}
"""The scalars by tag: the conversion of their text, and their name in messages."""


# --- writing ------------------------------------------------------------------------------------------------


class _Dumper(yaml.SafeDumper):
    """Quotes what YAML 1.1 or 1.2 would not read as text."""

    def ignore_aliases(self, data: object) -> bool:  # noqa: ARG002 - PyYAML's signature
        return True


def _represent_text(dumper: yaml.SafeDumper, text: str) -> yaml.ScalarNode:
    return dumper.represent_scalar(_TAG + "str", text, style=None if text.isprintable() else '"')


_Dumper.add_representer(str, _represent_text)
for _name, _pattern, _first in _SCALARS:
    _Dumper.add_implicit_resolver(_TAG + _name, _pattern, _first)


def write_yaml(value: Mapping[str, object], is_compact: bool = False) -> str:
    """Return `value` as YAML, from which `read_yaml` returns an equal value; compact with `{a: 1, b: 2}`."""
    style = None if is_compact else False
    text: str = yaml.dump(
        value, Dumper=_Dumper, sort_keys=False, default_flow_style=style, allow_unicode=True, width=110
    )
    return text
