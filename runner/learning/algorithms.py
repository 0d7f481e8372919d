"""The algorithms: what each learns from a step, how it acts, what it holds, and what its values are made of.

`ALGORITHMS` has a definition of each. docs/algorithms.md has all of them side by side; the formulas are from

- Sutton and Barto, "Reinforcement Learning", 2nd edition: SARSA (section 6.4), Q-learning (6.5), Expected
  SARSA (6.6), Double Q-learning (6.7; van Hasselt, "Double Q-learning", 2010), n-step returns (chapter 7),
  SARSA(lambda) with replacing traces (12.7);
- Matignon, Laurent and Le Fort-Piat, "Hysteretic Q-learning", 2007;
- Bowling and Veloso, "Multiagent learning using a variable learning rate", 2002: WoLF-PHC.

The loops of `kernel` call the functions at the end of this module, such as `learn`. When a loop is compiled,
the type of `Rules.algorithm` decides which definition they stand for. So each algorithm has loops of its own,
and none slows down another.

The greedy action and the value of each state are stored next to the tables and updated with them, so a step
does not scan a row unless the row's best value fell. Ties go to the lowest action.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numba
import numpy as np
from numba.extending import overload

from runner.learning import draws
from runner.learning.compiling import INLINED, inlined
from runner.learning.model import Model
from runner.learning.schedules import schedule_value
from runner.util.arrays import Floats, Ints, Ints32

FIRST, SECOND = 0, 1
"""Rows of `Tables.extra` of Double Q-learning: its two Q-tables."""
POLICY, AVERAGE_POLICY = 0, 1
"""Rows of `Tables.extra` of an algorithm that draws its actions."""


class Memory(NamedTuple):
    """What learners remember of the current episode, for updates that change the values of earlier steps.

    It follows from the steps of the episode, and is not part of a snapshot. How much of it there may be at
    once is `Algorithm.capacity`.
    """

    count: Ints
    """[L]: how many values a learner remembers; always 0 of an algorithm that remembers nothing."""
    cells: Ints
    """[L, capacity]: the values, as places in the learner's table, state * width + action."""
    numbers: Floats
    """[L, capacity]: for each of them its trace, or the reward that followed."""


class Tables(NamedTuple):
    """The learners' tables, those of one kind one after the other, and values derived from them."""

    q: Floats
    """[sum of S * width]: table i starts at offset[i], row-major. These values are shown, and greedy actions
    follow them; of Double Q-learning the mean of both tables."""
    offset: tuple[int, ...]
    """[L]; a tuple, as `Model.width`: their length is known when the kernel is compiled."""
    greedy: Ints32
    """[L, S]: the lowest action of the highest value."""
    value: Floats
    """[L, S]: the highest value."""
    extra: Floats
    """[2, sum of S * width], each row laid out as `q`; without rows if the algorithm has no such tables."""
    visits: Floats
    """[L, S]: updates of a state's policy by WoLF-PHC; without rows for the others."""
    memory: Memory


class Rules(NamedTuple):
    """The schedules (see `schedules`) and switches of the configuration."""

    algorithm: NamedTuple
    """The algorithm's own settings; their type is known when a kernel is compiled."""
    step_size: Floats
    discount: Floats
    epsilon: Floats
    by_step: bool
    """Whether step size, discount or epsilon counts steps, not episodes."""
    learns: bool
    independent: bool
    """Whether each learner explores by a draw of its own."""
    epsilon_exploits: bool
    first_action_for_all: bool
    bootstrap_after_termination: bool


class Transition(NamedTuple):
    """A training step as a learner sees it, and the values of the schedules at it."""

    seed: np.uint64
    """The run's."""
    episode: int
    step: int
    """Number of the step in training."""
    t: int
    """Number of the step in its episode."""
    learner: int
    state: int
    action: int
    """The learner's own."""
    reward: float
    """The learner's own."""
    next_state: int
    next_action: int
    """The learner's own action of the next step, for algorithms that choose ahead."""
    bootstraps: bool
    """Whether the next state counts: it does unless the episode was terminated."""
    ends: bool
    """Whether the episode ends with this step."""
    step_size: float
    discount: float
    next_epsilon: float
    """The probability of exploring at the next step, for algorithms that choose ahead or expect."""


