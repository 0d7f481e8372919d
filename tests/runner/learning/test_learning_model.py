"""The environment as the kernel wants it: nothing can be drawn that is not there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runner.learning.model import build_model
from tests.runner.learning.harness import GAMES, experiment

LARGEST = 1 - 2**-53
"""The largest number that a draw gives."""
ROUNDED = [0.1] * 10
"""They add up to less than 1: to the largest draw, rounded as they are."""


@pytest.mark.parametrize("game", GAMES)
def test_the_largest_draw_falls_to_an_outcome_and_a_start_that_are_possible(game):
    config, mdp = experiment(GAMES[game])
    model = build_model(mdp, config.tables)
    drawn = (model.cumulative > LARGEST).argmax(axis=1)
    assert (model.cumulative[:, -1] > LARGEST).all()
    possible = mdp.probability.reshape(model.cumulative.shape)
    assert (np.take_along_axis(possible, drawn[:, None], axis=1) > 0).all()
    assert model.start_cumulative[-1] > LARGEST
    assert (mdp.start[model.start_states] > 0).all()


@given(order=st.permutations([*ROUNDED, 0.0, 0.0]))
def test_probabilities_that_add_up_to_less_than_1_leave_no_gap(order):
    assert sum(ROUNDED) <= LARGEST, "the largest draw is not below the sum"
    _, lake = experiment({"env": {"id": "FrozenLake-v1"}})
    shape = (16, 4, len(order))
    mdp = replace(
        lake,
        next_state=np.zeros(shape, np.int32),
        probability=np.broadcast_to(np.array(order), shape),
        rewards=np.zeros((*shape, 1)),
        terminated=np.zeros(shape, np.bool_),
        events=np.zeros(shape, np.uint32),
    )
    last = max(k for k, probability in enumerate(order) if probability)
    drawn = (build_model(mdp, "joint").cumulative > LARGEST).argmax(axis=1)
    assert set(drawn.tolist()) == {last}
