"""The formulas of each algorithm: how it acts at a step, and what it learns from it.

`choose` and `learn` are compiled into the loops of `kernel`, which train and replay with them. The algorithm
is known when they are compiled (`Rules.algorithm`), so each has a kernel of its own and none slows down
another. docs/algorithms.md has all of them side by side; the formulas are from

- Sutton and Barto, "Reinforcement Learning", 2nd edition: SARSA (section 6.4), Q-learning (6.5), Expected
  SARSA (6.6), Double Q-learning (6.7; van Hasselt, "Double Q-learning", 2010);
- Matignon, Laurent and Le Fort-Piat, "Hysteretic Q-learning", 2007;
- Bowling and Veloso, "Multiagent learning using a variable learning rate", 2002: WoLF-PHC.

The greedy action and the value of each state are stored next to the tables and updated with them, so a step
does not scan a row unless the row's best value fell. Ties go to the lowest action.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from runner.learning import draws
from runner.learning.compiling import inlined
from runner.learning.model import Model
from runner.learning.schedules import schedule_value

Q_LEARNING: Final = 1
SARSA: Final = 2
EXPECTED_SARSA: Final = 3
DOUBLE_Q_LEARNING: Final = 4
HYSTERETIC_Q_LEARNING: Final = 5
WOLF_PHC: Final = 6

NUMBERS: Final = {
    "random": Q_LEARNING,
    "q_learning": Q_LEARNING,
    "sarsa": SARSA,
    "expected_sarsa": EXPECTED_SARSA,
    "double_q_learning": DOUBLE_Q_LEARNING,
    "hysteretic_q_learning": HYSTERETIC_Q_LEARNING,
    "wolf_phc": WOLF_PHC,
}
"""The configuration's `algorithm` to its number; random agents learn nothing (`Rules.learns`)."""

EXTRA_TABLES: Final = {
    "double_q_learning": ("q_1", "q_2"),
    "wolf_phc": ("policy", "average_policy", "visits"),
}
"""The tables of an algorithm besides the Q-table that is shown."""

FIRST, SECOND = 0, 1
"""Rows of `Tables.extra` of Double Q-learning: its two Q-tables."""
POLICY, AVERAGE_POLICY = 0, 1
"""Rows of `Tables.extra` of WoLF-PHC."""
DECREASE: Final = 0
"""Place in `Rules.parameters` of Hysteretic Q-learning: the step size of updates that lower a value."""
WIN, LOSE = 0, 1
"""Places in `Rules.parameters` of WoLF-PHC: how far the policy moves in one update."""
MAX_PARAMETERS: Final = 2


class Tables(NamedTuple):
    """The learners' tables, those of one kind one after the other, and values derived from them."""

    q: NDArray[np.float64]
    """[sum of S * width]: table i starts at offset[i], row-major. These values are shown, and greedy actions
    follow them; of Double Q-learning the mean of both tables."""
    offset: tuple[int, ...]
    """[L]; a tuple, as `Model.width`: their length is known when the kernel is compiled."""
    greedy: NDArray[np.int32]
    """[L, S]: the lowest action of the highest value."""
    value: NDArray[np.float64]
    """[L, S]: the highest value."""
    extra: NDArray[np.float64]
    """[2, sum of S * width], each row laid out as `q`; without rows if the algorithm has no such tables."""
    visits: NDArray[np.float64]
    """[L, S]: updates of a state's policy by WoLF-PHC; without rows for the others."""


class Rules(NamedTuple):
    """The schedules (see `schedules`) and switches of the configuration."""

    algorithm: tuple[int, ...]
    """A tuple whose length is the algorithm's number: lengths are known when a kernel is compiled."""
    step_size: NDArray[np.float64]
    discount: NDArray[np.float64]
    epsilon: NDArray[np.float64]
    parameters: tuple[NDArray[np.float64], ...]
    """Schedules of the algorithm's own parameters, in the order of its section of the configuration, then
    constants of 0: there are `MAX_PARAMETERS` of them for every algorithm."""
    by_step: bool
    """Whether step size, discount or epsilon counts steps, not episodes."""
    learns: bool
    independent: bool
    """Whether each learner explores by a draw of its own."""
    epsilon_exploits: bool
    first_action_for_all: bool
    bootstrap_after_termination: bool


