"""Loops over real environments come out again, step for step, whatever their resets have for seeds."""

from __future__ import annotations

import contextlib
import shutil
import time
from functools import partial

import ale_py
import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import NormalizeObservation as NormalizeVector

import runner
from runner.errors import RecordingError
from runner.execution.verify import verify
from runner.export.pictures import PictureSource, source_of
from runner.recording.reader import open_recording
from runner.replay.environment import rerun, rerun_in_child
from tests.runner.loops.making import drive, parallel
from tests.runner.replay import loops
from tests.runner.replay.loops import SEEDING, record, rerun_steps

gymnasium.register_envs(ale_py)

pytestmark = [
    pytest.mark.usefixtures("own_folder"),
    # Of MuJoCo and of environments' own makers, not of what is tested.
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore::UserWarning"),
]


def atari(**kwargs):
    env = wrappers.AtariPreprocessing(gymnasium.make("ALE/Pong-v5", frameskip=1, **kwargs), frame_skip=4)
    return wrappers.FrameStackObservation(env, 4)


ENVIRONMENTS = {
    "Taxi": (partial(gymnasium.make, "Taxi-v4"), 700),
    "FrozenLake": (partial(gymnasium.make, "FrozenLake-v1", is_slippery=True), 700),
    "Blackjack": (partial(gymnasium.make, "Blackjack-v1"), 700),
    "CartPole": (partial(gymnasium.make, "CartPole-v1"), 700),
    "Acrobot": (partial(gymnasium.make, "Acrobot-v1", max_episode_steps=100), 700),
    "LunarLander": (partial(gymnasium.make, "LunarLander-v3", enable_wind=True), 700),
    "HalfCheetah": (partial(gymnasium.make, "HalfCheetah-v5", max_episode_steps=100), 700),
    "Pong": (partial(atari, max_num_frames_per_episode=600), 250),
    "BipedalWalker": (partial(gymnasium.make, "BipedalWalker-v3", max_episode_steps=60), 700),
    "sticky actions": (lambda: wrappers.StickyAction(gymnasium.make("FrozenLake-v1"), 0.3), 700),
    "running means": (lambda: wrappers.NormalizeObservation(gymnasium.make("CartPole-v1")), 700),
    "Dict": (loops.rooms, 700),
    "texts": (loops.rooms_with_text, 300),
}
"""Name -> what makes the environment, and steps: more than between two recorded states."""


@pytest.mark.parametrize("seeding", SEEDING)
@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_an_environment_comes_out_again(name, seeding, tmp_path):
    make, steps = ENVIRONMENTS[name]
    own = make if name in ("Dict", "texts") else None
    path = record(make(), tmp_path, steps, seeding, make=own)
    assert rerun_steps(path, trust=own is not None) == (steps, None)
    with open_recording(path) as recording:
        last = recording.train.episodes.count() - 1
        length = len(recording.train.episode(max(last, 0)))
    for episode in {max(last, 0), 0}:
        found = rerun_steps(path, "train", [episode], trust=own is not None)
        assert found[1] is None
        assert found[0] == length or episode != last


@pytest.mark.parametrize("seeding", ["once", "never"])
@pytest.mark.parametrize("mode", AutoresetMode)
@pytest.mark.parametrize(("kind", "n"), [(SyncVectorEnv, 3), (AsyncVectorEnv, 3), (SyncVectorEnv, 1)])
def test_a_vector_comes_out_again(kind, n, mode, seeding, tmp_path):
    envs = kind([partial(gymnasium.make, "CartPole-v1")] * n, autoreset_mode=mode)
    check_vector(envs, seeding, tmp_path)


@pytest.mark.parametrize("seeding", ["once", "never"])
@pytest.mark.parametrize(
    "make",
    [
        lambda: gymnasium.make_vec("CartPole-v1", 3),
        lambda: NormalizeVector(gymnasium.make_vec("CartPole-v1", 3, vectorization_mode="sync")),
    ],
    ids=["of its own class", "with a wrapper around it"],
)
def test_a_vector_that_cannot_be_taken_apart_comes_out_again(make, seeding, tmp_path):
    check_vector(make(), seeding, tmp_path)


def test_the_unfinished_episode_of_a_vector_of_one_begins_with_its_first_step(tmp_path):
    envs = SyncVectorEnv([partial(gymnasium.make, "CartPole-v1")], autoreset_mode=AutoresetMode.NEXT_STEP)
    with runner.record_vector(envs, tmp_path) as recorded:
        recorded.reset(seed=0)
        while not any(recorded.step(np.zeros(1, int))[2]):
            continue
        for _ in range(4):  # of which the first only resets the environment
            recorded.step(np.zeros(1, int))
    with open_recording(recorded.run.recording) as recording:
        assert recording.train.episode_steps(1)["t"].tolist() == [0, 1, 2]
    assert rerun_steps(recorded.run.recording, "train", [1]) == (3, None)


