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

from runner.errors import RunnerError, nearest
from runner.util.expressions import CONDITION, NUMBER, TEXT, Operation, Parser, Term, spelt

ENDS: Final = ("success", "terminated", "truncated")
"""The conditions of an episode."""
AGGREGATES: Final[dict[Any, tuple[str, str]]] = {
    "any": ("coalesce(bool_or({0.sql}), FALSE)", "{0.high}"),
    "never": ("NOT coalesce(bool_or({0.sql}), FALSE)", "(NOT {0.high})"),
    "all": ("coalesce(bool_and({0.sql}), TRUE)", "{0.low}"),
    "count": ("count_if({0.sql})", "CASE WHEN NOT {0.high} THEN 0 WHEN {0.low} THEN length END"),
    "then": ("coalesce(bool_or({0.sql} AND {1.sql}), FALSE)", "({0.high} AND {1.high} AND NULL)"),
    "min": ("min({0.sql})", "{0.low}"),
    "max": ("max({0.sql})", "{0.high}"),
    "sum": ("nullif(sum({0.sql}), 'NaN')", "NULL"),
    "first": ("arg_min({0.sql}, step)", "NULL"),
    "last": ("arg_max({0.sql}, step)", "NULL"),
}
"""The functions of an episode's steps, and what the index says of them if it has no column for them."""
_OF_NUMBERS: Final = ("min", "max", "sum", "first", "last")
_LOGIC: Final = (ast.Not, ast.And, ast.Or)
_BOUNDS: Final[dict[Operation, tuple[str, str]]] = {
    ast.Not: ("(NOT {0.high})", "(NOT {0.low})"),
    ast.And: ("({0.low} AND {1.low})", "({0.high} AND {1.high} AND NULL)"),
    ast.Or: ("({0.low} OR {1.low} OR NULL)", "({0.high} OR {1.high})"),
    ast.Lt: ("({0.high} < {1.low})", "({0.low} < {1.high})"),
    ast.LtE: ("({0.high} <= {1.low})", "({0.low} <= {1.high})"),
    ast.Gt: ("({0.low} > {1.high})", "({0.high} > {1.low})"),
    ast.GtE: ("({0.low} >= {1.high})", "({0.high} >= {1.low})"),
    ast.Eq: (
        "({0.low} = {1.high} AND {0.high} = {1.low})",
        "({0.low} <= {1.high} AND {0.high} >= {1.low} AND NULL)",
    ),
}
"""Over the index, whether a condition holds at all steps of an episode, and whether it holds at some."""
_EXCLUDABLE: Final = "a filter of runs can exclude it"
_MAX_WITHIN: Final = 2**31 - 1
_OF_STEPS: Final = re.compile(r"(?:min|count)\((?!.* == )(.*)\)|n_(.*)")
"""A column of the index for each column of steps, and for each event, which may be known without steps."""


@dataclass(frozen=True)
class Facts:
    """What the episodes and steps of a run have."""

    index: Sequence[str]
    """The columns of the index: of episodes, and functions of steps such as `count(collision)`."""
    actions: Mapping[str, Sequence[str]]
    """The names of actions by number, by the column of steps."""

    def columns(self, of_steps: bool) -> dict[str, str]:
        """Return the columns of steps, or of episodes, by their names in expressions."""
        matches = map(_OF_STEPS.fullmatch, self.index)
        steps = [match[1] or match[2] for match in matches if match]
        columns = steps if of_steps else [name for name in self.index if "(" not in name and name != "phase"]
        return {re.sub("^return(?=_|$)", "ret", spelt(column)): column for column in columns}


def quoted(name: str) -> str:
    """Return a name in SQL."""
    return '"' + name.replace('"', '""') + '"'


class NotInRun(RunnerError):
    """A run does not have what an expression names; `reason` says so of it."""

    def __init__(self, error: RunnerError, reason: str) -> None:
        super().__init__(str(error))
        self.reason = reason


