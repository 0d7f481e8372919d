"""Vector environments in each autoreset mode; games of several agents."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import runner
from dualtaxi import Rewards
from dualtaxi.parallel import DualTaxiParallelEnv
from runner.errors import EnvironmentNotUsable, RecordingError
from runner.execution.verify import verify
from runner.recording import schema
from runner.recording.integrity import check_integrity
from runner.recording.reader import Recording, open_recording
from tests.runner.loops.making import Leaving, drive, make, parallel, play

N = 3
NAMES = ("CartPole-v1", "FrozenLake-v1", "Rooms")


def vector(name: str, mode: AutoresetMode) -> SyncVectorEnv:
    return SyncVectorEnv([lambda: make(name)] * N, autoreset_mode=mode)


def alike(left: Any, right: Any) -> bool:
    if isinstance(left, dict):
        return all(alike(left[key], right[key]) for key in left)
    if isinstance(left, tuple):
        return all(map(alike, left, right))
    return bool(np.array_equal(left, right))


@pytest.mark.parametrize("mode", AutoresetMode)
@pytest.mark.parametrize("name", NAMES)
def test_recording_changes_nothing_for_a_vector_loop(tmp_path, name, mode):
    with runner.record_vector(vector(name, mode), tmp_path, chunk_steps=256) as envs:
        seen = drive(envs, 300)
    assert all(map(alike, seen, drive(vector(name, mode), 300)))
    check_integrity(envs.run.recording)
    with open_recording(envs.run.recording) as recording:
        ended = recording.train.episodes.array()
        assert recording.environments == N
        assert len(ended) > 10
        steps = recording.train.steps.array()
        resets = recording.train.resets.array()
        assert len(steps) == 300 * N
        for number, episode in enumerate(ended):
            check_episode(recording, number, episode)
    assert steps["step"].tolist() == list(range(len(steps)))
    assert resets["seed"][:N].tolist() == [7, 8, 9]
    assert steps["environment"].tolist() == [*range(N)] * 300
    only_resets = int((~steps["taken"]).sum())
    assert not steps["t"][~steps["taken"]].any()
    assert (only_resets > 0) == (mode == AutoresetMode.NEXT_STEP)
    over = int((steps["terminated"] | steps["truncated"]).sum())
    assert len(ended) == over
    assert N + over - N <= len(resets) <= N + over
    check_follows(steps, resets)


def check_episode(recording: Recording, number: int, episode: Any) -> None:
    """The steps of an episode belong to one environment, are complete, and add up."""
    own = recording.train.episode_steps(number)
    assert own["t"].tolist() == list(range(int(episode["length"])))
    assert own["rewards"].sum() == pytest.approx(float(episode["returns"][0]))
    assert set(own["environment"].tolist()) == {int(episode["environment"])}
    assert own["taken"].all()
    assert (own["step"][0], own["step"][-1]) == (episode["first_step"], episode["last_step"])
    assert len(set(own["episode"].tolist())) == 1
    assert bool(own["terminated"][-1]) == bool(episode["terminated"])


def check_follows(steps: Any, resets: Any) -> None:
    """Each environment's first observation is that of its reset; each step starts in the last state."""
    if "state" not in steps.dtype.names:
        return
    first = {(int(r["environment"]), int(r["episode"])): int(r["observation"]) for r in resets}
    for i in range(N):
        own = steps[i::N]
        own = own[own["taken"]]
        begins = own["t"] == 0
        assert [first[i, int(e)] for e in own["episode"][begins]] == own["state"][begins].tolist()
        inside = ~begins[1:]
        assert own["state"][1:][inside].tolist() == own["next_state"][:-1][inside].tolist()


