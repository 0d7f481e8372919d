"""Exact results without playing episodes: of a policy from every start state, the optimum, best responses."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import Mdp
from runner.errors import EnvironmentNotUsable
from runner.planning import kernel
from runner.planning.kernel import Chain, Paths
from runner.util.arrays import Flags, Floats, Ints, Ints32, Scalar

TOLERANCE: Final = 1e-10
"""How far a value may be from the true one."""
Policy = Ints32 | Sequence[Floats]
"""The joint action of each state; or for each learner the probabilities of its own actions."""


@dataclass(frozen=True)
class Cycle:
    """States that a policy repeats for ever, so that its episodes time out."""

    states: tuple[int, ...]
    """In the order they are visited, from the lowest on."""
    percent: float
    """Percentage of episodes that end up here."""


@dataclass(frozen=True)
class PolicyOutcome:
    """Means of a policy's episodes over the start states, weighted by their probability."""

    starts: int
    """Number of start states."""
    success_percent: float
    """Percentage of episodes with a success; nan if the environment does not define success."""
    timeout_percent: float
    """Percentage of episodes that the step limit truncates."""
    mean_length: float
    mean_penalties: float
    mean_returns: tuple[float, ...]
    """Undiscounted, up to the step limit, for each learner."""
    values: tuple[float, ...]
    """Discounted, without a step limit, for each learner; nan for a discount of 1."""
    cycles: tuple[Cycle, ...]
    """The cycles of time-outs, the most frequent first; empty if the environment is not deterministic."""


@dataclass(frozen=True)
class _RewardProcess:
    """The Markov reward process that a policy induces: the outcomes of each state, [S, K] each."""

    next_state: Ints32
    probability: Floats
    rewards: Floats
    """[S, K, L]."""
    terminated: Flags
    success: Flags
    penalty: Flags | Floats
    """Whether a step is a penalty; of merged outcomes its probability."""


# --- policies -----------------------------------------------------------------------------------------


def evaluate_policy(mdp: Mdp, policy: Ints32, learners: int, discount: float) -> PolicyOutcome:
    """Return the exact outcome of a deterministic policy.

    In a deterministic environment every state has one successor, and each path ends, or closes a cycle;
    otherwise the probabilities are propagated step by step up to the limit.

    Args:
        policy: [S]: the joint action of each state.
        learners: 1, or the number of agents; each has its own return.
    """
    return _measured(mdp, _deterministic_process(mdp, policy, learners), discount)


def evaluate_stochastic_policy(
    mdp: Mdp, policies: Sequence[Floats], learners: int, discount: float
) -> PolicyOutcome:
    """Return the exact outcome of learners that draw their actions, in expectation over all draws.

    Args:
        policies: for each learner [S, n]: the probability of each of its own n actions. Learners draw
            independently of each other.
        learners: 1, whose actions are the joint ones, or the number of agents.
    """
    return _measured(mdp, _stochastic_process(mdp, joint_probabilities(policies), learners), discount)


def policy_values(mdp: Mdp, joint: Floats, learners: int, discount: float) -> Floats:
    """Return the discounted value of each state under a policy for each learner, [S, learners].

    The horizon is infinite: an episode that the environment cuts off counts as if it went on.

    Args:
        joint: [S, J]: the probability of each joint action.
        learners: 1, or the number of agents; each has its own reward.
    """
    require_discount(discount)
    process = _stochastic_process(mdp, joint, learners)
    if not _is_certain(process):
        return _stochastic_values(process, discount)
    chain = _chain(process)
    return _chain_values(chain, kernel.find_paths(chain), discount)


def action_values(mdp: Mdp, state: int, values: Floats, rewards: Floats, discount: float) -> Floats:
    """Return what each joint action in a state is worth if later steps are worth `values`, [J, n].

    Args:
        values: [S, n]: the values of the states.
        rewards: [S, J, K, n]: those that count.
    """
    outcome = rewards[state] + discount * (~mdp.terminated[state])[..., None] * values[mdp.next_state[state]]
    return np.asarray((mdp.probability[state][..., None] * outcome).sum(axis=1))


