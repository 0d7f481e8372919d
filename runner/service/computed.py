"""What is computed for an answer, by a child process, so that all that is heavy stays there."""

from __future__ import annotations

import dataclasses
import io
import json
import math
from collections.abc import Sequence
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from runner.analysis.evaluations import evaluation_records, training_records
from runner.analysis.frames import Phase, episode_columns, step_columns
from runner.errors import RunnerError
from runner.recording.reader import open_recording
from runner.service.errors import Refused
from runner.util.extras import require
from runner.util.values import finite

if TYPE_CHECKING:
    from runner.analysis.series import RunSeries
    from runner.export.rerun.selection import Request
    from runner.runs.run import Run

Which = Literal["evaluations", "training", "optimality"]


def curves(path: Path, chosen: Sequence[str], start: int, stop: int | None, points: int) -> bytes:
    """Return the metrics of a run over training episodes, as JSON.

    Args:
        path: its recording.
        chosen: metrics; all if there are none.
        start: the first training episode.
        stop: behind the last; None: to the end.
        points: at most so many of a curve; of more, the lowest and the highest of each stretch are given.
    """
    from runner.analysis.series import read_series, title_of

    with open_recording(path) as recording:
        series = read_series(recording)
    found = {}
    for (metric, line), (episodes, values) in _lines(series).items():
        if chosen and metric not in chosen:
            continue
        inside = (episodes >= start) & (episodes < (math.inf if stop is None else stop))
        kept = thinned(values[inside], points)
        title, unit = title_of(metric)
        found[metric, line] = {
            **{"metric": metric, "line": line, "title": title, "unit": unit},
            "episodes": episodes[inside][kept].tolist(),
            "values": values[inside][kept].tolist(),
            "of": int(inside.sum()),
            "thinned": bool(len(kept) < inside.sum()),
        }
    return as_json({"run_id": series.run_id, "curves": list(found.values())})


def records(path: Path, which: Which, start: int, stop: int, most: int) -> bytes:
    """Return evaluations, reports of training or exact measures number `start` up to `stop`, as JSON.

    Raises:
        Refused: they are more than `most`.
        RecordingError: the recording cannot be read, or is of a loop, which has no reports of training.
    """
    with open_recording(path) as recording:
        if which == "optimality":
            found = list(recording.optimality())
        else:
            if which != "evaluations":
                recording.require_job("a report of training", "Its metrics can be had all the same.")
            found = (evaluation_records if which == "evaluations" else training_records)(recording)
        shown = found[start:stop]
        if len(shown) > most:
            raise too_many(len(shown), most)
        told = {"run_id": recording.run_id, "start": start, "total": len(found), "records": shown}
        return as_json(told)


def too_many(found: int, most: int) -> Refused:
    """Return the error that a range is too long."""
    return Refused(
        HTTPStatus.UNPROCESSABLE_ENTITY,
        f"query: found a range of {found:,} records, expected at most {most:,}; ask for them in parts.",
    )


