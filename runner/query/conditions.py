"""Conditions on episodes and their steps, as SQL over the index of episodes.

    ret < -100 and count(collision) >= 2 and length > 50
    any(next_observation[2] > 0.2) or then(pickup, drop_off, within=5)

A function of steps is a column of the index, follows from its columns, or is NULL. The condition is NULL for
episodes that this leaves open. Of those alone the steps are read, and the function is an aggregate of them.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Final

from runner.errors import nearest
from runner.util.expressions import CONDITION, NUMBER, TEXT, Operation, Parser, Term

ENDS: Final = ("success", "terminated", "truncated")
"""The conditions of an episode."""
AGGREGATES: Final[dict[Any, tuple[str, str]]] = {
    "any": ("coalesce(bool_or({0.sql}), FALSE)", "{0.some}"),
    "never": ("NOT coalesce(bool_or({0.sql}), FALSE)", "(NOT {0.some})"),
    "all": ("coalesce(bool_and({0.sql}), TRUE)", "(NOT {0.fails})"),
    "count": ("count_if({0.sql})", "CASE WHEN NOT {0.some} THEN 0 WHEN NOT {0.fails} THEN length END"),
    "then": ("coalesce(bool_or({0.sql} AND {1.sql}), FALSE)", "({0.some} AND {1.some} AND NULL)"),
    "min": ("min({0.sql})", "{0.low}"),
    "max": ("max({0.sql})", "{0.high}"),
    "sum": ("sum({0.sql})", "NULL"),
    "first": ("arg_min({0.sql}, step)", "NULL"),
    "last": ("arg_max({0.sql}, step)", "NULL"),
}
"""The functions of an episode's steps, and what the index says of them if it has no column for them."""
_OF_NUMBERS: Final = ("min", "max", "sum", "first", "last")
_AT_STEPS: Final[dict[Operation, tuple[str, str]]] = {
    ast.Not: ("{0.fails}", "{0.some}"),
    ast.And: ("({0.some} AND {1.some} AND NULL)", "({0.fails} OR {1.fails})"),
    ast.Or: ("({0.some} OR {1.some})", "({0.fails} AND {1.fails} AND NULL)"),
    ast.Lt: ("{0.low} < {1.high}", "{0.high} >= {1.low}"),
    ast.LtE: ("{0.low} <= {1.high}", "{0.high} > {1.low}"),
    ast.Gt: ("{0.high} > {1.low}", "{0.low} <= {1.high}"),
    ast.GtE: ("{0.high} >= {1.low}", "{0.low} < {1.high}"),
    ast.Eq: (
        "({0.low} <= {1.high} AND {0.high} >= {1.low} AND NULL)",
        "({0.low} <> {1.high} OR {0.high} <> {1.low})",
    ),
}
"""Over the index, whether a condition holds at some step, and whether it fails at some step."""


_OF_STEPS: Final = re.compile(r"(?:min|count)\((?!.* == )(.*)\)|n_(.*)")
"""A column of the index for each column of steps, and for each event, which may be known without steps."""


@dataclass(frozen=True)
class Facts:
    """What the episodes and steps of a run have."""

    index: Sequence[str]
    """The columns of the index: of episodes, and functions of steps such as `count(collision)`."""
    actions: Mapping[str, Sequence[str]]
    """The names of actions by number, by the column of steps."""

    @property
    def steps(self) -> list[str]:
        """The columns of steps with numbers, flags and events."""
        matches = map(_OF_STEPS.fullmatch, self.index)
        return list(dict.fromkeys(match[1] or match[2] for match in matches if match))


def quoted(name: str) -> str:
    """Return a name in SQL."""
    return '"' + name.replace('"', '""') + '"'


@dataclass(frozen=True)
class Part(Term):
    """A part of a condition in SQL."""

    sql: str
    some: str = "NULL"
    """Over the index: whether a condition on steps holds at some step of the episode."""
    fails: str = "NULL"
    """Whether it fails at some step."""
    low: str = "NULL"
    """Over the index: the least value of a number of steps."""
    high: str = "NULL"
    label: str = ""
    """What the index calls it."""
    value: float | str | None = None
    """The value of a constant."""