def random_policy(mdp: Mdp) -> list[Floats]:
    """Return the policy that takes every joint action with the same probability, for one learner."""
    return [np.full((mdp.states, mdp.joint_actions), 1 / mdp.joint_actions)]


def joint_probabilities(policies: Sequence[Floats]) -> Floats:
    """Return the probability [S, J] of each joint action, the first learner's the most significant."""
    return functools.reduce(
        lambda joint, policy: (joint[:, :, None] * policy[:, None, :]).reshape(len(policy), -1), policies
    )


def _measured(mdp: Mdp, process: _RewardProcess, discount: float) -> PolicyOutcome:
    if not mdp.step_limit:
        raise EnvironmentNotUsable(
            f"{mdp.env_id}: found no step limit, expected one: without it some episodes never end."
        )
    starts = np.flatnonzero(mdp.start > 0)
    weights = mdp.start[starts]
    cycles: tuple[Cycle, ...] = ()
    if _is_certain(process):
        chain = _chain(process)
        paths = kernel.find_paths(chain)
        lengths, sums, counts = kernel.play_all(chain, paths, starts, mdp.step_limit)
        timed_out = (paths.cycle[starts] >= 0) | (paths.length[starts] > mdp.step_limit)
        success_percent = _mean(100.0 * (counts[:, 0] > 0), weights)
        timeout_percent = _mean(100.0 * timed_out, weights)
        totals = np.column_stack([lengths, counts[:, 1], sums])
        values = _chain_values(chain, paths, discount)
        cycles = _cycles(paths, starts, weights)
    else:
        p, penalty = process.probability, process.penalty
        gains = np.column_stack([np.ones(len(p)), (p * penalty).sum(axis=1), _expected_rewards(process)])
        after, ends, success = process.next_state, process.terminated, process.success
        chances, expected = kernel.expect(after, p, ends, success, gains, mdp.step_limit)
        succeeded, ended = _means(chances[starts], weights)
        success_percent, timeout_percent = 100 * succeeded, 100 * (1 - ended)
        totals = expected[starts]
        values = _stochastic_values(process, discount)
    length, penalties, *returns = _means(totals, weights)
    return PolicyOutcome(
        starts=len(starts),
        success_percent=success_percent if mdp.success_mask else math.nan,
        timeout_percent=timeout_percent,
        mean_length=length,
        mean_penalties=penalties,
        mean_returns=tuple(returns),
        values=_means(values[starts], weights),
        cycles=cycles,
    )


def _is_certain(process: _RewardProcess) -> bool:
    """Return whether each state has one outcome; merged outcomes may be penalties by chance."""
    only_one = ((process.probability > 0).sum(axis=1) == 1).all()
    return bool(only_one and np.isin(process.penalty, (0, 1)).all())


def _deterministic_process(mdp: Mdp, policy: Ints32, learners: int) -> _RewardProcess:
    """Return the process that a deterministic policy induces."""
    rows = np.arange(mdp.states)
    return _RewardProcess(
        mdp.next_state[rows, policy],
        mdp.probability[rows, policy],
        mdp.rewards_of(learners)[rows, policy],
        mdp.terminated[rows, policy],
        (mdp.events[rows, policy] & mdp.success_mask) != 0,
        mdp.summed_rewards[rows, policy] < mdp.penalty_below,
    )


def _stochastic_process(mdp: Mdp, joint: Floats, learners: int) -> _RewardProcess:
    """Return the process that a policy induces which draws with these probabilities, [S, J]."""
    if ((joint > 0).sum(axis=1) == 1).all():
        return _deterministic_process(mdp, joint.argmax(axis=1).astype(np.int32), learners)
    return _merged(mdp, joint[..., None] * mdp.probability, learners)


