"""Exporting runs to one `.rrd` file: an overview of each, then its selected steps with their Q-values."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Final

import numpy as np
import rerun as rr

from runner.drawing import palette
from runner.environments.naming import spoken
from runner.export.rerun.loops import LoopTracks, logged_tracks
from runner.export.rerun.metrics import mark_tracks, metric_tracks, phase_colours, series_lines
from runner.export.rerun.scene import GridLabels, background, scene_of
from runner.export.rerun.selection import Request, Selection, episodes_of, select
from runner.export.rerun.steps import Batch, MapTracks, StepTracks, ValueReader, ValueTracks, grid_view
from runner.export.rerun.tracks import (
    APPLICATION,
    GREY,
    MAX_ROWS,
    Track,
    Writer,
    blueprint,
    cleared,
    scalars,
    text_track,
    times_of,
)
from runner.recording import schema
from runner.recording.reader import open_recording
from runner.recording.steps import taken
from runner.runs.run import Run
from runner.util.arrays import Records, in_blocks
from runner.util.files import new_file

_BATCH_BYTES: Final = 64 << 20
Maker = LoopTracks | StepTracks | ValueTracks | MapTracks
"""Makes tracks of a phase: those that are `still`, and those `of` a batch of steps."""


class RunReader:
    """Reads a run as tracks: an overview, of which all views of a job follow, then its steps."""

    def __init__(self, writer: Writer) -> None:
        recording = writer.recording
        spans = writer.selection.by_phase
        self.writer = writer
        self._recording = recording
        self._is_job = recording.has_tables
        scene = self._scene = scene_of(recording.mdp) if recording.tabular else None
        self._loops = {} if self._is_job else {phase: LoopTracks(writer, phase) for phase in spans}
        self._makers: dict[str, list[Maker]] = {phase: [loop] for phase, loop in self._loops.items()}
        """Makers of the tracks of each phase with any: of the steps, and of the Q-values at them."""
        self._labels: GridLabels | None = None
        self._edges: set[int] = set()
        """First steps of the stretches of time that were sent, and the steps after their last ones."""
        if self._is_job:
            writer.last = sum(phase.steps.count() for phase in recording.phases)
        if not (writer.selection.steps and (scene or self._is_job)):
            return
        largest = max((float(np.abs(q.values).max()) for q in recording.snapshots()), default=0.0)
        labels = self._labels = GridLabels(recording.mdp, scene, recording.agents, largest)
        for phase in filter(spans.get, spans):
            makers = self._makers.setdefault(phase, [])
            makers.append(StepTracks(phase, writer.title, labels))
            if self._is_job:
                makers.append(ValueTracks(phase, labels))
                if scene and scene.placements:
                    learners = range(len(recording.agents))
                    makers += [MapTracks(phase, labels, scene.placements, learner) for learner in learners]

    def overview(self) -> Iterator[Track]:
        """Yield everything but steps, and what never changes of them."""
        writer = self.writer
        yield from metric_tracks(writer) if self._is_job else logged_tracks(self._recording)
        yield from mark_tracks(writer)
        if self._labels and self._scene:
            view = grid_view(writer.title, self._scene)
            yield from background(self._scene, view)
            if self._is_job:
                text = rr.Points2D.from_fields(radii=0.0, colors=[GREY])
                yield Track("notice/text", static=[text], view=view)
        for maker in chain.from_iterable(self._makers.values()):
            yield from maker.still

    def steps(self) -> Iterator[Track]:
        """Yield the selected steps, then pictures that are drawn of them."""
        recording, is_job, scene, labels = self._recording, self._is_job, self._scene, self._labels
        names = [f"reward {spoken(name)}" for name in recording.agents]
        values = ValueReader(recording, scene) if is_job and labels else None
        for phase, makers in self._makers.items():
            style = [series_lines(names, phase_colours(phase, len(names)))]
            edges: set[int] = set()
            for batch in self._batches(phase, values):
                if is_job:
                    yield Track(f"{phase}/reward", batch.times, scalars(batch.records["rewards"]), style)
                are_unknown = is_job and not len(batch.values)  # some steps before them were lost
                for maker in makers[:1] if are_unknown else makers:
                    yield from maker.of(batch)
                if labels:
                    edges ^= batch.edges()  # no edge where a stretch continues the one before
            self._edges ^= edges
            # A job's last step stays in view.
            last = self.writer.last if is_job else np.inf
            stops = [stop for stop in sorted(edges)[1::2] if stop <= last]
            for part in ("grid", "q", "map") if is_job else ("grid",):
                yield from cleared(f"{phase}/{part}", stops)
        if labels:  # all texts are known now
            yield labels.track()
        if not is_job:
            for loop in self._loops.values():
                yield from loop.drawn()
        elif scene and labels:
            yield from self._notice(scene.columns / 2, scene.rows / 2)

    def _batches(self, phase: str, values: ValueReader | None) -> Iterator[Batch]:
        """Yield the steps of a phase after checking them, at most a batch of each environment at a time."""
        recording = self._recording
        train = episodes_of(self._recording, "train")
        plan = recording.config["evaluation"] if self._is_job else None
        trials = int(plan["trials"]) if plan else 2**63 - 1
        for steps in self._blocks(phase):
            if self._labels:
                recording.mdp.check_steps(steps, str(recording.path), schema.PHASE_NAMES[phase])
            trained, episode = (steps[name].astype(np.int64) for name in ("step", "episode"))
            number = episode
            if phase == "eval":  # shown by the training episodes before it
                number = episode % trials
                trained = steps["log_time"].astype(np.int64) // schema.STEP_NANOSECONDS - 1 - trained
                episode = train.before(trained)
            batch = Batch(steps, times_of(steps["log_time"], episode=episode, t=steps["t"]), number)
            if values is None:
                yield batch
            else:
                yield from values.batches(batch, trained, int(phase == "train"))

    def _blocks(self, phase: str) -> Iterator[Records]:
        """Yield the steps of a phase in blocks of bounded size; values that vary in size as they are read."""
        table = self._recording.phase(phase).steps
        spans = self.writer.selection.by_phase[phase]
        limit = min(MAX_ROWS * self._recording.environments, _BATCH_BYTES // table.row_dtype.itemsize)
        blocks = map(taken, chain.from_iterable(map(table.numbered, spans)))
        parts = ([block] for block in blocks) if table.dtype is None else [blocks]
        return filter(len, chain.from_iterable(in_blocks(part, max(1, limit)) for part in parts))

    def _notice(self, x: float, y: float) -> Iterator[Track]:
        """Yield a notice on the grid for the times of which no steps were exported."""
        last = self.writer.last
        entity = "notice/text"
        gaps = np.array([0, *sorted(self._edges), last + 1]).reshape(-1, 2)
        gaps = gaps[gaps[:, 0].clip(min=1) < gaps[:, 1]]
        if len(gaps):
            words = ["no steps of this time were exported"] * len(gaps)
            yield text_track(entity, {"step": gaps[:, 0]}, (x, y), words)
            yield from cleared(entity, gaps[gaps[:, 1] <= last, 1])


def export(
    runs: Sequence[Run], request: Request, path: Path, stage: Callable[[str], None] = lambda _: None
) -> list[Selection]:
    """Write runs to an `.rrd` file; return the selection of each.

    Several runs have different colours. `stage` is called with what takes long.
    """
    with contextlib.ExitStack() as stack:
        recordings = [stack.enter_context(open_recording(run.recording)) for run in runs]
        selections = [select(recording, request) for recording in recordings]
        stream = rr.RecordingStream(APPLICATION, recording_id="-".join(r.run_id for r in recordings))
        temporary = stack.enter_context(new_file(path, force=True))
        temporary.touch()  # where no file can be created, Rerun would not raise an OSError
        stack.callback(stream.disconnect)  # before the file is renamed, or removed after an error
        stream.save(temporary)
        stream.set_log_time_enabled(False)
        writers = [
            Writer(stream, recording, selection, f"{run.title} ({run.run_id})", run.marks, stage=stage)
            for run, recording, selection in zip(runs, recordings, selections, strict=True)
        ]
        for i, writer in enumerate(writers if len(runs) > 1 else ()):
            writer.root = f"/{runs[i].run_id}"
            writer.tint = palette.COMPARED[i % len(palette.COMPARED)]
        stream.send_recording_name(" and ".join(writer.title for writer in writers))
        readers = [RunReader(writer) for writer in writers]
        for reader in readers:
            reader.writer.send(reader.overview())
        are_jobs = all(recording.has_tables for recording in recordings)
        if are_jobs:  # before the steps, so that a viewer need not arrange them itself as they load
            stream.send_blueprint(blueprint(writers))
        for reader in readers:
            reader.writer.send(reader.steps())
        if not are_jobs:  # their views follow from steps
            stream.send_blueprint(blueprint(writers))
        stream.flush()
    return selections