def _lines(series: RunSeries) -> dict[tuple[str, str], tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return the episodes and values of each curve, by metric and line."""
    found: dict[tuple[str, str], dict[int, float]] = {}
    for episode, readings in (*series.training, *series.evaluation):
        for metric, lines in readings.items():
            for line, value in lines.items():
                found.setdefault((metric, line), {})[episode] = value
    return {
        key: (np.array(sorted(points), np.float64), np.array([points[at] for at in sorted(points)]))
        for key, points in found.items()
    }


def thinned(values: NDArray[np.float64], points: int) -> NDArray[np.intp]:
    """Return which values are kept so that no extreme is lost: the lowest and the highest of each stretch.

    Args:
        values: float64 [n].
        points: at most so many are kept; 0 for all.
    """
    if points == 0 or len(values) <= points:
        return np.arange(len(values))
    stretches = np.array_split(np.arange(len(values)), max(points // 2, 1))
    known = np.where(np.isnan(values), np.inf, values)
    lowest = [part[np.argmin(known[part])] for part in stretches]
    known = np.where(np.isnan(values), -np.inf, values)
    highest = [part[np.argmax(known[part])] for part in stretches]
    return np.unique([*lowest, *highest])


def q_table(path: Path, step: int | None, episode: int | None, state: int | None, form: str) -> bytes:
    """Return the Q-table of a moment: `json` tells of it, of one state with its history; `npy` is all of it.

    Raises:
        RecordingError: there is no such moment, or the steps before it are not recorded.
        RunnerError: there is no such state.
    """
    from runner.analysis.qtable import describe_tables, one_array, replay_at

    with open_recording(path) as recording:
        recording.require_job("a Q-table", "A loop's arrays are in its recording.")
        replay = replay_at(recording, step, episode)
        if form == "json":
            return as_json(describe_tables(recording, replay, state))
        stream = io.BytesIO()
        np.save(stream, one_array(replay.tables))
        return stream.getvalue()


def arrow(path: Path, table: str, phase: Phase, start: int, stop: int) -> bytes:
    """Return the columns of steps or episodes number `start` up to `stop` as a stream of Arrow's IPC format.

    Raises:
        MissingExtra: pyarrow is not installed.
        RecordingError: the recording cannot be read.
    """
    require("pyarrow", extra="archive", purpose="Arrow")
    import pyarrow as pa

    with open_recording(path) as recording:
        if table == "steps":
            columns = step_columns(recording, phase, start=start, stop=stop)
        else:
            columns = episode_columns(recording, phase, start, stop)
    arrays = {
        name: pa.array(values if values.ndim == 1 else values.tolist()) for name, values in columns.items()
    }
    whole = pa.table(arrays)
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, whole.schema) as writer:
        writer.write_table(whole)
    return bytes(sink.getvalue())


def plot(paths: Sequence[Path], form: str) -> bytes:
    """Return every metric of some runs over episodes in one figure, as `svg`, `png` or `pdf`.

    Raises:
        MissingExtra: Matplotlib is not installed.
    """
    import tempfile

    from runner.analysis.groups import groups_of
    from runner.export.plots.curves import curves_sheet
    from runner.export.plots.image import check_suffix, save
    from runner.export.plots.metrics import panels_of

    check_suffix(Path(f"plot.{form}"))
    groups = groups_of(_series(paths))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, f"plot.{form}")
        save(curves_sheet(groups, panels_of(groups)), path)
        return path.read_bytes()


def difference(a: Run, b: Run, ignore: Sequence[str], first: bool, targets: Sequence[str]) -> bytes:
    """Return in what two runs differ, as `dualtaxi diff --json` tells it.

    Raises:
        RecordingError: a recording cannot be read.
        RunnerError: a target is none.
    """
    from runner.analysis import diff as differences
    from runner.analysis.series import parse_target

    levels = dict(parse_target(target) for target in targets)
    with open_recording(a.recording) as ours, open_recording(b.recording) as theirs:
        found = differences.diff(ours, theirs, levels, first)
    found = found if first else differences.with_seconds(found, a, b)
    return as_json(differences.as_json(differences.without_ignored(found, ignore)))


def comparison(
    paths: Sequence[Path], by: str | None, chosen: Sequence[str], at: str, target: str | None
) -> bytes:
    """Return groups of runs against each other, as `dualtaxi compare --json` tells it.

    Raises:
        MissingExtra: SciPy is not installed.
        RunnerError: there is nothing to compare.
    """
    from runner.analysis.compare import compare
    from runner.analysis.compare.moments import moment_of
    from runner.analysis.compare.statistics import require_scipy
    from runner.analysis.groups import grouped, metrics_of, require_two

    require_scipy()
    moment, metrics = moment_of(at, target, chosen)
    groups, notes = grouped(_series(paths), by)
    require_two(groups, by)
    return as_json(dataclasses.asdict(compare(groups, metrics_of(groups, metrics), moment, notes)))


def replay(runs: Sequence[Run], request: Request) -> Path:
    """Return an export for the Rerun viewer, made now unless it is in the user's cache.

    Raises:
        MissingExtra: Rerun is not installed.
        RecordingError: a recording cannot be read, or has not what is asked for.
        StorageError: the cache cannot be written.
    """
    from runner.export.rerun.viewer import require_rerun

    require_rerun("a replay")
    from runner.export.rerun.writing import cached_export

    return cached_export(runs, request)[0]


def as_json(value: Any) -> bytes:
    """Return a value as JSON; NaN and infinity become null."""
    return json.dumps(finite(value), allow_nan=False, ensure_ascii=False).encode(errors="replace")


def _series(paths: Sequence[Path]) -> list[RunSeries]:
    from runner.analysis.series import read_series

    found = []
    for path in paths:
        with open_recording(path) as recording:
            found.append(read_series(recording))
    if not found:
        raise RunnerError("found no run, expected one at least.")
    return found
