"""An environment that is not the recorded one is found out at the right step, or the reason is named."""

from __future__ import annotations

import dataclasses
import json
import math
import sys

import gymnasium
import numpy as np
import pytest

import runner
from runner.errors import CannotRedo
from runner.execution.verify import verify
from runner.export.pictures import PictureSource, source_of
from runner.recording.maker import EnvironmentMaker
from runner.recording.reader import open_recording
from runner.replay.environment import rerun, rerun_in_child
from runner.replay.makers import make_environment, why_not_made
from tests.runner.loops.making import drive
from tests.runner.replay import loops
from tests.runner.replay.loops import record, rerun_steps


def cart_pole(**attributes):
    """Return CartPole with other constants."""
    env = gymnasium.make("CartPole-v1")
    for name, value in attributes.items():
        setattr(env.unwrapped, name, value)
    return env


@pytest.fixture(scope="module")
def pole(tmp_path_factory):
    """Return the recording of a loop over CartPole."""
    return record(gymnasium.make("CartPole-v1"), tmp_path_factory.mktemp("pole"), 600)


# --- differences --------------------------------------------------------------------------------------


def test_another_constant_is_found_in_the_first_step(pole):
    steps, difference = rerun_steps(pole, make=lambda: cart_pole(gravity=9.81))
    assert steps == 1
    assert (difference.phase, difference.episode, difference.t, difference.step) == ("train", 0, 0, 0)
    assert difference.field == "observation[1]"  # gravity acts on both velocities, and not yet on places
    with open_recording(pole) as recording:
        first = recording.train.episode_steps(0)[0]["next_observation"]
    assert np.float32(difference.recorded) == first[1] != np.float32(difference.got)
    assert str(difference).startswith("train episode 0, t 0: observation[1]: recorded ")


def test_another_rule_of_the_end_is_found_where_it_first_matters(pole):
    steps, difference = rerun_steps(pole, make=lambda: cart_pole(theta_threshold_radians=math.radians(11)))
    with open_recording(pole) as recording:
        rows = recording.train.steps.array()
    beyond = np.abs(rows["next_observation"][:, 2]) > math.radians(11)
    expected = int(np.argmax(beyond & ~rows["terminated"]))
    assert (steps, difference.step, difference.field) == (expected + 1, expected, "terminated")
    assert (difference.episode, difference.t) == (rows["episode"][expected], rows["t"][expected])
    assert (difference.recorded, difference.got) == (False, True)


def test_another_limit_is_found_in_the_first_episode_that_reaches_it(tmp_path):
    path = record(gymnasium.make("Taxi-v4"), tmp_path, 700)
    steps, difference = rerun_steps(path, make=lambda: gymnasium.make("Taxi-v4", max_episode_steps=150))
    assert (steps, difference.episode, difference.t, difference.field) == (150, 0, 149, "truncated")


def test_steps_are_yielded_once_where_nothing_can_be_compared_in_advance(pole, monkeypatch):
    monkeypatch.setattr("runner.replay.environment._HELD_SECONDS", 0.0)  # as on a slow machine
    limited = {"render_mode": "rgb_array", "max_episode_steps": 4}
    steps, difference = rerun_steps(
        pole, "train", [0], render=True, make=lambda: gymnasium.make("CartPole-v1", **limited)
    )
    assert (steps, difference.t, difference.field) == (4, 3, "truncated")


def test_another_beginning_is_found_at_the_reset(pole):
    _, difference = rerun_steps(
        pole, make=lambda: gymnasium.wrappers.TransformObservation(cart_pole(), lambda o: o * 2, None)
    )
    assert (difference.t, difference.field) == (0, "first observation[0]")


def test_a_difference_in_one_part_of_a_dictionary_is_named(tmp_path):
    path = record(loops.rooms(), tmp_path, 50)

    class OtherDoors(loops.Rooms):
        def _observation(self):
            observation = super()._observation()
            if self._t == 3:
                observation["doors"] ^= np.array([0, 1, 0], np.int8)
            return observation

    _, difference = rerun_steps(path, make=OtherDoors)
    assert (difference.episode, difference.t, difference.field) == (0, 2, "observation['doors'][1]")


def test_an_action_that_the_environment_refuses_is_named(tmp_path):
    class Lenient(gymnasium.Env):
        observation_space = gymnasium.make("CartPole-v1").observation_space
        action_space = gymnasium.spaces.Discrete(2)

        def reset(self, *, seed=None, options=None):
            return gymnasium.make("CartPole-v1").reset(seed=seed)[0], {}

        def step(self, action):
            return np.zeros(4, np.float32), 1.0, False, False, {}

    with runner.record(Lenient(), tmp_path) as env:
        env.reset(seed=3)
        env.step(7)
    _, difference = rerun_steps(env.run.recording, make=cart_pole)
    assert difference.field == "error"
    assert "7" in difference.got
    assert "AssertionError" in difference.got


