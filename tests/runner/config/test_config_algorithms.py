"""The algorithm, and the section of its own parameters."""

from __future__ import annotations

from typing import get_args

import pytest

from runner.analysis.diff.causes import DRAWING
from runner.config import from_mapping
from runner.config.model import Algorithm
from runner.learning.algorithms import ALGORITHMS, OF_SETTINGS

TWO = {"episodes": 1, "tables": "per_agent", "rewards": "team"}


@pytest.mark.parametrize("algorithm", get_args(Algorithm))
def test_every_algorithm_is_defined_and_survives_a_round_trip(algorithm):
    config = from_mapping(TWO | {"algorithm": algorithm})
    assert from_mapping(config.to_mapping()) == config
    definition = ALGORITHMS[algorithm]
    assert OF_SETTINGS[definition.settings] == definition
    assert definition.draws_actions == (algorithm in DRAWING)


def test_a_section_is_present_only_with_its_algorithm():
    assert from_mapping(TWO | {"algorithm": "hysteretic_q_learning"}).to_mapping()["hysteretic"] == {
        "decrease": 0.01
    }
    wolf = from_mapping(TWO | {"algorithm": "wolf_phc", "wolf_phc": {"win": 0.1}}).to_mapping()
    assert wolf["wolf_phc"] == {"win": 0.1, "lose": 0.2}
    traces = from_mapping(TWO | {"algorithm": "sarsa_lambda"}).to_mapping()
    assert traces["sarsa_lambda"] == {"trace_decay": 0.9}
    steps = from_mapping(TWO | {"algorithm": "n_step_q_learning", "n_step": {"n": 2}}).to_mapping()
    assert steps["n_step"] == {"n": 2}
    assert not {"hysteretic", "wolf_phc", "sarsa_lambda", "n_step"} & from_mapping(TWO).to_mapping().keys()


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("algorithm: sarssa", "x.yaml:2:1: algorithm: found 'sarssa', expected"),
        (
            "algorithm: hysteretic_q_learning",
            "x.yaml:2:1: algorithm: found 'hysteretic_q_learning', which is",
        ),
        (
            "hysteretic: {decrease: 0.1}",
            "x.yaml:2:1: hysteretic: goes with algorithm: hysteretic_q_learning",
        ),
        (
            "algorithm: wolf_phc\nwolf_phc: {win: 0.3}",
            "x.yaml:3:12: wolf_phc.win: found 0.3, expected at most",
        ),
        ("algorithm: wolf_phc\nwolf_phc: {loose: 0.3}", "x.yaml:3:12: wolf_phc.loose: unknown key"),
        ("algorithm: wolf_phc\nwolf_phc: {lose: 0}", "x.yaml:3:12: wolf_phc.lose: found 0, expected"),
        (
            "algorithm: sarsa_lambda\nsarsa_lambda: {trace_decay: 1.5}",
            "x.yaml:3:16: sarsa_lambda.trace_decay: found 1.5, expected",
        ),
        ("algorithm: n_step_q_learning\nn_step: {n: 0}", "x.yaml:3:10: n_step.n: found 0, expected"),
        ("n_step: {n: 2}", "x.yaml:2:1: n_step: goes with algorithm: n_step_q_learning"),
        (
            "algorithm: sarsa\nmode: competitive\nquirks: {second_table_uses_first_action: true}",
            "x.yaml:4:10: quirks.second_table_uses_first_action: needs algorithm: q_learning",
        ),
    ],
)
def test_contradictions_are_reported_with_their_place(errors_of, text, line):
    (found,) = errors_of("episodes: 1\n" + text)
    assert found.startswith(line), found


def test_the_nearest_name_is_suggested(errors_of):
    assert errors_of("episodes: 1\nalgorithm: sarssa")[0].endswith("Did you mean 'sarsa'?")
    assert errors_of("episodes: 1\nalgorithm: wolf_phc\nwolf_phc: {loose: 0.3}")[0].endswith("'lose'?")