@pytest.mark.parametrize("mode", AutoresetMode)
def test_final_observations_belong_to_their_episode(tmp_path, mode):
    """CartPole ends where the pole or the cart is too far off, not where the next episode starts."""
    with runner.record_vector(vector("CartPole-v1", mode), tmp_path) as envs:
        drive(envs, 300)
    with open_recording(envs.run.recording) as recording:
        steps = recording.train.steps.array()
    last = steps["next_observation"][steps["terminated"]]
    assert len(last) > 20
    assert ((np.abs(last[:, 2]) > 0.2094) | (np.abs(last[:, 0]) > 2.4)).all()


def test_what_a_vector_cannot_record_is_refused(tmp_path):
    envs = vector("CartPole-v1", AutoresetMode.NEXT_STEP)
    envs.metadata = {}
    with pytest.raises(EnvironmentNotUsable, match="AutoresetMode"):
        runner.record_vector(envs, tmp_path)


def test_recording_changes_nothing_for_a_parallel_game(tmp_path):
    with runner.record_parallel(DualTaxiParallelEnv(max_steps=40), tmp_path) as game:
        seen = parallel(game, 4)
    alone = parallel(DualTaxiParallelEnv(max_steps=40), 4)
    assert [entry[0] for entry in seen] == [entry[0] for entry in alone]
    check_integrity(game.run.recording)
    played = [entry for entry in seen if entry[0] != "reset"]
    with open_recording(game.run.recording) as recording:
        steps = list(recording.train.transitions())
        ended = recording.train.episodes.array()
        first = list(recording.train.reset_values())
        assert recording.run["agents"] == '["taxi_1", "taxi_2"]'
    assert len(steps) == len(played)
    for one, (actions, observations, rewards, _, _) in zip(steps, played, strict=True):
        for i, agent in enumerate(("taxi_1", "taxi_2")):
            assert one["action"][agent] == actions[agent]
            assert one["next_observation"][agent] == observations[agent]
            assert one["rewards"][i] == rewards[agent]
        assert one["acted"] == 3
    assert ended["length"].tolist() == [40] * 4
    assert ended["truncated"].all()
    assert [int(one["seed"]) for one in first] == [0, 1, 2, 3]


def test_agents_that_leave_are_recorded(tmp_path):
    with runner.record_parallel(Leaving(), tmp_path, info=["left"]) as game:
        parallel(game, 2)
    with open_recording(game.run.recording) as recording:
        steps = list(recording.train.transitions())
        ended = recording.train.episodes.array()
        infos = list(recording.train.infos.decoded())
    assert [int(one["acted"]) for one in steps[:3]] == [0b111, 0b110, 0b100]
    assert [int(one["agents_terminated"]) for one in steps[:3]] == [0b001, 0b010, 0b100]
    assert [bool(one["terminated"]) for one in steps[:3]] == [False, False, True]
    assert steps[1]["next_observation"]["a"].tolist() == [0, 0]
    assert steps[1]["next_observation"]["b"].tolist() == [2, 2]
    assert ended["returns"].tolist() == [[1, 2, 3]] * 2
    assert infos[1]["json"] == '{"left": {"b": "b", "c": "b"}}'