@dataclass(frozen=True)
class Part(Term):
    """A part of a condition in SQL."""

    sql: str
    low: str = "NULL"
    """Over the index: its least value at the steps of an episode; of a condition, whether it always holds."""
    high: str = "NULL"
    """Its greatest value; of a condition, whether it holds at some step."""
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
        ast.Add: "nullif({}::DOUBLE + {}, 'NaN')",
        ast.Sub: "nullif({}::DOUBLE - {}, 'NaN')",
        ast.Mult: "nullif({}::DOUBLE * {}, 'NaN')",
        ast.Div: "nullif({}::DOUBLE / {}, 'NaN')",
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

    def fixed(self, kind: str, value: float | str) -> Part:
        """Return a constant; the SQL of a text is never used."""
        sql = f"'{value!r}'::DOUBLE" if kind == NUMBER else repr(value)
        return Part(kind, sql, sql, sql, repr(value), value)

    def applied(self, kind: str, operation: Operation, *parts: Part) -> Part:
        """Return an operation on one or two terms, and what the index knows of it."""
        left, right = parts[0], parts[-1]
        if operation is ast.USub and isinstance(left.value, int | float):
            return self.fixed(kind, -left.value)
        sql = self.operations[operation].format(*(part.sql for part in parts))
        if not self._is_inside or operation not in _BOUNDS:
            return Part(kind, sql)
        low, high = (text.format(*parts) for text in _BOUNDS[operation])
        if operation in _LOGIC:
            return Part(kind, sql, low, high)
        label = f"{left.label} == {right.label}" if operation is ast.Eq else ""
        counted = self._flag(Part(kind, f"coalesce({sql}, FALSE)", label=label))
        is_known = counted.high != "NULL" or left.value is right.value is None
        return counted if is_known else replace(counted, low=low, high=high)

    def _flag(self, part: Part) -> Part:
        """Return a condition on steps, which the index may count."""
        if (count := self._column("count", part)) == "NULL":
            return part
        return replace(part, low=f"({count} >= length)", high=f"({count} > 0)")

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
        if text.kind != TEXT or operator is not ast.Eq or not re.match("action(_|$)", action.label):
            return super().compared(node, left, operator, right)
        names = self.facts.actions.get(action.label, ())
        try:
            if not names:
                raise self.error(
                    right, f"found {text.label}, expected a number, as its actions have no names."
                )
            number = self.numbered(right, names, "action")
        except RunnerError as error:
            raise NotInRun(error, f"it has no action {text.label}; {_EXCLUDABLE}.") from None
        return self.applied(CONDITION, ast.Eq, action, self.fixed(NUMBER, number))

    def call(self, node: ast.Call, name: str) -> Part:
        """Return the term of a call: of abs(), or of a function of steps."""
        if name not in AGGREGATES:
            return super().call(node, name)
        within = "UNBOUNDED"
        for option in node.keywords:
            if (name, option.arg) != ("then", "within"):
                raise self.error(node, f"expected {name}() without options; then() alone has within=STEPS.")
            within = self.text_of(option.value)
            if not (within.isdecimal() and 0 < int(within) <= _MAX_WITHIN):
                raise self.error(
                    option.value,
                    f"found within={within}, expected a whole number of steps from 1 to {_MAX_WITHIN:,}; D "
                    "comes after C in then(C, D), so C and D at one step are any(C and D).",
                )
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
        text = self.text_of(node)[:60]
        columns = self.facts.columns(self._is_inside)
        if (column := columns.get(spelt(text))) is None:
            hint = nearest(text, [*columns, *AGGREGATES])
            more = ""
            reason = f"no {text}; {_EXCLUDABLE}"
            if not self._is_inside:
                more = ", any(), count(), then()"
                if spelt(text) in self.facts.columns(True):
                    hint = f" Steps have it: any({text}), count({text})."
            elif "t" not in columns:
                more, reason = (
                    ", as the run has no steps",
                    "no steps; `dualtaxi rerecord` records those of jobs",
                )
            listed = f"{', '.join(columns)[:1000] or 'nothing'}{more}"
            raise NotInRun(
                self.error(node, f"found {text}, expected one of {listed}.{hint}"), f"it has {reason}."
            )
        part = Part(CONDITION if column in ENDS else NUMBER, quoted(column), label=column)
        if not self._is_inside:
            return part
        if f"min({column})" in self.facts.index:
            return replace(part, low=self._column("min", part), high=self._column("max", part))
        return self._flag(replace(part, kind=CONDITION))
