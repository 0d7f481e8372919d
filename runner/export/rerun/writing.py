"""Exporting runs to one `.rrd` file, or into the user's cache."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import itertools
import os
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeVar

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from runner.drawing import palette
from runner.errors import RecordingError
from runner.export.rerun.columns import (
    Batch,
    Sender,
    StepValues,
    instances,
    new_stream,
    place,
    rgba,
    texts,
)
from runner.export.rerun.labels import Labels
from runner.export.rerun.layout import RunView, blueprint, loop_blueprint
from runner.export.rerun.loops import BATCH, LoopExporter
from runner.export.rerun.metrics import MetricWriter
from runner.export.rerun.q_values import MapWriter, StepValueReader, TableWriter
from runner.export.rerun.scene import scene_of
from runner.export.rerun.selection import Request, Selection, Span, select
from runner.export.rerun.steps import StepWriter
from runner.recording import schema
from runner.recording.reader import Recording, open_recording
from runner.replay.steps import check_steps
from runner.runs.run import Run
from runner.util import files
from runner.util.files import CACHE_VARIABLE, EXPORTS, RUN_SEPARATOR, storage_errors
from runner.util.version import __version__

MAX_QUEUED: Final = 8
"""Batches that may wait to be compressed, which takes longer than making them."""
MAX_CACHED: Final = 20
"""Exports in the cache; those that were not used for longest are removed."""
T = TypeVar("T")
Piece = tuple[NDArray[np.void], StepValues | None, NDArray[np.int64]]
"""Steps, their Q-values if known, and the training episode of each."""


@dataclass(frozen=True)
class Source:
    """A run to export."""

    recording: Recording
    title: str
    root: str = ""
    """Entity path of everything of the run; empty for the root."""
    tint: str | None = None
    """Base colour of its metrics, where runs are compared."""


def export(sources: Sequence[Source], request: Request, path: Path) -> list[Selection]:
    """Write runs to an `.rrd` file; return the selection of each.

    Raises:
        RecordingError: a recording cannot be read, or does not have what is requested.
        StorageError: the file cannot be written.
    """
    selections = [select(source.recording, request) for source in sources]
    are_jobs = [source.recording.is_job for source in sources]
    if len(set(are_jobs)) > 1:
        where = sources[are_jobs.index(True)].recording.path
        raise RecordingError(
            f"{where}: was trained here, the other was recorded from a loop; view them separately."
        )
    stream = new_stream("-".join(source.recording.run_id for source in sources))
    with _saved(stream, path):
        stream.send_recording_name(" and ".join(source.title for source in sources))
        if are_jobs[0]:
            runs = [RunExporter(stream, *pair) for pair in zip(sources, selections, strict=True)]
            entities = {entity for run in runs for entity in run.send_metrics()}
            stream.send_blueprint(blueprint([run.view for run in runs], entities), make_active=False)
            for run in runs:
                run.send_steps()
        else:
            loops = [
                LoopExporter(stream, source.recording, selection, source.root)
                for source, selection in zip(sources, selections, strict=True)
            ]
            for loop in loops:
                loop.export()
            views = [loop.blueprint(source.title) for loop, source in zip(loops, sources, strict=True)]
            stream.send_blueprint(loop_blueprint(views))
    return selections


def cached_export(runs: Sequence[Run], request: Request) -> tuple[Path, list[Selection]]:
    """Return the export of these runs in the user's cache, made now if missing, and the selection of each.

    Raises:
        RecordingError: a recording cannot be read, or does not have what is requested.
        StorageError: the cache cannot be written.
    """
    folder = files.cache_folder() / EXPORTS
    path = folder / f"{RUN_SEPARATOR.join(run.run_id for run in runs)}-{_cache_key(runs, request)}.rrd"
    with contextlib.ExitStack() as stack:
        recordings = [stack.enter_context(open_recording(run.recording)) for run in runs]
        if path.exists():
            path.touch()
            return path, [select(recording, request) for recording in recordings]
        sources = [
            Source(recording, f"{run.title} ({run.run_id})")
            for run, recording in zip(runs, recordings, strict=True)
        ]
        if len(runs) > 1:
            colours = itertools.cycle(palette.COMPARED)
            sources = [
                dataclasses.replace(source, root=f"/{run.run_id}", tint=next(colours))
                for source, run in zip(sources, runs, strict=True)
            ]
        with storage_errors(folder, f"set {CACHE_VARIABLE} to another folder"):
            folder.mkdir(parents=True, exist_ok=True)
            cached = sorted(folder.glob("*.rrd"), key=lambda file: file.stat().st_mtime, reverse=True)
            for old in cached[MAX_CACHED - 1 :]:
                old.unlink(missing_ok=True)
        return path, export(sources, request, path)


def _cache_key(runs: Sequence[Run], request: Request) -> str:
    """Return a hash of the recordings as they are now, the request, and the code."""
    parts = [__version__, repr(request)]
    for run in runs:
        stat = run.recording.stat()
        parts += [str(run.recording.absolute()), str(stat.st_size), str(stat.st_mtime_ns)]
    parts += [str(file.stat().st_mtime_ns) for file in sorted(Path(__file__).parent.glob("*.py"))]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


@contextlib.contextmanager
def _saved(stream: rr.RecordingStream, path: Path) -> Iterator[None]:
    """Save everything sent to a stream as a file, which replaces another only when it is complete."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with storage_errors(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary.touch()  # where no file can be created, Rerun would not raise an OSError
            stream.save(temporary)
            yield
            stream.flush()
            stream.disconnect()
            temporary.replace(path)
    finally:
        if os.path.lexists(temporary):
            temporary.unlink()


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
        self._has_steps = bool(selection.steps)
        scene = scene_of(recording.mdp)
        self.view = RunView(
            source.root,
            source.title,
            recording.mdp,
            scene,
            recording.agents,
            self._has_steps,
            self._has_steps,
            last,
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
        if not self._has_steps:
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

    def _send_phase(self, phase: str, pieces: Iterator[Piece], labels: Labels) -> list[tuple[int, int]]:
        """Send the steps of a phase; return the stretches of time that they cover."""
        view, stream = self.view, self._stream
        evaluation = self._recording.config.get("evaluation") if phase == "eval" else None
        trials = int(evaluation["trials"]) if evaluation else 0
        writer: StepWriter | None = None
        are_values_shown = False
        for batch in _prefetched(_batches(pieces, trials)):
            if writer is None:
                writer = StepWriter(stream, view.root, phase, view.mdp, view.scene, labels, view.learners)
                table = TableWriter(stream, writer.path, view.mdp, labels, len(view.learners))
                maps = [
                    MapWriter(
                        stream, writer.path, view.scene, view.scene.placements, labels, view.learners, i
                    )
                    for i in range(len(view.learners))
                    if view.scene and view.scene.placements
                ]
            writer.write(batch)
            if batch.values is not None:
                table.write(batch, batch.values)
                for one in maps:
                    one.write(batch, batch.values)
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

    def _training(self, reader: StepValueReader) -> Iterator[Piece]:
        for span in self._selection.train:
            for block in self._blocks("train", span):
                for part in reader.split(block):
                    yield part, reader.training(part), part["episode"].astype(np.int64)

    def _evaluations(self, reader: StepValueReader) -> Iterator[Piece]:
        for evaluation, span in self._selection.evaluations:
            for block in self._blocks("eval", span):
                after = np.full(len(block), evaluation.after, np.int64)
                yield block, reader.evaluation(block, evaluation.train_step), after

    def _blocks(self, phase: str, span: Span) -> Iterator[NDArray[np.void]]:
        """Yield the steps of a span, at most a batch at a time, after checking them."""
        recording, topic = self._recording, schema.PHASES[phase][0]
        for block in recording.blocks(topic, span.start, span.stop):
            for start in range(0, len(block), BATCH):
                part = block[start : start + BATCH]
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
            positions=place(n, scene.columns / 2, scene.rows / 2),
            labels=texts(["no steps exported here: see --episodes, --evaluations and --all"] * n),
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


def _batches(pieces: Iterable[Piece], trials: int) -> Iterator[Batch]:
    """Yield the pieces, combined to batches that are worth sending."""
    waiting: list[Piece] = []
    for piece in pieces:
        is_full = sum(len(records) for records, _, _ in waiting) + len(piece[0]) > BATCH
        if waiting and (is_full or (waiting[-1][1] is None) != (piece[1] is None)):
            yield _combined(waiting, trials)
            waiting = []
        waiting.append(piece)
    if waiting:
        yield _combined(waiting, trials)


def _combined(pieces: list[Piece], trials: int) -> Batch:
    records = np.concatenate([piece[0] for piece in pieces]) if len(pieces) > 1 else pieces[0][0]
    episode = np.concatenate([piece[2] for piece in pieces])
    time = records["log_time"].astype(np.int64) // schema.STEP_NANOSECONDS
    parts = [piece[1] for piece in pieces if piece[1] is not None]
    values = StepValues.concatenated(parts) if len(parts) > 1 else parts[0] if parts else None
    return Batch(records, episode, time, values, trials)
