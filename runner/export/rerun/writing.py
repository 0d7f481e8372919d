"""Exporting runs to one `.rrd` file."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.export.rerun.ahead import ahead
from runner.export.rerun.classes import Vocabulary, vocabulary_of
from runner.export.rerun.columns import Batch, Sender, StepValues, ink, instances, new_stream, place, texts
from runner.export.rerun.layout import Shown, blueprint, draw_background, loop_blueprint
from runner.export.rerun.metrics import TRAINING_MEANS, MetricWriter, known_metrics, send_metrics
from runner.export.rerun.scene import TRAIL_STEPS, Marks, Scene, marks_of, scene_of
from runner.export.rerun.selection import Request, Selection, Span, select
from runner.export.rerun.step_values import StepValueReader
from runner.export.rerun.steps import StepWriter
from runner.recording import schema
from runner.recording.reader import Recording
from runner.replay.checks import check_steps
from runner.util.files import replacing, storage_errors

BATCH: Final = 8_192
"""Rows sent at a time: larger columns are dropped by the web viewer."""
BATCHES_WAITING: Final = 8
"""Batches that may wait to be written: they are made faster than they are compressed, and would pile up."""


@dataclass(frozen=True)
class Source:
    """A run to export."""

    recording: Recording
    title: str
    root: str = ""
    """Entity path that everything of the run is under; empty for the root."""
    tint: str | None = None
    """Colour of its metrics, where runs are compared."""


def export(sources: Sequence[Source], request: Request, path: Path) -> list[Selection]:
    """Write runs to an `.rrd` file; return what was chosen of each.

    Raises:
        RecordingError: a recording cannot be read, or has not what is asked for.
        StorageError: the file cannot be written.
    """
    selections = [select(source.recording, request) for source in sources]
    stream = new_stream("-".join(source.recording.run_id for source in sources))
    if any(not source.recording.is_job for source in sources):
        return _export_loops(stream, sources, selections, path)
    exporters = [
        RunExporter(stream, source, selection) for source, selection in zip(sources, selections, strict=True)
    ]
    shown = blueprint([exporter.shown for exporter in exporters])
    with _saved(stream, sources, path, shown):
        for exporter in exporters:
            exporter.export()
    return selections


def _export_loops(
    stream: rr.RecordingStream, sources: Sequence[Source], selections: list[Selection], path: Path
) -> list[Selection]:
    """Write somebody's own loops to an `.rrd` file."""
    from runner.export.rerun.loops import LoopExporter

    for source in sources:
        if source.recording.is_job:
            raise RecordingError(
                f"{source.recording.path}: was trained here, the other was recorded from a loop; "
                "look at them one by one."
            )
    exporters = [
        LoopExporter(stream, source.recording, selection, source.root)
        for source, selection in zip(sources, selections, strict=True)
    ]
    with _saved(stream, sources, path):
        for exporter in exporters:
            exporter.export()
        views = [
            exporter.blueprint(source.title) for exporter, source in zip(exporters, sources, strict=True)
        ]
        stream.send_blueprint(loop_blueprint(views))
    return selections


@contextlib.contextmanager
def _saved(
    stream: rr.RecordingStream, sources: Sequence[Source], path: Path, shown: rrb.Blueprint | None = None
) -> Iterator[None]:
    """Save what is sent to a stream as a file, which is there whole or not at all."""
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as fresh:
            fresh.touch()  # where no file can be written, Rerun would not raise an OSError
            stream.save(fresh, default_blueprint=shown)
            stream.send_recording_name(" and ".join(source.title for source in sources))
            yield
            stream.flush()
            stream.disconnect()


