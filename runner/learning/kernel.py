"""The compiled learning and evaluation loops; they fill blocks of step records and know nothing else.

`train` is epsilon-greedy tabular Q-learning as in Sutton and Barto, "Reinforcement Learning" (2nd
edition, section 6.5), for one table over the joint action or one table a learner:

    Q(S, A) <- Q(S, A) + step_size * (R + discount * max_a Q(S', a) - Q(S, A))

The greedy action and the value of each state are kept beside the tables and mended at each update, so a
step does not scan a row unless the row's best value fell. Ties go to the lowest action.
"""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from runner.learning import draws
from runner.learning.model import Model
from runner.learning.schedules import schedule_value


class Tables(NamedTuple):
    """The learners' Q-tables, one after the other in one array, and what is kept beside them."""

    q: NDArray[np.float64]
    """[sum of S * width]: table i starts at offset[i], row-major."""
    offset: tuple[int, ...]
    """[L]; a tuple, as `Model.width`: their length is known when the kernel is compiled."""
    greedy: NDArray[np.int32]
    """[L, S]: the lowest action of the highest value."""
    value: NDArray[np.float64]
    """[L, S]: the highest value."""


class Rules(NamedTuple):
    """How to learn: three schedules (see `schedules`) and the switches of the configuration."""

    step_size: NDArray[np.float64]
    discount: NDArray[np.float64]
    epsilon: NDArray[np.float64]
    by_step: bool
    """Whether any schedule counts steps, not episodes."""
    learns: bool
    independent: bool
    """Whether each learner explores by a draw of its own."""
    epsilon_exploits: bool
    first_action_for_all: bool
    bootstrap_after_termination: bool


class Tally(NamedTuple):
    """What is counted while an episode runs, and over the last steps and episodes."""

    returns: NDArray[np.float64]
    """[L]: rewards of the current episode so far."""
    event_classes: NDArray[np.int64]
    """[E]: steps of the current episode by event class."""
    recent_outcomes: NDArray[np.int32]
    """Ring over the last steps: outcome class of step k at k modulo its length."""
    recent_lengths: NDArray[np.int64]
    """Ring over the last episodes: length of episode k at k modulo its length."""


Index = np.uint64
"""What the hot loops index with: numba leaves out the arithmetic for negative indices."""

START_RANDOM, START_EACH = -1, -2

CURSOR = np.dtype([("step", "<i8"), ("episode", "<i8"), ("t", "<i8"), ("state", "<i8")])
"""Where a phase stands: steps taken, current episode, steps in it, current state (if t > 0)."""


@numba.njit(inline="always")
def _start_state(model: Model, bits: np.uint64) -> int:
    """Return the start state that falls to these bits."""
    return Index(
        model.start_states[np.searchsorted(model.start_cumulative, draws.uniform(bits), side="right")]
    )


@numba.njit(inline="always")
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


@numba.njit(inline="always")
def _update(
    tables: Tables, i: int, state: int, action: int, width: int, target: float, step_size: float
) -> None:
    """Move Q_i(state, action) towards the target; keep the state's greedy action and value true."""
    row = Index(tables.offset[i]) + state * Index(width)
    old = tables.q[row + action]
    new = old + step_size * (target - old)
    tables.q[row + action] = new
    if action == Index(tables.greedy[i, state]):
        if new >= old:
            tables.value[i, state] = new
        else:
            _rescan(tables, i, state, row, width)
    elif new > tables.value[i, state] or (
        new == tables.value[i, state] and action < Index(tables.greedy[i, state])
    ):
        tables.greedy[i, state] = action
        tables.value[i, state] = new


@numba.njit(inline="always")
def _rescan(tables: Tables, i: int, state: int, row: int, width: int) -> None:
    """Find the state's greedy action and value anew."""
    best = Index(0)
    highest = tables.q[row]
    for action in range(Index(1), Index(width)):
        if tables.q[row + action] > highest:
            highest = tables.q[row + action]
            best = action
    tables.greedy[i, state] = best
    tables.value[i, state] = highest


