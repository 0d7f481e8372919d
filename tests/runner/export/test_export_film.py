"""Films, decoded: number of frames, their size, and what they show."""

from __future__ import annotations

import itertools
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import av
import gymnasium
import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

import runner
from runner.analysis.episodes import EpisodeRef, ranked_episodes
from runner.cli import cli
from runner.errors import RunnerError
from runner.export.film import FORMATS, Encoder
from runner.export.pictures import Pictures
from runner.recording.reader import open_recording
from tests.runner.export.making import made_otherwise
from tests.runner.loops.making import Rooms, play

ENDINGS = tuple(FORMATS)


def film(*words):
    return CliRunner().invoke(cli, ["export", "film", *map(str, words)])


def frames_of(path):
    """Return the frames of a film, uint8 [frames, height, width, 3]; of a WebP picture by Pillow."""
    if path.suffix == ".webp":
        with Image.open(path) as picture:
            frames = []
            for number in range(picture.n_frames):
                picture.seek(number)
                frames.append(np.asarray(picture.convert("RGB")))
            return np.array(frames)
    with av.open(path) as container:
        return np.array([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


def assert_shows(frame, picture):
    """Assert that a frame shows a picture of its width somewhere, but for what a codec loses."""
    height, expected = len(picture), picture.astype(np.int16)
    shown = frame.astype(np.int16)
    differences = [
        np.abs(shown[top : top + height : 4, ::4] - expected[::4, ::4]).mean()
        for top in range(len(frame) - height + 1)
    ]
    top = int(np.argmin(differences))
    difference = np.abs(shown[top : top + height] - expected)
    assert difference.mean() < 4
    assert (difference.max(axis=2) > 100).mean() < 0.01


@pytest.fixture(scope="module")
def pole(tmp_path_factory):
    """Return a loop over CartPole with frames, and the pictures that the environment drew, by episode."""
    drawn, env = [], gymnasium.make("CartPole-v1", render_mode="rgb_array")
    with runner.record(env, tmp_path_factory.mktemp("pole"), seed=0, frames_every=1) as rec:
        for entry in play(rec, 200):
            if entry[0] == "reset":
                drawn.append([])
            drawn[-1].append(env.render())
    return rec.run, drawn


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_film_shows_what_the_environment_drew(pole, tmp_path, ending):
    run, drawn = pole
    path = tmp_path / f"film{ending}"
    result = film(run.recording, "--episode", 1, "-o", path)
    assert result.exit_code == 0, result.output
    frames = frames_of(path)
    assert (
        f"training episode 1, recorded frames, {len(drawn[1])} frames of {frames.shape[2]}x{frames.shape[1]}"
        in result.stdout
    )
    assert frames.shape[1] % 2 == frames.shape[2] % 2 == 0
    assert len(frames) == len(drawn[1])
    for shown, expected in ((frames[0], drawn[1][0]), (frames[-1], drawn[1][-1])):
        assert_shows(shown, expected)
    assert (np.abs(frames[0].astype(int) - frames[-1]) > 50).any()
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_job_becomes_a_film_of_its_scene(pictured, tmp_path, ending):
    run, path = pictured("lake"), tmp_path / f"film{ending}"
    result = film(run.recording, "--eval", "40:2", "-o", path, "--width", 300)
    assert result.exit_code == 0, result.output
    with open_recording(run.recording) as recording:
        shown = list(Pictures(recording, "eval", 14))
    frames = frames_of(path)
    assert frames.shape[2] == 300
    assert len(frames) == len(shown)
    expected = np.asarray(Image.fromarray(shown[-1].pixels).resize((300, 300), Image.Resampling.LANCZOS))
    assert_shows(frames[-1], expected)
    assert not (frames[0] == frames[len(frames) // 2]).all()


@pytest.mark.parametrize("world", ["lake", "corridor", "rivals"])
def test_every_world_becomes_a_film(pictured, tmp_path, world):
    path = tmp_path / "film.mp4"
    result = film(pictured(world).recording, "--episode", 3, "-o", path, "--fps", 12.5)
    assert result.exit_code == 0, result.output
    with open_recording(pictured(world).recording) as recording:
        assert len(frames_of(path)) == len(recording.train.episode_steps(3)) + 1
    with av.open(path) as container:
        assert container.streams.video[0].average_rate == 12.5
        assert container.streams.video[0].codec_context.name == "h264"
        assert container.streams.video[0].codec_context.pix_fmt == "yuv420p"


def test_values_and_their_reason_are_shown(tmp_path):
    with runner.record(Rooms(), tmp_path / "runs") as rec:
        list(play(rec, 30))
    result = film(rec.run.recording, "--episode", 1, "-o", tmp_path / "film.webm")
    assert result.exit_code == 0, result.output
    assert "The film shows values: " in result.stderr
    with open_recording(rec.run.recording) as recording:
        assert len(frames_of(tmp_path / "film.webm")) == len(recording.train.episode_steps(1)) + 1


def test_a_film_ends_with_a_note_where_the_environment_differs(tmp_path):
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path / "runs") as rec:
        list(play(rec, 120))
    other = made_otherwise(rec.run.recording, tmp_path / "other.mcap", max_episode_steps=4)
    result = film(other, "--episode", 0, "-o", tmp_path / "film.mp4")
    assert result.exit_code == 1
    assert "At step 4 the environment differs from the recording: truncated" in result.stderr
    assert len(frames_of(tmp_path / "film.mp4")) == 5


REAL = {
    "LunarLander": lambda: gymnasium.make("LunarLander-v3", render_mode="rgb_array"),
    "Pong": lambda: gymnasium.make("ALE/Pong-v5", render_mode="rgb_array"),
}


@pytest.mark.filterwarnings("ignore:builtin type:DeprecationWarning")  # of Box2D when it is imported
@pytest.mark.parametrize("name", REAL)
def test_environments_draw_the_film_of_a_loop_without_frames(tmp_path, name):
    if name == "Pong":
        gymnasium.register_envs(pytest.importorskip("ale_py"))
    drawn, env = [], REAL[name]()
    with runner.record(env, tmp_path / "runs") as rec:
        drawn += [env.render() for _ in itertools.islice(play(rec, 40), 40)]
    path = tmp_path / "film.mp4"
    result = film(rec.run.recording, "--episode", 0, "-o", path, "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["source"] == "pictures drawn again"
    frames = frames_of(path)
    assert len(frames) == len(drawn)
    scale = frames.shape[2] // drawn[0].shape[1]
    for shown, expected in ((frames[0], drawn[0]), (frames[-1], drawn[-1])):
        assert_shows(shown, expected.repeat(scale, axis=0).repeat(scale, axis=1))


def test_the_film_of_a_game_shows_what_its_environment_draws(tmp_path):
    spread = pytest.importorskip("mpe2.simple_spread_v3")
    game = runner.record_parallel(spread.parallel_env(max_cycles=5), tmp_path / "runs", name="spread")
    other, drawn = spread.parallel_env(max_cycles=5, render_mode="rgb_array"), []
    for env in (game, other):
        env.reset(seed=0)
    drawn.append(other.render())
    while game.agents:
        actions = dict.fromkeys(game.agents, 2)
        game.step(actions)
        other.step(actions)
        drawn.append(other.render())
    game.close()
    result = film(game.run.recording, "--episode", 0, "-o", tmp_path / "film.webm")
    assert result.exit_code == 0, result.output
    frames = frames_of(tmp_path / "film.webm")
    assert len(frames) == len(drawn)
    for shown, expected in zip(frames, drawn, strict=True):
        assert_shows(shown, np.asarray(expected))


def test_infinite_rewards_and_odd_pictures_are_shown(tmp_path):
    class Odd(Rooms):
        def step(self, action):
            observation, _, _, _, info = super().step(action)
            return observation, [np.inf, -np.inf, np.nan][self._t - 1], False, self._t == 3, info

        def render(self):
            return np.full((900, 3, 3), 40 * self._t, np.uint8)

    with runner.record(Odd(), tmp_path / "runs", frames_every=1) as rec:
        list(play(rec, 3))
    result = film(rec.run.recording, "--best", "-o", tmp_path / "film.mp4")
    assert result.exit_code == 0, result.output
    frames = frames_of(tmp_path / "film.mp4")
    assert len(frames) == 4
    assert frames.shape[2] == 160
    played = CliRunner().invoke(cli, ["play", str(rec.run.recording), "--episode", "0"])
    assert "reward inf, so far inf" in played.stdout


@pytest.mark.parametrize("ending", ENDINGS)
def test_frames_that_are_too_large_are_refused(tmp_path, ending):
    encoder = Encoder(tmp_path / f"film{ending}", FORMATS[ending], 30)
    with pytest.raises(RunnerError, match="20x20000 pixels, expected at most 16,000"), encoder:
        encoder.add(np.zeros((20_000, 20, 3), np.uint8))


def test_best_and_worst_are_chosen_by_return(pictured, tmp_path):
    run = pictured("lake")
    with open_recording(run.recording) as recording:
        records = recording.eval.episodes.array()
        phase, ranked = ranked_episodes(recording)
    assert phase == "eval"
    returns = records["returns"].sum(axis=1)
    assert returns[ranked[0]] == returns[~records["success"]].min()
    for flag, number in (("--best", ranked[-1]), ("--worst", ranked[0])):
        result = film(run.recording, flag, "-o", tmp_path / "film.mp4", "--force")
        assert f"trial {number % 6} of the evaluation after {20 * (number // 6)} episodes" in result.stdout


def test_without_evaluations_training_episodes_are_ranked(pole, tmp_path):
    run, drawn = pole
    result = film(run.recording, "--best", "-o", tmp_path / "film.mp4")
    with open_recording(run.recording) as recording:
        best = recording.train.episodes.array()["returns"].sum(axis=1).argmax()
    assert f"training episode {best}, recorded frames, {len(drawn[best])} frames" in result.stdout


def test_a_grid_shows_episodes_from_best_to_worst_side_by_side(pole, tmp_path):
    run, drawn = pole
    path = tmp_path / "grid.mp4"
    result = film(run.recording, "--grid", "2x2", "-o", path, "--width", 1200, "--whole")
    assert result.exit_code == 0, result.output
    with open_recording(run.recording) as recording:
        _, ranked = ranked_episodes(recording)
    shown = [drawn[ranked[place]] for place in np.linspace(len(ranked) - 1, 0, 4).round().astype(int)]
    frames = frames_of(path)
    assert len(frames) == max(map(len, shown))
    height, width = frames.shape[1] // 2, frames.shape[2] // 2
    assert width == 600
    for place, episode in enumerate(shown):
        row, column = divmod(place, 2)
        cell = frames[-1][row * height : (row + 1) * height, column * width : (column + 1) * width]
        assert_shows(cell, episode[-1])
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(("words", "frames"), [((), 8), (("--whole",), 60)])
def test_a_grid_ends_after_twice_the_median_length(tmp_path, words, frames):
    with runner.record(gymnasium.make("CliffWalking-v1"), tmp_path / "runs") as rec:
        for episode, length in enumerate((3, 3, 59, 4)):
            rec.reset(seed=episode)
            for _ in range(length):
                rec.step(0)
            rec.reset(seed=episode)
    path = tmp_path / "grid.mp4"
    result = film(rec.run.recording, "--grid", "2x2", "--width", 320, "-o", path, *words)
    assert result.exit_code == 0, result.output
    assert len(frames_of(path)) == frames
    assert ("1 of 4 episodes are longer than the film, 7 steps; --whole" in result.stderr) == (not words)


def test_a_film_names_the_extra_where_the_environment_needs_pygame(tmp_path):
    hidden = tmp_path / "hidden"
    hidden.mkdir()
    (hidden / "pygame.py").write_text("raise ModuleNotFoundError('hidden', name='pygame')")
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path / "runs") as rec:
        rec.reset(seed=0)
        rec.step(0)
    words = [sys.executable, "-m", "runner", "export", "film", str(rec.run.recording), "-o", "film.gif"]
    done = subprocess.run(
        words,
        env=os.environ | {"PYTHONPATH": f"{hidden}{os.pathsep}{Path.cwd()}"},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert "The film shows values: Drawing this environment needs pygame" in done.stderr
    assert "[film]" in done.stderr


def test_a_grid_larger_than_the_run_has_empty_cells(pictured, tmp_path):
    run = pictured("lake", evaluation=None, episodes=3)
    result = film(run.recording, "--grid", "2x2", "-o", tmp_path / "grid.mp4")
    assert result.exit_code == 0, result.output
    assert "only 3 episodes: 1 cells" in result.stderr
    frames = frames_of(tmp_path / "grid.mp4")
    corner = frames[-1][frames.shape[1] // 2 :, frames.shape[2] // 2 :]
    assert corner.min() > 240


def test_an_episode_that_never_ended_is_shown_up_to_its_last_step(tmp_path):
    env = runner.record(gymnasium.make("FrozenLake-v1"), tmp_path / "runs")
    env.reset(seed=0)
    env.step(1)
    env._loop.close("interrupted")
    result = film(env.run.recording, "--episode", 0, "-o", tmp_path / "film.gif")
    assert result.exit_code == 0, result.output
    assert len(frames_of(tmp_path / "film.gif")) == 2
    assert "did not finish (interrupted)" in result.stderr


def test_without_a_choice_it_is_the_median_trial(pictured, tmp_path):
    run = pictured("lake")
    result = film(run.recording, "-o", tmp_path / "film.gif")
    with open_recording(run.recording) as recording:
        typical = EpisodeRef.parse("typical").resolved(recording)
        records = recording.eval.episodes.array(12, 18)
    assert f"trial {typical.episode} of the evaluation after 40 episodes" in result.stdout
    assert typical.after == 40
    ranks = [(r["success"], r["returns"].sum(), -int(r["length"])) for r in records]
    assert sorted(ranks)[3] == ranks[typical.episode]


def test_a_run_without_evaluations_shows_its_last_training_episode(pictured, tmp_path):
    result = film(pictured("lake", evaluation=None).recording, "-o", tmp_path / "film.gif")
    assert result.exit_code == 0, result.stderr
    assert "training episode 39" in result.stdout


REFUSED = {
    "no such episode": (("--episode", 9999), "has no training episode 9,999; there are 40, from 0"),
    "no such evaluation": (("--eval", "7:0"), r"no evaluation after 7 episodes.*nearest after 0"),
    "no such trial": (("--eval", "40:99"), "no trial 99 of the evaluation after 40 episodes; it has 6"),
    "no trial at all": (("--eval", "x"), "expected N:TRIAL"),
    "both": (("--eval", "0:0", "--episode", 0), "--episode and --eval exclude each other"),
    "best of a grid": (("--best", "--grid", "2x2"), "--best and --grid exclude each other"),
    "a grid of nothing": (("--grid", "0x3"), "expected ROWSxCOLUMNS"),
    "too many frames": (("--fps", 60), "expected at most 50 of a GIF"),
    "an unknown ending": (
        ("-o", "film.avi"),
        "found the ending '.avi', expected one of .mp4, .webm, .gif, .webp",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_shown_is_refused(pictured, tmp_path, case, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words, message = REFUSED[case]
    result = film(pictured("lake").recording, "-o", "film.gif", *words)
    assert result.exit_code == 2
    assert re.search(message, " ".join(result.stderr.split()))
    assert not list(tmp_path.iterdir())


def test_without_steps_the_error_names_the_command_that_records_them(pictured, tmp_path):
    run = pictured("lake", recording={"steps": "none"})
    result = film(run.recording, "-o", tmp_path / "film.gif")
    assert result.exit_code == 2
    assert "dualtaxi rerecord" in result.stderr


def test_a_file_is_replaced_by_force_only(pictured, tmp_path):
    path = tmp_path / "film.gif"
    path.write_text("mine")
    result = film(pictured("lake").recording, "-o", path)
    assert (result.exit_code, path.read_text()) == (2, "mine")
    assert "--force" in result.stderr
    assert film(pictured("lake").recording, "-o", path, "--force").exit_code == 0


def test_a_film_that_fails_leaves_no_file(pole, tmp_path, monkeypatch):
    run, _ = pole
    monkeypatch.setattr(Encoder, "add", lambda self, pixels: (_ for _ in ()).throw(OSError(28, "full")))
    result = film(run.recording, "--episode", 1, "-o", tmp_path / "film.mp4")
    assert result.exit_code == 1
    assert "cannot be written (full)" in result.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("module", ["av", "resvg_py"])
def test_a_missing_package_is_named(pictured, tmp_path, monkeypatch, module):
    monkeypatch.setitem(__import__("sys").modules, module, None)
    result = film(pictured("lake").recording, "-o", tmp_path / "film.gif")
    assert module.replace("_", "-") in result.stderr
    assert "pip install" in result.stderr
    assert "[film]" in result.stderr or "[plots]" in result.stderr
