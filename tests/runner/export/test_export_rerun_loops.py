"""Loops of several environments or agents in Rerun, read back and compared with what was recorded."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from rerun.chunk import RrdReader

import runner
from runner.analysis.step_reference import StepRef
from runner.errors import RecordingError
from runner.export.rerun.location import locate
from runner.export.rerun.runs import Source
from runner.export.rerun.selection import Request, select
from runner.export.rerun.writing import export
from runner.recording import schema
from runner.recording.reader import open_recording
from tests.runner.loops.making import Leaving, parallel

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
        (self.selection,) = export([Source(recording, "a run")], Request(**request), path)
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
            (batch.column("step").to_pylist(), batch.column(component).to_pylist()) for batch in batches
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
    steps = np.concatenate(list(recording.blocks(recording.topic(f"/{phase}/step"))))
    return steps[steps["t"] != schema.RESET_ONLY]


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
        episodes = recording.episodes("train")
        extras = recording.extras("train").at(steps["step"])["own"]
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
        assert exported.names(f"{where}/observation") == [f"observation[{k}]" for k in range(4)]


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
        span = recording.episode_span("train", 4)
        (chosen,) = select(recording, Request(episodes=((4, 5),))).train
        assert chosen.start <= span.start < span[-1] < chosen.stop
        assert chosen.start % N == chosen.stop % N == 0
        assert chosen.stop - chosen.start < len(span) * N + N
        time = steps_of(recording)["log_time"][steps_of(recording)["step"] == span[2]]
    assert locate(run, Request(), StepRef(4, 2, None)).time * schema.STEP_NANOSECONDS == time
    with pytest.raises(RecordingError, match="found no t = 9999"):
        locate(run, Request(), StepRef(4, 9999, None))
    with pytest.raises(RecordingError, match="no training episode 999"):
        locate(run, Request(), StepRef(999, 0, None))