@pytest.mark.parametrize("step", [1, 20, 61])
def test_an_error_of_a_vector_is_named(step, tmp_path):
    class Failing(gymnasium.vector.VectorWrapper):
        steps = 0

        def step(self, actions):
            self.steps += 1
            if self.steps == step:
                raise RuntimeError("out of order")
            return super().step(actions)

    with runner.record_vector(gymnasium.make_vec("CartPole-v1", 3), tmp_path) as envs:
        drive(envs, 80)
    done, difference = rerun_steps(
        envs.run.recording, make=lambda: Failing(gymnasium.make_vec("CartPole-v1", 3))
    )
    assert (difference.field, difference.got) == ("error", "RuntimeError: out of order")
    assert difference.step // 3 in (step - 1, step)
    assert done <= step


def test_small_differences_are_accepted_within_a_tolerance(pole):
    def scaled(factor):
        return lambda: gymnasium.wrappers.TransformObservation(
            cart_pole(), lambda o: (o * np.float32(factor)).astype(np.float32), None
        )

    assert rerun_steps(pole, make=scaled(1 + 1e-5), tolerance=1e-4) == (600, None)
    assert rerun_steps(pole, make=scaled(1 + 1e-5))[1] is not None
    assert rerun_steps(pole, make=scaled(1 + 1e-2), tolerance=1e-4)[1] is not None


def test_a_recording_that_was_cut_by_a_kill_is_done_again_as_far_as_it_goes(pole, tmp_path):
    data = pole.read_bytes()
    with open_recording(pole) as recording:
        spans = [recording.train.episode(k) for k in (0, 1)]
    done = []
    for share in (0.5, 0.8, 0.97):
        cut = tmp_path / f"{share}.mcap"
        cut.write_bytes(data[: int(share * len(data))])
        with open_recording(cut) as recording:
            if any(phase.steps for phase in recording.phases):
                done.append(rerun_steps(cut))
    assert done
    assert all(difference is None for _, difference in done)
    assert max(steps for steps, _ in done) > spans[1].last + 1


# --- what cannot be done ------------------------------------------------------------------------------


def altered(maker, **spec):
    """Return a maker whose specification has other values."""
    return dataclasses.replace(maker, spec=json.dumps(json.loads(maker.spec) | spec))


@pytest.fixture(scope="module")
def maker(pole):
    with open_recording(pole) as recording:
        return recording.maker


def wrapper(entry_point, **kwargs):
    return [{"name": "W", "entry_point": entry_point, "kwargs": kwargs}]


def test_nothing_is_imported_but_installed_packages_of_environments(maker, tmp_path, monkeypatch):
    (tmp_path / "trap.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    for hostile in (
        altered(maker, entry_point="trap:Env"),
        altered(maker, id="trap:CartPole-v1"),
        altered(maker, additional_wrappers=wrapper("trap:Wrapper")),
        dataclasses.replace(maker, registered_by="trap"),
        dataclasses.replace(maker, make="trap:make", spec=""),
        EnvironmentMaker("pettingzoo", json.dumps({"entry_point": "trap:parallel_env", "kwargs": {}})),
    ):
        with pytest.raises(CannotRedo):
            make_environment(hostile, trust=False)
    assert "trap" not in sys.modules
    with pytest.raises(SystemExit, match="imported"):
        make_environment(dataclasses.replace(maker, make="trap:make"), trust=True)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"entry_point": "gymnasium.envs.toy_text.taxi:TaxiEnv"}, "another environment, or another version"),
        ({"id": "CartPole-v77"}, "not registered with Gymnasium"),
        ({"additional_wrappers": wrapper("gymnasium.utils.play:play")}, "not a known one"),
        ({"additional_wrappers": wrapper("gymnasium.wrappers.common:TimeLimit")}, "cannot be made here"),
        ({"additional_wrappers": "x"}, "not possible: found 'x' as additional_wrappers, expected a list"),
        ({"kwargs": {"xml_file": "/etc/passwd"}}, "expected numbers or a known word"),
        ({"kwargs": {"deep": [{"path": "../secret"}]}}, "expected numbers or a known word"),
        ({"kwargs": {"x": "y" * 100_000}}, "65,536 at most"),
        ({"kwargs": {"no_such": 1}}, "no_such"),
        ({"max_episode_steps": -3}, "found -3 as max_episode_steps"),
        ({"id": None}, "found None as id, expected a text"),
    ],
)
def test_a_hostile_specification_is_refused_with_the_reason(maker, changes, reason):
    with pytest.raises(CannotRedo, match=reason):
        make_environment(altered(maker, **changes), trust=False)


