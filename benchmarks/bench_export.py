"""The Rerun export: the default selection, every step, and against one `rr.log` call per step."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.bench_cold_start import command
from benchmarks.figures import Figure, figure
from benchmarks.processes import Process, run, run_command
from runner.recording import schema
from runner.recording.reader import open_recording

CONFIG: Final = "tutorial_cooperative"
LOGGED_STEPS: Final = 3_000
TIMES: Final = 10


@dataclass(frozen=True)
class Export:
    """One export by command."""

    process: Process
    steps: int
    """Of the whole run."""
    file_bytes: int


def measure(quick: bool) -> list[Figure]:
    """Return time, size and memory of exports of the tutorial, or of a tenth of it if quick."""
    episodes = 5_000 if quick else 50_000
    repetitions = 2 if quick else 3
    with tempfile.TemporaryDirectory() as folder:
        for count in (episodes, episodes // TIMES):
            run(run_command(CONFIG, f"{folder}/{count}", f"episodes={count}"))
        export(folder, episodes)  # compiles
        chosen = [export(folder, episodes) for _ in range(repetitions)]
        whole = [export(folder, episodes, "--all") for _ in range(repetitions)]
        short = [export(folder, episodes // TIMES, "--all") for _ in range(repetitions)]
        logged = logged_rate(recording_in(folder, episodes), Path(folder, "log.rrd"))
    steps, size = whole[0].steps, whole[0].file_bytes
    rates = [one.steps / one.process.seconds for one in whole]
    peaks = [one.process.peak_megabytes for one in whole]
    growth = 100 * (figure("", peaks, "").value / _peak(short) - 1)
    times = figure("", [one.process.cpu_seconds for one in whole], "").value
    return [
        _lower("export of the default selection", [one.process.seconds for one in chosen], "s", (15, 5)),
        figure(
            "export of every step",
            rates,
            "steps/s",
            (150_000, 400_000),
            detail=f"{steps / 1e6:.2f} M steps, whole process; {times:.1f} s of processor time",
        ),
        _lower("  file size per step", [size / steps], "bytes", (250, 250), detail=f"{size / 1e9:.2f} GB"),
        figure(
            "  against rr.log per step",
            [rate / logged for rate in rates],
            "times",
            detail=f"rr.log: {logged:,.0f} steps/s, without computing anything",
        ),
        _lower("  peak memory", peaks, "MB", (1000, 400), detail="resident"),
        _lower(
            "  growth of the peak",
            [growth],
            "%",
            detail=f"compared with a run of a {TIMES}th of the length: {short[0].steps / 1e6:.2f} M steps, "
            f"{_peak(short):.0f} MB",
        ),
    ]


def export(folder: str, episodes: int, *options: str) -> Export:
    """Export the run with this number of episodes by command, and remove the file."""
    recording = recording_in(folder, episodes)
    facts = json.loads(recording.with_name("run.json").read_bytes())["summary"]
    path = Path(folder, "export.rrd")
    process = run(command("export", "rerun", str(recording.parent), "-o", str(path), *options))
    size = path.stat().st_size
    path.unlink()
    return Export(process, facts["train_steps"] + facts["eval_steps"], size)


def recording_in(folder: str, episodes: int) -> Path:
    """Return the recording of the run with this number of episodes."""
    (recording,) = Path(folder, str(episodes)).glob("*/recording.mcap")
    return recording


def logged_rate(recording: Path, path: Path) -> float:
    """Return steps a second of logging the same archetypes one by one, without computing anything."""
    import rerun as rr

    with open_recording(recording) as opened:
        steps = next(opened.train.steps.blocks())[:LOGGED_STEPS]
    points, vectors = np.ones((36, 2), np.float32), np.ones((2, 2), np.float32)
    strips, bars = np.ones((2, 6, 2), np.float32), np.ones((12, 2, 2), np.float32)
    stream = rr.RecordingStream("dualtaxi", recording_id="logged")
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    stream.save(path)
    started = time.perf_counter()
    for record in steps:
        stream.set_time("step", sequence=int(record["log_time"]) // schema.STEP_NANOSECONDS)
        stream.set_time("episode", sequence=int(record["episode"]))
        stream.set_time("t", sequence=int(record["t"]))
        stream.log("train/reward", rr.Scalars(record["rewards"]))
        stream.log("train/grid/things", rr.Points2D(points[:5], class_ids=[1, 2, 3, 4, 5]))
        stream.log("train/grid/things", rr.Arrows2D(vectors=vectors, origins=vectors))
        stream.log("train/grid/things", rr.LineStrips2D(strips))
        stream.log("train/q", rr.Scalars(np.ones(12)))
        stream.log("train/q", rr.Points2D.from_fields(class_ids=np.ones(36, np.uint16)))
        stream.log("train/q", rr.LineStrips2D(bars))
        stream.log("train/map/here", rr.Boxes2D.from_fields(centers=points[:1]))
    stream.flush()
    stream.disconnect()
    return len(steps) / (time.perf_counter() - started)


def _peak(exports: Sequence[Export]) -> float:
    return figure("", [one.process.peak_megabytes for one in exports], "").value


def _lower(
    what: str,
    values: Sequence[float],
    unit: str,
    targets: tuple[float, float] | None = None,
    detail: str = "",
) -> Figure:
    return figure(what, values, unit, targets, higher_is_better=False, detail=detail)
