"""Frames that are recorded of vector environments and games: each belongs to its environment and its step."""

from __future__ import annotations

import contextlib
import io

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from mpe2 import simple_spread_v3
from PIL import Image

import runner
from runner.archive.reading import restore
from runner.errors import CannotRedo, ConfigError
from runner.export.pictures import Pictures, PictureSource, encoded_pictures
from runner.recording import schema
from runner.recording.integrity import check_integrity
from runner.recording.reader import open_recording
from tests.runner.archive.whole import archived, contents
from tests.runner.loops.making import N_COUNTING as N
from tests.runner.loops.making import Rooms, counting, play, record_counting


def shown_states(recording, phase, episode):
    """Return the state that each picture of an episode shows."""
    with contextlib.closing(Pictures(recording, phase, episode)) as shown:
        assert shown.source is PictureSource.RECORDED
        return [picture.pixels[0, 0].tolist() for picture in shown]


def encoded_states(path, phase, episode, start=0):
    """Return the state that each picture of an episode shows on the replay page."""
    states = []
    for data in encoded_pictures(path, phase, episode, start):
        pixels = np.asarray(Image.open(io.BytesIO(data)).convert("RGB")) if data else None
        states.append(states[-1] if pixels is None else pixels[0, 0].tolist())
    return states


@pytest.mark.parametrize("kind", [SyncVectorEnv, AsyncVectorEnv])
@pytest.mark.parametrize("mode", AutoresetMode)
def test_each_picture_of_a_vector_shows_its_environment_at_its_step(tmp_path, mode, kind):
    path = record_counting(tmp_path, mode, kind)
    check_integrity(path)
    with open_recording(path) as recording:
        episodes = recording.train.episodes.array()
        assert len(episodes) > 2 * N
        for number, episode in enumerate(episodes):
            i, length = int(episode["last_step"]) % N, int(episode["length"])
            shown = shown_states(recording, "train", number)
            assert len(shown) == length + 1
            own = shown[0][1]
            expected = [[i, own, t] for t in range(length + 1)]
            if mode == AutoresetMode.SAME_STEP and (episode["terminated"] or episode["truncated"]):
                expected[-1] = expected[-2]  # the environment was reset before it could be rendered
            assert shown == expected
            assert encoded_states(path, "train", number) == expected
            assert encoded_states(path, "train", number, 2) == expected[2:]


def test_frames_now_and_then_are_the_last_ones_up_to_each_step(tmp_path):
    path = record_counting(tmp_path, AutoresetMode.NEXT_STEP, frames_every=3, frame_format="png")
    with open_recording(path) as recording:
        count = recording.train.frames.count()
        assert count < recording.train.steps.count()
        for number, episode in enumerate(recording.train.episodes.array()):
            # Rendered again where the environment can be made again; here it cannot.
            shown = shown_states(recording, "train", number)
            over = bool(episode["terminated"])
            assert shown[0][2] == 0
            assert not over or shown[-1][2] == episode["length"]
            assert all(0 <= t - state[2] < 3 for t, state in enumerate(shown))
            assert encoded_states(path, "train", number, 3) == shown[3:]


def test_frames_of_chosen_environments(tmp_path):
    path = record_counting(tmp_path, AutoresetMode.NEXT_STEP, frames_of=[2])
    with open_recording(path) as recording:
        ids = {frame["frame_id"] for frame in recording.train.frames.decoded()}
        assert ids == {"train/2", "train/2/reset"}
        for number, episode in enumerate(recording.train.episodes.array()):
            with contextlib.closing(Pictures(recording, "train", number)) as shown:
                is_chosen = int(episode["last_step"]) % N == 2
                assert shown.source is (PictureSource.RECORDED if is_chosen else PictureSource.VALUES)
            if is_chosen:
                assert len(encoded_states(path, "train", number)) == episode["length"] + 1
            else:
                with pytest.raises(CannotRedo, match="There is no picture"):
                    next(encoded_pictures(path, "train", number))


def test_a_game_has_a_frame_each_step(tmp_path):
    env = simple_spread_v3.parallel_env(max_cycles=5, render_mode="rgb_array")
    seen = []
    with runner.record_parallel(env, tmp_path, frames_every=1) as rec:
        for seed in range(2):
            rec.reset(seed=seed)
            seen.append([env.render()])
            while rec.agents:
                rec.step(dict.fromkeys(rec.agents, 1))
                seen[-1].append(env.render())
    with open_recording(rec.run.recording) as recording:
        for number, frames in enumerate(seen):
            with contextlib.closing(Pictures(recording, "train", number)) as shown:
                assert shown.source is PictureSource.RECORDED
                found = [picture.pixels for picture in shown]
            assert len(found) == len(frames) == 6
            assert all(map(np.array_equal, found, frames))


def test_frames_keep_their_places_in_archives(tmp_path):
    path = record_counting(tmp_path, AutoresetMode.SAME_STEP)
    folder = archived(path, tmp_path / "archive")
    restore(folder, tmp_path / "back.mcap")
    assert contents(tmp_path / "back.mcap") == contents(path)


def test_frames_that_cannot_be_rendered_are_refused(tmp_path):
    envs = SyncVectorEnv([counting(0)] * 2)
    for wrong in ([2], -1, "0", [0.5]):
        with pytest.raises(ConfigError, match="frames_of: found"):
            runner.record_vector(envs, tmp_path, frames_every=1, frames_of=wrong)
    with pytest.raises(ConfigError, match="frames_of: found 0 with frames_every=0"):
        runner.record_vector(envs, tmp_path, frames_of=0)
    with pytest.raises(ConfigError, match="frames_every: found an environment with render_mode=None"):
        runner.record_vector(gymnasium.make_vec("CartPole-v1", 2), tmp_path, frames_every=1)
    with pytest.raises(ConfigError, match="frames_every: found an environment with render_mode=None"):
        runner.record_parallel(simple_spread_v3.parallel_env(), tmp_path, frames_every=1)
    assert not list(tmp_path.iterdir())


def test_frames_are_exact_and_carry_their_moment(tmp_path):
    plain, expected, steps, since = Rooms(), [], 0, 0
    for entry in play(plain, 40):
        since = 4 if entry[0] == "reset" else since - 1
        steps += entry[0] == "step"
        if entry[0] == "reset" or since == 0 or entry[4] or entry[5]:
            since = 4
            expected.append((steps, plain.render()))
    with runner.record(Rooms(), tmp_path, frames_every=4) as rec:
        list(play(rec, 40))
    with open_recording(rec.run.recording) as recording:
        found = list(recording.train.frames.decoded())
    assert len(expected) > 12
    for one, (moment, pixels) in zip(found, expected, strict=True):
        assert one["log_time"] == moment * schema.STEP_NANOSECONDS
        assert np.array_equal(np.asarray(Image.open(io.BytesIO(one["data"]))), pixels)
