"""What the environment says of recorded steps: a record has where a step led, not which outcome it took."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import Mdp

_COMPARED: Final = 1 << 20
"""Outcomes that are compared at a time, so that memory grows with neither steps nor outcomes."""


def events_of(mdp: Mdp, steps: NDArray[np.void]) -> NDArray[np.uint32]:
    """Return the events of recorded steps, a bit mask each: those of the outcome that a step took.

    That is one with its next state; of several, one that ends as it did, and that pays what it did. There
    are none where the environment has no such outcome, as a loop of one's own may have it.
    """
    found = np.zeros(len(steps), np.uint32)
    if mdp.event_names:
        slice_steps = max(1, _COMPARED // mdp.next_state.shape[2])
        for start in range(0, len(steps), slice_steps):
            some = slice(start, start + slice_steps)
            found[some] = _events(mdp, steps[some])
    return found


def _events(mdp: Mdp, steps: NDArray[np.void]) -> NDArray[np.uint32]:
    state, action = steps["state"].astype(np.int64), steps["action"].astype(np.int64)
    fits = mdp.next_state[state, action] == steps["next_state"][:, np.newaxis]
    outcome = np.zeros(len(steps), np.int64)
    if fits.shape[1] > 1:
        fits &= mdp.probability[state, action] > 0
        ends = mdp.terminated[state, action] == steps["terminated"][:, np.newaxis]
        outcome = np.argmax(fits * 4 + (fits & ends) * 2 + (fits & _pays(mdp, steps)), axis=1)
    return np.where(fits.any(axis=1), mdp.events[state, action, outcome], np.uint32(0))


def _pays(mdp: Mdp, steps: NDArray[np.void]) -> NDArray[np.bool_]:
    """Return which outcomes of each step's state and action pay what the step did, [n, outcomes]."""
    rewards = mdp.rewards[steps["state"], steps["action"]].sum(axis=-1)
    learners = steps["rewards"].shape[1]
    if mdp.rewards.shape[-1] == 1 and learners > 1:  # every learner was paid the shared reward
        rewards = rewards * learners
    return np.asarray(np.isclose(rewards, steps["rewards"].sum(axis=-1)[:, np.newaxis]))