def check_vector(envs, seeding, folder):
    """Record 250 steps of each environment, and check that all steps and single episodes come out again."""
    with runner.record_vector(envs, folder) as recorded:
        if seeding == "once":
            drive(recorded, 250)
        else:
            recorded.action_space.seed(2)
            recorded.reset()
            for _ in range(250):
                _, _, terminated, truncated, _ = recorded.step(recorded.action_space.sample())
                over = terminated | truncated
                if recorded.metadata["autoreset_mode"] == AutoresetMode.DISABLED and over.any():
                    recorded.reset(options={"reset_mask": over})
    path = recorded.run.recording
    with open_recording(path) as recording:
        resets_alone = recording.train.steps.count() - sum(map(len, recording.train.steps.taken()))
        ended = recording.train.episodes.count()
        numbers = sorted({0, 5 % ended, min(12, ended - 1)})
        spans = [recording.train.episode(k) for k in numbers]
    assert rerun_steps(path) == (250 * recorded.num_envs - resets_alone, None)
    for number, span in zip(numbers, spans, strict=True):
        assert rerun_steps(path, "train", [number]) == (len(span), None)


@pytest.mark.parametrize("seeding", ["each", "never"])
def test_a_game_of_several_agents_comes_out_again(seeding, tmp_path):
    from mpe2 import simple_tag_v3

    env = simple_tag_v3.parallel_env(max_cycles=10, num_good=1, num_adversaries=2)
    with runner.record_parallel(env, tmp_path) as recorded:
        if seeding == "each":
            parallel(recorded, 4)
        else:
            generator = np.random.default_rng(3)
            for _ in range(4):
                recorded.reset()
                while recorded.agents:
                    recorded.step({agent: int(generator.integers(5)) for agent in recorded.agents})
    assert rerun_steps(recorded.run.recording) == (40, None)
    assert rerun_steps(recorded.run.recording, "train", [2]) == (10, None)


def test_options_of_resets_are_given_again(tmp_path):
    with runner.record(loops.counter(), tmp_path, make=loops.counter) as env:
        for seed, options in ((3, {"add": 500}), (None, None), (2**80, {"add": 7})):
            env.reset(seed=seed, options=options)
            for _ in range(10):
                env.step(0)
    assert rerun_steps(env.run.recording, trust=True) == (30, None)


def test_options_and_large_seeds_of_resets_in_a_vector_are_given_again(tmp_path):
    with runner.record_vector(loops.counters(), tmp_path, make=loops.counters) as envs:
        envs.reset(seed=[2**80, 4, None], options={"add": 500})
        for k in range(30):
            over = envs.step(np.zeros(3, np.int64))[2]
            if over.any():
                mask = np.arange(3) == (k + 1) // 10 % 3
                envs.reset(seed=[7, 2**70, 9], options={"add": k, "reset_mask": mask})
                envs.reset(options={"reset_mask": ~mask})
    with open_recording(envs.run.recording) as recording:
        given = list(recording.train.reset_options())
        resets = recording.train.resets.array()
    assert [(own.reset, own.options, own.large_seed) for own in given[:3]] == [
        (0, {"add": 500}, 2**80),
        (1, {"add": 500}, None),
        (2, {"add": 500}, None),
    ]
    assert [(own.reset, own.options) for own in given[3:]] == [
        (3, {"add": 9}),
        (6, {"add": 19}),
        (9, {"add": 29}),
    ]
    assert resets["environment"][3:6].tolist() == [1, 0, 2]
    assert rerun_steps(envs.run.recording, trust=True) == (90, None)


@pytest.mark.parametrize("is_shared", [True, False])
@pytest.mark.parametrize("is_whole", [True, False])
def test_a_reset_while_the_end_of_an_episode_is_pending_is_recorded_as_it_happened(
    tmp_path, is_shared, is_whole
):
    vector = AsyncVectorEnv([loops.counter] * 2, shared_memory=is_shared)
    envs = NormalizeVector(vector) if is_whole else vector
    with runner.record_vector(envs, tmp_path) as recorded:
        recorded.reset(seed=0)
        for k in range(15):
            if k == 10:
                first, _ = recorded.reset()
            after, rewards, *_ = recorded.step(np.zeros(2, np.int64))
            if k == 10:
                second = after
                assert rewards.tolist() == ([1, 1] if is_shared else [0, 0])
    with open_recording(recorded.run.recording) as recording:
        steps, resets = recording.train.steps.array(), recording.train.resets.array()
        lengths = recording.train.episodes.array()["length"].tolist()
    assert steps["taken"].reshape(15, 2).all(axis=1).tolist() == [True] * 10 + [is_shared] + [True] * 4
    observed = resets["observation"].reshape(-1, 2).tolist()
    assert observed[1:] == (
        [first.ravel().tolist()] if is_shared else [first.ravel().tolist(), second.ravel().tolist()]
    )
    assert lengths == [10, 10]
    found = verify(recorded.run.recording, trust=True)
    if is_whole and not is_shared:
        assert "as AsyncVectorEnv does without shared memory" in found.reason
    else:
        assert (found.verdict, found.finding) == ("reproduced", "")


