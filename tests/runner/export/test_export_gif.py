"""Films: frames, captions and pixels against the recording."""

from __future__ import annotations

import re

import numpy as np
import pytest
from click.testing import CliRunner
from PIL import Image

from runner.cli import cli
from runner.drawing.svg import Drawing
from runner.export.gif import Film, captions_of, render_svg
from runner.export.reports.episode import training_episode, trial, typical_trial
from runner.recording.reader import open_recording


def gif(*words):
    return CliRunner().invoke(cli, ["export", "gif", *map(str, words)])


def test_frames_show_each_state_and_describe_each_step(recording):
    mdp = recording.mdp
    episode = training_episode(recording, 3, 30)
    steps = recording.episode_steps("train", 3)[:30]
    captions = captions_of(mdp, recording.agents, episode, scene=mdp.scene is not None)
    assert len(Film(recording, episode)) == len(captions) == len(steps) + 1
    totals = steps["rewards"].sum(axis=1).cumsum()
    for k in range(len(steps)):
        caption = " ".join(captions[k + 1])
        assert f"step {k + 1} of" in caption
        assert f"sum {totals[k]:+g}" in caption
        if mdp.scene is None:
            assert f"state {steps['next_state'][k]}" in caption


def test_frames_look_like_the_pictures_of_the_replay(recording):
    mdp = recording.mdp
    if mdp.scene is None:
        pytest.skip("no scene")
    episode = training_episode(recording, 3, 30)
    drawing, film = Drawing(mdp.scene), Film(recording, episode)
    places = drawing.places(mdp, episode.states)
    first = np.asarray(film.frame(0), np.int16)
    for number in range(0, len(film), 7):
        picture = drawing.frame(places[number], "", places[: number + 1])
        grid = film.frame(number).crop(film.grid_box)
        sized = '<svg width="{}" height="{}" '.format(*grid.size)
        expected = render_svg(picture.replace("<svg ", sized, 1), *grid.size)
        ground = Image.new("RGBA", grid.size, "#ffffff")
        expected = np.asarray(Image.alpha_composite(ground, expected).convert("RGB"), np.int16)
        difference = np.abs(np.asarray(grid, np.int16) - expected)
        assert difference.mean() < 1.5
        assert (difference.max(axis=2) > 100).mean() < 0.005
        assert not number or (np.asarray(film.frame(number)) != first).any()


def test_events_in_captions_are_those_that_the_episode_counts(recording):
    episode = training_episode(recording, 5, 10_000)
    counted = recording.episodes("train", 5, 6)[0]["events"].tolist()
    bits = [int((episode.events >> bit & 1).sum()) for bit in range(len(counted))]
    assert bits == counted


def test_a_film_is_a_gif_that_moves(pictured, tmp_path):
    run, path = pictured("taxi"), tmp_path / "film.gif"
    result = gif(run.recording, "--eval", "40:2", "-o", path, "--width", 300, "--steps", 12)
    assert result.exit_code == 0, result.output
    with open_recording(run.recording) as recording:
        shown = trial(recording, 40, 2, 12)
    with Image.open(path) as film:
        assert film.size[0] == 300
        assert film.n_frames <= shown.steps + 1  # frames that are alike are one, shown for longer
        total = 0
        pixels = []
        for number in range(film.n_frames):
            film.seek(number)
            total += film.info["duration"]
            pixels.append(np.asarray(film.convert("RGB")))
    assert total == shown.steps * 500 + 2500
    assert pixels[0][0, 0].tolist() == [255, 255, 255]
    assert any((one != pixels[0]).any() for one in pixels[1:])
    assert "--steps shows more" in result.stderr or shown.steps == shown.length


def test_without_a_choice_it_is_the_median_trial(pictured, tmp_path):
    run = pictured("lake")
    result = gif(run.recording, "-o", tmp_path / "film.gif")
    with open_recording(run.recording) as recording:
        after, number = typical_trial(recording)
        records = recording.episodes("eval", 12, 18)
    assert f"trial {number} of the evaluation after {after} episodes" in result.stdout
    ranks = [(r["success"], r["returns"].sum(), -int(r["length"])) for r in records]
    assert sorted(ranks)[3] == ranks[number]


REFUSED = {
    "no such episode": (("--episode", 9999), "no training episode 9999"),
    "no such evaluation": (("--eval", "7:0"), r"no evaluation after 7 episodes.*nearest after 0"),
    "no such trial": (("--eval", "40:99"), "no trial 99 of the evaluation after 40 episodes; it has 6"),
    "no trial at all": (("--eval", "x"), "expected N:TRIAL"),
    "both": (("--eval", "0:0", "--episode", 0), "exclude each other"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_missing_episodes_are_refused(pictured, tmp_path, case):
    words, message = REFUSED[case]
    result = gif(pictured("lake").recording, *words, "-o", tmp_path / "film.gif")
    assert result.exit_code == 2
    assert re.search(message, result.stderr.replace("\n", " "))
    assert not list(tmp_path.iterdir())


def test_without_steps_the_error_names_the_command_that_records_them(pictured, tmp_path):
    run = pictured("lake", recording={"steps": "none"})
    result = gif(run.recording, "-o", tmp_path / "film.gif")
    assert result.exit_code == 2
    assert "dualtaxi rerecord" in result.stderr


def test_a_run_without_evaluations_shows_its_last_training_episode(pictured, tmp_path):
    result = gif(pictured("lake", evaluation=None).recording, "-o", tmp_path / "film.gif")
    assert result.exit_code == 0, result.stderr
    assert "training episode 39" in result.stdout
    assert "no whole evaluation" in result.stderr


def test_a_file_is_replaced_by_force_only(pictured, tmp_path):
    path = tmp_path / "film.gif"
    path.write_text("mine")
    result = gif(pictured("lake").recording, "-o", path)
    assert (result.exit_code, path.read_text()) == (2, "mine")
    assert "--force" in result.stderr
    assert gif(pictured("lake").recording, "-o", path, "--force").exit_code == 0


def test_a_missing_package_is_named(pictured, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "resvg_py", None)
    result = gif(pictured("lake").recording, "-o", tmp_path / "film.gif")
    assert "resvg-py" in result.stderr
    assert "pip install" in result.stderr
    assert "[plots]" in result.stderr
