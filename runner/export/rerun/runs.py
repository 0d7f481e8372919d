"""A run trained here in Rerun: its metrics, the selected steps, and the Q-values at each of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final, TypeVar

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from runner.drawing import palette
from runner.export.rerun.columns import MAX_ROWS, Batch, Sender, instances, repeated_point, rgba, texts
from runner.export.rerun.labels import Labels
from runner.export.rerun.layout import RunView
from runner.export.rerun.metrics import MetricWriter
from runner.export.rerun.q_values import MapWriter, TableWriter
from runner.export.rerun.scene import scene_of
from runner.export.rerun.selection import Selection
from runner.export.rerun.step_values import StepValueReader
from runner.export.rerun.steps import StepWriter
from runner.recording import schema
from runner.recording.reader import Recording
from runner.replay.steps import check_steps

MAX_QUEUED: Final = 8
"""Batches that may wait to be compressed, which takes longer than making them."""
T = TypeVar("T")


@dataclass(frozen=True)
class Source:
    """A run to export."""

    recording: Recording
    title: str
    root: str = ""
    """Entity path of everything of the run; empty for the root."""
    tint: str | None = None
    """Base colour of its metrics, where runs are compared."""


class RunExporter:
    """Sends one run to a stream: its metrics, then its steps."""

    def __init__(self, stream: rr.RecordingStream, source: Source, selection: Selection) -> None:
        recording = source.recording
        self._stream = stream
        self._recording = recording
        self._selection = selection
        self._source = source
        self._batches_sent = 0
        steps = sum(recording.count(topic) for topic in (schema.TRAIN_STEP, schema.EVAL_STEP))
        reports = [*recording.metrics("train")[-1:], *recording.metrics("eval")[-1:]]
        last = max([steps, *(row["log_time"] // schema.STEP_NANOSECONDS for row in reports)])
        self.view = RunView(
            source.root,
            source.title,
            recording.mdp,
            scene_of(recording.mdp),
            recording.agents,
            has_steps=bool(selection.steps),
            has_values=bool(selection.steps),
            last=last,
            focus=selection.focus,
        )

    def send_metrics(self) -> set[str]:
        """Send all metrics; return their entities."""
        recording, source = self._recording, self._source
        label = recording.run_id if source.tint else ""
        writer = MetricWriter(
            self._stream, source.root, recording.agents, recording.mdp.event_names, source.tint, label
        )
        writer.send_recorded(recording)
        return {f"{source.root}/{path}" for path in writer.paths}

    def send_steps(self) -> None:
        """Send the selected steps."""
        if not self.view.has_steps:
            return
        view = self.view
        low = high = 0.0
        for snapshot in self._recording.snapshots():
            low, high = min(low, float(snapshot.values.min())), max(high, float(snapshot.values.max()))
        labels = Labels(view.mdp, view.scene, view.learners, (low, high))
        labels.log(self._stream, view.root)
        view.draw_background(self._stream)
        reader = StepValueReader(self._recording, view.scene.placements if view.scene else None)
        covered = [
            stretch
            for phase, pieces in (("train", self._training(reader)), ("eval", self._evaluations(reader)))
            for stretch in self._send_phase(phase, pieces, labels)
        ]
        self._send_notice(sorted(covered))

    def _send_phase(self, phase: str, pieces: Iterator[Batch], labels: Labels) -> list[tuple[int, int]]:
        """Send the steps of a phase; return the stretches of time that they cover."""
        view, stream = self.view, self._stream
        writer: StepWriter | None = None
        are_values_shown = False
        for batch in _prefetched(_batches(pieces)):
            if writer is None:
                writer = StepWriter(stream, view, phase, labels, with_rewards=True)
                table = TableWriter(stream, writer.path, view, labels)
                has_maps = view.scene is not None and view.scene.placements is not None
                count = len(view.learners) if has_maps else 0
                maps = [MapWriter(stream, writer.path, view, labels, i) for i in range(count)]
            writer.write(batch)
            if batch.values is not None:
                table.write(batch, batch.values)
                for map_writer in maps:
                    map_writer.write(batch, batch.values)
            elif are_values_shown:
                for part in ("q", "map"):
                    writer.clear(part, [int(batch.time[0])])
            are_values_shown = batch.values is not None
            self._batches_sent += 1
            if self._batches_sent % MAX_QUEUED == 0:
                stream.flush()
        if writer is None:
            return []
        writer.clear_gaps(("grid", "q", "map"), view.last)  # the run's last step stays in view
        return writer.covered

    def _training(self, reader: StepValueReader) -> Iterator[Batch]:
        for span in self._selection.train:
            for block in self._blocks("train", span):
                for part in reader.split(block):
                    yield Batch.of(part, part["episode"].astype(np.int64), reader.training(part))

    def _evaluations(self, reader: StepValueReader) -> Iterator[Batch]:
        trials = int(self._recording.config["evaluation"]["trials"]) if self._selection.evaluations else 0
        for evaluation, span in self._selection.evaluations:
            for block in self._blocks("eval", span):
                after = np.full(len(block), evaluation.after, np.int64)
                yield Batch.of(block, after, reader.evaluation(block, evaluation.train_step), trials)

    def _blocks(self, phase: str, span: range) -> Iterator[NDArray[np.void]]:
        """Yield the steps of a span, at most a batch at a time, after checking them."""
        recording, topic = self._recording, schema.PHASES[phase][0]
        for block in recording.blocks(topic, span.start, span.stop):
            for start in range(0, len(block), MAX_ROWS):
                part = block[start : start + MAX_ROWS]
                check_steps(part, recording.mdp, str(recording.path), schema.PHASE_NAMES[phase])
                yield part

    def _send_notice(self, covered: list[tuple[int, int]]) -> None:
        """Send a notice to the grid for the times of which no steps were exported."""
        scene, last = self.view.scene, self.view.last
        starts, stops = [0, *(stop for _, stop in covered)], [*(start for start, _ in covered), last + 1]
        gaps = [(start, stop) for start, stop in zip(starts, stops, strict=True) if max(start, 1) < stop]
        if scene is None or not gaps:
            return
        n, sender = len(gaps), Sender(self._stream, f"{self._source.root}/notice")
        colours = [rgba(palette.MIDTONE)]
        sender.send_static("text", rr.Points2D.from_fields(radii=0.0, colors=colours))
        columns = instances(
            rr.Points2D,
            positions=repeated_point(n, scene.columns / 2, scene.rows / 2),
            labels=texts(["no steps of this time were exported"] * n),
        )
        sender.send("text", [rr.TimeColumn("step", sequence=[start for start, _ in gaps])], columns)
        sender.clear("text", [stop for _, stop in gaps if stop <= last])


def _prefetched(items: Iterable[T]) -> Iterator[T]:
    """Yield the items; while one is in use, a thread makes the next."""
    iterator = iter(items)
    with ThreadPoolExecutor(1, "prefetch") as executor:
        following = executor.submit(next, iterator, None)
        while (item := following.result()) is not None:
            following = executor.submit(next, iterator, None)
            yield item


def _batches(pieces: Iterable[Batch]) -> Iterator[Batch]:
    """Yield the pieces combined to larger batches, in each of which all values are known or none are."""
    waiting: list[Batch] = []
    for piece in pieces:
        is_full = sum(len(each.records) for each in waiting) + len(piece.records) > MAX_ROWS
        if waiting and (is_full or (waiting[-1].values is None) != (piece.values is None)):
            yield Batch.concatenated(waiting)
            waiting = []
        waiting.append(piece)
    if waiting:
        yield Batch.concatenated(waiting)
