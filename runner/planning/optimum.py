"""The best that can be done: value iteration, over joint actions or one agent's own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import Mdp
from runner.errors import EnvironmentNotUsable
from runner.planning import kernel
from runner.util.arrays import Floats, Ints32, Scalar

TOLERANCE: Final = 1e-10
"""How far a value may be from the true one."""


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
    own = policy // stride % widths[learner]
    joint = (policy - own * stride)[:, None] + np.arange(widths[learner]) * stride
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
