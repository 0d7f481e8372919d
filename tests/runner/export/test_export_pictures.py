"""The pictures of an episode, against the recording, the environment's own pictures and the pages' SVG."""

from __future__ import annotations

import contextlib

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.classic_control.cartpole import CartPoleEnv
from PIL import Image

import runner
from runner.drawing.raster import render_svg
from runner.drawing.svg import SvgDrawing
from runner.errors import RecordingError
from runner.export.pictures import Pictures, PictureSource
from runner.recording.reader import open_recording
from runner.runs.trust_marks import MARK_FILE
from tests.runner.export.making import made_otherwise
from tests.runner.loops.making import Rooms, make, play


def recorded(folder, env, steps=60, **options):
    """Return the recording of a random loop, opened, and the pictures that the environment drew."""
    drawn = []

    def render():
        drawn[-1].append(env.render())

    with runner.record(env, folder, **options) as rec:
        for entry in play(rec, steps):
            if entry[0] == "reset":
                drawn.append([])
            if env.render_mode == "rgb_array":
                render()
    return open_recording(rec.run.recording), drawn


def test_there_is_a_picture_of_every_state_with_its_step(recording):
    steps = recording.train.episode_steps(3)
    shown = list(Pictures(recording, "train", 3))
    assert [picture.t for picture in shown] == list(range(len(steps) + 1))
    assert len({picture.pixels.shape for picture in shown}) == 1
    assert not any(shown[0].rewards)
    assert not shown[0].action
    np.testing.assert_array_equal([picture.rewards for picture in shown[1:]], steps["rewards"])
    np.testing.assert_array_equal([one.returns for one in shown[1:]], steps["rewards"].cumsum(axis=0))
    assert all(picture.action for picture in shown[1:])
    assert [bool(picture.ended) for picture in shown] == [False] * len(steps) + [True]


def test_scenes_look_like_the_pictures_of_the_pages(recording):
    mdp, steps = recording.mdp, recording.train.episode_steps(3)[:30]
    shown = Pictures(recording, "train", 3)
    if mdp.scene is None:
        assert shown.source is PictureSource.VALUES
        return
    assert shown.source is PictureSource.SCENE
    drawing = SvgDrawing(mdp.scene)
    places = drawing.places(mdp, np.append(steps["state"], steps["next_state"][-1]))
    for picture in shown:
        if picture.t % 7 or picture.t > 30:
            continue
        svg = drawing.frame(places[picture.t], "", places[: picture.t + 1])
        height, width, _ = picture.pixels.shape
        expected = render_svg(
            svg.replace("<svg ", f'<svg width="{width}" height="{height}" ', 1), width, height
        )
        ground = Image.new("RGBA", (width, height), "#ffffff")
        pixels = np.asarray(Image.alpha_composite(ground, expected).convert("RGB"), np.int16)
        difference = np.abs(picture.pixels.astype(np.int16) - pixels)
        assert difference.mean() < 1.5
        assert (difference.max(axis=2) > 100).mean() < 0.005


def test_recorded_frames_are_those_that_the_environment_drew(tmp_path):
    recording, drawn = recorded(
        tmp_path, gymnasium.make("CartPole-v1", render_mode="rgb_array"), frames_every=1
    )
    with recording:
        for episode in (0, 1, len(drawn) - 1):
            shown = Pictures(recording, "train", episode)
            assert shown.source is PictureSource.RECORDED
            np.testing.assert_array_equal([picture.pixels for picture in shown], drawn[episode])


def test_a_frame_is_shown_until_the_next_recorded_one(tmp_path):
    class Hidden(Rooms):
        """Has no name by which it could be imported."""

    recording, drawn = recorded(tmp_path, Hidden(), frames_every=4)
    with recording:
        for episode, frames in enumerate(drawn[:-1]):
            shown = Pictures(recording, "train", episode)
            assert shown.source is PictureSource.RECORDED
            assert "cannot be imported" in shown.reason  # which is why it is not drawn again
            last = len(frames) - 1
            expected = [frames[t if t == last else t - t % 4] for t in range(last + 1)]
            np.testing.assert_array_equal([picture.pixels for picture in shown], expected)


DRAWN_AGAIN = {
    "CartPole": ("CartPole-v1", {}, 0),
    "with a frame now and then": ("CartPole-v1", {"frames_every": 5}, 0),
    "LunarLander": ("LunarLander-v3", {}, 0),
    "Blackjack": ("Blackjack-v1", {}, 0),
    "Pong": ("ALE/Pong-v5", {}, 30),
}


@pytest.mark.filterwarnings("ignore:builtin type:DeprecationWarning")  # of Box2D when it is imported
@pytest.mark.parametrize("case", DRAWN_AGAIN)
def test_pictures_drawn_again_are_those_of_the_environment(tmp_path, case):
    env_id, options, steps = DRAWN_AGAIN[case]
    if env_id.startswith("ALE/"):
        gymnasium.register_envs(pytest.importorskip("ale_py"))
    recording, drawn = recorded(
        tmp_path, gymnasium.make(env_id, render_mode="rgb_array"), steps or 150, **options
    )
    with recording:
        for episode in {0, min(1, len(drawn) - 1)}:
            with contextlib.closing(Pictures(recording, "train", episode)) as shown:
                assert (shown.source, shown.reason) == (PictureSource.REDRAWN, "")
                np.testing.assert_array_equal([picture.pixels for picture in shown], drawn[episode])


def own_pole(render_mode=None):
    """Return an environment that this function alone makes."""
    return CartPoleEnv(render_mode=render_mode)


