"""The compiled learning and evaluation loops, which fill blocks of step records.

The formulas of algorithms are in `algorithms`; both loops that learn, `train` and `replay`, call the same
function.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from runner.learning import draws
from runner.learning.algorithms import (
    Index,
    Rules,
    Tables,
    Transition,
    choose,
    chooses_ahead,
    drawn,
    expects,
    exploring,
    learn,
    remember,
)
from runner.learning.compiling import inlined, loop
from runner.learning.ledger import outcome_of
from runner.learning.model import Model
from runner.learning.schedules import schedule_value
from runner.util.arrays import Floats, Ints, Ints32, Records


class Tally(NamedTuple):
    """Counts within an episode, and over the last steps and episodes."""

    returns: Floats
    """[L]: rewards of the current episode so far."""
    event_classes: Ints
    """[E]: steps of the current episode by event class."""
    recent_outcomes: Ints32
    """Ring over the last steps: outcome class of step k at k modulo its length."""
    recent_lengths: Ints
    """Ring over the last episodes: length of episode k at k modulo its length."""


class Ends(NamedTuple):
    """Room for the episodes that a call ends, of one type for all environments: a loop is compiled once."""

    counts: Ints
    """[n, 7 + E]: what `ENDS` names, and the steps by event."""
    returns: Floats
    """[n, L]."""

    @classmethod
    def of(cls, episodes: Records) -> Ends:
        """Return room for as many episodes as a block of records has."""
        n = len(episodes)
        events, learners = episodes["events"].shape[1], episodes["returns"].shape[1]
        return cls(np.empty((n, len(ENDS) + events), np.int64), np.empty((n, learners)))

    def put(self, episodes: Records, ended: int) -> None:
        """Fill the first records of a block with the first episodes that ended."""
        episodes, counts = episodes[:ended], self.counts[:ended]
        for column, name in enumerate(ENDS):
            episodes[name] = counts[:, column]
        episodes["events"] = counts[:, len(ENDS) :]
        episodes["returns"] = self.returns[:ended]


class StateProbe(NamedTuple):
    """Values and greedy actions of some states, read before some of the steps of a block."""

    before: Ints
    """[k]: rows of the block, ascending."""
    states: Ints32
    """[k, n]: the states that are read before each of these rows; -1 for none."""
    value: NDArray[np.float32]
    """[k, L, n]: filled with the highest value of each state; nan for none."""
    greedy: Ints32
    """[k, L, n]: filled with the greedy action in each state; -1 for none."""

    def between(self, start: int, stop: int) -> StateProbe:
        """Return the part of the probe for rows `start` to `stop` of the block, as a block of their own."""
        part = slice(*np.searchsorted(self.before, (start, stop)))
        return StateProbe(self.before[part] - start, self.states[part], self.value[part], self.greedy[part])


START_RANDOM, START_EACH = -1, -2

ENDS = ("episode", "first_step", "last_step", "length", "terminated", "truncated", "penalties")
"""The fields of an ended episode that are one number each."""
PENALTIES = ENDS.index("penalties")

DRAWN = -2
"""In a policy to evaluate: each learner draws its action from the policy it has learned."""

CURSOR = np.dtype(
    [(name, "<i8") for name in ("step", "episode", "t", "state", "next_action", "next_explored")]
)
"""The position in a phase: steps taken, current episode, steps in it; if t > 0 the current state, and of
an algorithm that chooses ahead the joint action to take there, and which learners explore by it."""


@inlined
def _start_state(model: Model, bits: np.uint64) -> int:
    """Return the start state that these bits select.

    For `np.searchsorted`, comparisons of complex numbers would be compiled, which takes half a second.
    """
    u = draws.uniform(bits)
    low, high = Index(0), Index(len(model.start_states) - 1)
    while low < high:
        middle = (low + high) >> Index(1)
        if u < model.start_cumulative[middle]:
            high = middle
        else:
            low = middle + Index(1)
    return Index(model.start_states[low])


@inlined
def _outcome(model: Model, pair: int, key: np.uint64, t: int) -> int:
    """Return the index of the outcome that follows the (state, joint action) `pair` at time t."""
    outcomes = model.cumulative.shape[1]
    if outcomes == 1:
        return pair
    u = draws.uniform(draws.draw(key, t))
    k = Index(0)
    while u >= model.cumulative[pair, k]:
        k += Index(1)
    return pair * Index(outcomes) + k


@inlined
def _take_reward(model: Model, tally: Tally, record: np.record, kind: int) -> None:
    """Fill a step's record with the rewards of its outcome, and count them and its events."""
    for i in range(len(model.width)):
        record.rewards[i] = model.rewards[kind, i]
        tally.returns[i] += model.rewards[kind, i]
    tally.event_classes[Index(model.event_class[kind])] += 1


