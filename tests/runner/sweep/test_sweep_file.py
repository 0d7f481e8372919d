"""Sweep files and their errors."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from sweeping import BASE, described

from runner.config import ConfigError
from runner.sweep.model import STRATEGIES, from_values, load_sweep
from runner.sweep.running import plan_of

SHIPPED = sorted((Path(__file__).parents[3] / "configs" / "sweeps").glob("*.yaml"))


def refused(file, **changes):
    with pytest.raises(ConfigError) as caught:
        load_sweep(file(**changes))
    return str(caught.value)


def test_a_sweep_survives_a_round_trip_as_plain_values(sweep):
    assert from_values(sweep.to_mapping()) == sweep
    assert sweep.base.recording.steps == "none"
    assert sweep.seeds == (0, 1)


def test_a_base_is_found_relative_to_the_file(tmp_path, file):
    from runner.config.document import write_yaml

    (tmp_path / "base.yaml").write_text(write_yaml(BASE))
    assert load_sweep(file(base="base.yaml")) == load_sweep(file())


def test_an_unknown_parameter_is_reported_with_place_and_nearest_name(file):
    reply = refused(file, parameters={"step_sise": [0.1], "discount": [0.9]})
    assert "small.yaml:" in reply
    assert "step_sise: unknown key. Did you mean 'step_size'?" in reply


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"parameters": {"step_size": {"low": 0.5, "high": 0.5}}}, 'parameters."step_size"'),
        ({"parameters": {"step_size": {"low": 0.5, "high": 0.5}}}, "above low, 0.5"),
        ({"parameters": {"step_size": []}}, "found an empty list"),
        (
            {"parameters": {"step_size": {"low": True, "high": 1}}},
            "step_size.low: found true, expected a whole",
        ),
        (
            {"parameters": {"step_size": {"low": "x", "high": 1}}},
            "step_size.low: found 'x', expected a whole",
        ),
        ({"parameters": {"step_size": {"low": 0.1, "high": float("inf")}}}, "step_size.high: found .inf"),
        (
            {"parameters": {"episodes": {"low": 1, "high": 10**400}}},
            "expected a whole number from -10^15 to 10^15",
        ),
        (
            {"parameters": {"step_size": {"low": 0.1, "high": 1, "step": -0.1}}},
            "step: found -0.1, expected a",
        ),
        ({"trials": 10**9}, "trials: found 1000000000, expected a whole number from 1 to 100,000"),
        (
            {"strategy": "grid", "trials": None, "parameters": {"episodes": {"low": 1, "high": 10**9}}},
            "parameters: found a grid of more points than 100,000",
        ),
        ({"parameters": {"step_size": {"low": 0.5, "high": 2.0}}}, "step_size: found 2.0"),
        ({"parameters": {"step_size": {"low": 0, "high": 1.0, "log": True}}}, "above 0: log is true"),
        ({"strategy": "gird"}, "Did you mean 'grid'?"),
        ({"strategy": "grid"}, "a grid tries all of its points"),
        ({"strategy": "grid", "trials": None}, "a grid needs one"),
        ({"trials": None}, "tpe has no end"),
        ({"objectiv": {}}, "unknown key. Did you mean 'objective'?"),
        (
            {"objective": {"metric": "success_percent", "at": "first_over"}},
            "expected a number: at is first_over",
        ),
        ({"base": BASE | {"episods": 5}}, "episods: unknown key"),
        ({"base": "nowhere.yaml"}, "nowhere.yaml: no such file"),
        ({"base": "quick"}, "quick: no such file. A shipped experiment"),
        ({"base": 5}, "base: found 5, expected text or a mapping"),
        ({"parameters": {}}, "parameters: found an empty mapping, expected a mapping, not empty"),
        ({"name": "x" * 60}, "name: found 60 characters, expected at most 50"),
        ({"episodes": 5}, "episodes: unknown key"),
        ({"recording": {"steps": "some"}}, "recording.steps: found 'some'"),
        ({"seeds": [1, 1]}, "found 1 for the second time"),
        ({"parameters": {"env.kwargs.is_slipery": [True]}}, "is_slipery"),
    ],
)
def test_an_invalid_sweep_is_refused(file, changes, expected):
    reply = refused(file, **changes)
    assert expected.replace('."step_size"', ".step_size") in reply
    assert all(re.match(r"\S+/small\.yaml:\d+:\d+: ", line) for line in reply.splitlines()), reply


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", ":1:1: found null, expected keys and values, such as base and trials"),
        ("- a", ":1:1: found a list of 1, expected keys and values"),
        ("episodes: 10", ":1:1: found an experiment, expected a sweep: `dualtaxi run` runs it"),
    ],
)
def test_what_is_no_sweep_is_refused_with_its_place(tmp_path, text, expected):
    path = tmp_path / "small.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_sweep(path)
    assert str(caught.value).startswith(f"{path}{expected}")


def test_an_unknown_environment_is_reported_once_with_its_place(file):
    with pytest.raises(ConfigError) as error:
        load_sweep(file(base=BASE | {"env": {"id": "NoSuch-v1"}}, parameters={"discount": [0.9, 0.99]}))
    assert "base.env.id: environment 'NoSuch-v1'" in str(error.value)
    assert "parameters" not in str(error.value)


def test_the_environment_of_the_base_may_be_unknown_if_each_trial_has_its_own(file):
    each = [{"id": "CliffWalking-v1"}, {"id": "Taxi-v4"}]
    sweep = load_sweep(file(base=BASE | {"env": {"id": "NoSuch-v1"}}, parameters={"env": each}))
    assert list(sweep.file.parameters) == ["env"]


def test_an_unknown_reward_of_the_environment_is_reported_with_its_place(file):
    base = BASE | {"env": {"id": "dualtaxi:DualTaxi-v1"}}
    reply = refused(file, base=base, parameters={"env.kwargs.rewards.pick_up": [1, 2]})
    assert "small.yaml:" in reply
    assert "did you mean 'pickup'" in reply


def test_the_documentation_has_the_strategies():
    lines = (Path(__file__).parents[3] / "docs" / "sweeps.md").read_text().splitlines()
    assert {f"| `{name}` | {strategy.text} |" for name, strategy in STRATEGIES.items()} <= set(lines)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_sweep_can_be_run(path):
    plan = plan_of(load_sweep(path))
    assert plan.runs >= plan.trials > 1
    assert plan.bytes > 10**6


def test_a_shipped_sweep_is_found_by_name():
    assert {"algorithms", "hyperparameters", "modes", "rewards"} <= {path.stem for path in SHIPPED}


def test_an_objective_that_is_never_recorded_is_refused_with_those_that_are():
    for metric, expected in (
        ("success_procent", "Did you mean 'success_percent'?"),
        ("exact.value", "evaluation: {exact: true}"),
    ):
        with pytest.raises(Exception, match="never recorded") as caught:
            plan_of(from_values(described(objective={"metric": metric})))
        assert expected in str(caught.value)


def test_defaults_that_depend_on_a_parameter_are_set_in_each_trial(file):
    base = BASE | {"env": {}}
    modes = {"mode": ["cooperative", "competitive"]}
    searched = load_sweep(file(strategy="grid", trials=None, base=base, parameters=modes))
    explorations = [searched.config({"mode": mode}).exploration for mode in ("cooperative", "competitive")]
    assert explorations == ["shared", "independent"]
    assert from_values(searched.to_mapping()) == searched


def test_the_exploration_of_the_base_is_kept_in_every_trial(file):
    named = load_sweep(
        file(
            strategy="grid",
            trials=None,
            base=BASE | {"env": {}, "exploration": "shared"},
            parameters={"mode": ["cooperative", "competitive"]},
        )
    )
    assert named.config({"mode": "competitive"}).exploration == "shared"
    assert from_values(named.to_mapping()) == named


def test_algorithms_with_sections_of_their_own_can_be_searched_over(file):
    searched = load_sweep(
        file(
            strategy="grid",
            trials=None,
            base=BASE
            | {"env": {}, "mode": "competitive", "algorithm": "wolf_phc", "wolf_phc": {"win": 0.01}},
            parameters={"algorithm": ["q_learning", "wolf_phc", "hysteretic_q_learning"]},
        )
    )
    assert searched.config({"algorithm": "q_learning"}).wolf_phc is None
    assert searched.config({"algorithm": "wolf_phc"}).wolf_phc.win == 0.01
    assert searched.config({"algorithm": "hysteretic_q_learning"}).hysteretic is not None


def test_parameters_of_one_algorithm_count_only_in_its_trials(file):
    searched = load_sweep(
        file(
            strategy="grid",
            trials=None,
            base=BASE | {"env": {}, "mode": "competitive"},
            parameters={
                "algorithm": ["q_learning", "hysteretic_q_learning"],
                "hysteretic.decrease": [0.01, 0.1],
            },
        )
    )
    config = searched.config({"algorithm": "hysteretic_q_learning", "hysteretic.decrease": 0.1})
    assert config.hysteretic.decrease == 0.1
    plain = searched.config({"algorithm": "q_learning", "hysteretic.decrease": 0.1})
    assert plain == searched.config({"algorithm": "q_learning", "hysteretic.decrease": 0.01})
    assert plan_of(searched).excluded == 0


def test_a_parameter_of_another_algorithm_than_the_base_names_is_refused(file):
    reply = refused(file, parameters={"hysteretic.decrease": [0.1, 0.2]})
    assert "goes with algorithm: hysteretic_q_learning" in reply
