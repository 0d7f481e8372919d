"""A tabular environment for the kernel: small arrays that stay in the processor's caches.

An outcome of a (state, joint action) is two 32-bit integers: the next state and an *outcome class*.
Outcomes of one class agree in rewards, termination and events, so all else that a step needs is looked up
in arrays of a few dozen entries.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import Mdp
from runner.util.arrays import Array, Flags, Floats, Ints, Ints32

PENALTY_BIT = np.uint32(1 << 31)
"""Bit of an event class that marks a penalty; events themselves use the bits below it."""


class Model(NamedTuple):
    """The arrays of one environment, for learners that share its joint action.

    S states, J joint actions, K outcomes a pair at most, L learners, C outcome classes, E event classes.
    """

    next_state: Ints32
    """[S * J * K]."""
    outcome_class: Ints32
    """[S * J * K]; an array of its own, so that the one that every step waits for is small."""
    cumulative: Floats
    """[S * J, K]: cumulative probability of the outcomes; the last real one and all after it are 1."""
    rewards: Floats
    """[C, L]: reward of each learner."""
    terminated: Flags
    """[C]."""
    event_class: Ints32
    """[C]."""
    event_mask: NDArray[np.uint32]
    """[E]: bit i is event i, bit 31 a penalty."""
    start_states: Ints32
    """States an episode can start in."""
    start_cumulative: Floats
    """Their cumulative probability; the last is 1."""
    own_action: Ints32
    """[J, L]: each learner's part of a joint action."""
    stride: tuple[int, ...]
    """[L]: a joint action is the sum of own actions times these."""
    width: tuple[int, ...]
    """[L]: number of own actions."""
    step_limit: int
    """Steps after which an episode is truncated; 0 for never."""


@lru_cache(maxsize=4)
def build_model(mdp: Mdp, tables: str) -> Model:
    """Return `mdp` prepared for one `joint` table, or for one table `per_agent`; not to be changed."""
    width = (mdp.joint_actions,) if tables == "joint" else mdp.action_counts
    stride = tuple(math.prod(width[i + 1 :]) for i in range(len(width)))
    own_actions = np.arange(mdp.joint_actions)[:, None] if tables == "joint" else mdp.own_actions
    rewards = mdp.rewards_of(len(width)).reshape(-1, len(width)) + 0.0  # turns -0.0 into 0.0
    terminated = mdp.terminated.reshape(-1)
    penalty = mdp.summed_rewards.reshape(-1) < mdp.penalty_below
    masks = mdp.events.reshape(-1) | np.where(penalty, PENALTY_BIT, np.uint32(0))
    first, class_of = _outcome_classes(rewards, terminated, masks)
    event_mask, event_class = np.unique(masks[first], return_inverse=True)
    support = np.flatnonzero(mdp.start > 0)
    next_state = mdp.next_state.reshape(-1)
    # Always read-only, as arrays out of a recording are not: a kernel is compiled for one or the other.
    next_state.flags.writeable = False
    return Model(
        next_state=next_state,
        outcome_class=class_of.astype(np.int32),
        cumulative=_cumulative(mdp.probability.reshape(-1, mdp.probability.shape[-1])),
        rewards=rewards[first],
        terminated=terminated[first],
        event_class=event_class.astype(np.int32),
        event_mask=event_mask.astype(np.uint32),
        start_states=support.astype(np.int32),
        start_cumulative=_cumulative(mdp.start[support][None])[0],
        own_action=np.ascontiguousarray(own_actions, np.int32),
        stride=stride,
        width=width,
        step_limit=mdp.step_limit,
    )


def _outcome_classes(rewards: Floats, terminated: Flags, masks: NDArray[np.uint32]) -> tuple[Ints, Ints]:
    """Return where each distinct (rewards, terminated, mask) of outcomes is first, and each outcome's class.

    NumPy sorts numbers several times as fast as it finds their order, or that of records.
    """
    _, classes = _numbered(masks * np.uint64(2) + terminated)
    for column in rewards.T:
        values, numbers = _numbered(column)
        _, classes = _numbered(classes * len(values) + numbers)
    first = np.empty(classes.max(initial=-1) + 1, np.int64)
    first[classes[::-1]] = np.arange(len(classes))[::-1]
    return first, classes


def _numbered(values: Array) -> tuple[Array, Ints]:
    """Return the distinct values in ascending order, and the place of each value among them."""
    distinct = np.unique(values)
    return distinct, np.searchsorted(distinct, values)


def _cumulative(probability: Floats) -> Floats:
    """Return cumulative probabilities along the last axis, exactly 1 from the last possible entry on."""
    total = np.cumsum(probability, axis=-1)
    left = np.cumsum(probability[:, ::-1], axis=-1)[:, ::-1]  # what is still to come, this one included
    total[left - probability <= 0] = 1.0
    return total