@inlined
def _end_episode(model: Model, tally: Tally, ends: Ends, row: int, last: np.record) -> None:
    """Fill a row of `ends` from the tally and the episode's last step, and clear the tally."""
    counts = ends.counts[Index(row)]
    counts[0], counts[1], counts[2], counts[3] = last.episode, last.step - last.t, last.step, last.t + 1
    counts[4], counts[5] = last.terminated, last.truncated
    for column in range(PENALTIES, len(counts)):
        counts[column] = 0
    for i in range(len(tally.returns)):
        ends.returns[Index(row), Index(i)] = tally.returns[i]
        tally.returns[i] = 0.0
    for k in range(len(tally.event_classes)):
        count = tally.event_classes[k]
        if count == 0:
            continue
        tally.event_classes[k] = 0
        mask = model.event_mask[k]
        for event in range(len(counts) - len(ENDS)):
            if mask >> np.uint32(event) & np.uint32(1):
                counts[len(ENDS) + event] += count
        if mask >> np.uint32(31):
            counts[PENALTIES] += count


@loop
def train(
    cursor: Records,
    seed: np.uint64,
    model: Model,
    tables: Tables,
    rules: Rules,
    tally: Tally,
    steps: Records,
    ends: Ends,
    until_episode: int,
    until_step: int,
    replacement: Ints32,
) -> tuple[int, int]:
    """Train until a block is full, or an episode or a step is reached; return (steps, episodes) filled.

    `steps` are records with the fields of the recording's messages; other fields are not touched. All that a
    later call needs is in the cursor, tables and tally. `replacement` ([J], or empty) is the joint action
    that is taken instead of each one chosen, as at the step of a branch.
    """
    at = cursor[0]
    step, episode, t, state = at.step, at.episode, at.t, Index(at.state)
    next_action, next_explored = at.next_action, at.next_explored
    ahead, looks_ahead = chooses_ahead(rules), chooses_ahead(rules) or expects(rules)
    learners = len(model.width)
    joint_actions = len(model.own_action)
    window, lengths = len(tally.recent_outcomes), len(tally.recent_lengths)
    exploration = draws.key(seed, draws.EXPLORATION, episode)
    chance = draws.key(seed, draws.OUTCOME, episode)
    step_size = schedule_value(rules.step_size, episode, step)
    discount = schedule_value(rules.discount, episode, step)
    epsilon = exploring(rules, episode, step)
    place = step % window
    filled = 0
    ended = np.int64(0)
    while filled < len(steps) and ended < len(ends.counts) and episode < until_episode and step < until_step:
        if t == 0:
            state = _start_state(model, draws.draw(draws.key(seed, draws.START, episode), 0))
            exploration = draws.key(seed, draws.EXPLORATION, episode)
            chance = draws.key(seed, draws.OUTCOME, episode)
        if t == 0 or rules.by_step:
            step_size = schedule_value(rules.step_size, episode, step)
            discount = schedule_value(rules.discount, episode, step)
            epsilon = exploring(rules, episode, step)

        # Choose the joint action; an algorithm that chooses ahead did so before its last update.
        if ahead and t > 0:
            action, explored = next_action, next_explored
        else:
            action, explored = choose(seed, model, tables, rules, epsilon, exploration, episode, t, state)
        if len(replacement):
            action = np.int64(replacement[action])

        # Take it, and observe.
        outcome = _outcome(model, state * Index(joint_actions) + Index(action), chance, t)
        next_state = Index(model.next_state[outcome])
        kind = Index(model.outcome_class[outcome])
        terminated = model.terminated[kind]
        truncated = t + 1 == model.step_limit

        # Learn from it.
        next_epsilon = epsilon
        if looks_ahead and rules.by_step:
            next_epsilon = exploring(rules, episode, step + 1)
        if ahead:
            next_action, next_explored = choose(
                seed, model, tables, rules, next_epsilon, exploration, episode, t + 1, next_state
            )
        if rules.learns:
            bootstraps = not terminated or rules.bootstrap_after_termination
            for i in range(learners):
                seen = Transition(
                    seed=seed,
                    episode=episode,
                    step=step,
                    t=t,
                    learner=i,
                    state=state,
                    action=Index(model.own_action[action, 0 if rules.first_action_for_all else i]),
                    reward=model.rewards[kind, i],
                    next_state=next_state,
                    next_action=Index(model.own_action[next_action, i]),
                    bootstraps=bootstraps,
                    ends=terminated or truncated,
                    step_size=step_size,
                    discount=discount,
                    next_epsilon=next_epsilon,
                )
                learn(rules, model, tables, seen)

        # Record it.
        record = steps[Index(filled)]
        record.step, record.episode, record.t = step, episode, t
        record.state, record.action, record.next_state = state, action, next_state
        record.terminated, record.truncated, record.explored = terminated, truncated, explored
        _take_reward(model, tally, record, kind)
        tally.recent_outcomes[Index(place)] = kind
        place += 1
        if place == window:
            place = 0
        filled += 1
        step += 1
        t += 1
        state = next_state
        if terminated or truncated:
            _end_episode(model, tally, ends, ended, record)
            tally.recent_lengths[episode % lengths] = t
            ended += 1
            episode += 1
            t = 0
    at.step, at.episode, at.t, at.state = step, episode, t, state
    at.next_action, at.next_explored = next_action, next_explored
    return filled, ended


