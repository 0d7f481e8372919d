"""Conditions on a job's training, and the quantities that they name.

q[STATE, ACTION]       a Q-value; max(q[STATE]) and min(q[STATE]) those of a state
greedy[STATE]          the greedy action
greedy_success[STATE]  whether the greedy path from there has an event of success within the step limit
visits[STATE]          how often a step began in the state; visits[STATE, ACTION] with this action
step, episode          numbers of the training step and of its episode
reward                 of the training step
epsilon                the probability of exploring at the training step

With a table for each agent, `q.taxi_1[...]`, `reward.taxi_1`, `greedy.taxi_1[...]` and `visits.taxi_1[...]`
are the agent's own; `greedy[...]` and `visits[...]` are then of joint actions.

A condition becomes a tree of NumPy operations over columns, a column for each quantity, a row for each
moment. All numbers are float64, so a division by zero is infinite or NaN.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.config import from_mapping
from runner.environments.naming import actions_in_words, numbered_actions, states_in_words
from runner.errors import nearest
from runner.recording.reader import Recording
from runner.util.expressions import CONDITION, NUMBER, TEXT, Operation, Parser, Term

MAX_CHARACTERS: Final = 1_000
NAMES: Final = ("q", "greedy", "greedy_success", "visits", "step", "episode", "reward", "epsilon")
TABLE_NAMES: Final = NAMES[:3]
"""The quantities that are read from Q-tables."""
_INDEXED: Final = NAMES[:4]
_FORMS: Final = {name: f"{name} alone" for name in NAMES} | {
    "q": "q[STATE, ACTION]",
    "greedy": "greedy[STATE]",
    "greedy_success": "greedy_success[STATE]",
    "visits": "visits[STATE] or visits[STATE, ACTION]",
}
JOINT: Final = -1
"""Stands for the learner of a joint action."""

Array = NDArray[Any]
"""Numbers as float64, conditions as bool."""
Columns = Mapping[Any, Array]
"""The values of each quantity, [moments]; those of a row [moments, values]."""

_ROW: Final = "the values of all actions"
_ACTION: Final = "an action"


@dataclass(frozen=True)
class Quantity:
    """What is read after each step."""

    name: str
    learner: int
    """`JOINT` for joint actions."""
    state: int
    action: int
    """-1 for all."""


@dataclass(frozen=True)
class Series(Term):
    """A part of a condition, which has a value at each moment."""

    evaluate: Callable[[Columns], Array]
    names: Sequence[str] = ()
    """The names of its values, if they are actions."""
    is_whole: bool = False
    """Whether its values are whole numbers."""
    text: str = ""
    """The part's own text."""


@dataclass(frozen=True)
class Expression:
    """A condition."""

    text: str
    condition: Series
    terms: tuple[Series, ...]
    """The quantities in it, and the conditions that it combines: what explains its value."""


