"""Values that change over a run: constant, linear, exponential or piecewise, by episode or by step.

A schedule is a float64 array, so that the compiled kernel and the replay read the same numbers:

    [kind, by_step, floor, parameters ...]

and its value is a function of the absolute episode or step alone, computed with + - * / only: `pow` and
`exp` differ between libraries in the last bit, and a run must not.
"""

from __future__ import annotations

import numba
import numpy as np

from runner.config.sections import Exponential, Linear, Piecewise, Schedule
from runner.util.arrays import Floats

CONSTANT, LINEAR, EXPONENTIAL, PIECEWISE = 0.0, 1.0, 2.0, 3.0


@numba.njit(cache=True)
def schedule_value(schedule: Floats, episode: int, step: int) -> float:
    """Return the schedule's value at an episode and a training step, both counted from 0."""
    if schedule[0] == CONSTANT:
        return schedule[3]
    return _changing_value(schedule, step if schedule[1] == 1.0 else episode)


@numba.njit(cache=True)
def _changing_value(schedule: Floats, n: int) -> float:
    if schedule[0] == LINEAR:
        value = _between(0.0, schedule[3], schedule[5], schedule[4], n)
    elif schedule[0] == EXPONENTIAL:
        value = schedule[3] * _power(schedule[4], n)
    else:
        value = _piecewise(schedule, n)
    return max(value, schedule[2])


@numba.njit(cache=True)
def _between(x0: float, y0: float, x1: float, y1: float, x: float) -> float:
    """Return the point at x of the line from (x0, y0) to (x1, y1), and y1 from x1 on."""
    if x >= x1:
        return y1
    return y0 + (y1 - y0) * ((x - x0) / (x1 - x0))


@numba.njit(cache=True)
def _power(base: float, n: int) -> float:
    """Return base ** n by squaring: the same multiplications everywhere."""
    result = 1.0
    while n > 0:
        if n & 1:
            result *= base
        base *= base
        n >>= 1
    return result


@numba.njit(cache=True)
def _piecewise(schedule: Floats, n: int) -> float:
    k = 5
    while k < len(schedule):
        if n < schedule[k]:
            return _between(schedule[k - 2], schedule[k - 1], schedule[k], schedule[k + 1], n)
        k += 2
    return schedule[len(schedule) - 1]


def compile_schedule(value: float | Schedule) -> Floats:
    """Return the configured constant or schedule as the array that `schedule_value` reads."""
    if isinstance(value, Linear):
        parameters = [value.start, value.end, float(value.over)]
        kind = LINEAR
    elif isinstance(value, Exponential):
        parameters = [value.start, value.factor]
        kind = EXPONENTIAL
    elif isinstance(value, Piecewise):
        parameters = [float(number) for point in value.points for number in point]
        kind = PIECEWISE
    else:
        return np.array([CONSTANT, 0.0, 0.0, value])
    return np.array([kind, float(value.by == "step"), value.floor, *parameters])
