"""Conditions on a job's training, and the quantities that they name, after each training step.

    q[STATE, ACTION]       a Q-value; max(q[STATE]) and min(q[STATE]) are a state's highest and lowest
    greedy[STATE]          the greedy action
    greedy_success[STATE]  whether the greedy path from there has an event of success within the step limit
    visits[STATE]          how often a step began in the state; visits[STATE, ACTION]: with this action
    step, episode          numbers of the training step and of its episode
    reward                 the reward of the training step
    epsilon                the probability of exploring at the training step

With a table for each agent, `q.taxi_1[...]`, `reward.taxi_1`, `greedy.taxi_1[...]` and `visits.taxi_1[...]`
are the agent's own; `greedy[...]` and `visits[...]` are then of joint actions.

A condition becomes a tree of NumPy operations over columns, a column for each quantity and a row for each
moment, which `JobColumns` fills. All numbers are float64, so a division by zero is infinite or NaN.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.config import from_mapping
from runner.environments.naming import actions_in_words, numbered_actions, states_in_words
from runner.errors import RecordingError, RunnerError, nearest
from runner.learning.learner import rules_of
from runner.learning.watching import Watch, WatchedValues, explorations, new_watch
from runner.recording.reader import Recording
from runner.replay.tables import TableReplay
from runner.util.arrays import Flags, Ints, Records
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
    """A value that is read after each step."""

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
    """The quantities in it, and the conditions that it combines."""


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
        quantity = Quantity(name, learner, state, action)
        self.quantities[quantity] = None
        kind = {"greedy_success": CONDITION, "greedy": _ACTION}.get(name, NUMBER)
        return Series(
            _ROW if name == "q" and action < 0 else kind,
            lambda columns: columns[quantity],
            self._actions(learner) if kind == _ACTION else (),
            name in ("visits", "step", "episode"),
        )

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


# --- values after each training step ------------------------------------------------------------------

MAX_CELLS: Final = 4_096
"""The most Q-values of an expression."""
MAX_PATH_STATES: Final = 1 << 24
"""The most states of all greedy paths of an expression."""
_VALUES_AT_ONCE: Final = 1 << 20


class JobColumns:
    """The values of quantities after training steps, in blocks of which only the changes are taken.

    `start` is the first training step; the tables are those before it.
    """

    def __init__(self, recording: Recording, quantities: list[Quantity], start: int) -> None:
        self._quantities = quantities
        self._mdp = recording.mdp
        config = from_mapping(recording.config)
        starts = sorted({0, *(branch.step for branch in config.branches)})
        self._segments = [(start, rules_of(config.from_step(start))) for start in starts]
        """The rules of training, each with the step from which they apply."""
        several = len(recording.agents) > 1
        self._widths = list(self._mdp.action_counts) if several else [self._mdp.joint_actions]
        self._cells: dict[Quantity, slice] = {}
        self._greedy: dict[Quantity, list[int]] = {}
        self._paths = [quantity for quantity in quantities if quantity.name == "greedy_success"]
        names = {quantity.name for quantity in quantities}
        by_step = "epsilon" in names and (
            len(starts) > 1
            or any(bool(rules.epsilon[1]) for _, rules in self._segments)  # schedules by step, not by episode
        )
        self._every_step = by_step or bool(names & {"step", "reward"})
        self._by_episode = bool(names & {"episode", "epsilon"})
        self._watch = self._new_watch()
        self._visits = {quantity: 0 for quantity in quantities if quantity.name == "visits"}
        if self._visits:
            self._count_visits(recording, start)
        self._replay = TableReplay(recording, start) if names & set(TABLE_NAMES) else None
        self.last = self._first()
        """The values now, one row each; NaN for those of a step before the first step."""

    def _new_watch(self) -> Watch:
        offsets = [self._mdp.states * sum(self._widths[:i]) for i in range(len(self._widths))]
        cells: list[int] = []
        greedy: list[tuple[int, int]] = []
        states = np.zeros(self._mdp.states, np.bool_)
        for quantity in self._quantities:
            if quantity.name == "q":
                width = self._widths[quantity.learner]
                row = offsets[quantity.learner] + quantity.state * width
                cells_of_quantity = (
                    range(row, row + width) if quantity.action < 0 else [row + quantity.action]
                )
                self._cells[quantity] = slice(len(cells), len(cells) + len(cells_of_quantity))
                cells += cells_of_quantity
            elif quantity.name == "greedy":
                learners = range(len(self._widths)) if quantity.learner == JOINT else [quantity.learner]
                self._greedy[quantity] = [len(greedy) + k for k in range(len(learners))]
                greedy += [(i, quantity.state) for i in learners]
            if quantity.name in ("q", "greedy"):
                states[quantity.state] = True
        if len(cells) > MAX_CELLS or len(self._paths) * self._mdp.states > MAX_PATH_STATES:
            raise RunnerError(
                f"expression: needs {len(cells):,} Q-values and {len(self._paths)} greedy paths through "
                f"{self._mdp.states:,} states, expected at most {MAX_CELLS:,} values and {MAX_PATH_STATES:,} "
                "states on paths; ask for parts of it."
            )
        path_starts = [quantity.state for quantity in self._paths]
        return new_watch(states, np.array(cells, np.int64), greedy, path_starts, self._mdp.success_mask)

    def take(self, block: Records, needed: int) -> Iterator[tuple[Ints, Columns]]:
        """Yield the places in a block after which quantities may have changed, and the values there.

        The block has the training steps that follow. The values have one more row, the first: the values
        before these steps. The place `needed` is always included; -1 for none.
        """
        width = max(len(self._watch.cells), 1)
        size = max(_VALUES_AT_ONCE // width, 1)
        for first in range(0, len(block), size):
            part = block[first : first + size]
            places, columns = self._part(part, needed - first)
            if len(places):
                whole = {key: np.concatenate([self.last[key], column]) for key, column in columns.items()}
                self.last = {key: column[-1:] for key, column in whole.items()}
                yield places + first, whole

    def _part(self, block: Records, needed: int) -> tuple[Ints, Columns]:
        changes = None if self._replay is None else self._replay.watch(block, self._watch)
        visits = {quantity: self._visited(quantity, block) for quantity in self._visits}
        may_change = np.full(len(block), self._every_step)
        for mask in visits.values():
            may_change |= mask
        if changes is not None:
            may_change[changes.row] = True
        if self._by_episode:
            may_change |= block["t"] == 0
        if 0 <= needed < len(block):
            may_change[needed] = True
        places = np.flatnonzero(may_change)
        columns: dict[Quantity, Array] = {}
        if len(places):
            columns = self._of_steps(block[places])
            if changes is not None:  # the values of the last change before or at each place
                at = np.searchsorted(changes.row, places, side="right")
                for quantity, values in self._table_values(changes).items():
                    columns[quantity] = np.concatenate([self.last[quantity], values])[at]
        for quantity, mask in visits.items():
            if len(places):
                columns[quantity] = (self._visits[quantity] + np.cumsum(mask)[places]).astype(np.float64)
            self._visits[quantity] += int(np.count_nonzero(mask))
        return places, columns

    def _of_steps(self, steps: Records) -> dict[Quantity, Array]:
        columns: dict[Quantity, Array] = {}
        for quantity in self._quantities:
            if quantity.name in ("step", "episode"):
                columns[quantity] = steps[quantity.name].astype(np.float64)
            elif quantity.name == "reward":
                columns[quantity] = steps["rewards"][:, quantity.learner].astype(np.float64)
            elif quantity.name == "epsilon":
                columns[quantity] = np.empty(len(steps))
                for start, rules in self._segments:
                    wanted_steps = steps[steps["step"] >= start]
                    numbers = (
                        np.ascontiguousarray(wanted_steps[name], np.int64) for name in ("episode", "step")
                    )
                    columns[quantity][len(steps) - len(wanted_steps) :] = explorations(rules, *numbers)
        return columns

    def _table_values(self, changes: WatchedValues) -> dict[Quantity, Array]:
        columns: dict[Quantity, Array] = {}
        for quantity, cells in self._cells.items():
            columns[quantity] = changes.q[:, cells] if quantity.action < 0 else changes.q[:, cells.start]
        for quantity, learners in self._greedy.items():
            strides = (
                [math.prod(self._widths[i + 1 :]) for i in range(len(learners))] if len(learners) > 1 else [1]
            )
            columns[quantity] = (
                (changes.greedy[:, learners] * np.array(strides)).sum(axis=1).astype(np.float64)
            )
        for p, quantity in enumerate(self._paths):
            columns[quantity] = changes.succeeds[:, p]
        return columns

    def _first(self) -> Columns:
        columns: dict[Quantity, Array] = {quantity: np.full(1, np.nan) for quantity in self._quantities}
        for quantity, visits in self._visits.items():
            columns[quantity] = np.full(1, float(visits))
        if self._replay is not None:
            columns |= self._table_values(self._replay.begin_watch(self._watch))
        return columns

    def _count_visits(self, recording: Recording, stop: int) -> None:
        expected = 0
        if stop:
            for block in recording.train.steps.blocks(0, stop):
                first = int(block["step"][0])
                check_lost(recording, expected, first)
                expected = first + len(block)
                for quantity in self._visits:
                    self._visits[quantity] += int(np.count_nonzero(self._visited(quantity, block)))
        check_lost(recording, expected, stop)

    def _visited(self, quantity: Quantity, steps: Records) -> Flags:
        mask = steps["state"] == quantity.state
        if quantity.action < 0:
            return np.asarray(mask)
        actions = steps["action"]
        if quantity.learner != JOINT and len(self._widths) > 1:
            agent_actions = self._mdp.own_actions[:, quantity.learner]
            actions = agent_actions[np.minimum(actions, len(agent_actions) - 1)]
        return np.asarray(mask & (actions == quantity.action))


def check_lost(recording: Recording, expected: int, found: int) -> None:
    """Check that no training steps were lost before the step that was found.

    Raises:
        RecordingError: another step was expected.
    """
    if found != expected:
        raise RecordingError(
            f"{recording.path}: training steps {expected:,} to {found - 1:,} were lost, so what holds after "
            "them is unknown; search up to the step before, or from one after the next Q-table, without "
            "visits."
        )