OPTIONS = [
    {},
    {"start": (1, (2, [3])), "$start": 4},
    {0: "a", (1, 2): {None: True}},
    {"of": {3, 4}, "also": frozenset({"x"}), "text": "\ud800"},
    {"array": np.arange(6, dtype=np.int16).reshape(2, 3), "empty": np.zeros((0, 2), np.float32)},
    {"number": np.float32(0.1), "flag": np.bool_(True), "high": float("inf"), np.int64(3): -0.0},
]


@pytest.mark.parametrize("options", OPTIONS, ids=lambda options: str(list(options)))
def test_options_come_back_with_the_types_that_the_environment_got(options, tmp_path):
    vector = SyncVectorEnv([loops.Telling] * 2, autoreset_mode=AutoresetMode.DISABLED)
    recorders = (runner.record(loops.Telling(), tmp_path), runner.record_vector(vector, tmp_path))
    for recorded, action in zip(recorders, (0, np.zeros(2, np.int64)), strict=True):
        with recorded:
            recorded.reset(seed=1, options=options)
            recorded.step(action)
        found = verify(recorded.run.recording, trust=True)
        assert (found.verdict, found.finding) == ("reproduced", "")


@pytest.mark.parametrize("options", [{"deep": [{"thing": 3j}]}, {"loop": [[]]}], ids=["kind", "size"])
def test_a_difference_proves_nothing_if_options_could_not_be_recorded(options, tmp_path):
    if "loop" in options:
        options["loop"].append(options["loop"])
    with runner.record(loops.Telling(), tmp_path) as recorded:
        recorded.reset(seed=1)
        with pytest.warns(RuntimeWarning, match="the options of a reset"):
            recorded.reset(seed=1, options=options)
        recorded.step(0)
    found = verify(recorded.run.recording, trust=True)
    assert (found.verdict, found.act) == ("consistent", "checked")
    assert "The options of training reset 1 could not be recorded exactly" in found.reason


def test_options_that_the_environment_changes_are_recorded_as_they_were(tmp_path):
    class Taking(loops.Counter):
        def reset(self, *, seed=None, options=None):
            (options or {"start": {"add": 0}})["start"].pop("add")
            return super().reset(seed=seed)

    with runner.record(Taking(), tmp_path) as env:
        env.reset(seed=1, options={"start": {"add": 500}})
        env.step(0)
    with open_recording(env.run.recording) as recording:
        (given,) = recording.train.reset_options()
    assert (given.reset, given.options) == (0, {"start": {"add": 500}})


@pytest.mark.parametrize("is_shared", [True, False])
def test_evaluations_between_training_episodes_come_out_again(is_shared, tmp_path):
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path) as env:
        other = env if is_shared else runner.record(gymnasium.make("CartPole-v1"), into=env, phase="eval")
        env.reset(seed=1)
        if not is_shared:
            other.reset(seed=5)
        over, ended = False, 0
        for step in range(400):
            if over:
                env.reset()
            over = env.step(step % 2)[2]
            ended += over
            if step % 100 == 50 and not is_shared:  # in the middle of an episode of training
                other.reset()
                while not other.step(1)[2]:
                    pass
            if over and is_shared and ended % 2 == 0:
                with env.phase("eval"):
                    env.reset()
                    while not env.step(1)[2]:
                        pass
    path = env.run.recording
    with open_recording(path) as recording:
        evaluated = recording.eval.steps.count()
    assert evaluated > 20
    assert rerun_steps(path) == (400 + evaluated, None)
    assert rerun_steps(path, "eval", [1])[1] is None
    assert rerun_steps(path, "train", [7])[1] is None


def test_few_pictures_are_in_memory_after_episodes_that_are_not_drawn(tmp_path):
    with runner.record(gymnasium.make("Pendulum-v1"), tmp_path, seed=0) as env:
        env.reset(seed=0)
        for _ in range(1000):
            if any(env.step(np.zeros(1, np.float32))[2:4]):
                env.reset()
    with open_recording(env.run.recording) as recording:
        blocks = [len(b.frames) for b in rerun(recording, "train", [4], render=True)]
    assert sum(blocks) == 200
    assert max(blocks) <= 32


