"""`tests.runner.corridor:Corridor-v0`: a bare transition table, without events, agents or scene."""

from __future__ import annotations

from typing import ClassVar

import gymnasium
import numpy as np


class Corridor(gymnasium.Env):
    """Five cells in a row, the last one the end; it has neither scene nor agents nor events."""

    P: ClassVar = {
        state: {
            action: [(1.0, next_state, -1.0, next_state == 4)]
            for action, next_state in ((0, max(state - 1, 0)), (1, min(state + 1, 4)))
        }
        for state in range(5)
    }
    initial_state_distrib = np.array([1.0, 0, 0, 0, 0])
    observation_space = gymnasium.spaces.Discrete(5)
    action_space = gymnasium.spaces.Discrete(2)


gymnasium.register("Corridor-v0", Corridor, max_episode_steps=40)