class Moment(NamedTuple):
    """The time of a step, and the values of the schedules at it."""

    episode: int
    step: int
    """Number of the step in training."""
    t: int
    """Number of the step in its episode."""
    step_size: float
    discount: float
    next_epsilon: float
    """The probability of exploring at the next step; only Expected SARSA needs it."""


Index = np.uint64
"""The type of indices in hot loops: for it Numba leaves out the arithmetic of negative indices."""


# --- acting -------------------------------------------------------------------------------------------


@inlined
def exploring(rules: Rules, episode: int, step: int) -> float:
    """Return the probability of exploring at a training step."""
    epsilon = schedule_value(rules.epsilon, episode, step)
    return 1.0 - epsilon if rules.epsilon_exploits else epsilon


@inlined
def choose(
    seed: np.uint64,
    model: Model,
    tables: Tables,
    rules: Rules,
    epsilon: float,
    exploration: np.uint64,
    episode: int,
    t: int,
    state: int,
) -> tuple[int, int]:
    """Return the joint action at time t of a training episode, and who explored (bit i: learner i).

    `exploration` is the key of the episode's exploration draws.
    """
    learners = len(model.width)
    action = 0
    explored = 0
    if rules.independent:
        for i in range(learners):
            bits = draws.draw(exploration, t * learners + i)
            if draws.coin(bits) < epsilon:
                action += draws.below(bits, model.width[i]) * model.stride[i]
                explored |= 1 << i
            else:
                action += _own_choice(seed, model, tables, rules, episode, t, i, state) * model.stride[i]
    else:
        bits = draws.draw(exploration, t)
        if draws.coin(bits) < epsilon:
            action = draws.below(bits, len(model.own_action))
            explored = (1 << learners) - 1
        else:
            for i in range(learners):
                action += _own_choice(seed, model, tables, rules, episode, t, i, state) * model.stride[i]
    return action, explored


@inlined
def _own_choice(
    seed: np.uint64, model: Model, tables: Tables, rules: Rules, episode: int, t: int, i: int, state: int
) -> int:
    """Return learner i's action when it does not explore: the greedy one, or one drawn from its policy."""
    if len(rules.algorithm) == WOLF_PHC:
        bits = draws.draw(draws.key(seed, draws.POLICY, episode), t * len(model.width) + i)
        return drawn(model, tables, i, state, draws.uniform(bits))
    return np.int64(tables.greedy[i, state])


@numba.njit
def drawn(model: Model, tables: Tables, i: int, state: int, u: float) -> int:
    """Return the action of learner i's policy that u in [0, 1) selects; never one of probability 0."""
    row = tables.offset[i] + state * model.width[i]
    chosen = 0
    total = 0.0
    for action in range(model.width[i]):
        probability = tables.extra[POLICY, row + action]
        if probability > 0.0:
            chosen = action
            total += probability
            if u < total:
                break
    return chosen


# --- learning -----------------------------------------------------------------------------------------