@numba.njit(inline="always")
def _end_episode(model: Model, tally: Tally, record: np.record, last: np.record) -> None:
    """Fill the episode's record from the tally and its last step, and clear the tally."""
    record.episode = last.episode
    record.length = last.t + 1
    record.last_step = last.step
    record.terminated = last.terminated
    record.truncated = last.truncated
    record.penalties = 0
    for i in range(len(tally.returns)):
        record.returns[i] = tally.returns[i]
        tally.returns[i] = 0.0
    for event in range(len(record.events)):
        record.events[event] = 0
    for k in range(len(tally.event_classes)):
        count = tally.event_classes[k]
        if count == 0:
            continue
        tally.event_classes[k] = 0
        mask = model.event_mask[k]
        for event in range(len(record.events)):
            if mask >> np.uint32(event) & np.uint32(1):
                record.events[event] += count
        if mask >> np.uint32(31):
            record.penalties += count


@numba.njit(cache=True, nogil=True)
def train(
    cursor: NDArray[np.void],
    seed: np.uint64,
    model: Model,
    tables: Tables,
    rules: Rules,
    tally: Tally,
    steps: NDArray[np.void],
    episodes: NDArray[np.void],
    until_episode: int,
    until_step: int,
) -> tuple[int, int]:
    """Train until a block is full, or an episode or a step is reached; return (steps, episodes) filled.

    `steps` and `episodes` are record arrays with the fields of the recording's messages; whatever else
    they have is left alone. Everything that a later call needs is in the cursor, tables and tally.
    """
    at = cursor[0]
    step, episode, t, state = at.step, at.episode, at.t, Index(at.state)
    learners = len(model.width)
    joint_actions = len(model.own_action)
    every_learner = (1 << learners) - 1
    window, lengths = len(tally.recent_outcomes), len(tally.recent_lengths)
    exploration = draws.key(seed, draws.EXPLORATION, episode)
    chance = draws.key(seed, draws.OUTCOME, episode)
    step_size = schedule_value(rules.step_size, episode, step)
    discount = schedule_value(rules.discount, episode, step)
    epsilon = schedule_value(rules.epsilon, episode, step)
    if rules.epsilon_exploits:
        epsilon = 1.0 - epsilon
    place = step % window
    filled = ended = 0
    while filled < len(steps) and ended < len(episodes) and episode < until_episode and step < until_step:
        if t == 0:
            state = _start_state(model, draws.draw(draws.key(seed, draws.START, episode), 0))
            exploration = draws.key(seed, draws.EXPLORATION, episode)
            chance = draws.key(seed, draws.OUTCOME, episode)
        if t == 0 or rules.by_step:
            step_size = schedule_value(rules.step_size, episode, step)
            discount = schedule_value(rules.discount, episode, step)
            epsilon = schedule_value(rules.epsilon, episode, step)
            if rules.epsilon_exploits:
                epsilon = 1.0 - epsilon

        # Choose the joint action.
        action = 0
        explored = 0
        if rules.independent:
            for i in range(learners):
                bits = draws.draw(exploration, t * learners + i)
                if draws.coin(bits) < epsilon:
                    action += draws.below(bits, model.width[i]) * model.stride[i]
                    explored |= 1 << i
                else:
                    action += tables.greedy[i, state] * model.stride[i]
        else:
            bits = draws.draw(exploration, t)
            if draws.coin(bits) < epsilon:
                action = draws.below(bits, joint_actions)
                explored = every_learner
            else:
                for i in range(learners):
                    action += tables.greedy[i, state] * model.stride[i]

        # Take it, and observe.
        outcome = _outcome(model, state * Index(joint_actions) + Index(action), chance, t)
        next_state = Index(model.next_state[outcome])
        kind = Index(model.outcome_class[outcome])
        terminated = model.terminated[kind]
        truncated = t + 1 == model.step_limit

        # Learn from it.
        if rules.learns:
            for i in range(learners):
                target = model.rewards[kind, i]
                if not terminated or rules.bootstrap_after_termination:
                    target += discount * tables.value[i, next_state]
                own = Index(model.own_action[action, 0 if rules.first_action_for_all else i])
                _update(tables, i, state, own, model.width[i], target, step_size)

        # Record it.
        record = steps[Index(filled)]
        record.step = step
        record.episode = episode
        record.t = t
        record.state = state
        record.action = action
        record.next_state = next_state
        for i in range(learners):
            record.rewards[i] = model.rewards[kind, i]
            tally.returns[i] += model.rewards[kind, i]
        record.terminated = terminated
        record.truncated = truncated
        record.explored = explored
        tally.event_classes[Index(model.event_class[kind])] += 1
        tally.recent_outcomes[Index(place)] = kind
        place += 1
        if place == window:
            place = 0
        filled += 1
        step += 1
        t += 1
        state = next_state
        if terminated or truncated:
            _end_episode(model, tally, episodes[ended], record)
            tally.recent_lengths[episode % lengths] = t
            ended += 1
            episode += 1
            t = 0
    at.step, at.episode, at.t, at.state = step, episode, t, state
    return filled, ended