def test_agents_without_names_are_refused_before_there_is_a_run(tmp_path):
    game = Leaving()
    game.possible_agents = [("a", 1), ("b", 2)]
    with pytest.raises(EnvironmentNotUsable, match="expected a name or a number"):
        runner.record_parallel(game, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_loop_is_recorded_after_its_working_directory_was_removed(tmp_path, monkeypatch):
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    with runner.record(make("FrozenLake-v1"), tmp_path / "runs") as env:
        list(play(env, 20))
    with open_recording(env.run.recording) as recording:
        assert recording.provenance["directory"] == ""
    monkeypatch.chdir(tmp_path)


def test_a_vector_of_one_equals_the_environment_alone(tmp_path):
    with runner.record(make("FrozenLake-v1"), tmp_path) as env:
        list(play(env, 200))
    mode = AutoresetMode.SAME_STEP
    one = SyncVectorEnv([lambda: make("FrozenLake-v1")], autoreset_mode=mode)
    with runner.record_vector(one, tmp_path) as envs:
        actions = make("FrozenLake-v1").action_space
        actions.seed(5)
        envs.reset(seed=5)
        for _ in range(200):
            envs.step(np.array([actions.sample()]))
    digests = [run.summary["topic_digests"]["/train/step"] for run in (env.run, envs.run)]
    assert digests[0] == digests[1]


def test_rooms_of_every_kind_of_space_come_back_from_a_vector(tmp_path):
    mode = AutoresetMode.NEXT_STEP
    with runner.record_vector(vector("Rooms", mode), tmp_path) as envs:
        envs.action_space.seed(0)
        seen = [envs.reset(seed=1)[0]]
        seen += [envs.step(envs.action_space.sample())[0] for _ in range(5)]
    with open_recording(envs.run.recording) as recording:
        steps = next(recording.train.steps.blocks())["next_observation"]
    for k, observation in enumerate(seen[1:]):
        rows = steps[k * N : (k + 1) * N]
        assert np.array_equal(rows["position"], observation["position"])
        assert np.array_equal(rows["doors"], observation["doors"])
        assert np.array_equal(rows["room"]["0"], observation["room"][0])
        assert np.array_equal(rows["room"]["1"], observation["room"][1])


def test_an_export_to_rerun_notes_how_many_environments_it_shows(tmp_path):
    from runner.export.rerun.selection import Request, select

    with runner.record_vector(SyncVectorEnv([lambda: make("CartPole-v1")] * 3), tmp_path) as rec:
        rec.reset(seed=0)
        for _ in range(5):
            rec.step(rec.action_space.sample())
    with open_recording(rec.run.recording) as recording:
        assert select(recording, Request()).exported == ["15 of 15 training steps in 3 environments"]


def test_an_export_to_rerun_notes_that_texts_are_not_drawn(tmp_path):
    from runner.export.rerun.selection import Request, select

    with runner.record(make("RoomsText"), tmp_path) as rec:
        list(play(rec, 5))
    with open_recording(rec.run.recording) as recording:
        assert "they are not drawn" in select(recording, Request()).warnings[0]


class Tide(gymnasium.Env[Any, Any]):
    """Episodes, rewards and observations computed from the seed of the first reset in whole numbers."""

    def __init__(self, is_discrete: bool) -> None:
        self.observation_space: Any = spaces.Box(-9, 9, (2,), np.float32)
        self.action_space: Any = spaces.Box(-9, 9, (1,), np.float32)
        if is_discrete:
            self.observation_space, self.action_space = (
                spaces.Discrete(9, start=2),
                spaces.Discrete(3, start=1),
            )
        self._is_discrete = is_discrete
        self._k = 0

    def _observation(self) -> Any:
        self._k = (self._k * 75 + 74) % 65537
        return 2 + self._k % 9 if self._is_discrete else np.array([self._k % 9, -(self._k % 7)], np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self._k += 0 if seed is None else seed
        return self._observation(), {}

    def step(self, action: Any) -> Any:
        observation = self._observation()
        return observation, self._k / 10 - 3000, self._k % 11 == 0, self._k % 13 == 0, {}


def tide(folder: Any, is_discrete: bool, mode: AutoresetMode) -> Any:
    """Return the run of a loop with two phases, resets of some environments, resets of all, logged values."""
    envs = SyncVectorEnv([lambda: Tide(is_discrete)] * N, autoreset_mode=mode)
    action = np.array([1, 2, 3]) if is_discrete else np.array([[0.5], [-1], [2]], np.float32)
    with runner.record_vector(envs, folder, chunk_steps=256) as rec:

        def step(k: int) -> None:
            _, _, terminated, truncated, _ = rec.step(action)
            over = terminated | truncated
            if mode == AutoresetMode.DISABLED and over.any():
                rec.reset(options={"reset_mask": over if k % 3 else np.ones(N, np.bool_)})

        rec.reset(seed=7)
        for k in range(400):
            step(k)
            if k % 5 == 0:
                rec.log("k", k)
            if k % 100 == 50:
                with rec.phase("eval"):
                    rec.reset(seed=k)
                    for i in range(30):
                        step(i)
                rec.reset()
    return rec.run


TIDES = {
    (True, AutoresetMode.NEXT_STEP): "39568adc88bee6204387922cd7670141c937c301d05b2880e6993897e42510cf",
    (True, AutoresetMode.SAME_STEP): "a8ba928035690600c48327345192235aa99f4fc901dcc6f6d62edffa476bbdf8",
    (True, AutoresetMode.DISABLED): "b8aff319e00e31db54b11dd19ac0d2fac331da25272765382198846a92c87882",
    (False, AutoresetMode.NEXT_STEP): "9b4b7db49b77be0a398817a74288d543c608618c3ebb35e7aafc86de7fe01567",
    (False, AutoresetMode.SAME_STEP): "b47122a1e27108f618a67d8a6dbdc6f140569563feb479e062a623ef40296cb5",
    (False, AutoresetMode.DISABLED): "9e2491285598608f3cc4b9c69f8d0ee6b46b0dbcf225b1c07d70570c9b362aa3",
}
"""Content digests by kind of spaces and autoreset mode."""


@pytest.mark.parametrize(("is_discrete", "mode"), TIDES)
def test_the_content_of_a_vector_loop_is_unchanged(tmp_path, is_discrete, mode):
    run = tide(tmp_path, is_discrete, mode)
    assert run.summary["content_digest"] == TIDES[is_discrete, mode]
    check_integrity(run.recording)


def test_logged_values_have_the_place_of_their_step(tmp_path):
    envs = SyncVectorEnv([lambda: Tide(True)] * N)
    ended, expected = 0, []
    with runner.record_vector(envs, tmp_path) as rec:
        rec.reset(seed=3)
        for k in range(50):
            _, _, terminated, truncated, _ = rec.step(np.ones(N, np.int64))
            ended += int((terminated | truncated).sum())
            rec.log("k", float(k))
            expected.append(((k + 1) * N, ended))
    with open_recording(rec.run.recording) as recording:
        logged = list(recording.table(schema.SCALAR_TOPIC).decoded())
    assert ended > 5
    assert [(one["step"], one["episode"]) for one in logged] == expected


def test_options_are_recorded_as_they_were_before_a_game_took_them(tmp_path):
    class Taking(Leaving):
        def reset(self, seed=None, options=None):
            options.clear()
            return super().reset(seed)

    with runner.record_parallel(Taking(), tmp_path) as rec:
        rec.reset(options={"map": "small"})
    with open_recording(rec.run.recording) as recording:
        (given,) = recording.train.reset_options()
    assert (given.reset, given.options) == (0, {"map": "small"})


def test_options_of_a_vector_are_recorded_once_for_a_call(tmp_path):
    with runner.record_vector(vector("CartPole-v1", AutoresetMode.NEXT_STEP), tmp_path) as envs:
        envs.reset(seed=1, options={"low": -0.01})
        envs.reset(seed=10**3999, options={"low": -0.02})
        with pytest.raises(RecordingError, match="more digits than 4,000"):
            envs.reset(seed=10**4001)
    with open_recording(envs.run.recording) as recording:
        given = list(recording.train.reset_options())
    assert [(one.reset, one.resets, one.options) for one in given] == [
        (0, 3, {"low": -0.01}),
        *((k, 1, {"low": -0.02}) for k in (3, 4, 5)),
    ]


def test_a_game_is_made_with_the_arguments_it_had(tmp_path):
    rewards = Rewards(step=-3.0)
    game = DualTaxiParallelEnv(max_steps=30, rewards=rewards, slip=0.25)
    with runner.record_parallel(game, tmp_path) as rec:
        parallel(rec, 2)
    outcome = verify(rec.run.recording, trust=True)
    assert (outcome.verdict, outcome.steps, outcome.assumed) == ("reproduced", 60, ())
