"""Compiled loops that fill what is sent for each step; they release the interpreter lock."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator,unused-ignore]
def best_of_joint(rows: Any, own: Any, first: Any, best: Any, greedy: Any) -> None:
    """Take a joint table's values apart: each agent's best over the others' actions, and its greedy action.

    Args:
        rows: [n, J], values of the joint actions.
        own: [J, agents], each agent's part of a joint action.
        first: [agents], where the values of each agent begin in `best`.
        best: [n, sum of the action counts], filled.
        greedy: [n, agents], filled; ties go to the lowest joint action.
    """
    for k in range(len(rows)):
        for at in range(best.shape[1]):
            best[k, at] = -np.inf
        highest = 0
        for joint in range(rows.shape[1]):
            value = rows[k, joint]
            if value > rows[k, highest]:
                highest = joint
            for agent in range(own.shape[1]):
                at = first[agent] + own[joint, agent]
                best[k, at] = max(best[k, at], value)
        for agent in range(own.shape[1]):
            greedy[k, agent] = own[highest, agent]


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator,unused-ignore]
def bar_ends(values: Any, bounds: Any, left: float, length: float, fineness: int, ends: Any) -> None:
    """Fill in where the bar of each value ends: from an agent's lowest value in a step to its highest.

    Args:
        values: [n, values].
        bounds: [agents + 1], the first value of each agent, and the number of values.
        left: where bars begin.
        length: of the longest bar.
        fineness: parts of a unit to which lengths are rounded up.
        ends: [n, values], filled.
    """
    for k in range(len(values)):
        for agent in range(len(bounds) - 1):
            low, high = np.inf, -np.inf
            for i in range(bounds[agent], bounds[agent + 1]):
                low, high = min(low, values[k, i]), max(high, values[k, i])
            scale = length * fineness / (high - low) if high > low else 0.0
            for i in range(bounds[agent], bounds[agent + 1]):
                ends[k, i] = left + np.ceil((values[k, i] - low) * scale) / fineness


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator,unused-ignore]
def arrows(greedy: Any, own: Any, moves: Any, vectors: Any) -> None:
    """Fill in the arrows of greedy actions; none where there is no state, or no move.

    Args:
        greedy: [k, pixels], joint or own actions; -1 where there is no state.
        own: [actions, agents], the part of each agent that is shown.
        moves: [agents, own actions, 2].
        vectors: [k, agents, pixels, 2], filled.
    """
    for k in range(len(greedy)):
        for pixel in range(greedy.shape[1]):
            action = greedy[k, pixel]
            for agent in range(len(moves)):
                for axis in range(2):
                    vectors[k, agent, pixel, axis] = (
                        moves[agent, own[action, agent], axis] if action >= 0 else 0.0
                    )