@inlined
def learn(
    seed: np.uint64,
    model: Model,
    tables: Tables,
    rules: Rules,
    now: Moment,
    i: int,
    state: int,
    action: int,
    reward: float,
    next_state: int,
    next_action: int,
    bootstraps: bool,
) -> tuple[int, bool]:
    """Update learner i's tables by one step, and return what else its new value was made of.

    A new value is a weighted sum of the old one, the reward, and the values that the target has of the next
    state; `ledger` follows these weights.

    Args:
        seed: of the run.
        model: the environment.
        tables: the tables to update.
        rules: of the run.
        now: the time of the step.
        i: the learner.
        state: of the step.
        action: the learner's own action.
        reward: of the learner.
        next_state: of the step.
        next_action: its own action of the next step; only SARSA needs it.
        bootstraps: whether the next state counts: it does unless the episode was terminated.

    Returns:
        The action of the next state whose value the target has, -1 for none; of Expected SARSA it has those
        of all actions, and this is the greedy one. And which of two ways was taken: of Double Q-learning
        whether the second table learned, of the others whether the value fell.
    """
    algorithm = len(rules.algorithm)
    width = model.width[i]
    row = Index(tables.offset[i]) + state * Index(width)
    next_row = Index(tables.offset[i]) + next_state * Index(width)
    td_target = reward
    bootstrapped, second = np.int64(-1), False
    if algorithm == DOUBLE_Q_LEARNING:
        bits = draws.draw(draws.key(seed, draws.UPDATE, now.episode), now.t * len(model.width) + i)
        second = draws.coin(bits) >= 0.5
        learned, other = (SECOND, FIRST) if second else (FIRST, SECOND)
        if bootstraps:
            best = _best(tables.extra[learned], next_row, width)
            bootstrapped = np.int64(best)
            td_target += now.discount * tables.extra[other, next_row + best]
        old = tables.extra[learned, row + action]
        tables.extra[learned, row + action] = old + now.step_size * (td_target - old)
        mean = 0.5 * (tables.extra[FIRST, row + action] + tables.extra[SECOND, row + action])
        _set(tables, i, state, action, row, width, mean)
    else:
        if bootstraps:
            bootstrapped = np.int64(next_action if algorithm == SARSA else tables.greedy[i, next_state])
            if algorithm == SARSA:
                td_target += now.discount * tables.q[next_row + Index(next_action)]
            elif algorithm == EXPECTED_SARSA:
                td_target += now.discount * _expected(
                    tables, i, next_state, next_row, width, now.next_epsilon
                )
            else:
                td_target += now.discount * tables.value[i, next_state]
        old = tables.q[row + action]
        second = td_target < old
        rate = update_rate(rules, now.episode, now.step, now.step_size, second)
        _set(tables, i, state, action, row, width, old + rate * (td_target - old))
    if algorithm == WOLF_PHC:
        win = schedule_value(rules.parameters[WIN], now.episode, now.step)
        lose = schedule_value(rules.parameters[LOSE], now.episode, now.step)
        _improve_policy(tables, i, state, row, width, win, lose)
    return bootstrapped, second


@inlined
def update_rate(rules: Rules, episode: int, step: int, step_size: float, second: bool) -> float:
    """Return the weight of the target in an update; `step_size` at this step, `second` as of `learn`."""
    if len(rules.algorithm) == HYSTERETIC_Q_LEARNING and second:
        return schedule_value(rules.parameters[DECREASE], episode, step)
    return step_size


@inlined
def _expected(tables: Tables, i: int, state: int, row: int, width: int, epsilon: float) -> float:
    """Return a state's expected value under the epsilon-greedy policy.

    All actions share epsilon equally; the greedy action, the lowest of the best, has the rest.
    """
    total = 0.0
    for action in range(Index(width)):
        total += tables.q[row + action]
    return epsilon * (total / width) + (1.0 - epsilon) * tables.value[i, state]


@numba.njit
def _improve_policy(
    tables: Tables, i: int, state: int, row: int, width: int, win: float, lose: float
) -> None:
    """Average the policy of a state, then move it towards the greedy action, by less if it wins.

    It wins if, by the present values, it is worth more than the average policy.
    """
    policy, average = tables.extra[POLICY], tables.extra[AVERAGE_POLICY]
    visits = tables.visits[i, state] + 1.0
    tables.visits[i, state] = visits
    worth = 0.0
    usual = 0.0
    for action in range(Index(width)):
        cell = row + action
        average[cell] += (policy[cell] - average[cell]) / visits
        worth += policy[cell] * tables.q[cell]
        usual += average[cell] * tables.q[cell]
    rate = win if worth > usual else lose
    best = Index(tables.greedy[i, state])
    moved = 0.0
    for action in range(Index(width)):
        if action != best:
            taken = min(policy[row + action], rate / (width - 1))
            policy[row + action] -= taken
            moved += taken
    policy[row + best] += moved


@inlined
def _set(tables: Tables, i: int, state: int, action: int, row: int, width: int, new: float) -> None:
    """Set Q_i(state, action), and update the state's greedy action and value."""
    old = tables.q[row + action]
    tables.q[row + action] = new
    if action == Index(tables.greedy[i, state]):
        if new >= old:
            tables.value[i, state] = new
        else:
            best = _best(tables.q, row, width)
            tables.greedy[i, state] = best
            tables.value[i, state] = tables.q[row + best]
    elif new > tables.value[i, state] or (
        new == tables.value[i, state] and action < Index(tables.greedy[i, state])
    ):
        tables.greedy[i, state] = action
        tables.value[i, state] = new


@inlined
def _best(q: NDArray[np.float64], row: int, width: int) -> int:
    best = Index(0)
    highest = q[row]
    for action in range(Index(1), Index(width)):
        if q[row + action] > highest:
            highest = q[row + action]
            best = action
    return best
