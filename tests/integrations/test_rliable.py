"""Comparisons over environments have the numbers of rliable, the library of Agarwal et al. (2021)."""

from __future__ import annotations

import importlib

import numpy as np
import pytest

from runner.analysis.compare.moments import Moment
from runner.analysis.compare.tasks import Bounds, compare_tasks
from runner.analysis.groups import Group
from runner.analysis.series import RunSeries

TASKS = ("first", "second", "third", "fourth")
RNG = np.random.default_rng(11)
SCORES = {  # [runs, tasks], as rliable has them
    "a": RNG.normal([0.2, 0.9, 1.3, 0.6], 0.25, (10, 4)),
    "b": RNG.normal([0.1, 0.8, 0.7, 0.7], 0.25, (10, 4)),
}
REPETITIONS = 5_000


@pytest.fixture(scope="module")
def rliable():
    """Return the library; its dependency arch calls a function of pandas as it was before version 3."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pandas.util._decorators.deprecate_kwarg", lambda *_, **__: lambda function: function)
        return importlib.import_module("rliable.library"), importlib.import_module("rliable.metrics")


@pytest.fixture(scope="module")
def ours():
    def runs(scores):
        for (seed, task), score in np.ndenumerate(scores):
            points = [(10 * k, {"mean_return": {"": score * 100 * k / 5}}) for k in range(6)]
            yield RunSeries(f"{seed}{task}", "", seed, "finished", {}, points, [], environment=TASKS[task])

    groups = [Group(label, tuple(runs(scores))) for label, scores in SCORES.items()]
    table = {task: Bounds(0, 100) for task in TASKS}
    return compare_tasks(groups, ("mean_return", ""), Moment("last"), table)


def test_aggregates_and_their_intervals(rliable, ours):
    library, metrics = rliable
    functions = {
        "iqm": metrics.aggregate_iqm,
        "median": metrics.aggregate_median,
        "mean": metrics.aggregate_mean,
        "optimality_gap": metrics.aggregate_optimality_gap,
    }
    for name, function in functions.items():
        values, intervals = library.get_interval_estimates(
            SCORES, lambda scores, function=function: np.array([function(scores)]), reps=REPETITIONS
        )
        for own in ours.algorithms:
            estimate = getattr(own, name)
            assert estimate.value == pytest.approx(values[own.label][0])
            assert (estimate.low, estimate.high) == pytest.approx(intervals[own.label][:, 0], abs=0.01)


def test_the_probability_of_improvement_and_its_interval(rliable, ours):
    library, metrics = rliable
    values, intervals = library.get_interval_estimates(
        {"a,b": (SCORES["a"], SCORES["b"])}, metrics.probability_of_improvement, reps=1_000
    )
    (pair,) = ours.improvements
    assert pair.probability.value == pytest.approx(values["a,b"])
    assert (pair.probability.low, pair.probability.high) == pytest.approx(intervals["a,b"].ravel(), abs=0.015)


def test_performance_profiles_and_their_bands(rliable, ours):
    library, _ = rliable
    profiles, bands = library.create_performance_profile(SCORES, np.array(ours.thresholds)[1:-1], reps=1_000)
    for own in ours.algorithms:
        assert own.profile[1:-1] == pytest.approx(profiles[own.label])
        low, high = bands[own.label]
        assert own.profile_low[1:-1] == pytest.approx(low, abs=0.03)
        assert own.profile_high[1:-1] == pytest.approx(high, abs=0.03)


def test_sample_efficiency_curves(rliable, ours):
    library, metrics = rliable
    shares = np.array(ours.positions) / 50
    at = [0, 30, 60, 100]
    frames = {label: scores[:, :, np.newaxis] * shares[at] for label, scores in SCORES.items()}
    values, intervals = library.get_interval_estimates(
        frames,
        lambda scores: np.array([metrics.aggregate_iqm(scores[..., k]) for k in range(len(at))]),
        reps=1_000,
    )
    for own in ours.algorithms:
        assert np.array(own.curve)[at] == pytest.approx(values[own.label])
        assert np.array(own.curve_low)[at] == pytest.approx(intervals[own.label][0], abs=0.02)
        assert np.array(own.curve_high)[at] == pytest.approx(intervals[own.label][1], abs=0.02)
