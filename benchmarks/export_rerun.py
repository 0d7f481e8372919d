"""The Rerun export of every step, against `rr.log` called a step; `python -m benchmarks.export_rerun`."""

from __future__ import annotations

import resource
import tempfile
import time
from pathlib import Path

import numpy as np
import rerun as rr

import runner
from runner.export.rerun.selection import Request
from runner.export.rerun.writing import Source, export, new_stream
from runner.recording import schema
from runner.recording.reader import Recording, open_recording

LOGGED_STEPS = 3_000


def main() -> None:
    """Print steps a second and bytes a step of both ways, for the whole of quick.yaml."""
    with tempfile.TemporaryDirectory() as folder:
        run = runner.run(Path(__file__).parents[1] / "configs" / "quick.yaml", recordings=folder)
        with open_recording(run.recording) as recording:
            export([Source(recording, "warm")], Request(), Path(folder, "warm.rrd"))
            path = Path(folder, "all.rrd")
            started, busy = time.perf_counter(), time.process_time()
            (selection,) = export([Source(recording, "all")], Request(everything=True), path)
            elapsed, busy = time.perf_counter() - started, time.process_time() - busy
            rate = selection.steps / elapsed
            logged = logged_rate(recording, Path(folder, "log.rrd"))
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"columns        {rate:12,.0f} steps/s  ({selection.steps / busy:,.0f} a second of processor)")
        print(f"               {path.stat().st_size / selection.steps:12,.0f} bytes a step")
        print(f"rr.log a step  {logged:12,.0f} steps/s  ({rate / logged:,.0f}x)")
        print(f"peak memory    {peak:12,.0f} MB")


def logged_rate(recording: Recording, path: Path) -> float:
    """Return steps a second of logging the same archetypes one by one, without any of the computing."""
    steps = next(recording.blocks(schema.TRAIN_STEP))[:LOGGED_STEPS]
    points, vectors = np.ones((17, 2), np.float32), np.ones((2, 2), np.float32)
    strips, bars = np.ones((2, 6, 2), np.float32), np.ones((12, 2, 2), np.float32)
    stream = new_stream("logged")
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
        stream.log("train/q", rr.Points2D(points[:16], class_ids=np.ones(16, np.uint16)))
        stream.log("train/q", rr.LineStrips2D(bars))
        stream.log("train/map/here", rr.Boxes2D(centers=points[:1], half_sizes=points[:1]))
    stream.flush()
    stream.disconnect()
    return len(steps) / (time.perf_counter() - started)


if __name__ == "__main__":
    main()
