"""The report of one run: time of the command and size of the page."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

from benchmarks.bench_cold_start import command
from benchmarks.figures import Figure, figure
from benchmarks.processes import run, run_command


def measure(quick: bool) -> list[Figure]:
    """Return seconds and megabytes of `dualtaxi report`, and seconds of `dualtaxi plot`."""
    repetitions = 2 if quick else 5
    config = "quick" if quick else "tutorial_cooperative"
    with tempfile.TemporaryDirectory() as folder:
        run(run_command(config, folder))
        (facts,) = [json.loads(file.read_bytes()) for file in Path(folder).glob("*/run.json")]
        page, picture = str(Path(folder) / "report.html"), str(Path(folder) / "plot.png")
        words = (facts["run_id"], "--recordings", folder, "--force", "-o")
        reports = [run(command("report", *words, page)).seconds for _ in range(repetitions)]
        plots = [run(command("plot", *words, picture)).seconds for _ in range(repetitions)]
        size = Path(page).stat().st_size / 1e6
    detail = f"{config}, {facts['summary']['train_steps']:,} training steps"
    return [
        figure("dualtaxi report, one run", reports, "s", (10, 3), higher_is_better=False, detail=detail),
        figure("  its page", [size], "MB", (3, 1), higher_is_better=False),
        figure("dualtaxi plot, one run", plots, "s", higher_is_better=False),
    ]