@loop
def evaluate(
    cursor: Records,
    seed: np.uint64,
    model: Model,
    tables: Tables,
    policy: Ints32,
    tally: Tally,
    steps: Records,
    ends: Ends,
    until_episode: int,
    start: int,
) -> tuple[int, int]:
    """Play `policy` (the joint action of each state; -1 for a random one, `DRAWN`) as `train` trains.

    `start` is the state that trials start in, or `START_RANDOM`, or `START_EACH` for all in turn.
    """
    at = cursor[0]
    step, episode, t, state = at.step, at.episode, at.t, Index(at.state)
    learners = len(model.width)
    joint_actions = len(model.own_action)
    every_learner = (1 << learners) - 1
    chance = draws.key(seed, draws.EVALUATION_OUTCOME, episode)
    filled = 0
    ended = np.int64(0)
    while filled < len(steps) and ended < len(ends.counts) and episode < until_episode:
        if t == 0:
            if start >= 0:
                state = Index(start)
            elif start == START_EACH:
                state = Index(model.start_states[episode % len(model.start_states)])
            else:
                state = _start_state(model, draws.draw(draws.key(seed, draws.EVALUATION_START, episode), 0))
            chance = draws.key(seed, draws.EVALUATION_OUTCOME, episode)
        action = np.int64(policy[state])
        explored = 0
        if action == DRAWN:
            key = draws.key(seed, draws.EVALUATION_ACTION, episode)
            action = 0
            for i in range(learners):
                u = draws.uniform(draws.draw(key, t * learners + i))
                action += drawn(model, tables, i, state, u) * model.stride[i]
        elif action < 0:
            bits = draws.draw(draws.key(seed, draws.EVALUATION_ACTION, episode), t)
            action = draws.below(bits, joint_actions)
            explored = every_learner

        outcome = _outcome(model, state * Index(joint_actions) + Index(action), chance, t)
        next_state = Index(model.next_state[outcome])
        kind = Index(model.outcome_class[outcome])
        terminated = model.terminated[kind]
        truncated = t + 1 == model.step_limit

        record = steps[Index(filled)]
        record.step, record.episode, record.t = step, episode, t
        record.state, record.action, record.next_state = state, action, next_state
        record.terminated, record.truncated, record.explored = terminated, truncated, explored
        _take_reward(model, tally, record, kind)
        filled += 1
        step += 1
        t += 1
        state = next_state
        if terminated or truncated:
            _end_episode(model, tally, ends, ended, record)
            ended += 1
            episode += 1
            t = 0
    at.step, at.episode, at.t, at.state = step, episode, t, state
    return filled, ended


@inlined
def _recorded(
    seed: np.uint64, model: Model, rules: Rules, record: np.record, i: int, next_action: int, epsilon: float
) -> Transition:
    """Return a recorded step as learner i saw it; the next joint action and epsilon are given."""
    return Transition(
        seed=seed,
        episode=record.episode,
        step=record.step,
        t=np.int64(record.t),
        learner=i,
        state=Index(record.state),
        action=Index(model.own_action[record.action, 0 if rules.first_action_for_all else i]),
        reward=record.rewards[i],
        next_state=Index(record.next_state),
        next_action=Index(model.own_action[next_action, i]),
        bootstraps=not record.terminated or rules.bootstrap_after_termination,
        ends=record.terminated or record.truncated,
        step_size=schedule_value(rules.step_size, record.episode, record.step),
        discount=schedule_value(rules.discount, record.episode, record.step),
        next_epsilon=epsilon,
    )