def _merged(mdp: Mdp, probability: Floats, learners: int) -> _RewardProcess:
    """Return the process of outcomes with these probabilities, [S, J, K], as [S, K'].

    Outcomes that lead to the same state are merged, with the mean of their rewards: of 36 joint actions of
    two taxis many do, and every outcome takes time at every step of an episode.
    """
    state, action, outcome = np.nonzero(probability)
    at = state, action, outcome
    chance = probability[at]
    success = (mdp.events[at] & mdp.success_mask) != 0
    key = ((state * mdp.states + mdp.next_state[at]) * 2 + mdp.terminated[at]) * 2 + success
    _, first, group = np.unique(key, return_index=True, return_inverse=True)
    row = state[first]
    column = np.arange(len(first)) - np.searchsorted(row, row)
    shape = mdp.states, int(column.max()) + 1

    def padded(values: NDArray[Any]) -> NDArray[Any]:
        table = np.zeros((*shape, *values.shape[1:]), values.dtype)
        table[row, column] = values
        return table

    total = np.bincount(group, chance)
    rewards = mdp.rewards_of(learners)[at]
    penalty = mdp.summed_rewards[at] < mdp.penalty_below
    return _RewardProcess(
        padded(mdp.next_state[at][first]),
        padded(total),
        padded(np.stack([np.bincount(group, chance * reward) / total for reward in rewards.T], axis=1)),
        padded(mdp.terminated[at][first]),
        padded(success[first]),
        padded(np.bincount(group, chance * penalty) / total),
    )


def _chain(process: _RewardProcess) -> Chain:
    only = np.arange(len(process.next_state)), process.probability.argmax(axis=1)
    return Chain(
        process.next_state[only].astype(np.int64),
        np.ascontiguousarray(process.rewards[only]),
        process.terminated[only],
        process.success[only],
        process.penalty[only],
    )


def _chain_values(chain: Chain, paths: Paths, discount: float) -> Floats:
    """Return the discounted values of a chain, [S, L]; nan for a discount of 1."""
    values = np.full_like(chain.rewards, np.nan)
    if discount < 1:
        steps = paths.length + paths.away  # to the end of the episode, or to its cycle
        order = np.argsort(steps, kind="stable")
        kernel.discounted_paths(chain, paths, order[steps[order] > 0], discount, values)
    return values


def _stochastic_values(process: _RewardProcess, discount: float) -> Floats:
    """Return the discounted values of outcomes by chance, [S, L]; nan for a discount of 1."""
    rewards = _expected_rewards(process)
    values = np.full_like(rewards, np.nan)
    if discount < 1:
        values[:] = 0.0
        weight = discount * process.probability * ~process.terminated
        kernel.discounted(process.next_state, weight, rewards, values, sweep_tolerance(discount))
    return values


def _expected_rewards(process: _RewardProcess) -> Floats:
    return np.asarray((process.probability[..., None] * process.rewards).sum(axis=1))


def _cycles(paths: Paths, starts: Ints, weights: Floats) -> tuple[Cycle, ...]:
    """Return the cycles that start states lead into."""
    stuck = paths.cycle[starts]
    shares = np.bincount(stuck[stuck >= 0], weights[stuck >= 0], minlength=len(paths.offsets) - 1)
    percents = (100 * shares / math.fsum(weights)).tolist()
    members, offsets = paths.members.tolist(), paths.offsets.tolist()
    cycles = []
    for number in np.flatnonzero(shares).tolist():
        states = members[offsets[number] : offsets[number + 1]]
        lowest = states.index(min(states))
        cycles.append(Cycle((*states[lowest:], *states[:lowest]), percents[number]))
    return tuple(sorted(cycles, key=lambda cycle: (-cycle.percent, cycle.states)))


def start_mean(mdp: Mdp, values: Floats) -> float:
    """Return the mean of values [S] over the states that an episode starts in."""
    return _mean(values, mdp.start)