class JobParser(Parser[Series]):
    """Parses a condition on the training of a job; `quantities` lists what it names."""

    what = "expression"
    needed = "a quantity in it that changes"
    example = "max(q[300]) > 20"
    max_length = MAX_CHARACTERS
    max_nodes = 300
    max_number = 2**53  # exact as float64
    operations = {  # noqa: RUF012 - declared in the base class
        ast.And: np.logical_and,
        ast.Or: np.logical_or,
        ast.Not: np.logical_not,
        ast.UAdd: np.positive,
        ast.USub: np.negative,
        ast.Add: np.add,
        ast.Sub: np.subtract,
        ast.Mult: np.multiply,
        ast.Div: np.divide,
        ast.FloorDiv: np.floor_divide,
        ast.Mod: np.remainder,
        ast.Lt: np.less,
        ast.LtE: np.less_equal,
        ast.Gt: np.greater,
        ast.GtE: np.greater_equal,
        ast.Eq: np.equal,
        "max": np.maximum,
        "min": np.minimum,
        "abs": np.abs,
    }
    expected = "expected comparisons, and, or, not, + - * / // %, max(), min() and abs()"
    not_numbers = {  # noqa: RUF012
        _ROW: "one, or max() or min() of them",
        TEXT: "it next to an action: greedy[...] == TEXT",
        _ACTION: "a number; an action is compared, with == or !=, to its name",
    }

    def __init__(self, text: str, recording: Recording) -> None:
        super().__init__(text)
        self._mdp = recording.mdp
        self._learners = recording.agents
        self._learns = from_mapping(recording.config).algorithm != "random"
        self._joint = [str(name) for name in actions_in_words(self._mdp)]
        self._own = numbered_actions(self._mdp) if len(self._learners) > 1 else [self._joint]
        self._state_names = [str(name) for name in states_in_words(self._mdp)]
        self.quantities: dict[Quantity, None] = {}
        self._shown: dict[str, Series] = {}
        self._conditions: dict[str, Series] = {}

    def parse(self) -> Expression:
        """Return the parsed condition.

        Raises:
            RunnerError: it is no condition over quantities, or too large; a line marks the place.
        """
        condition = self.whole()
        parts = self._conditions if len(self._conditions) > 1 else {}
        return Expression(self.text, condition, tuple((self._shown | parts).values()))

    def term(self, node: ast.expr) -> Series:
        """Return the term of a node; quantities and comparisons are noted."""
        term = super().term(node)
        if isinstance(node, ast.Compare):
            noted = self._conditions
        elif isinstance(node, ast.Name | ast.Attribute | ast.Subscript) and term.kind != _ROW:
            noted = self._shown
        else:
            return term
        text = self.text_of(node)
        return noted.setdefault(text, replace(term, text=text))

    def fixed(self, kind: str, value: float | str) -> Series:
        """Return the term of a number, of True or False, or of a text, whose value is never asked."""
        constant = np.array(value, np.float64 if kind == NUMBER else None)
        return Series(kind, lambda _: constant)

    def applied(self, kind: str, operation: Operation, *parts: Series) -> Series:
        """Return the term of an operation on one or two terms."""
        function = self.operations[operation]
        values = [part.evaluate for part in parts]
        return Series(kind, lambda columns: function(*(value(columns) for value in values)))

    def number(self, node: ast.expr) -> Series:
        """Return the term of a number, as float64."""
        term = super().number(node)
        return Series(NUMBER, lambda columns: np.asarray(term.evaluate(columns), np.float64))

    def call(self, node: ast.Call, name: str) -> Series:
        """Return the term of a call; the highest and the lowest value of a row are quantities."""
        if name in ("max", "min") and len(node.args) == 1 and not node.keywords:
            row = self.term(node.args[0])
            if row.kind != _ROW:
                raise self.error(node.args[0], f"found one value, expected {name}(q[STATE]), or several.")
            choose = self.operations[name]
            text = self.text_of(node)
            highest = Series(NUMBER, lambda columns: choose.reduce(row.evaluate(columns), axis=1), text=text)
            return self._shown.setdefault(text, highest)
        return super().call(node, name)

    def compared(
        self, node: ast.Compare, left: ast.expr, operator: type[ast.cmpop], right: ast.expr
    ) -> Series:
        """Return the condition that compares two numbers, or two actions."""
        terms = [self.term(left), self.term(right)]
        names = terms[0].names or terms[1].names
        if not names:
            return super().compared(node, left, operator, right)
        if operator is not ast.Eq:
            raise self.error(node, "found an order of actions, expected == or !=.")
        for k, side in enumerate((left, right)):
            if not terms[k].names:
                terms[k] = self.fixed(NUMBER, self.numbered(side, names, "action"))
            elif terms[k].names != names:
                raise self.error(node, "found a joint action and one agent's, which are not comparable.")
        return self.applied(CONDITION, operator, *terms)

    # --- names ------------------------------------------------------------------------------------------

    @property
    def states(self) -> tuple[tuple[int, str], ...]:
        """The states of the quantities, with their names."""
        numbers = sorted({quantity.state for quantity in self.quantities if quantity.state >= 0})
        return tuple((number, self._state_names[number]) for number in numbers)

    def named(self, node: ast.expr) -> Series:
        """Return the quantity that a node names."""
        head = node.value if isinstance(node, ast.Subscript) else node
        base = head.value if isinstance(head, ast.Attribute) else head
        if not isinstance(base, ast.Name) or base.id not in NAMES:
            base_text = self.text_of(base)
            hint = nearest(base_text, NAMES)
            raise self.error(base, f"found {base_text[:60]}, expected one of {', '.join(NAMES)}.{hint}")
        name = base.id
        agent = head.attr if isinstance(head, ast.Attribute) else None
        self._check_algorithm(base, name)
        learner = self._learner(head, name, agent)
        index: list[ast.expr] = []
        if isinstance(node, ast.Subscript):
            index = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        if not (name in _INDEXED) <= len(index) <= _FORMS[name].count(",") + (name in _INDEXED):
            raise self.error(node, f"found {self.text_of(node)}, expected {_FORMS[name]}.")
        state = self.numbered(index[0], self._state_names, "state") if index else -1
        action = self.numbered(index[1], self._actions(learner), "action") if index[1:] else -1
        return self._quantity(Quantity(name, learner, state, action))

    def _check_algorithm(self, node: ast.expr, name: str) -> None:
        if name in TABLE_NAMES and not self._learns:
            raise self.error(
                node,
                f"found {name}, but random agents learn no Q-values; visits and reward remain.",
            )
        if name == "greedy_success":
            if not self._mdp.success_events:
                raise self.error(node, "found greedy_success, but the environment names no success events.")
            if (self._mdp.probability[..., 1:] > 0).any():
                raise self.error(
                    node,
                    "found greedy_success, but actions of this environment have several outcomes, so that a "
                    "greedy path is not one path; greedy[STATE] is the action in each state.",
                )

    def _learner(self, node: ast.expr, name: str, agent: str | None) -> int:
        several = len(self._learners) > 1
        expected = " or ".join(f"{name}.{learner}" for learner in self._learners)
        if agent is not None:
            if name not in ("q", "greedy", "visits", "reward"):
                raise self.error(node, f"found {name} of an agent, expected {name} alone.")
            if agent not in self._learners:
                hint = nearest(agent, self._learners)
                raise self.error(node, f"found {name}.{agent}, expected {expected}.{hint}")
            return self._learners.index(agent)
        if several and name in ("q", "reward"):
            raise self.error(node, f"found {name} of {len(self._learners)} agents, expected {expected}.")
        return JOINT if several else 0

    def _actions(self, learner: int) -> list[str]:
        return self._joint if learner == JOINT else self._own[learner]

    def _quantity(self, quantity: Quantity) -> Series:
        self.quantities[quantity] = None
        kind = {"greedy_success": CONDITION, "greedy": _ACTION}.get(quantity.name, NUMBER)
        if quantity.name == "q" and quantity.action < 0:
            kind = _ROW
        return Series(
            kind,
            lambda columns: columns[quantity],
            self._actions(quantity.learner) if kind == _ACTION else (),
            quantity.name in ("visits", "step", "episode"),
        )
