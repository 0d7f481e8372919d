"""Values that vary in size, and those of spaces of one's own, are recorded exactly and come out again."""

from __future__ import annotations

from functools import partial

import pytest
from gymnasium import spaces

import runner
from runner.errors import CannotRedo, ConfigError
from runner.execution.verify import check_integrity
from runner.recording.gym_spaces import recorded_space, value_of
from runner.recording.reader import open_recording
from tests.runner.replay import varied
from tests.runner.replay.loops import rerun_steps


@pytest.mark.parametrize("name", varied.SPACES)
@pytest.mark.parametrize("is_seeded", [True, False])
def test_actions_and_observations_of_any_space_come_out_again(name, is_seeded, tmp_path):
    with runner.record(varied.Varied(name), tmp_path) as env:
        env.action_space.seed(3)
        for episode in range(3):
            env.reset(seed=episode if is_seeded else None)
            for _ in range(7):
                env.step(env.action_space.sample())
    check_integrity(env.run.recording)
    make = partial(varied.Varied, name)
    assert rerun_steps(env.run.recording, make=make) == (21, None)
    assert rerun_steps(env.run.recording, "train", [1], make=make) == (7, None)


@pytest.mark.parametrize("name", varied.SPACES)
def test_a_value_comes_back_from_its_text(name):
    space = varied.SPACES[name]
    space.seed(1)
    recorded = recorded_space(space)
    for _ in range(20):
        value = space.sample()
        back = value_of(space, recorded.text(value))
        assert back in space
        assert recorded.text(back) == recorded.text(value)


@pytest.mark.parametrize("text", ["{", "[9, 1]", "[-1, 0]", "[1]", "3", '{"a": 1}', "[0, [[" + "[" * 9999])
def test_a_text_that_is_no_value_is_refused(text):
    with pytest.raises(ValueError, match=r"\w"):
        value_of(varied.SPACES["one of"], text)


def test_the_description_has_the_parts_of_a_space(tmp_path):
    with runner.record(varied.Varied("nested"), tmp_path) as env:
        env.reset()
    with open_recording(env.run.recording) as recording:
        described = recording.spaces["action"]["spaces"]
    assert described["graph"]["space"]["node_space"]["dtype"] == "<f4"
    sequence, hands, numbers = described["both"]["spaces"]
    assert sequence["space"]["space"]["n"] == 9
    assert hands["space"] == {"type": "tests.runner.replay.varied:Hands"}
    assert numbers["type"] == "Box"


def test_another_space_is_found_out(tmp_path):
    with runner.record(varied.Varied("sequence"), tmp_path) as env:
        env.reset()
        env.step(env.action_space.sample())
    with pytest.raises(CannotRedo, match="another observation space"):
        rerun_steps(env.run.recording, make=partial(varied.Varied, "graph"))


@pytest.mark.parametrize("cls", [spaces.Box, int, varied.Hands()])
def test_only_classes_of_spaces_are_registered(cls):
    with pytest.raises(ConfigError, match="register_space: found"):
        runner.register_space(cls, to_json=list, from_json=list)


def test_a_branch_takes_an_action_as_json(tmp_path, monkeypatch):
    with runner.record(varied.Varied("sequence"), tmp_path, make=sequence) as env:
        env.reset(seed=1)
        for _ in range(7):
            env.step(())
    branch = runner.branch(
        env.run, at="0:2", action="[[1, 2]]", policy="recorded", recordings=tmp_path, trust=True
    )
    with open_recording(branch.run.recording) as recording:
        actions = [step["action"] for step in recording.train.transitions()]
    assert actions[1:4] == ["[]", "[[1.0, 2.0]]", "[]"]
    with pytest.raises(ConfigError, match="expected JSON for Sequence"):
        runner.branch(env.run, at="0:2", action="[1, 2", recordings=tmp_path, trust=True)


def sequence() -> varied.Varied:
    """Return the environment whose actions are sequences."""
    return varied.Varied("sequence")


def test_an_action_without_numbers_comes_back_from_its_text():
    assert value_of(spaces.Box(-1, 1, (0,)), "[]").shape == (0,)
