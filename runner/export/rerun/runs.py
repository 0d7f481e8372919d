"""A run as tracks: an overview, then the selected steps, with the Q-values of a job at each of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import chain
from typing import Final, TypeVar

import numpy as np
import rerun as rr

from runner.environments.naming import spoken
from runner.export.rerun.labels import GridLabels
from runner.export.rerun.loops import FRAMES_SENT, LoopTracks
from runner.export.rerun.metrics import EVENTS, mark_tracks, metric_tracks, phase_colours, series_lines
from runner.export.rerun.q_values import MapTracks, ValueReader, ValueTracks
from runner.export.rerun.scene import background, scene_of
from runner.export.rerun.selection import episodes_of
from runner.export.rerun.steps import Batch, StepTracks, grid_view
from runner.export.rerun.tracks import (
    GREY,
    MAX_ROWS,
    Track,
    Writer,
    cleared,
    in_tracks,
    scalars,
    text_track,
)
from runner.recording import schema
from runner.recording.turns import taken
from runner.util.arrays import Records

T = TypeVar("T")
_BATCH_BYTES: Final = 64 << 20


class RunReader:
    """Reads a run as tracks: an overview, of which all views of a job follow, then its steps."""

    def __init__(self, writer: Writer) -> None:
        recording, selection = writer.source.recording, writer.selection
        self.writer, self._recording, self._is_job = writer, recording, recording.has_tables
        self._loop = None if self._is_job else LoopTracks(writer)
        scene = self._scene = scene_of(recording.mdp) if recording.tabular else None
        self._makers: dict[str, list[StepTracks | ValueTracks | MapTracks]] = {}
        """Makers of the tracks of each phase: of the steps, and of the Q-values at them."""
        self._edges: set[int] = set()
        """First steps of the stretches of time that were sent, and the steps after their last ones."""
        if self._is_job:
            reports = [*recording.train.all_metrics()[-1:], *recording.eval.all_metrics()[-1:]]
            steps = sum(phase.steps.count() for phase in recording.phases)
            writer.last = max([steps, *(row["log_time"] // schema.STEP_NANOSECONDS for row in reports)])
        if not (selection.steps and (scene or self._is_job)):
            return
        bounds = [0.0, *(b for q in recording.snapshots() for b in (q.values.min(), q.values.max()))]
        labels = self._labels = GridLabels(recording.mdp, scene, recording.agents, (min(bounds), max(bounds)))
        for phase in (phase for phase, spans in selection.by_phase.items() if spans):
            makers = self._makers[phase] = [StepTracks(phase, writer.source.title, labels)]
            if self._is_job:
                makers.append(ValueTracks(phase, labels))
                if scene and scene.placements:
                    learners = range(len(recording.agents))
                    makers += [MapTracks(phase, labels, scene.placements, learner) for learner in learners]

    def overview(self) -> Iterator[Track]:
        """Yield everything but steps, and what never changes of them."""
        source = self.writer.source
        yield from self._loop.overview() if self._loop else metric_tracks(source)
        yield from mark_tracks(source)
        if not self._makers:
            return
        yield self._labels.track()
        if self._scene:
            view = grid_view(source.title, self._scene)
            yield from background(self._scene, view)
            if self._is_job:
                text = rr.Points2D.from_fields(radii=0.0, colors=[GREY])
                yield Track("notice/text", static=[text], view=view)
        for phase, makers in self._makers.items():
            if self._is_job:
                yield Track(f"{phase}/events", view=EVENTS)
            for maker in makers:
                yield from maker.still

    def steps(self) -> Iterator[Track]:
        """Yield the selected steps, then pictures that are drawn of them."""
        names = [f"reward {spoken(name)}" for name in self._recording.agents]
        values = ValueReader(self._recording, self._scene) if self._is_job and self._makers else None
        for phase, spans in self.writer.selection.by_phase.items():
            style = [series_lines(names, phase_colours(phase, len(names)))]
            makers, batches = self._makers.get(phase, ()), self._batches(phase, spans, values)
            edges: set[int] = set()
            for batch in _prefetched(batches) if self._is_job else batches:
                if self._loop:
                    yield from self._loop.lines(phase, batch.records)
                else:
                    yield Track(f"{phase}/reward", batch.times(), scalars(batch.records["rewards"]), style)
                for maker in makers:
                    yield from maker.of(batch)
                edges ^= batch.edges()  # no edge where a stretch continues the one before
            if makers:
                self._edges ^= edges
                parts = ("q", "map", "grid") if self._is_job else ("grid",)
                # A job's last step stays in view.
                last = self.writer.last if self._is_job else np.inf
                stops = [stop for stop in sorted(edges)[1::2] if stop <= last]
                yield from cleared([f"{phase}/{part}" for part in parts], stops)
        if self._loop:
            yield from in_tracks(self._loop.drawn(), FRAMES_SENT)
        elif self._scene and self._makers:
            yield from self._notice(self._scene.columns / 2, self._scene.rows / 2)

    def _batches(self, phase: str, spans: Sequence[range], values: ValueReader | None) -> Iterator[Batch]:
        """Yield the steps of a phase after checking them, at most a batch of each environment at a time."""
        recording, train = self._recording, episodes_of(self._recording, "train")
        plan = recording.config["evaluation"] if self._is_job else None
        trials = int(plan["trials"]) if plan else 2**63 - 1
        for steps in self._blocks(phase, spans):
            if self._makers:
                recording.mdp.check_steps(steps, str(recording.path), schema.PHASE_NAMES[phase])
            trained, episode = (steps[name].astype(np.int64) for name in ("step", "episode"))
            number = episode
            if phase == "eval":  # shown by the training episodes before it
                number = episode % trials
                trained = steps["log_time"].astype(np.int64) // schema.STEP_NANOSECONDS - 1 - trained
                episode = train.before(trained)
            if values is None:
                yield Batch(steps, episode, number)
            else:
                yield from values.batches(phase, steps, episode, number, trained)

    def _blocks(self, phase: str, spans: Sequence[range]) -> Iterator[Records]:
        """Yield the steps of a phase in blocks of bounded size; values that vary in size as they are read."""
        table, n = self._recording.phase(phase).steps, self._recording.environments
        limit = max(1, min(MAX_ROWS * n, _BATCH_BYTES // table.row_dtype.itemsize))
        waiting: list[Records] = []
        for block in filter(len, map(taken, chain.from_iterable(map(table.numbered, spans)))):
            for part in np.split(block, range(limit, len(block), limit)):
                if waiting and (table.dtype is None or sum(map(len, waiting)) + len(part) > limit):
                    yield np.concatenate(waiting)
                    waiting = []
                waiting.append(part)
        if waiting:
            yield np.concatenate(waiting)

    def _notice(self, x: float, y: float) -> Iterator[Track]:
        """Yield a notice on the grid for the times of which no steps were exported."""
        last, entity = self.writer.last, "notice/text"
        gaps = np.array([0, *sorted(self._edges), last + 1]).reshape(-1, 2)
        gaps = gaps[gaps[:, 0].clip(min=1) < gaps[:, 1]]
        if len(gaps):
            words = ["no steps of this time were exported"] * len(gaps)
            yield text_track(entity, {"step": gaps[:, 0]}, (x, y), words)
            yield from cleared([entity], gaps[gaps[:, 1] <= last, 1])


def _prefetched(items: Iterable[T]) -> Iterator[T]:
    """Yield the items; while one is in use, a thread makes the next."""
    iterator = iter(items)
    with ThreadPoolExecutor(1, "prefetch") as executor:
        following = executor.submit(next, iterator, None)
        while (item := following.result()) is not None:
            following = executor.submit(next, iterator, None)
            yield item
