"""Loops of several environments or agents in Rerun, read back and compared with what was recorded."""

from __future__ import annotations

import contextlib
import io

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from PIL import Image
from rerun.chunk import RrdReader

import runner
from runner.analysis.episodes import EpisodeRef
from runner.errors import RecordingError
from runner.export.pictures import Pictures, PictureSource, encoded_picture
from runner.export.rerun import selection
from runner.export.rerun.selection import Request, locate, select
from runner.export.rerun.writing import export
from runner.integrations.tensorboard import SummaryWriter
from runner.recording import schema
from runner.recording.environment import NAMES
from runner.recording.reader import open_recording
from runner.recording.steps import taken
from runner.runs.run import run_at
from tests.runner.export.making import made_otherwise
from tests.runner.export.rerun_views import shown_ranges
from tests.runner.loops.making import Leaving, Rooms, parallel, play, record_counting

N = 3


def make_pole(render_mode=None):
    return gymnasium.make("CartPole-v1", render_mode=render_mode)


def record_poles(folder, mode=AutoresetMode.NEXT_STEP, kind=SyncVectorEnv, steps=90, **options):
    """Record a vector of CartPoles; return the run."""
    render_mode = "rgb_array" if options else None
    envs = kind([lambda: make_pole(render_mode)] * N, autoreset_mode=mode)
    rng = np.random.default_rng(0)
    with runner.record_vector(envs, folder, name="poles", **options) as rec:
        rec.reset(seed=0)
        for k in range(steps):
            actions = rng.integers(0, 2, N)
            over = np.logical_or(*rec.step(actions, extras={"own": 10 * k + np.arange(N)})[2:4])
            if mode == AutoresetMode.DISABLED and over.any():
                rec.reset(options={"reset_mask": over})
    return rec.run


class Exported:
    """An export, read back."""

    def __init__(self, recording, path, **request):
        (self.selection,) = export([run_at(recording.path)], Request(**request), path)
        self._chunks = RrdReader(str(path)).store().stream().to_chunks()

    @property
    def entities(self):
        """The paths of everything that changes with time."""
        return {str(chunk.entity_path) for chunk in self._chunks if not chunk.is_static}

    def rows(self, entity, component):
        """Return (step, value) of each row of an entity, in order of time."""
        batches = [
            chunk.to_record_batch()
            for chunk in self._chunks
            if str(chunk.entity_path) == entity and not chunk.is_static
        ]
        columns = [
            (batch.column("step").to_pylist(), batch.column(component).to_pylist())
            for batch in batches
            if component in batch.schema.names  # that which clears an entity is elsewhere
        ]
        return sorted(
            (row for steps, values in columns for row in zip(steps, values, strict=True)), key=lambda r: r[0]
        )

    def names(self, entity):
        """Return the names of an entity's lines."""
        (batch,) = [
            chunk.to_record_batch()
            for chunk in self._chunks
            if str(chunk.entity_path) == entity and chunk.is_static
        ]
        return batch.column("SeriesLines:names")[0].as_py()


def steps_of(recording, phase="train"):
    return taken(recording.phase(phase).steps.array())