Index = np.uint64
"""The type of indices in hot loops: for it Numba leaves out the arithmetic of negative indices."""


# --- steps of updates ---------------------------------------------------------------------------------


@inlined
def exploring(rules: Rules, episode: int, step: int) -> float:
    """Return the probability of exploring at a training step."""
    epsilon = schedule_value(rules.epsilon, episode, step)
    return 1.0 - epsilon if rules.epsilon_exploits else epsilon


@inlined
def _row(model: Model, tables: Tables, i: int, state: int) -> int:
    return Index(tables.offset[i]) + state * Index(model.width[i])


@inlined
def _best(q: Floats, row: int, width: int) -> int:
    best = Index(0)
    highest = q[row]
    for action in range(Index(1), Index(width)):
        if q[row + action] > highest:
            highest = q[row + action]
            best = action
    return best


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
def _move(
    rules: Rules, model: Model, tables: Tables, seen: Transition, state: int, action: int, td_target: float
) -> bool:
    """Move a value of the learner towards a target, and return whether the target was below it."""
    i = seen.learner
    row = _row(model, tables, i, state)
    old = tables.q[row + action]
    falls = td_target < old
    weight = rate(rules, seen.episode, seen.step, seen.step_size, falls)
    _set(tables, i, state, action, row, model.width[i], old + weight * (td_target - old))
    return falls


@inlined
def _step_size(rules: Rules, episode: int, step: int, step_size: float, second: bool) -> float:
    return step_size


# --- Q-learning ---------------------------------------------------------------------------------------


class QLearning(NamedTuple):
    """Q-learning has no settings of its own."""


@inlined
def _q_learning(rules: Rules, model: Model, tables: Tables, seen: Transition) -> tuple[int, bool]:
    td_target = seen.reward
    bootstrapped = np.int64(-1)
    if seen.bootstraps:
        bootstrapped = np.int64(tables.greedy[seen.learner, seen.next_state])
        td_target += seen.discount * tables.value[seen.learner, seen.next_state]
    return bootstrapped, _move(rules, model, tables, seen, seen.state, seen.action, td_target)


# --- SARSA --------------------------------------------------------------------------------------------


class Sarsa(NamedTuple):
    """SARSA has no settings of its own."""


@inlined
def _sarsa_target(model: Model, tables: Tables, seen: Transition) -> float:
    if not seen.bootstraps:
        return seen.reward
    next_row = _row(model, tables, seen.learner, seen.next_state)
    return seen.reward + seen.discount * tables.q[next_row + Index(seen.next_action)]


@inlined
def _sarsa(rules: Rules, model: Model, tables: Tables, seen: Transition) -> tuple[int, bool]:
    td_target = _sarsa_target(model, tables, seen)
    bootstrapped = np.int64(seen.next_action if seen.bootstraps else -1)
    return bootstrapped, _move(rules, model, tables, seen, seen.state, seen.action, td_target)


# --- Expected SARSA -----------------------------------------------------------------------------------


class ExpectedSarsa(NamedTuple):
    """Expected SARSA has no settings of its own."""


@inlined
def _expected_sarsa(rules: Rules, model: Model, tables: Tables, seen: Transition) -> tuple[int, bool]:
    """All actions share epsilon equally; the greedy action, the lowest of the best, has the rest."""
    td_target = seen.reward
    bootstrapped = np.int64(-1)
    if seen.bootstraps:
        bootstrapped = np.int64(tables.greedy[seen.learner, seen.next_state])
        next_row, width = _row(model, tables, seen.learner, seen.next_state), model.width[seen.learner]
        total = 0.0
        for action in range(Index(width)):
            total += tables.q[next_row + action]
        epsilon = seen.next_epsilon
        expected = epsilon * (total / width) + (1.0 - epsilon) * tables.value[seen.learner, seen.next_state]
        td_target += seen.discount * expected
    return bootstrapped, _move(rules, model, tables, seen, seen.state, seen.action, td_target)


