"""The JSON Schema for editors, and the shipped files."""

import json
from pathlib import Path

import pytest
import yaml
from jsonschema import Draft202012Validator

from runner.config import ExperimentFile, json_schema, load
from runner.config.model import KEYS, ExperimentConfig
from runner.errors import ConfigError

CONFIGS = Path(__file__).parents[3] / "configs"
SHIPPED = sorted(CONFIGS.glob("*.yaml"))


def test_the_shipped_schema_is_the_current_one():
    assert json.loads((CONFIGS / "schema.json").read_text(encoding="utf-8")) == json_schema()


def test_the_schema_has_title_dialect_and_required_keys():
    schema = json_schema()
    assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    assert schema["title"] == "Experiment"
    assert schema["required"] == ["episodes"]
    assert tuple(schema["properties"]) == KEYS
    assert set(KEYS) == set(ExperimentFile.model_fields) >= set(ExperimentConfig.model_fields)


def test_the_returned_schema_may_be_changed():
    json_schema()["properties"].clear()
    assert json_schema()["properties"]


def test_every_key_has_a_description():
    schema = json_schema()
    for model in (schema, *schema["$defs"].values()):
        assert model["description"]
        assert model["additionalProperties"] is False
        for key, value in model["properties"].items():
            assert value.get("description"), key


def test_the_documented_experiments_are_shipped():
    assert {path.stem for path in SHIPPED} == {
        *(
            "tutorial_cooperative",
            "tutorial_competitive",
            "tutorial_text_cooperative",
            "tutorial_text_competitive",
        ),
        *("cooperative", "competitive", "random", "quick"),
        *("taxi", "frozen_lake", "frozen_lake_slippery", "cliff_walking"),
        *("sarsa", "hysteretic", "optimal"),
    }


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_experiment_loads_and_has_a_description(path):
    first, second, *_ = path.read_text(encoding="utf-8").splitlines()
    assert first == "# yaml-language-server: $schema=schema.json"
    assert second.startswith("# ")
    config = load(path)
    assert config.name == path.stem
    assert config.evaluation is not None


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_experiment_follows_the_schema_in_an_editor(path):
    validator = Draft202012Validator(json_schema())
    validator.validate(yaml.safe_load(path.read_text(encoding="utf-8")))


def test_the_tutorials_settings():
    for mode, discount in (("cooperative", 0.7), ("competitive", 0.8)):
        published = load(CONFIGS / f"tutorial_{mode}.yaml")
        as_meant = load(CONFIGS / f"tutorial_text_{mode}.yaml")
        for config in (published, as_meant):
            assert (config.mode, config.episodes) == (mode, 50_000)
            assert (config.step_size, config.discount, config.epsilon) == (0.1, discount, 0.2)
            assert (config.evaluation.every, config.evaluation.trials) == (1000, 200)
            assert (config.log.every_steps, config.log.window, config.log.episodes) == (50_000, 50_000, 50)
        assert not any(dict(as_meant.quirks).values())
        assert dict(published.quirks) == {
            "epsilon_exploits": True,
            "second_table_uses_first_action": mode == "competitive",
            "bootstrap_after_termination": True,
        }


@pytest.mark.parametrize(
    "wrong",
    [
        {"episodes": -1},
        {"episodes": 1, "epsilonn": 1},
        {"episodes": 1, "epsilon": 1.5},
        {"episodes": 1, "step_size": 0},
        {"episodes": 1, "mode": None},
        {"episodes": 1, "epsilon": {"schedule": "linear", "start": 1}},
        {"episodes": 1, "epsilon": {"start": 1, "end": 0, "over": 5}},
        {"episodes": 1, "epsilon": {"schedule": "piecewise", "points": [[0]]}},
        {"episodes": 1, "env": {"kwargs": {"competitive": True}}},
        {"episodes": 1, "evaluation": {"every": 5}},
        {"episodes": 1, "seeds": [1, 1]},
        {"episodes": 1, "seed": 2**64},
        {"episodes": 1, "initial_q": "zero"},
        {"episodes": 1, "recording": {"level": 20}},
    ],
    ids=str,
)
def test_an_editor_flags_what_loading_refuses(tmp_path, wrong):
    path = tmp_path / "x.yaml"
    path.write_text(yaml.safe_dump(wrong))
    with pytest.raises(ConfigError):
        load(path)
    validator = Draft202012Validator(json_schema())
    assert not validator.is_valid(wrong)
