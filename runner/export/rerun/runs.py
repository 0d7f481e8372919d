"""A run trained here as tracks: its metrics, the selected steps, and the Q-values at each of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np
import rerun as rr

from runner.environments.naming import spoken
from runner.export.rerun.labels import Labels
from runner.export.rerun.metrics import EVENTS, metric_tracks, phase_colours, series_lines
from runner.export.rerun.q_values import MapTracks, ValueReader, ValueTracks
from runner.export.rerun.scene import background, scene_of
from runner.export.rerun.selection import Selection
from runner.export.rerun.steps import Batch, StepTracks, grid_view
from runner.export.rerun.tracks import (
    GREY,
    MAX_ROWS,
    Source,
    Track,
    cleared,
    scalars,
    text_track,
)
from runner.recording import schema
from runner.replay.steps import check_steps

T = TypeVar("T")


class JobReader:
    """Reads a job as tracks: an overview, of which all views follow, then its steps."""

    def __init__(self, source: Source, selection: Selection) -> None:
        self._source, self._selection = source, selection
        recording = self._recording = source.recording
        self._mdp, self._scene = recording.mdp, scene_of(recording.mdp)
        steps = sum(recording.table(topic).count() for topic in (schema.TRAIN_STEP, schema.EVAL_STEP))
        reports = [*recording.train.all_metrics()[-1:], *recording.eval.all_metrics()[-1:]]
        self.last = max([steps, *(row["log_time"] // schema.STEP_NANOSECONDS for row in reports)])
        """Steps executed in the whole run."""
        low = high = 0.0
        for snapshot in recording.snapshots() if selection.steps else ():
            low, high = min(low, float(snapshot.values.min())), max(high, float(snapshot.values.max()))
        labels = self._labels = Labels(self._mdp, self._scene, recording.agents, (low, high))
        self._phases: dict[str, tuple[StepTracks, list[ValueTracks | MapTracks]]] = {}
        """What makes the tracks of the steps, and of the values at them."""
        maps = range(len(recording.agents) if self._scene and self._scene.placements else 0)
        for phase in (phase for phase, spans in selection.by_phase.items() if spans):
            values: list[ValueTracks | MapTracks] = [ValueTracks(source.root, phase, labels)]
            values += [MapTracks(source.root, phase, labels, i) for i in maps]
            self._phases[phase] = StepTracks(source.root, phase, source.title, labels), values

    def overview(self) -> Iterator[Track]:
        """Yield all metrics, and what never changes of the steps."""
        root = self._source.root
        yield from metric_tracks(self._source)
        if not self._phases:
            return
        yield self._labels.track(root)
        if self._scene:
            view = grid_view(self._source.title, self._scene)
            yield from background(root, self._scene, view)
            text = rr.Points2D.from_fields(radii=0.0, colors=[GREY])
            yield Track(f"{root}/notice/text", static=[text], view=view)
        for steps, values in self._phases.values():
            yield Track(f"{steps.path}/events", view=EVENTS)
            for maker in (steps, *values):
                yield from maker.still

    def steps(self) -> Iterator[Track]:
        """Yield the selected steps."""
        if not self._phases:
            return
        covered, reader = [], ValueReader(self._recording, self._scene)
        for phase, (steps, values) in self._phases.items():
            parts = [f"{steps.path}/{part}" for part in ("q", "map", "grid")]
            names = [f"reward {spoken(name)}" for name in self._recording.agents]
            style, are_values_shown = [series_lines(names, phase_colours(phase, len(names)))], False
            for batch in _prefetched(_batches(self._pieces(phase, reader))):
                yield Track(f"{steps.path}/reward", batch.times(), scalars(batch.records["rewards"]), style)
                yield from steps.of(batch)
                if len(batch.values):
                    for shown in values:
                        yield from shown.of(batch)
                elif are_values_shown:
                    yield from cleared(parts[:2], [int(batch.times()["step"][0])])
                are_values_shown = len(batch.values) > 0
            # the run's last step stays in view
            yield from cleared(parts, [stop for _, stop in steps.covered if stop <= self.last])
            covered += steps.covered
        yield from self._notice(sorted(covered))

    def _pieces(self, phase: str, reader: ValueReader) -> Iterator[Batch]:
        """Yield the steps of a phase, at most a batch at a time, after checking them."""
        recording, selection = self._recording, self._selection
        spans = [(None, span) for span in selection.train] if phase == "train" else selection.evaluations
        for evaluation, span in spans:
            for block in recording.phase(phase).steps.blocks(span.start, span.stop):
                for start in range(0, len(block), MAX_ROWS):
                    part = block[start : start + MAX_ROWS]
                    check_steps(part, recording.mdp, str(recording.path), schema.PHASE_NAMES[phase])
                    yield from reader.batches(part, evaluation)

    def _notice(self, covered: list[tuple[int, int]]) -> Iterator[Track]:
        """Yield a notice on the grid for the times of which no steps were exported."""
        starts, stops = [0, *(stop for _, stop in covered)], [*(start for start, _ in covered), self.last + 1]
        gaps = [(start, stop) for start, stop in zip(starts, stops, strict=True) if max(start, 1) < stop]
        if self._scene is None or not gaps:
            return
        entity, begins = f"{self._source.root}/notice/text", {"step": np.array([start for start, _ in gaps])}
        words = ["no steps of this time were exported"] * len(gaps)
        yield text_track(entity, begins, (self._scene.columns / 2, self._scene.rows / 2), words)
        yield from cleared([entity], [stop for _, stop in gaps if stop <= self.last])


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
        is_full = sum(len(one.records) for one in waiting) + len(piece.records) > MAX_ROWS
        if waiting and (is_full or bool(len(waiting[-1].values)) != bool(len(piece.values))):
            yield Batch(*map(np.concatenate, zip(*waiting, strict=True)))
            waiting = []
        waiting.append(piece)
    if waiting:
        yield Batch(*map(np.concatenate, zip(*waiting, strict=True)))