def test_a_package_that_is_not_installed_is_named(maker):
    for trust in (False, True):
        missing = dataclasses.replace(maker, registered_by="miniworld")
        assert why_not_made(missing, trust) == (
            "The package miniworld, which the environment needs, is not installed here."
        )
    own = dataclasses.replace(maker, make="not_on_the_path:make_env")
    assert "PYTHONPATH" in why_not_made(own, trust=True)


def test_an_environment_of_the_script_itself_cannot_be_made_again(tmp_path):
    path = record(
        gymnasium.wrappers.TransformReward(gymnasium.make("CartPole-v1"), lambda r: 2 * r), tmp_path, 20
    )
    with open_recording(path) as recording:
        source, reason = source_of(recording, "train")
        assert source is PictureSource.VALUES
        assert "JSON cannot hold" in reason
        with pytest.raises(CannotRedo, match="JSON cannot hold"):
            next(rerun(recording))


def test_another_space_is_named(tmp_path):
    path = record(gymnasium.make("CartPole-v1"), tmp_path, 20)
    with pytest.raises(CannotRedo, match="another observation space than recorded"):
        rerun_steps(path, make=lambda: gymnasium.make("Pendulum-v1"))


@pytest.mark.parametrize(
    ("make", "seconds", "reason"),
    [
        (loops.hanging, 2, "longer than 2 s"),
        (loops.crashing, 60, "ended its process"),
        (loops.hungry, 60, "more than 537 MB"),
        (loops.reticent, 60, "more than 537 MB"),
    ],
)
def test_an_environment_of_bad_habits_ends_with_the_reason(make, seconds, reason, tmp_path, monkeypatch):
    monkeypatch.setattr("runner.replay.makers.SECONDS", seconds)
    monkeypatch.setattr("runner.replay.makers.MEMORY_BYTES", 1 << 29)
    path = record(make(), tmp_path, 60, make=make)
    with pytest.raises(CannotRedo, match=reason):
        list(rerun_in_child(path, trust=True))
    found = verify(path, trust=True)
    assert found.verdict == "consistent"
    assert reason in found.reason


@pytest.mark.parametrize(
    ("make", "reason"),
    [(loops.counter, "draw no pictures"), (loops.blind, "cannot open display :0")],
)
def test_an_environment_that_cannot_draw_says_so(make, reason, tmp_path):
    path = record(make(), tmp_path, 30, make=make)
    with pytest.raises(CannotRedo, match=reason):
        list(rerun_in_child(path, "train", [0], render=True, trust=True))
    assert rerun_steps(path, trust=True) == (30, None)


# --- verdicts -----------------------------------------------------------------------------------------


def test_a_loop_is_verified_by_doing_it_again(pole):
    found = verify(pole)
    with open_recording(pole) as recording:
        episodes = recording.train.episodes.count()
    assert (found.verdict, found.steps, found.difference) == ("reproduced", 600, None)
    assert found.episodes in (episodes, episodes + 1)
    sample = verify(pole, sample=4)
    assert (sample.verdict, sample.episodes, sample.of_episodes) == ("reproduced", 4, episodes)
    assert 0 < sample.steps < 600


def test_state_outside_of_the_seed_is_named(tmp_path):
    path = record(loops.noisy(), tmp_path, 40, make=loops.noisy)
    found = verify(path, trust=True)
    assert found.verdict == "consistent"
    assert "more than its seed" in found.reason
    assert (found.difference.episode, found.difference.t, found.difference.field) == (0, 0, "reward")


@pytest.mark.parametrize("make", [loops.ordered, loops.clocked])
def test_the_order_of_a_set_and_a_coarse_clock_are_no_difference(make, tmp_path, monkeypatch):
    """Recorded on another day, with another hash seed; each rerun in one process differs in the same way."""
    monkeypatch.setattr(type(make()), "reward", lambda self: -1.0)
    path = record(make(), tmp_path, 20, make=make)
    found = verify(path, trust=True)
    assert (found.verdict, found.act, found.finding) == ("consistent", "checked", "")
    assert "more than its seed" in found.reason
    assert (found.difference.field, found.difference.recorded) == ("reward", -1.0)


def test_an_environment_of_another_version_differs(tmp_path, monkeypatch):
    monkeypatch.setattr(
        loops.Counter, "reward", lambda self: 2.0
    )  # as it was then; the child has it as it is
    versions = runner.loops.makers.package_versions()
    monkeypatch.setattr("runner.loops.makers.package_versions", lambda _=(): versions | {"gymnasium": "0.9"})
    path = record(loops.counter(), tmp_path, 40, make=loops.counter)
    found = verify(path, trust=True)
    assert (found.verdict, found.steps) == ("differs", 1)
    assert (found.difference.field, found.difference.recorded, found.difference.got) == ("reward", 2.0, 1.0)
    assert found.changes == {"gymnasium": ("0.9", gymnasium.__version__)}