@pytest.mark.parametrize(
    ("mode", "kind"),
    [
        (AutoresetMode.NEXT_STEP, SyncVectorEnv),
        (AutoresetMode.SAME_STEP, AsyncVectorEnv),
        (AutoresetMode.DISABLED, SyncVectorEnv),
    ],
)
def test_every_environment_of_a_vector_is_sent(tmp_path, mode, kind):
    run = record_poles(tmp_path, mode, kind)
    with open_recording(run.recording) as recording:
        exported, steps = Exported(recording, tmp_path / "run.rrd", everything=True), steps_of(recording)
        episodes = recording.train.episodes.array()
        extras = recording.train.extras.at(steps["step"])["own"]
    for i in range(N):
        own = steps[steps["step"] % N == i]
        times = (own["log_time"] // schema.STEP_NANOSECONDS).tolist()
        where = f"/train/env_{i}"
        for quantity, values in (
            ("reward", own["rewards"]),
            ("action", own["action"][:, np.newaxis]),
            ("observation", own["next_observation"]),
            ("extra/own", extras[steps["step"] % N == i][:, np.newaxis]),
        ):
            rows = exported.rows(f"{where}/{quantity}", "Scalars:scalars")
            assert [time for time, _ in rows] == times
            assert np.array_equal([value for _, value in rows], values)
        ended = episodes[episodes["last_step"] % N == i]
        lengths = exported.rows(f"{where}/length", "Scalars:scalars")
        assert [value for _, [value] in lengths] == ended["length"].tolist()
        assert exported.names(f"{where}/reward") == [f"train env_{i}"]
        assert exported.names(f"{where}/observation") == [*NAMES["CartPoleEnv"]]


def test_every_agent_of_a_game_is_sent_where_it_acted(tmp_path):
    with runner.record_parallel(Leaving(), tmp_path, name="game") as rec:
        parallel(rec, 5)
    with open_recording(rec.run.recording) as recording:
        exported, steps = Exported(recording, tmp_path / "run.rrd", everything=True), steps_of(recording)
        agents = recording.agents
    assert len(agents) > 1
    for i, agent in enumerate(agents):
        own = steps[steps["acted"] >> i & 1 == 1]
        rows = exported.rows(f"/train/{agent}/reward", "Scalars:scalars")
        assert [value for _, [value] in rows] == own["rewards"][:, i].tolist()
        assert f"/train/{agent}/return" in exported.entities
    assert len(exported.rows("/train/length", "Scalars:scalars")) == 5


def test_episodes_of_a_vector_are_selected_and_located(tmp_path):
    run = record_poles(tmp_path)
    with open_recording(run.recording) as recording:
        span = recording.train.episode(4).numbers()
        (chosen,) = select(recording, Request(episodes=((4, 5),))).by_phase["train"]
        assert chosen.start <= span[0] < span[-1] < chosen.stop
        assert chosen.start % N == chosen.stop % N == 0
        assert chosen.stop - chosen.start < len(span) * N + N
        time = steps_of(recording)["log_time"][steps_of(recording)["step"] == span[2]]
    assert locate(run, Request(), EpisodeRef(4, 2, None)).time * schema.STEP_NANOSECONDS == time
    with pytest.raises(RecordingError, match="has 29 steps, from 0; found no step 9,999"):
        locate(run, Request(), EpisodeRef(4, 9999, None))
    with pytest.raises(RecordingError, match="no training episode 999"):
        locate(run, Request(), EpisodeRef(999, 0, None))


def picture_rows(exported, entity):
    """Return (step, bytes of the file) of each picture."""
    return [(step, bytes(blob[0])) for step, blob in exported.rows(entity, "EncodedImage:blob") if blob]


@pytest.mark.parametrize("mode", AutoresetMode)
def test_recorded_frames_stand_at_the_steps_of_their_environment(tmp_path, mode):
    with open_recording(record_counting(tmp_path, mode)) as recording:
        exported, steps = Exported(recording, tmp_path / "run.rrd", everything=True), steps_of(recording)
    for i in range(N):
        own = steps[steps["step"] % N == i]
        if mode == AutoresetMode.SAME_STEP:  # the environment was reset before it could be rendered
            own = own[~own["terminated"]]
        shown = dict(picture_rows(exported, f"/train/env_{i}/frame"))
        for step in own:
            pixels = np.asarray(Image.open(io.BytesIO(shown[step["log_time"] // schema.STEP_NANOSECONDS])))
            assert pixels[0, 0].tolist() == [i, int(step["next_observation"][1]), int(step["t"]) + 1]


def test_pictures_of_selected_episodes_of_a_vector_are_drawn(tmp_path):
    run = record_poles(tmp_path)
    with open_recording(run.recording) as recording:
        exported = Exported(recording, tmp_path / "run.rrd", episodes=((2, 5),), frames=True)
        assert exported.selection.drawn["train"] == [2, 3, 4]
        assert any("pictures of 3 of" in text for text in exported.selection.exported)
        steps = steps_of(recording)
        for number in (2, 3, 4):
            episode = recording.train.episode(number)
            own = steps[np.isin(steps["step"], episode.numbers())]["log_time"] // schema.STEP_NANOSECONDS
            shown = dict(picture_rows(exported, f"/train/env_{episode.environment}/frame"))
            with contextlib.closing(Pictures(recording, "train", number)) as expected:
                assert expected.source is PictureSource.REDRAWN
                first, *others = [encoded_picture(picture.pixels) for picture in expected]
            assert shown[own[0] - 1] == first
            assert [shown[time] for time in own] == others
            cleared = exported.rows(f"/train/env_{episode.environment}/frame", "Clear:is_recursive")
            assert own[-1] + N in [step for step, flag in cleared if flag]


@pytest.mark.parametrize("is_vector", [False, True])
def test_views_of_steps_show_the_time_of_the_chosen_episodes(tmp_path, is_vector):
    if is_vector:
        run = record_poles(tmp_path)
    else:
        with runner.record(make_pole(), tmp_path) as run:
            list(play(run, 200))
        run = run.run
    with open_recording(run.recording) as recording:
        Exported(recording, tmp_path / "chosen.rrd", episodes=((2, 3),), with_default=True)
        Exported(recording, tmp_path / "whole.rrd")
        span = recording.train.episode(2).numbers()
        steps = steps_of(recording)
    times = steps["log_time"] // schema.STEP_NANOSECONDS
    first, last = (int(times[steps["step"] == step][0]) for step in (span[0], span[-1]))
    chosen, whole = (shown_ranges(tmp_path / f"{name}.rrd") for name in ("chosen", "whole"))
    assert np.abs(np.subtract(chosen["reward"], (first, last))).max() < (N if is_vector else 1)
    assert whole["reward"] == whole["return"] == chosen["return"] == (0, times.max())


def test_each_environment_of_a_vector_has_pictures_by_default(tmp_path):
    with open_recording(record_poles(tmp_path, steps=60).recording) as recording:
        drawn = select(recording, Request(frames=True)).drawn["train"]
        assert {recording.train.episode(number).environment for number in drawn} == set(range(N))
        assert not select(recording, Request()).drawn


def test_pictures_end_where_the_environment_differs(tmp_path):
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path / "runs") as rec:
        list(play(rec, 60))
    other = made_otherwise(rec.run.recording, tmp_path / "other.mcap", max_episode_steps=5)
    with open_recording(other) as recording:
        exported = Exported(recording, tmp_path / "run.rrd", frames=True)
    (warning,) = [text for text in exported.selection.warnings if "pictures" in text]
    assert "from episode 0 on: At step 5 the environment differs" in warning
    assert [step for step, _ in picture_rows(exported, "/train/frame")] == list(range(5))
    ((_, [text]),) = exported.rows("/log", "TextLog:text")
    assert text == warning


def test_a_loop_whose_environment_cannot_be_made_again_is_exported_without_pictures(tmp_path):
    class Hidden(Rooms):
        """Has no name by which it could be imported."""

    with runner.record(Hidden(), tmp_path) as rec:
        list(play(rec, 30))
    with open_recording(rec.run.recording) as recording:
        exported = Exported(recording, tmp_path / "run.rrd", frames=True)
    assert any("No train pictures: " in text for text in exported.selection.warnings)
    assert "/train/frame" not in exported.entities
    assert "/train/reward" in exported.entities


def test_logged_pictures_are_shown_by_name_and_of_films_the_first_frame(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (2, 6, 8, 3), np.uint8)
    with SummaryWriter(recordings=tmp_path, monitor_gym=False) as writer:
        writer.add_image("one", pixels[0], 3, dataformats="HWC")
        writer.add_video("film", pixels[None], 5, dataformats="NTHWC")
    with open_recording(writer.run.recording) as recording:
        exported = Exported(recording, tmp_path / "run.rrd")
    ((step, shown),) = picture_rows(exported, "/picture/one")
    assert step == 3
    assert (np.asarray(Image.open(io.BytesIO(bytes(shown)))) == pixels[0]).all()
    ((step, shown),) = picture_rows(exported, "/picture/film")
    assert (step, Image.open(io.BytesIO(bytes(shown))).size) == (5, (8, 6))


def test_a_run_with_tables_and_a_loop_are_shown_together(pictured, tmp_path):
    with runner.record(gymnasium.make("FrozenLake-v1"), tmp_path / "runs", name="own") as env:
        list(play(env, 50))
    runs = [pictured("lake"), env.run]
    path = tmp_path / "both.rrd"
    export(runs, Request(), path)
    chunks = RrdReader(str(path)).store().stream().to_chunks()
    entities = {str(chunk.entity_path) for chunk in chunks}
    for run in runs:
        assert any(entity.startswith(f"/{run.run_id}/train/grid") for entity in entities), run


def test_evaluations_of_a_loop_are_selected_by_number(tmp_path, monkeypatch):
    monkeypatch.setattr(selection, "DEFAULT_STEPS", 6)
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path, name="loop") as env:
        for phase in ("eval", "train", "eval", "train", "eval"):
            with env.phase(phase):
                play_episode(env)
    with open_recording(env.run.recording) as recording:
        spans = [recording.eval.episode(number).numbers() for number in range(3)]
        chosen = select(recording, Request(evaluations=(1,)))
        assert set(spans[1]) <= {step for steps in chosen.by_phase["eval"] for step in steps}
        assert not set(spans[0]) & {step for steps in chosen.by_phase["eval"] for step in steps}
        with pytest.raises(RecordingError, match="found no evaluation after 7 episodes"):
            select(recording, Request(evaluations=(7,)))
    assert locate(env.run, Request(), EpisodeRef(0, 1, 0)).request.evaluations == (0,)


def play_episode(env):
    """Take the same action until the episode is over."""
    env.reset(seed=1)
    while not any(env.step(0)[2:4]):
        pass