@pytest.mark.parametrize("kind", ["own class", "wrapped"])
def test_a_vector_that_cannot_be_taken_apart_draws_its_episodes(kind, tmp_path):
    def make_envs(render_mode=None):
        mode = "vector_entry_point" if kind == "own class" else "sync"
        envs = gymnasium.make_vec("CartPole-v1", 3, vectorization_mode=mode, render_mode=render_mode)
        return envs if kind == "own class" else NormalizeVector(envs)

    envs = make_envs("rgb_array")
    with runner.record_vector(make_envs(), tmp_path) as recorded:
        recorded.action_space.seed(1)
        actions = [recorded.action_space.sample() for _ in range(150)]
        recorded.reset(seed=4)
        for action in actions:
            recorded.step(action)
    envs.reset(seed=4)
    shown = [envs.render()[1].copy()] + [
        [envs.step(action), envs.render()[1].copy()][1] for action in actions
    ]
    with open_recording(recorded.run.recording) as recording:
        own = (k for k in range(12) if recording.train.episode(k).environment == 1)
        first, second = next(own), next(own)
        spans = [recording.train.episode(k) for k in (first, second)]
    for number, span in ((first, spans[0]), (second, spans[1])):
        blocks = list(rerun_in_child(recorded.run.recording, "train", [number], render=True))
        assert all(block.difference is None for block in blocks)
        frames = [start.frame for block in blocks for start in block.starts]
        frames += [frame for block in blocks for frame in block.frames]
        assert len(frames) == len(span) + 1
        for k, frame in enumerate(frames):
            assert (frame == shown[span.first // 3 + k]).all(), k


def test_large_pictures_come_one_by_one(tmp_path):
    path = record(loops.Wide(), tmp_path, 100, make="tests.runner.replay.loops:Wide")
    with open_recording(path) as recording:
        blocks = [len(block.frames) for block in rerun(recording, "train", [0], render=True, trust=True)]
    assert sum(blocks) == 10
    assert max(blocks) == 1, "as many of them as of small pictures would take gigabytes"


def test_a_child_process_draws_the_pictures_of_an_episode(tmp_path):
    path = record(gymnasium.make("CartPole-v1"), tmp_path, 200)
    blocks = list(rerun_in_child(path, "train", [3], render=True))
    with open_recording(path) as recording:
        steps = recording.train.episode_steps(3)
        assert source_of(recording, "train") == (PictureSource.REDRAWN, "")
        (in_process,) = (b for b in rerun(recording, "train", [3], render=True) if b.starts)
    frames = [frame for block in blocks for frame in block.frames]
    assert len(frames) == sum(map(len, blocks)) == len(steps)
    assert frames[0].shape == (400, 600, 3)
    assert frames[0].dtype == np.uint8
    assert (frames[0] != frames[-1]).any()
    assert (blocks[0].starts[0].frame == in_process.starts[0].frame).all()
    assert (blocks[0].frames[0] == in_process.frames[0]).all()
    assert [t for block in blocks for t in block.recorded["t"]] == list(range(len(steps)))
    assert {int(episode) for block in blocks for episode in block.recorded["episode"]} == {3}
    assert (np.concatenate([b.got["rewards"] for b in blocks]) == steps["rewards"]).all()


def test_a_run_that_was_killed_comes_out_again_with_both_of_its_environments(tmp_path):
    def counted(path):
        with open_recording(path) as recording:
            return [recording.phase(phase).steps.count() for phase in ("train", "eval")]

    with runner.record(gymnasium.make("CartPole-v1"), tmp_path) as env:
        other = runner.record(gymnasium.make("CartPole-v1"), into=env, phase="eval")
        other.reset(seed=3)
        env.reset(seed=1)
        tested, killed = 0, tmp_path / "killed.mcap"
        for step in range(600):
            if env.step(step % 2)[2]:
                env.reset()
            if step % 100 == 53:
                other.reset()
                over = False
                while not over:
                    over, tested = other.step(1)[2], tested + 1
        recorded, has_maker = [0, 0], False
        while recorded != [600, tested] or not has_maker:
            time.sleep(0.5)  # the loop is flushed twice a second
            shutil.copy(env.run.recording, killed)
            with contextlib.suppress(RecordingError), open_recording(killed) as recording:
                recorded, has_maker = counted(killed), recording.eval.own_maker is not None
    steps, difference = rerun_steps(killed)
    assert difference is None
    assert sum(recorded) - 60 < steps <= sum(recorded)
    verdict = verify(killed)
    assert (verdict.verdict, verdict.act, verdict.steps) == ("interrupted", "rerun", steps)
    assert verdict.cut_off == sum(recorded) - steps
