"""Suggested values, the value of a run, and pruning."""

from __future__ import annotations

import math

import numpy as np
import pytest
from sweeping import described, swept

from runner import sweep as names
from runner.recording import schema
from runner.recording.reader import open_recording
from runner.recording.topic_chunks import TopicChunks
from runner.sweep import state
from runner.sweep.charts import drawn_trials, parameters_section
from runner.sweep.model import STRATEGIES, Objective, from_values
from runner.sweep.results import results_of
from runner.sweep.task import curve_of, pruning_bounds, should_prune, value_of
from runner.sweep.trials import Search, Trials

CURVE = {0: 0.0, 100: 40.0, 200: 80.0, 300: 60.0}


def searched(**changes):
    return Search(from_values(described(**changes)))


def test_a_grid_has_all_points_in_order():
    parameters = {"episodes": {"low": 1, "high": 6, "step": 2}, "discount": [0.5, 0.9]}
    search = searched(strategy="grid", trials=None, parameters=parameters)
    assert search.trials == 6
    suggested = search.ask(4) + search.ask(4)
    assert [tuple(values.values()) for values in suggested] == [
        (episodes, discount) for episodes in (1, 3, 5) for discount in (0.5, 0.9)
    ]


def test_a_range_ends_at_its_last_step_in_decimal_arithmetic():
    parameters = {
        "discount": {"low": 0.7, "high": 0.9, "step": 0.1},
        "epsilon": {"low": 0, "high": 0.3, "step": 0.1},
    }
    grid = searched(strategy="grid", trials=None, parameters=parameters).ask(12)
    assert [values["discount"] for values in grid[::4]] == [0.7, 0.8, 0.9]
    assert [values["epsilon"] for values in grid[:4]] == [0.0, 0.1, 0.2, 0.3]
    drawn = searched(strategy="random", trials=30, parameters=parameters).ask(30)
    assert {values["discount"] for values in drawn} == {0.7, 0.8, 0.9}


def test_choices_may_be_of_any_kind():
    choices = [{"schedule": "linear", "start": 1.0, "end": 0.1, "over": 10}, 0.5]
    search = searched(strategy="grid", trials=None, parameters={"epsilon": choices})
    assert [values["epsilon"] for values in search.ask(2)] == choices


@pytest.mark.parametrize("strategy", ["random", "tpe", "genetic"])
def test_equal_results_give_equal_suggestions(strategy):
    def suggestions():
        search, suggested = searched(strategy=strategy, trials=40, batch=5), []
        for _ in range(8):
            batch = search.ask(5)
            for values in batch:
                search.tell(len(suggested), values["step_size"] * values["discount"], False, {})
                suggested.append(values)
        return suggested

    first = suggestions()
    assert first == suggestions()
    assert len({str(values) for values in first}) > 20


@pytest.mark.parametrize("strategy", [name for name, strategy in STRATEGIES.items() if strategy.is_adaptive])
def test_a_strategy_that_learns_from_results_is_asked_for_a_batch_at_a_time(strategy):
    sweep = from_values(described(strategy=strategy, trials=12, batch=4))
    assert len(Trials(sweep).ask()) == 4


def test_a_search_improves():
    search, tried = searched(trials=60), []
    for number in range(60):
        (values,) = search.ask(1)
        tried.append(abs(values["step_size"] - 0.7))
        search.tell(number, -tried[-1], False, {})
    assert np.median(tried[40:]) < np.median(tried[:10])


@pytest.mark.parametrize(
    ("objective", "expected"),
    [
        ({}, 60.0),
        ({"at": "best"}, 80.0),
        ({"at": "best", "direction": "minimize"}, 0.0),
        ({"at": "area"}, 50.0),
        ({"at": "first_over", "level": 40.0, "direction": "minimize"}, 100.0),
        ({"at": "first_over", "level": 90.0, "direction": "minimize"}, 1e100),
    ],
)
def test_the_value_of_a_run_at_each_moment(objective, expected):
    assert value_of(Objective(**objective), CURVE) == expected


def test_a_run_without_readings_has_no_value():
    assert math.isnan(value_of(Objective(), {}))