def test_what_a_recording_names_is_imported_if_it_is_trusted_only(tmp_path):
    with runner.record(own_pole(), tmp_path, make=own_pole) as rec:
        list(play(rec, 60))
    with open_recording(rec.run.recording) as recording:
        with contextlib.closing(Pictures(recording, "train", 0)) as shown:
            assert shown.source is PictureSource.REDRAWN
        (rec.run.folder / MARK_FILE).unlink()
        shown = Pictures(recording, "train", 0)
        assert shown.source is PictureSource.VALUES
        assert "--trust" in shown.reason
        with contextlib.closing(Pictures(recording, "train", 0, trust=True)) as shown:
            assert shown.source is PictureSource.REDRAWN
            assert next(shown).pixels.shape == (400, 600, 3)


def test_pictures_end_with_a_note_where_the_environment_differs(tmp_path):
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path / "runs") as rec:
        list(play(rec, 120))
    other = made_otherwise(rec.run.recording, tmp_path / "other.mcap", max_episode_steps=5)
    with open_recording(other) as recording:
        shown = list(Pictures(recording, "train", 0))
        steps = recording.train.episode_steps(0)
        later = Pictures(recording, "train", 1)  # its reset needs those before it
    assert later.source is PictureSource.VALUES
    assert "before, at train episode 0, t 4: truncated" in later.reason
    expected = "At step 5 the environment differs from the recording: truncated: recorded False, got True."
    assert shown[-1].note == expected
    assert [picture.t for picture in shown] == list(range(6))
    assert not any(picture.note for picture in shown[:-1])
    np.testing.assert_array_equal(shown[-1].pixels, shown[-2].pixels)
    assert shown[-1].returns[0] == steps["rewards"][:5].sum()


@pytest.mark.filterwarnings("ignore:builtin type:DeprecationWarning")  # of Box2D when it is imported
def test_values_are_shown_where_the_environment_begins_otherwise(tmp_path):
    with runner.record(gymnasium.make("LunarLander-v3"), tmp_path / "runs") as rec:
        list(play(rec, 150))
    other = made_otherwise(rec.run.recording, tmp_path / "other.mcap", kwargs={"gravity": -5.0})
    with open_recording(other) as recording:
        shown = Pictures(recording, "train", 0)
        assert shown.source is PictureSource.VALUES
        assert "first observation" in shown.reason
        assert len(list(shown)) == len(recording.train.episode_steps(0)) + 1


def test_values_are_drawn_as_bars_that_follow_them(tmp_path):
    class Hidden(CartPoleEnv):
        """Has no name by which it could be imported."""

    recording, _ = recorded(tmp_path, Hidden())
    with recording:
        shown = Pictures(recording, "train", 0)
        assert shown.source is PictureSource.VALUES
        assert "cannot be imported" in shown.reason
        frames = [picture.pixels for picture in shown]
        values = recording.train.episode_steps(0)["next_observation"][:, 2]
    blue = [(frame[50:70] == [0, 0x72, 0xB2]).all(axis=2).sum() for frame in frames[1:]]
    for number, value in zip(blue, values, strict=True):
        assert (number > 0) == (value > 0)
    assert np.corrcoef(blue, values.clip(0))[0, 1] > 0.99


def test_observations_that_are_images_are_shown(tmp_path):
    class Camera(Rooms):
        def __init__(self):
            super().__init__()
            self.observation_space = gymnasium.spaces.Box(0, 255, (4, 20, 24), np.uint8)

    recording, _ = recorded(tmp_path, Camera(), 20)
    with recording:
        shown = Pictures(recording, "train", 0)
        assert shown.source is PictureSource.OBSERVATION
        last = recording.train.episode_steps(0)["next_observation"][:, -1]
        np.testing.assert_array_equal([picture.pixels[..., 0] for picture in shown][1:], last)


def test_games_and_vectors_have_pictures(tmp_path):
    pettingzoo = pytest.importorskip("mpe2.simple_spread_v3")
    game = runner.record_parallel(pettingzoo.parallel_env(max_cycles=5), tmp_path, name="spread")
    game.reset(seed=0)
    while game.agents:
        game.step(dict.fromkeys(game.agents, 1))
    game.close()
    with open_recording(game.run.recording) as recording:
        shown = Pictures(recording, "train", 0)
        assert shown.source is PictureSource.REDRAWN
        last = list(shown)[-1]
        assert last.pixels.shape == (700, 700, 3)
        assert last.action == "agent 0 left, agent 1 left, agent 2 left"
        assert len(last.returns) == 3
        np.testing.assert_allclose(last.returns, recording.train.episodes.array()[0]["returns"])
    envs = runner.record_vector(gymnasium.make_vec("CartPole-v1", 3), tmp_path, name="vector")
    envs.reset(seed=0)
    for _ in range(60):
        envs.step(np.ones(3, np.int64))
    envs.close()
    with open_recording(envs.run.recording) as recording:
        for episode, record in enumerate(recording.train.episodes.array()):
            shown = list(Pictures(recording, "train", episode))
            assert len(shown) == record["length"] + 1
            assert shown[-1].returns[0] == record["returns"][0]
            assert shown[-1].ended == "ended"


def test_texts_of_an_observation_are_named(tmp_path):
    recording, _ = recorded(tmp_path, make("RoomsText"))
    with recording:
        shown = list(Pictures(recording, "train", 1))
        missions = [step["next_observation"]["mission"] for step in recording.train.transitions()]
    assert all(picture.events.startswith("mission ") for picture in shown[1:])
    assert any(repr(mission) in shown[1].events for mission in missions)
    assert shown[1].action.startswith("go ")


def test_an_episode_that_is_not_there_is_refused(recording):
    with pytest.raises(RecordingError, match="has no training episode 999; there are 40, from 0"):
        Pictures(recording, "train", 999)
