"""The values of schedules in plain Python, by + - * / alone."""

from __future__ import annotations

from typing import Any


def value_of(schedule: Any, episode: int, step: int) -> float:
    """Return a constant's or schedule's value, by + - * / alone."""
    if isinstance(schedule, int | float):
        return float(schedule)
    n = step if schedule.by == "step" else episode
    if schedule.schedule == "linear":
        value = line(n, (0, schedule.start), (schedule.over, schedule.end))
    elif schedule.schedule == "exponential":
        value = schedule.start * power(schedule.factor, n)
    else:
        value = schedule.points[-1][1]
        for before, after in zip(schedule.points, schedule.points[1:], strict=False):
            if before[0] <= n < after[0]:
                value = line(n, before, after)
    return max(value, schedule.floor)


def line(n: int, first: tuple[int, float], last: tuple[int, float]) -> float:
    """Return the height at n of the line between two points (x, y); y of the last one from there on."""
    if n >= last[0]:
        return last[1]
    return first[1] + (last[1] - first[1]) * ((n - first[0]) / (last[0] - first[0]))


def power(base: float, n: int) -> float:
    """Return base ** n by repeated squaring."""
    result = 1.0
    for bit in reversed(bin(n)[2:]):
        if bit == "1":
            result *= base
        base *= base
    return result
