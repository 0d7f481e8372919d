"""Schedules: what the configuration promises of each, and the twin's value to the last bit."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from runner.config.sections import Exponential, Linear, Piecewise
from runner.learning.schedules import compile_schedule, schedule_value
from tests.runner.learning import plain_schedules

positions = st.integers(0, 300) | st.integers(0, 10**12)
fractions = st.floats(0.0, 1.0)
counted = st.sampled_from(["episode", "step"])
linear = st.builds(
    Linear, start=fractions, end=fractions, over=st.integers(1, 10**12), floor=fractions, by=counted
)
exponential = st.builds(
    Exponential, start=fractions, factor=st.floats(1e-3, 1.0), floor=fractions, by=counted
)
piecewise = st.lists(st.tuples(st.integers(1, 400), fractions), min_size=1, max_size=6).flatmap(
    lambda points: st.builds(
        Piecewise,
        points=st.just([(sum(gap for gap, _ in points[:k]), height) for k, (_, height) in enumerate(points)]),
        floor=fractions,
        by=counted,
    )
)


def value(schedule, episode=0, step=0):
    return schedule_value(compile_schedule(schedule), episode, step)


@settings(deadline=None)
@given(linear | exponential | piecewise | fractions, positions, positions)
def test_the_value_is_the_twins(schedule, episode, step):
    assert value(schedule, episode, step) == plain_schedules.value_of(schedule, episode, step)


@settings(deadline=None)
@given(linear | exponential | piecewise, positions, positions, positions)
def test_it_depends_only_on_its_own_count_and_respects_its_floor(schedule, n, other, another):
    def at(others):
        return value(schedule, *((n, others) if schedule.by == "episode" else (others, n)))

    assert at(other) == at(another)
    assert schedule.floor <= at(other) <= max(1.0, schedule.floor)


def test_a_line_goes_from_start_to_end_and_stays():
    line = Linear(start=1.0, end=0.2, over=40)
    assert [value(line, n) for n in (0, 10, 20, 40, 41, 10**12)] == [1.0, 0.8, 0.6, 0.2, 0.2, 0.2]


@settings(deadline=None)
@given(exponential, st.integers(0, 5000))
def test_a_decay_is_start_times_a_power_of_the_factor(schedule, n):
    expected = max(schedule.start * math.pow(schedule.factor, n), schedule.floor)
    found = value(schedule, n, n)
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-300)


def test_lines_between_points_pass_through_each_of_them():
    schedule = Piecewise(points=[(0, 0.9), (10, 0.5), (11, 0.7), (31, 0.1)], by="step")
    assert [value(schedule, step=n) for n, _ in schedule.points] == [height for _, height in schedule.points]
    assert value(schedule, step=5) == pytest.approx(0.7)
    assert value(schedule, step=21) == pytest.approx(0.4)
    assert value(schedule, step=10**9) == 0.1