class RunExporter:
    """Sends one run to a stream."""

    def __init__(self, stream: rr.RecordingStream, source: Source, selection: Selection) -> None:
        self._stream = stream
        self._recording = source.recording
        self._selection = selection
        self._source = source
        self._sent = 0
        self._learners = source.recording.agents
        self._scene: Scene | None = scene_of(source.recording.mdp)
        self._marks: Marks | None = marks_of(self._scene) if self._scene else None
        steps = [source.recording.count(topic) for topic in (schema.TRAIN_STEP, schema.EVAL_STEP)]
        self.shown = Shown(
            source.root,
            source.title,
            source.recording.mdp,
            self._scene,
            self._learners,
            bool(selection.steps),
            max(sum(steps), _last_report(source.recording)),
            frozenset(_metric_paths(source.recording)),
        )

    def export(self) -> None:
        """Send everything that is chosen."""
        source = self._source
        writer = MetricWriter(
            self._stream,
            source.root,
            self._learners,
            source.recording.mdp.event_names,
            source.tint,
            source.recording.run_id if source.tint else "",
        )
        send_metrics(writer, self._recording)
        if not self._selection.steps:
            return
        words = self._vocabulary()
        self._stream.log(f"{source.root}/", rr.AnnotationContext(words.classes.context()), static=True)
        draw_background(self._stream, self.shown)
        values = StepValueReader(self._recording, self._scene.placements if self._scene else None)
        covered = {phase: self._send_phase(phase, words, values) for phase in ("train", "eval")}
        self._send_notice(sorted(covered["train"] + covered["eval"]))

    def _send_phase(self, phase: str, words: Vocabulary, values: StepValueReader) -> list[tuple[int, int]]:
        """Send the steps of a phase; return the stretches of time that they cover."""
        pieces = self._training(values) if phase == "train" else self._evaluating(values)
        path = f"{self._source.root}/{phase}"
        mdp, covered = self._recording.mdp, list[tuple[int, int]]()
        writer = StepWriter(self._stream, path, phase, mdp, self._scene, self._marks, words, self._learners)
        plan = self._recording.config.get("evaluation") if phase == "eval" else None
        trials = int(plan["trials"]) if plan else 0
        for batch in ahead(_batches(pieces, trials)):
            if not covered:
                writer.dress()
            writer.write(batch)
            self._sent += 1
            if self._sent % BATCHES_WAITING == 0:
                self._stream.flush()
            _cover(covered, batch.time)
        ends = [stop for _, stop in covered if stop <= self.shown.last]  # the run's last step stays in view
        if ends:
            writer.end(ends)
        return covered

    def _training(self, values: StepValueReader) -> Iterator[Piece]:
        for span in self._selection.train:
            for block in self._steps("train", span):
                for part in values.split(block):
                    yield part, values.training(part), part["episode"].astype(np.int64)

    def _evaluating(self, values: StepValueReader) -> Iterator[Piece]:
        for evaluation, span in self._selection.evaluations:
            for block in self._steps("eval", span):
                after = np.full(len(block), evaluation.after, np.int64)
                yield block, values.evaluating(block, evaluation.train_step), after

    def _steps(self, phase: str, span: Span) -> Iterator[NDArray[np.void]]:
        """Yield the steps of a span, at most a batch at a time, after checking them."""
        recording, topic = self._recording, schema.PHASES[phase][0]
        for block in recording.blocks(topic, span.start, span.stop):
            for start in range(0, len(block), BATCH):
                part = block[start : start + BATCH]
                check_steps(part, recording.mdp, str(recording.path), schema.PHASE_NAMES[phase])
                yield part

    def _vocabulary(self) -> Vocabulary:
        """Return the labels of the run; numbers as fine as its tables ask for."""
        low = high = 0.0
        for snapshot in self._recording.snapshots():
            low, high = min(low, float(snapshot.values.min())), max(high, float(snapshot.values.max()))
        return vocabulary_of(self._recording.mdp, self._scene, self._marks, self._learners, (low, high))

    def _send_notice(self, covered: list[tuple[int, int]]) -> None:
        """Say in the grid, wherever no steps were exported, that there are none."""
        if self._scene is None:
            return
        starts = [0, *(stop for _, stop in covered)]
        stops = [*(start for start, _ in covered), self.shown.last + 1]
        gaps = [
            (start, stop) for start, stop in zip(starts, stops, strict=True) if start + (start == 0) < stop
        ]
        if not gaps:
            return
        n, path = len(gaps), f"{self._source.root}/notice"
        columns = instances(
            rr.Points2D,
            n,
            positions=place(n, self._scene.columns / 2, self._scene.rows / 2),
            labels=texts(["no steps exported here: see --episodes, --evaluations and --all"] * n),
            radii=np.zeros((n, 1), np.float32),
            colors=ink(n),
        )
        sender = Sender(self._stream, path)
        sender.send("text", [rr.TimeColumn("step", sequence=[start for start, _ in gaps])], columns)
        sender.clear("text", [stop for _, stop in gaps if stop <= self.shown.last])