@inlined
def relearn(
    seed: np.uint64, model: Model, tables: Tables, rules: Rules, record: np.record, traced: int
) -> tuple[int, bool]:
    """Apply the updates of a recorded training step; return what `learn` returns of learner `traced`.

    `traced` is -1 if no learner's update is asked for.

    A recorded step and the run's draws hold all inputs of its update, so the update is equal to `train`'s,
    to the last bit. A memory of earlier steps is one of these inputs: see `recall`.
    """
    noted = np.int64(-1), False
    if not rules.learns:
        return noted
    next_action, next_epsilon = 0, 0.0
    if chooses_ahead(rules) or expects(rules):
        next_epsilon = exploring(rules, record.episode, record.step + 1)
    if chooses_ahead(rules):
        exploration = draws.key(seed, draws.EXPLORATION, record.episode)
        t, next_state = np.int64(record.t) + 1, Index(record.next_state)
        next_action, _ = choose(
            seed, model, tables, rules, next_epsilon, exploration, record.episode, t, next_state
        )
    for i in range(len(model.width)):
        seen = _recorded(seed, model, rules, record, i, next_action, next_epsilon)
        made_of = learn(rules, model, tables, seen)
        if i == traced:
            noted = made_of
    return noted


@loop
def recall(seed: np.uint64, model: Model, tables: Tables, rules: Rules, steps: Records) -> None:
    """Remember recorded training steps, in order, as when they were learned from; only the memory changes."""
    for k in range(len(steps)):
        for i in range(len(model.width)):
            remember(rules, model, tables, _recorded(seed, model, rules, steps[k], i, np.int64(0), 0.0))


@inlined
def _read_rows(model: Model, tables: Tables, rows: Floats, k: int, state: int) -> None:
    """Read each learner's values of a state into row k of `rows`, [n, L, widest], if it has one."""
    if k < len(rows):
        for i in range(len(model.width)):
            row = tables.offset[i] + state * model.width[i]
            for action in range(model.width[i]):
                rows[k, i, action] = tables.q[row + action]


@loop
def read_states(tables: Tables, states: Ints32, value: Floats, greedy: Ints32) -> None:
    """Read the highest value and the greedy action of states, [n], into [L, n]; nan and -1 for state -1."""
    for i in range(value.shape[0]):
        for k in range(value.shape[1]):
            state = states[k]
            if state < 0:
                value[i, k] = np.nan
                greedy[i, k] = -1
            else:
                value[i, k] = tables.value[i, state]
                greedy[i, k] = tables.greedy[i, state]


@loop
def replay(
    seed: np.uint64,
    model: Model,
    tables: Tables,
    rules: Rules,
    steps: Records,
    rows: Floats,
    updates: Records,
    traced: int,
    probe: StateProbe,
) -> None:
    """Apply the updates of recorded training steps, in order, to the tables, and fill a probe.

    As far as `rows` ([steps, L, widest], or empty) goes, row k gets each learner's values of the state before
    step k's update: those it chose by. Item k of `updates` ([steps] of `ledger.UPDATE`, or empty) gets what
    decides the weights of learner `traced`'s update.
    """
    at = 0
    for k in range(len(steps)):
        while at < len(probe.before) and probe.before[at] == k:
            read_states(tables, probe.states[at], probe.value[at], probe.greedy[at])
            at += 1
        record = steps[k]
        _read_rows(model, tables, rows, k, record.state)
        bootstrapped, second = relearn(seed, model, tables, rules, record, traced)
        if k < len(updates) and rules.learns:
            update = updates[k]
            update.outcome, update.episode = outcome_of(model, record, traced), record.episode
            update.bootstrapped, update.second = bootstrapped, second


@numba.njit(cache=True)
def fill_random(q: Floats, seed: np.uint64, low: float, high: float) -> None:
    """Fill the tables with draws, uniform in [low, high)."""
    state = draws.key(seed, draws.INITIAL_Q, 0)
    for cell in range(len(q)):
        q[cell] = low + (high - low) * draws.uniform(draws.draw(state, cell))
