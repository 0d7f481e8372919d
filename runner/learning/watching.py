"""Replaying recorded steps while watching some values of the tables: only their changes are reported."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numba
import numpy as np

from runner.learning.algorithms import Index, Rules, Tables, exploring
from runner.learning.compiling import inlined, loop
from runner.learning.kernel import relearn
from runner.learning.model import Model
from runner.util.arrays import Flags, Floats, Ints, Ints32, Records


class Watch(NamedTuple):
    """The values to watch, and the greedy paths from P start states."""

    states: Flags
    """[S]: the states whose updates are reported."""
    cells: Ints
    """[n]: places in `Tables.q`."""
    greedy: Ints
    """[m, 2]: a learner and a state each."""
    starts: Ints
    """[P]: where the greedy paths start."""
    success: np.uint32
    """The bits of an event mask that mean success."""
    path: Ints32
    """[P, S]: the states on each path, in order."""
    length: Ints
    """[P]: how many there are."""
    on_path: Flags
    """[P, S]: whether a state is on the path."""
    succeeds: Flags
    """[P]: whether the path has an event of success."""


def new_watch(
    states: Flags,
    cells: Ints,
    greedy: Sequence[tuple[int, int]] = (),
    starts: Sequence[int] = (),
    success: int = 0,
) -> Watch:
    """Return what to watch, with room for the greedy paths."""
    paths = len(starts), len(states)
    return Watch(
        states,
        cells,
        np.array(greedy, np.int64).reshape(-1, 2),
        np.array(starts, np.int64),
        np.uint32(success),
        np.zeros(paths, np.int32),
        np.zeros(len(starts), np.int64),
        np.zeros(paths, np.bool_),
        np.zeros(len(starts), np.bool_),
    )


class WatchedValues(NamedTuple):
    """The watched values after the steps of a block that could change them, a row for each."""

    row: Ints
    """[k]: the step, as its place in the block, ascending."""
    q: Floats
    """[k, n]."""
    greedy: Ints32
    """[k, m]."""
    succeeds: Flags
    """[k, P]."""


def empty_changes(watch: Watch, rows: int) -> WatchedValues:
    """Return changes to be filled, of up to this number of rows."""
    return WatchedValues(
        np.empty(rows, np.int64),
        np.empty((rows, len(watch.cells))),
        np.empty((rows, len(watch.greedy)), np.int32),
        np.empty((rows, len(watch.starts)), np.bool_),
    )


def joined(parts: Sequence[tuple[WatchedValues, int]]) -> WatchedValues:
    """Return the filled rows of changes, each with their number, one after the other."""
    columns = zip(*([array[:rows] for array in changes] for changes, rows in parts), strict=True)
    return WatchedValues(*map(np.concatenate, columns))


@inlined
def _joint_greedy(model: Model, tables: Tables, state: int) -> int:
    action = 0
    for i in range(len(model.width)):
        action += np.int64(tables.greedy[i, state]) * model.stride[i]
    return action


@inlined
def _follow(model: Model, tables: Tables, watch: Watch, p: int) -> None:
    """Follow the greedy path number p through a deterministic environment, to its end or into a cycle.

    A path that returns to one of its states goes round for ever, and so has no success.
    """
    for k in range(watch.length[p]):
        watch.on_path[p, watch.path[p, k]] = False
    watch.succeeds[p] = False
    state, n = watch.starts[p], 0
    while not watch.on_path[p, state] and (model.step_limit == 0 or n < model.step_limit):
        watch.on_path[p, state] = True
        watch.path[p, n] = state
        n += 1
        pair = state * len(model.own_action) + _joint_greedy(model, tables, state)
        outcome = pair * model.cumulative.shape[1]
        kind = model.outcome_class[outcome]
        if model.event_mask[model.event_class[kind]] & watch.success:
            watch.succeeds[p] = True
            break
        if model.terminated[kind]:
            break
        state = np.int64(model.next_state[outcome])
    watch.length[p] = n


@inlined
def _read(tables: Tables, watch: Watch, changes: WatchedValues, k: int) -> None:
    """Fill row k of `changes` with the watched values as they are now."""
    for n in range(len(watch.cells)):
        changes.q[k, n] = tables.q[watch.cells[n]]
    for m in range(len(watch.greedy)):
        changes.greedy[k, m] = tables.greedy[watch.greedy[m, 0], watch.greedy[m, 1]]
    for p in range(len(watch.starts)):
        changes.succeeds[k, p] = watch.succeeds[p]


@inlined
def _is_remembered(model: Model, tables: Tables, states: Flags) -> bool:
    """Return whether a learner remembers a value of one of these states, [S]."""
    memory = tables.memory
    for i in range(len(model.width)):
        for k in range(memory.count[i]):
            if states[memory.cells[i, k] // model.width[i]]:
                return True
    return False


@loop
def begin(model: Model, tables: Tables, watch: Watch, changes: WatchedValues) -> None:
    """Follow all greedy paths, and fill the first row of `changes`."""
    for p in range(len(watch.starts)):
        _follow(model, tables, watch, p)
    _read(tables, watch, changes, 0)


@loop
def replay_watched(
    seed: np.uint64,
    model: Model,
    tables: Tables,
    rules: Rules,
    steps: Records,
    watch: Watch,
    changes: WatchedValues,
) -> int:
    """Replay steps, fill `changes`, which has a row for each step, and return how many rows were filled.

    An update changes values of its step's state, and of states in the learners' memory. So a greedy path is
    followed again only when the greedy action changed in the step's state, or a state in memory is on it.
    """
    filled = 0
    for k in range(len(steps)):
        state = Index(steps[k].state)
        before = _joint_greedy(model, tables, state)
        relearn(seed, model, tables, rules, steps[k], np.int64(-1))
        is_turned = _joint_greedy(model, tables, state) != before
        is_changed = watch.states[state] or _is_remembered(model, tables, watch.states)
        for p in range(len(watch.starts)):
            on_path = watch.on_path[p]
            if (is_turned and on_path[state]) or _is_remembered(model, tables, on_path):
                succeeded = watch.succeeds[p]
                _follow(model, tables, watch, p)
                is_changed |= watch.succeeds[p] != succeeded
        if is_changed:
            changes.row[filled] = k
            _read(tables, watch, changes, filled)
            filled += 1
    return filled


@numba.njit(cache=True, nogil=True)
def explorations(rules: Rules, episodes: Ints, steps: Ints) -> Floats:
    """Return the probability of exploring at training steps of these episodes, [n]."""
    probabilities = np.empty(len(steps))
    for k in range(len(steps)):
        probabilities[k] = exploring(rules, episodes[k], steps[k])
    return probabilities
