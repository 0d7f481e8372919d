"""The description of an environment in a recording, which anyone may have written: every part is checked."""

import json

import pytest

from runner.errors import RecordingError
from runner.recording.maker import parse_shards
from runner.recording.metadata import environment_description

ENVIRONMENT = {
    **dict.fromkeys(("agents", "action_counts", "event_names", "success_events", "arrays"), ()),
    **{"env_id": "A-v1", "kwargs": {}, "step_limit": 0, "penalty_below": None, "scene": None},
}


@pytest.mark.parametrize("key", ["arrays", "event_names", "success_events", "agents"])
@pytest.mark.parametrize("names", [None, "wall", [1]])
def test_an_environment_that_names_nothing_is_refused(key, names):
    with pytest.raises(
        RecordingError, match=f"here: environment.json: found .* as {key}.*, expected a (list|text)"
    ):
        environment_description(json.dumps(ENVIRONMENT | {key: names}).encode(), "here")


@pytest.mark.parametrize("key", sorted(ENVIRONMENT.keys() - {"scene"}))
def test_an_environment_without_a_part_of_its_description_is_refused(key):
    assert environment_description(json.dumps(ENVIRONMENT).encode(), "here")["env_id"] == "A-v1"
    entries = {name: value for name, value in ENVIRONMENT.items() if name != key}
    with pytest.raises(RecordingError, match=f"here: environment.json: found none, expected the key {key}"):
        environment_description(json.dumps(entries).encode(), "here")


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("env_id", [1], r"found \[1\] as env_id, expected a text"),
        ("kwargs", 3, "found 3 as kwargs, expected an object"),
        ("penalty_below", "x", "found 'x' as penalty_below, expected a number or null"),
        ("action_counts", [-1], r"found -1 as action_counts\[0\], expected a whole number >= 0"),
        ("step_limit", True, "found True as step_limit, expected a whole number"),
        ("scene", "x", "found 'x' as scene, expected an object or null"),
        ("scene", {}, "environment.json: found {} as scene, found none, expected the key"),
    ],
)
def test_an_impossible_value_in_the_description_of_an_environment_is_refused(key, value, message):
    with pytest.raises(RecordingError, match=message):
        environment_description(json.dumps(ENVIRONMENT | {key: value}).encode(), "here")


@pytest.mark.parametrize(
    "change", [{"\ud800": 1}, {"name": "\ud800"}, {"environments": 10**300}, {"status": 3}]
)
def test_an_impossible_shard_is_refused(change):
    shard = {"name": "", "environments": 1, "status": "finished", "train_steps": 1, "eval_steps": 0}
    assert parse_shards(json.dumps([shard]), "here")[0].train_steps == 1
    with pytest.raises(RecordingError, match="here: its shards are damaged"):
        parse_shards(json.dumps([shard | change]), "here")