Piece = tuple[NDArray[np.void], StepValues | None, NDArray[np.int64]]
"""Steps, their Q-values if they are known, and the training episode of each."""


def _batches(pieces: Iterator[Piece], trials: int) -> Iterator[Batch]:
    """Yield the pieces put together to batches that are worth sending."""
    waiting: list[Piece] = []
    before: NDArray[np.void] | None = None
    for piece in pieces:
        full = sum(len(one[0]) for one in waiting) + len(piece[0]) > BATCH
        if waiting and (full or (waiting[-1][1] is None) != (piece[1] is None)):
            batch = _together(waiting, before, trials)
            yield batch
            before, waiting = batch.records[-TRAIL_STEPS:], []
        waiting.append(piece)
    if waiting:
        yield _together(waiting, before, trials)


def _together(pieces: list[Piece], before: NDArray[np.void] | None, trials: int) -> Batch:
    records = np.concatenate([piece[0] for piece in pieces]) if len(pieces) > 1 else pieces[0][0]
    values = _joined([piece[1] for piece in pieces if piece[1] is not None])
    episode = np.concatenate([piece[2] for piece in pieces])
    time = records["log_time"].astype(np.int64) // schema.STEP_NANOSECONDS
    return Batch(records, values, episode, records[:0] if before is None else before, time, trials)


def _joined(parts: list[StepValues]) -> StepValues | None:
    """Return the values of successive pieces as one; None if there are none."""
    if len(parts) < 2:
        return parts[0] if parts else None
    starts = np.cumsum([0] + [len(part.values) for part in parts])
    renewed = [part.renewed + start for part, start in zip(parts, starts[:-1], strict=True)]
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in ("values", "greedy", "value_maps", "greedy_maps")
    }
    return StepValues(renewed=np.concatenate(renewed), **joined)


def _cover(covered: list[tuple[int, int]], time: NDArray[np.int64]) -> None:
    """Add the times of a batch to the stretches (first, one past the last) that are covered."""
    breaks = np.flatnonzero(np.diff(time) != 1) + 1
    for run in np.split(time, breaks):
        first, stop = int(run[0]), int(run[-1]) + 1
        if covered and covered[-1][1] == first:
            covered[-1] = (covered[-1][0], stop)
        else:
            covered.append((first, stop))


def _last_report(recording: Recording) -> int:
    rows = [*recording.metrics("train")[-1:], *recording.metrics("eval")[-1:]]
    return max((row["log_time"] // schema.STEP_NANOSECONDS for row in rows), default=0)


def _metric_paths(recording: Recording) -> Iterator[str]:
    """Yield the metrics that a recording has."""
    evaluations = recording.metrics("eval")
    events = recording.mdp.event_names
    reports = recording.metrics("train") or evaluations
    yield from (f"eval/metrics/{metric.name}" for metric in known_metrics(evaluations))
    if reports:
        names = ("filled_percent", "epsilon", "step_size", "reward_percent")
        yield from (f"train/metrics/{name}" for name in (*TRAINING_MEANS, *names))
    for name in (f"{event}s" for event in events if "." not in event):
        if reports:
            yield f"train/metrics/{name}"
        if evaluations:
            yield f"eval/metrics/{name}"