def _mean(values: Floats | Flags, weights: Floats) -> float:
    """Return the weighted mean, correctly rounded sums: 100 % is 100."""
    return math.fsum((values * weights).tolist()) / math.fsum(weights.tolist())


def _means(columns: Floats, weights: Floats) -> tuple[float, ...]:
    """Return the weighted mean of each column of [N, C]."""
    return tuple(_mean(column, weights) for column in columns.T)


# --- the optimum, and best responses ------------------------------------------------------------------


def optimal_values(mdp: Mdp, discount: float) -> Floats:
    """Return what all agents together can get at most from each state, [S], to within 1e-10.

    Value iteration, in place: Sutton and Barto, Reinforcement Learning, 2nd edition, section 4.4. The
    horizon is infinite: an episode that the environment cuts off counts as if it went on.
    """
    weight = _weight(mdp, discount)
    reward = (mdp.probability * mdp.summed_rewards).sum(axis=-1)
    return _iterated(mdp.next_state, weight, reward, discount)


def greedy_policy(mdp: Mdp, discount: float, values: Floats) -> Ints32:
    """Return the joint action that leads to the most of these values, [S]; the first of equals.

    Values that differ by rounding only count as equal.
    """
    reward = (mdp.probability * mdp.summed_rewards).sum(axis=-1)
    worth = reward + (_weight(mdp, discount) * values[mdp.next_state]).sum(axis=-1)
    close = worth >= worth.max(axis=1, keepdims=True) - 1e-8
    return np.asarray(close.argmax(axis=1), np.int32)


def best_response(mdp: Mdp, policy: Ints32, learner: int, learners: int, discount: float) -> Floats:
    """Return what one learner can get at most from each state while all others keep to a policy, [S].

    Args:
        policy: [S]: the joint action of each state.
        learner: whose own action is free, and whose reward counts.
        learners: how many there are; 1 is all agents together, whose best response is the optimum.
    """
    widths = mdp.action_counts if learners > 1 else (mdp.joint_actions,)
    stride = int(np.prod(widths[learner + 1 :], dtype=np.int64))
    own_action = policy // stride % widths[learner]
    joint = (policy - own_action * stride)[:, None] + np.arange(widths[learner]) * stride
    rows = np.arange(mdp.states)[:, None]
    reward = (mdp.probability * mdp.rewards_of(learners)[..., learner]).sum(axis=-1)
    weight = _weight(mdp, discount)[rows, joint]
    return _iterated(mdp.next_state[rows, joint], weight, reward[rows, joint], discount)


def best_response_to_stochastic(
    mdp: Mdp, policies: Sequence[Floats], learner: int, discount: float
) -> Floats:
    """Return what one learner can get at most from each state while all others draw from their policies, [S].

    Args:
        policies: one a learner, [S, n]: the probability of each of its own actions; a single one is over
            joint actions, and its best response is the optimum.
        learner: whose own action is free, and whose reward counts.
    """
    widths = tuple(policy.shape[1] for policy in policies)
    states, outcomes = mdp.states, mdp.probability.shape[2]

    def by_own_action(array: NDArray[Scalar]) -> NDArray[Scalar]:
        """Return [S, J, K] as [S, own action, others' joint actions and outcomes]."""
        parts = np.moveaxis(array.reshape(states, *widths, outcomes), 1 + learner, 1)
        return parts.reshape(states, widths[learner], -1)

    others: Floats = np.ones((states, 1))
    for number, policy in enumerate(policies):
        if number != learner:
            others = (others[:, :, None] * policy[:, None, :]).reshape(states, -1)
    chance = np.repeat(others, outcomes, axis=1)[:, None, :]
    reward = chance * by_own_action(mdp.probability * mdp.rewards_of(len(policies))[..., learner])
    weight = chance * by_own_action(_weight(mdp, discount))
    return _iterated(by_own_action(mdp.next_state), weight, reward.sum(axis=-1), discount)


