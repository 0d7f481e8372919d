"""Archives of the cooperative tutorial: bytes per step, time, peak memory, also of a longer run."""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from benchmarks.figures import Figure, figure
from benchmarks.processes import Process, run, run_command, run_config

CONFIG = "tutorial_cooperative"
EPISODES = 50_000


@dataclass(frozen=True)
class RoundTrip:
    """A run archived, its recording removed, and restored."""

    archive: Process
    checked: Process
    """The same with `--remove`: written, read back and compared."""
    restore: Process
    steps: int
    archive_bytes: int
    """All files of the archive."""
    recording_bytes: int


def measure(quick: bool) -> list[Figure]:
    """Return size, times and peak memory; the longer run has ten times the episodes, or two if quick."""
    times = 2 if quick else 10
    run_config("quick")  # compiles
    trips = [round_trip() for _ in range(1 if quick else 3)]
    longer = round_trip(f"episodes={times * EPISODES}")
    size = [trip.archive_bytes / trip.steps for trip in trips]
    first = trips[0]
    detail = f"{first.steps / 1e6:.1f} M steps, {first.recording_bytes / 1e6:.0f} MB before"
    return [
        figure("archive, bytes per step", size, "bytes", (4, 2.7), higher_is_better=False, detail=detail),
        *_times("archive", [trip.archive for trip in trips]),
        *_times("archive --remove", [trip.checked for trip in trips]),
        *_times("restore", [trip.restore for trip in trips]),
        _peak("peak memory of the three", trips),
        _peak(f"  {times} times as long", [longer], f"{longer.steps / 1e6:.0f} M steps"),
    ]


def round_trip(*overrides: str) -> RoundTrip:
    """Run the tutorial, archive and restore it, each by the command line."""
    with tempfile.TemporaryDirectory() as folder:
        recordings, archive = f"{folder}/recordings", Path(folder) / "archive"
        run(run_command(CONFIG, recordings, *overrides))
        (recording,) = Path(recordings).glob("*/recording.mcap")
        size = recording.stat().st_size
        command = [sys.executable, "-m", "runner"]
        where = ["@latest", "--recordings", recordings]
        plain = run([*command, "archive", *where, "--to", f"{folder}/plain"])
        checked = run([*command, "archive", *where, "--to", str(archive), "--remove"])
        restored = run([*command, "restore", *where])
        files = [path for path in archive.rglob("*") if path.is_file()]
        return RoundTrip(plain, checked, restored, _steps(recording), _size(files), size)


def _steps(recording: Path) -> int:
    from runner.recording.reader import open_recording

    with open_recording(recording) as opened:
        return opened.train.steps.count() + opened.eval.steps.count()


def _size(files: list[Path]) -> int:
    return sum(path.stat().st_size for path in files)


def _times(what: str, processes: list[Process]) -> list[Figure]:
    cpu = sum(process.cpu_seconds for process in processes) / len(processes)
    wall = [process.seconds for process in processes]
    detail = f"whole command; {cpu:.1f} s of processor time"
    return [figure(f"{what}, tutorial", wall, "s", (15, 5), higher_is_better=False, detail=detail)]


def _peak(what: str, trips: list[RoundTrip], detail: str = "resident") -> Figure:
    peaks = [
        max(process.peak_megabytes for process in (trip.archive, trip.checked, trip.restore))
        for trip in trips
    ]
    return figure(what, peaks, "MB", (500, 250), higher_is_better=False, detail=detail)