# --- Double Q-learning --------------------------------------------------------------------------------


class DoubleQLearning(NamedTuple):
    """Double Q-learning has no settings of its own."""


@inlined
def _double_q_learning(rules: Rules, model: Model, tables: Tables, seen: Transition) -> tuple[int, bool]:
    i, state, action = seen.learner, seen.state, seen.action
    bits = draws.draw(draws.key(seen.seed, draws.UPDATE, seen.episode), seen.t * len(model.width) + i)
    second = draws.coin(bits) >= 0.5
    learned, other = (SECOND, FIRST) if second else (FIRST, SECOND)
    row, width = _row(model, tables, i, state), model.width[i]
    td_target = seen.reward
    bootstrapped = np.int64(-1)
    if seen.bootstraps:
        next_row = _row(model, tables, i, seen.next_state)
        best = _best(tables.extra[learned], next_row, width)
        bootstrapped = np.int64(best)
        td_target += seen.discount * tables.extra[other, next_row + best]
    old = tables.extra[learned, row + action]
    tables.extra[learned, row + action] = old + seen.step_size * (td_target - old)
    mean = 0.5 * (tables.extra[FIRST, row + action] + tables.extra[SECOND, row + action])
    _set(tables, i, state, action, row, width, mean)
    return bootstrapped, second


# --- Hysteretic Q-learning ----------------------------------------------------------------------------


class HystereticSchedules(NamedTuple):
    """The settings of Hysteretic Q-learning."""

    decrease: Floats
    """The step size of updates that lower a value."""


@inlined
def _hysteretic_rate(rules: Rules, episode: int, step: int, step_size: float, second: bool) -> float:
    return schedule_value(rules.algorithm.decrease, episode, step) if second else step_size  # type: ignore[attr-defined]


# --- WoLF-PHC -----------------------------------------------------------------------------------------


class WolfPhcSchedules(NamedTuple):
    """The settings of WoLF-PHC: how far the policy moves in one update."""

    win: Floats
    lose: Floats


@numba.njit(cache=True)
def drawn(model: Model, tables: Tables, i: int, state: int, u: float) -> int:
    """Return the action of learner i's policy that u in [0, 1) selects; never one of probability 0."""
    row = tables.offset[i] + state * model.width[i]
    choice = 0
    total = 0.0
    for action in range(model.width[i]):
        probability = tables.extra[POLICY, row + action]
        if probability > 0.0:
            choice = action
            total += probability
            if u < total:
                break
    return choice


@numba.njit(cache=True)
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
def _wolf_phc(rules: Rules, model: Model, tables: Tables, seen: Transition) -> tuple[int, bool]:
    i, state = seen.learner, seen.state
    made_of = _q_learning(rules, model, tables, seen)
    win = schedule_value(rules.algorithm.win, seen.episode, seen.step)  # type: ignore[attr-defined]
    lose = schedule_value(rules.algorithm.lose, seen.episode, seen.step)  # type: ignore[attr-defined]
    _improve_policy(tables, i, state, _row(model, tables, i, state), model.width[i], win, lose)
    return made_of


# --- SARSA(lambda) ------------------------------------------------------------------------------------


class SarsaLambdaSchedules(NamedTuple):
    """The settings of SARSA(lambda)."""

    trace_decay: Floats
    """Lambda."""


@inlined
def _remember_traces(rules: Rules, model: Model, tables: Tables, seen: Transition) -> None:
    """Let all traces of the episode decay; that of the step's value is replaced by 1."""
    memory, i = tables.memory, seen.learner
    cell = np.int64(seen.state) * model.width[i] + np.int64(seen.action)
    decay = seen.discount * schedule_value(
        rules.algorithm.trace_decay,  # type: ignore[attr-defined]
        seen.episode,
        seen.step,
    )
    kept = 0
    for k in range(memory.count[i] if seen.t > 0 else 0):
        trace = memory.numbers[i, k] * decay
        if memory.cells[i, k] != cell and trace > 0.0:
            memory.cells[i, kept] = memory.cells[i, k]
            memory.numbers[i, kept] = trace
            kept += 1
    memory.cells[i, kept] = cell
    memory.numbers[i, kept] = 1.0
    memory.count[i] = kept + 1