def test_bounds_follow_the_percentile():
    curves = [{100: float(reading)} for reading in range(11)]
    assert pruning_bounds(Objective(), curves, 80.0) == {100: 2.0}
    assert pruning_bounds(Objective(direction="minimize"), curves, 80.0) == {100: 8.0}


def test_a_run_is_pruned_when_its_best_is_worse_than_most():
    up = Objective()
    limit = pruning_bounds(up, [CURVE, {0: 0.0, 100: 20.0, 200: 20.0}, {0: 0.0, 100: 60.0, 200: 10.0}], 50.0)
    assert limit == {0: 0.0, 100: 40.0, 200: 60.0, 300: 80.0}
    assert not should_prune(up, {0: 0.0}, limit)
    assert not should_prune(up, {0: 0.0, 100: 45.0}, limit)
    assert should_prune(up, {0: 0.0, 100: 45.0, 200: 30.0}, limit)
    down = Objective(direction="minimize")
    assert should_prune(down, {100: 30.0}, {100: 20.0})
    assert not should_prune(down, {100: 10.0}, {100: 20.0})


def test_exact_measures_belong_to_their_own_evaluation(done, monkeypatch):
    """A measure that was lost in a repair does not shift the others."""
    folder, *_ = done
    recording_path = next(folder.glob("*/recording.mcap"))
    measures = [
        {"evaluation": number, "success_percent": 10.0 * number, "optimal_success_percent": 100.0}
        | {"mean_length": 1.0, "optimal_mean_length": 1.0, "optimal_value": 1.0}
        | {"values": [0.5], "best_responses": [0.5]}
        for number in range(4)
    ]
    decoded = TopicChunks.decoded

    def without_first(table):
        return iter(measures[1:]) if table.topic == schema.OPTIMALITY_TOPIC else decoded(table)

    monkeypatch.setattr(TopicChunks, "decoded", without_first)
    with open_recording(recording_path) as recording:
        assert curve_of(recording, "exact.success_percent") == {20: 10.0, 40: 20.0, 60: 30.0}


def test_tpe_repeats_no_values_while_there_are_others():
    def tried(**changes):
        parameters = {"step_size": [0.1, 0.2, 0.3, 0.4], "discount": [0.5, 0.7, 0.9]}
        search = Search(from_values(described(trials=12, batch=4, parameters=parameters, **changes)))
        found = []
        while batch := search.ask(4):
            for values in batch:
                search.tell(len(found), values["step_size"], False, {})
                found.append(str(values))
        return found

    assert len(tried()) == 12
    assert len(set(tried())) > len(set(tried(repeats=True)))
    assert tried() == tried()


@pytest.mark.parametrize("changes", [{"strategy": "grid", "trials": None}, {"trials": 4}])
def test_parameters_that_an_algorithm_does_not_use_spend_no_trials(changes, tmp_path):
    parameters = {
        "algorithm": ["q_learning", "wolf_phc"],
        "wolf_phc.lose": [0.1, 0.2, 0.4],
    }
    sweep = from_values(described(parameters=parameters, seeds=[0], batch=4, **changes))
    swept(tmp_path, sweep)
    results = results_of(sweep.name, tmp_path)
    assert sorted(map(str, (trial.values for trial in results.ranking))) == [
        str({"algorithm": "q_learning"}),
        *(str({"algorithm": "wolf_phc", "wolf_phc.lose": lose}) for lose in (0.1, 0.2, 0.4)),
    ]
    assert results.trials == len(results.suggested) == 4
    rows = {row[-3]: row[-2] for row in results.sections()[0].grids[0].rows}
    assert rows["q_learning"] == "–"
    drawn = drawn_trials(results)
    assert "nan" not in "".join(plot.picture for plot in parameters_section(drawn).figures).lower()


def test_an_old_sweep_without_repeats_may_repeat_values(tmp_path):
    sweep = from_values(described())
    state.begin(sweep, tmp_path, resume=False, accept_changes=False)
    stored = names.folder_of(sweep.name, tmp_path) / names.FILE
    stored.write_text(stored.read_text().replace("repeats: false\n", ""))
    assert not sweep.file.repeats
    assert state.read_sweep(sweep.name, tmp_path).file.repeats