def require_discount(discount: float) -> None:
    """Refuse a discount with which an infinite process may have no value.

    Raises:
        EnvironmentNotUsable: it is not below 1.
    """
    if not 0 <= discount < 1:
        raise EnvironmentNotUsable(
            f"found discount {discount}, expected one from 0 up to below 1: "
            "else a process without an end has no value."
        )


def sweep_tolerance(discount: float) -> float:
    """Return by how much the last sweep may change a value so that all are within the tolerance."""
    return TOLERANCE * (1 - discount) / max(discount, 0.5)


def _weight(mdp: Mdp, discount: float) -> Floats:
    """Return the discounted probability [S, J, K] that an outcome comes and the episode goes on."""
    require_discount(discount)
    return np.asarray(discount * mdp.probability * ~mdp.terminated)


def _iterated(next_state: Ints32, weight: Floats, reward: Floats, discount: float) -> Floats:
    values = np.zeros(len(next_state))
    kernel.iterate_values(
        np.ascontiguousarray(next_state),
        np.ascontiguousarray(weight),
        np.ascontiguousarray(reward),
        values,
        sweep_tolerance(discount),
    )
    return values


# --- all measures of an evaluation --------------------------------------------------------------------


class ExactEvaluator:
    """Evaluates policies exactly in one environment; the optimum is computed once for each discount."""

    def __init__(self, mdp: Mdp, learners: int) -> None:
        self._mdp = mdp
        self._learners = learners
        self._best: dict[float, tuple[float, PolicyOutcome]] = {}

    def measure(self, policy: Policy, discount: float) -> dict[str, object]:
        """Return the exact measures of a policy, named as in the recording.

        With a discount of 1 the values are nan: those of a process without end are not defined.

        Args:
            policy: [S]: the joint action of each state; or, for learners that draw, an array for each, [S,
                n]: the probability of each of its own actions.
        """
        if isinstance(policy, np.ndarray):
            outcome = evaluate_policy(self._mdp, policy, self._learners, discount)
        else:
            outcome = evaluate_stochastic_policy(self._mdp, policy, self._learners, discount)
        undiscounted = discount >= 1
        optimal_value, optimum = (np.nan, None) if undiscounted else self._optimum(discount)
        return {
            "starts": outcome.starts,
            "success_percent": outcome.success_percent,
            "timeout_percent": outcome.timeout_percent,
            "mean_length": outcome.mean_length,
            "mean_penalties": outcome.mean_penalties,
            "mean_returns": list(outcome.mean_returns),
            "values": list(outcome.values),
            "best_responses": [
                np.nan if undiscounted else self._best_response(policy, learner, discount)
                for learner in range(self._learners)
            ],
            "optimal_value": optimal_value,
            "optimal_success_percent": optimum.success_percent if optimum else np.nan,
            "optimal_mean_length": optimum.mean_length if optimum else np.nan,
            "cycle_states": [cycle.states[0] for cycle in outcome.cycles],
            "cycle_lengths": [len(cycle.states) for cycle in outcome.cycles],
            "cycle_percents": [cycle.percent for cycle in outcome.cycles],
        }

    def _best_response(self, policy: Policy, learner: int, discount: float) -> float:
        if isinstance(policy, np.ndarray):
            values = best_response(self._mdp, policy, learner, self._learners, discount)
        else:
            values = best_response_to_stochastic(self._mdp, policy, learner, discount)
        return start_mean(self._mdp, values)

    def _optimum(self, discount: float) -> tuple[float, PolicyOutcome]:
        if discount not in self._best:
            values = optimal_values(self._mdp, discount)
            policy = greedy_policy(self._mdp, discount, values)
            outcome = evaluate_policy(self._mdp, policy, self._learners, discount)
            self._best[discount] = start_mean(self._mdp, values), outcome
        return self._best[discount]