@numba.njit(cache=True, nogil=True)
def evaluate(
    cursor: NDArray[np.void],
    seed: np.uint64,
    model: Model,
    policy: NDArray[np.int32],
    tally: Tally,
    steps: NDArray[np.void],
    episodes: NDArray[np.void],
    until_episode: int,
    start: int,
) -> tuple[int, int]:
    """Play `policy` (the joint action of each state; -1 for a random one) as `train` trains.

    `start` is the state that trials start in, or `START_RANDOM`, or `START_EACH` for all in turn.
    """
    at = cursor[0]
    step, episode, t, state = at.step, at.episode, at.t, Index(at.state)
    learners = len(model.width)
    joint_actions = len(model.own_action)
    every_learner = (1 << learners) - 1
    chance = draws.key(seed, draws.EVALUATION_OUTCOME, episode)
    filled = ended = 0
    while filled < len(steps) and ended < len(episodes) and episode < until_episode:
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
        if action < 0:
            bits = draws.draw(draws.key(seed, draws.EVALUATION_ACTION, episode), t)
            action = draws.below(bits, joint_actions)
            explored = every_learner

        outcome = _outcome(model, state * Index(joint_actions) + Index(action), chance, t)
        next_state = Index(model.next_state[outcome])
        kind = Index(model.outcome_class[outcome])
        terminated = model.terminated[kind]
        truncated = t + 1 == model.step_limit

        record = steps[Index(filled)]
        record.step = step
        record.episode = episode
        record.t = t
        record.state = state
        record.action = action
        record.next_state = next_state
        for i in range(learners):
            record.rewards[i] = model.rewards[kind, i]
            tally.returns[i] += model.rewards[kind, i]
        record.terminated = terminated
        record.truncated = truncated
        record.explored = explored
        tally.event_classes[Index(model.event_class[kind])] += 1
        filled += 1
        step += 1
        t += 1
        state = next_state
        if terminated or truncated:
            _end_episode(model, tally, episodes[ended], record)
            ended += 1
            episode += 1
            t = 0
    at.step, at.episode, at.t, at.state = step, episode, t, state
    return filled, ended


@numba.njit(cache=True, nogil=True)
def replay(
    model: Model, tables: Tables, rules: Rules, steps: NDArray[np.void], rows: NDArray[np.float64]
) -> None:
    """Apply the updates of recorded training steps, in order, to the tables.

    A recorded step holds all that its update took in, so the replayed update is `train`'s own, to the last
    bit. Where `rows` ([steps, L, widest], or empty) has room, row k gets each learner's values of the state
    before step k's update: what it saw when it chose.
    """
    learners = len(model.width)
    for k in range(len(steps)):
        record = steps[k]
        if k < len(rows):
            for i in range(learners):
                row = tables.offset[i] + record.state * model.width[i]
                for action in range(model.width[i]):
                    rows[k, i, action] = tables.q[row + action]
        if not rules.learns:
            continue
        step_size = schedule_value(rules.step_size, record.episode, record.step)
        discount = schedule_value(rules.discount, record.episode, record.step)
        for i in range(learners):
            target = record.rewards[i]
            if not record.terminated or rules.bootstrap_after_termination:
                target += discount * tables.value[i, record.next_state]
            own = Index(model.own_action[record.action, 0 if rules.first_action_for_all else i])
            _update(tables, i, Index(record.state), own, model.width[i], target, step_size)


@numba.njit(cache=True)
def fill_random(q: NDArray[np.float64], seed: np.uint64, low: float, high: float) -> None:
    """Fill the tables with draws, uniform in [low, high)."""
    state = draws.key(seed, draws.INITIAL_Q, 0)
    for cell in range(len(q)):
        q[cell] = low + (high - low) * draws.uniform(draws.draw(state, cell))