@dataclass
class EpisodeParser(Parser[Part]):
    """Parses a condition on episodes, or a number to sort them by."""

    given: str
    facts: Facts
    reads_steps: bool = False
    """Whether `aggregates` are columns, as steps were read; else the index alone is asked."""
    aggregates: dict[str, str] = field(default_factory=dict)
    """The functions of steps in it, the SQL of each by name."""
    windows: dict[str, str] = field(default_factory=dict)
    """The columns of steps that they need, the SQL of each by name."""
    what = "expression"
    example = "ret < -100 and count(collision) >= 2"
    max_length = 1_000
    max_nodes = 300
    max_number = 2**53
    operations: ClassVar[Mapping[Operation, Any]] = {
        ast.And: "({} AND {})",
        ast.Or: "({} OR {})",
        ast.Not: "(NOT {})",
        ast.UAdd: "{}",
        ast.USub: "(- {}::DOUBLE)",
        ast.Add: "({}::DOUBLE + {})",
        ast.Sub: "({}::DOUBLE - {})",
        ast.Mult: "({}::DOUBLE * {})",
        ast.Div: "({}::DOUBLE / {})",
        ast.Lt: "({} < {})",
        ast.LtE: "({} <= {})",
        ast.Gt: "({} > {})",
        ast.GtE: "({} >= {})",
        ast.Eq: "({} = {})",
        "abs": "abs({}::DOUBLE)",
        **AGGREGATES,
    }
    expected = f"expected comparisons, and, or, not, in, + - * /, abs(), {'(), '.join(AGGREGATES)}()"
    not_numbers = {TEXT: "a number; names are compared to actions, with == or !="}  # noqa: RUF012
    _is_inside: bool = False

    def __post_init__(self) -> None:
        super().__init__(self.given)

    def sort_key(self) -> str:
        """Return the number that the whole expression is, in SQL."""
        try:
            return self.number(ast.parse(self.text, mode="eval").body).sql
        except SyntaxError as error:
            raise self.syntax_error(error) from None

    def fixed(self, value: float | str) -> Part:
        """Return a constant; a text has no SQL."""
        if isinstance(value, bool):
            return Part(CONDITION, str(value), str(value), str(not value))
        sql = "" if isinstance(value, str) else f"'{value!r}'::DOUBLE"
        return Part(NUMBER if sql else TEXT, sql, low=sql, high=sql, label=repr(value), value=value)

    def applied(self, kind: str, operation: Operation, *parts: Part) -> Part:
        """Return an operation on one or two terms, and what the index knows of it."""
        left, right = parts[0], parts[-1]
        if operation is ast.USub and isinstance(left.value, int | float):
            return self.fixed(-left.value)
        part = Part(kind, self.operations[operation].format(*(part.sql for part in parts)))
        if not self._is_inside or operation not in _AT_STEPS:
            return part
        some, fails = (text.format(*parts) for text in _AT_STEPS[operation])
        if operation in (ast.Not, ast.And, ast.Or):
            return replace(part, some=some, fails=fails)
        part = replace(part, sql=f"coalesce({part.sql}, FALSE)")
        if operation is ast.Eq:
            part = self._flag(replace(part, label=f"{left.label} == {right.label}"))
        is_known = part.some != "NULL" or left.value is right.value is None
        return part if is_known else replace(part, some=some, fails=fails)

    def _flag(self, part: Part) -> Part:
        """Return a condition on steps, which the index may count."""
        if (count := self._column("count", part)) == "NULL":
            return part
        return replace(part, some=f"({count} > 0)", fails=f"({count} < length)")

    def _column(self, function: str, part: Part) -> str:
        """Return the column of the index with a function of steps; NULL if there is none."""
        for name in (f"{function}({part.label})", f"n_{part.label}" if function == "count" else ""):
            if name in self.facts.index:
                return quoted(name)
        return "NULL"

    def number(self, node: ast.expr) -> Part:
        """Return a number; a condition counts as 0 or 1."""
        term = super().number(node)
        return Part(NUMBER, f"({term.sql})::INTEGER") if term.kind == CONDITION else term

    def compared(self, node: ast.Compare, left: ast.expr, operator: type[ast.cmpop], right: ast.expr) -> Part:
        """Return the condition that compares two numbers, or an action with its name."""
        action, text = self.term(left), self.term(right)
        names = self.facts.actions.get(action.label, ())
        if text.kind != TEXT or operator is not ast.Eq or not names:
            return super().compared(node, left, operator, right)
        numbers = {spelt(name): k for k, name in enumerate(names)}
        if (number := numbers.get(spelt(str(text.value)))) is None:
            raise self.error(
                right,
                f"found {str(text.value)[:60]!r}, expected one of {len(names):,} actions, such as "
                f"{names[0]!r}.{nearest(str(text.value), names)}",
            )
        return self.applied(CONDITION, ast.Eq, action, self.fixed(number))

    def call(self, node: ast.Call, name: str) -> Part:
        """Return the term of a call: of abs(), or of a function of steps."""
        if name not in AGGREGATES:
            return super().call(node, name)
        within = "UNBOUNDED"
        match name, node.keywords:
            case "then", [ast.keyword(arg="within", value=ast.Constant(value=int() as steps))] if (
                0 < steps < 2**31
            ):
                within = str(int(steps))
            case _, [_, *_]:
                raise self.error(node, f"expected {name}() without options; then() has within=STEPS, from 1.")
        if self._is_inside or len(node.args) != 1 + (name == "then"):
            raise self.error(
                node,
                f"expected {name}() of values of a step: any(reward < -5), then(reward < 0, reward > 5).",
            )
        self._is_inside = True
        parts = list(map(self.number if name in _OF_NUMBERS else self.condition, node.args))
        self._is_inside = False
        if name == "then":
            rows = f"ORDER BY t ROWS BETWEEN {within} PRECEDING AND 1 PRECEDING"
            window = f"w{len(self.windows)}"
            sql = f"bool_or({parts[0].sql}) OVER (PARTITION BY phase, environment, episode {rows})"
            self.windows[window], parts[0] = sql, replace(parts[0], sql=window)
        of_steps, known = (text.format(*parts) for text in AGGREGATES[name])
        if (column := self._column(name, parts[0])) != "NULL":
            known = column
        read = f"a{len(self.aggregates)}"
        self.aggregates[read] = of_steps
        kind = NUMBER if name in (*_OF_NUMBERS, "count") else CONDITION
        return Part(kind, f"coalesce({read}, {known})" if self.reads_steps else known)

    def named(self, node: ast.expr) -> Part:
        """Return the column that a node names: `next_observation[2]` is next_observation_2."""
        text, facts = self.text_of(node)[:60], self.facts
        name = re.sub("^ret(?=_|$)", "return", spelt(text))
        plain = [column for column in facts.index if "(" not in column and column != "phase"]
        of_steps = {spelt(column): column for column in facts.steps}
        columns = of_steps if self._is_inside else {spelt(column): column for column in plain}
        if self._is_inside and not columns:
            raise self.error(node, f"found {text}, and the run has no steps")
        if name not in columns:
            hint = nearest(text, [*columns, *AGGREGATES])
            if not self._is_inside and name in of_steps:
                hint = f" Steps have it: any({text}), count({text})."
            listed = (
                ", ".join(columns) if self._is_inside else f"{', '.join(columns)}, any(), count(), then()"
            )
            listed = re.sub(r"\breturn(?=_|\b)", "ret", listed)
            raise self.error(node, f"found {text}, expected one of {listed[:1000]}.{hint}")
        column = columns[name]
        part = Part(CONDITION if column in ENDS else NUMBER, quoted(column), label=column)
        if not self._is_inside:
            return part
        if f"min({column})" in facts.index:
            return replace(part, low=self._column("min", part), high=self._column("max", part))
        return self._flag(replace(part, kind=CONDITION))


def spelt(name: str) -> str:
    """Return a name in one spelling."""
    return re.sub(r"(?:[^\w-]|_)+|(?<=\w)-(?=[a-z])", "_", name).strip("_")