@inlined
def _sarsa_lambda(rules: Rules, model: Model, tables: Tables, seen: Transition) -> tuple[int, bool]:
    _remember_traces(rules, model, tables, seen)
    memory, i, width = tables.memory, seen.learner, model.width[seen.learner]
    value = tables.q[_row(model, tables, i, seen.state) + seen.action]
    td_error = _sarsa_target(model, tables, seen) - value
    for k in range(memory.count[i]):
        state, action = Index(memory.cells[i, k] // width), Index(memory.cells[i, k] % width)
        row = _row(model, tables, i, state)
        new = tables.q[row + action] + seen.step_size * td_error * memory.numbers[i, k]
        _set(tables, i, state, action, row, width, new)
    return np.int64(-1), False


# --- n-step Q-learning --------------------------------------------------------------------------------


class NStepQLearning(NamedTuple):
    """The settings of n-step Q-learning."""

    n: Floats
    """Rewards in a return, a constant; kernels take it from the room in `Memory`."""


@inlined
def _remember_steps(rules: Rules, model: Model, tables: Tables, seen: Transition) -> None:
    """Put the step into the ring of the last n of its episode."""
    memory, i = tables.memory, seen.learner
    n = memory.cells.shape[1]
    memory.cells[i, seen.t % n] = np.int64(seen.state) * model.width[i] + np.int64(seen.action)
    memory.numbers[i, seen.t % n] = seen.reward
    memory.count[i] = min(seen.t + 1, n)


@inlined
def _n_step_q_learning(rules: Rules, model: Model, tables: Tables, seen: Transition) -> tuple[int, bool]:
    """Update the value of n steps ago; at the end of the episode those of all later steps, the last first."""
    _remember_steps(rules, model, tables, seen)
    memory, i, width = tables.memory, seen.learner, model.width[seen.learner]
    n = memory.cells.shape[1]
    n_step_return = tables.value[i, seen.next_state] if seen.bootstraps else 0.0
    for ago in range(memory.count[i]):
        k = (seen.t - ago) % n
        n_step_return = memory.numbers[i, k] + seen.discount * n_step_return
        if seen.ends or ago == n - 1:
            state, action = Index(memory.cells[i, k] // width), Index(memory.cells[i, k] % width)
            _move(rules, model, tables, seen, state, action, n_step_return)
    return np.int64(-1), False


# --- all of them --------------------------------------------------------------------------------------


class Algorithm(NamedTuple):
    """The definition of an algorithm; its functions are compiled into the loops of `kernel`."""

    settings: type[Any]
    """A named tuple of the schedules in its section of the configuration; each algorithm has its own type."""
    learn: Callable[..., tuple[int, bool]]
    """Its update, as `learn` below."""
    rate: Callable[..., float] = _step_size
    """The weight of the target in an update, as `rate` below."""
    tables: tuple[str, ...] = ()
    """The tables that it has besides the Q-table that is shown: rows of `Tables.extra`, and `visits`."""
    is_double: bool = False
    """Whether its tables are two Q-tables, of which one learns from the other's value of the next state."""
    draws_actions: bool = False
    """Whether it acts by the policy in its tables; else it acts greedily."""
    chooses_ahead: bool = False
    """Whether it chooses the next action before it learns, and takes it then."""
    expects: bool = False
    """Whether its target has the values of all next actions, weighted as it explores."""
    remember: Callable[..., None] | None = None
    """What it adds to its memory with each step, as `remember` below; None if it has none."""
    capacity: Callable[[Any, int], int] = lambda _settings, _cells: 0
    """The room in the memory of a learner, by the settings and the number of values in its table."""


ALGORITHMS: Final = {
    "random": Algorithm(QLearning, _q_learning),
    "q_learning": Algorithm(QLearning, _q_learning),
    "sarsa": Algorithm(Sarsa, _sarsa, chooses_ahead=True),
    "expected_sarsa": Algorithm(ExpectedSarsa, _expected_sarsa, expects=True),
    "double_q_learning": Algorithm(
        DoubleQLearning, _double_q_learning, tables=("q_1", "q_2"), is_double=True
    ),
    "hysteretic_q_learning": Algorithm(HystereticSchedules, _q_learning, rate=_hysteretic_rate),
    "wolf_phc": Algorithm(
        WolfPhcSchedules, _wolf_phc, tables=("policy", "average_policy", "visits"), draws_actions=True
    ),
    "sarsa_lambda": Algorithm(
        SarsaLambdaSchedules,
        _sarsa_lambda,
        chooses_ahead=True,
        remember=_remember_traces,
        capacity=lambda _settings, cells: cells,
    ),
    "n_step_q_learning": Algorithm(
        NStepQLearning,
        _n_step_q_learning,
        remember=_remember_steps,
        capacity=lambda settings, _cells: int(schedule_value(settings.n, 0, 0)),
    ),
}
"""The definitions by the configuration's `algorithm`; random agents learn nothing (`Rules.learns`)."""

OF_SETTINGS: Final = {algorithm.settings: algorithm for algorithm in ALGORITHMS.values()}
"""The definitions by the type of `Rules.algorithm`."""


def _compiled_for(name: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Let a function stand for the attribute `name` of the algorithm of its first argument, the rules."""

    def compiled_for(stub: Callable[..., Any]) -> Callable[..., Any]:
        def select(rules: Any, *_others: Any) -> Callable[..., Any]:
            algorithm = OF_SETTINGS[rules.types[Rules._fields.index("algorithm")].instance_class]
            value = getattr(algorithm, name)
            return value.py_func if callable(value) else lambda rules: value  # noqa: ARG005

        overload(stub, jit_options=INLINED, strict=False)(select)
        return stub

    return compiled_for


@_compiled_for("learn")
def learn(rules: Rules, model: Model, tables: Tables, seen: Transition) -> tuple[int, bool]:
    """Update a learner's tables by one step, and return what else its new value was made of.

    A new value is a weighted sum of the old one, the reward, and the values that the target has of the next
    state; `ledger` follows these weights.

    Returns:
        The action of the next state whose value the target has, -1 for none; of Expected SARSA it has those
        of all actions, and this is the greedy one. And which of two ways was taken: of Double Q-learning
        whether the second table learned, of the others whether the value fell.
    """
    raise NotImplementedError


@_compiled_for("remember")
def remember(rules: Rules, model: Model, tables: Tables, seen: Transition) -> None:
    """Remember a step without learning from it, as `learn` does first; only of an algorithm with a memory."""
    raise NotImplementedError


@_compiled_for("rate")
def rate(rules: Rules, episode: int, step: int, step_size: float, second: bool) -> float:
    """Return the weight of the target in an update; `step_size` at this step, `second` as of `learn`."""
    raise NotImplementedError


@_compiled_for("draws_actions")
def draws_actions(rules: Rules) -> bool:
    """Return `Algorithm.draws_actions`."""
    raise NotImplementedError


@_compiled_for("chooses_ahead")
def chooses_ahead(rules: Rules) -> bool:
    """Return `Algorithm.chooses_ahead`."""
    raise NotImplementedError


@_compiled_for("expects")
def expects(rules: Rules) -> bool:
    """Return `Algorithm.expects`."""
    raise NotImplementedError


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
    if draws_actions(rules):
        bits = draws.draw(draws.key(seed, draws.POLICY, episode), t * len(model.width) + i)
        return drawn(model, tables, i, state, draws.uniform(bits))
    return np.int64(tables.greedy[i, state])
