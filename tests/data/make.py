"""Make the kept recordings and what is expected of them: only when the format gets a new version.

python -m tests.data.make
"""

from __future__ import annotations

import json
import platform
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

from blake3 import blake3

import runner
from runner import execution
from runner.analysis.tables import last_step, tables_at
from runner.config import load
from runner.job import Job
from runner.recording import open as open_recording
from runner.runs import Run

HERE = Path(__file__).parent
NAMES = ("cooperative", "competitive")


def expectations(path: Path) -> dict[str, Any]:
    """Return what a recording of these holds, in few words."""
    with open_recording(path) as recording:
        last = last_step(recording)
        moments = (0, last // 3, last // 2, last)
        hashes = {
            str(step): [blake3(table.tobytes()).hexdigest() for table in tables_at(recording, step)]
            for step in moments
        }
        return {
            "content_digest": recording.result["content_digest"],
            "topic_digests": recording.result["topic_digests"],
            "messages": recording.result["messages"],
            "tables": hashes,
            "evaluations": [
                [one["finish_percent"], one["eval_mean_length"]] for one in recording.metrics("eval")
            ],
        }


def make(name: str) -> None:
    """Make one of them, with nothing in it that tells of the machine but its kind."""
    packages = {f"package.{package}": version(package) for package in ("numpy", "numba", "llvmlite")}
    made_by = {"dualtaxi": runner.__version__, "python": platform.python_version(), **packages}
    execution.provenance = lambda: made_by | {"machine": platform.machine()}
    config = load(HERE / f"{name}.yaml")
    facts = {
        "run_id": name,
        "name": config.name,
        "seed": config.seeds[0],
        "created": "2026-01-01T00:00:00+00:00",
    }
    with tempfile.TemporaryDirectory() as folder:
        run = Run(Path(folder), facts | {"status": "running", "config": config.to_mapping()})
        done = execution.run_job(Job(config, config.seeds[0]), run)
        done.recording.replace(HERE / f"{name}.mcap")


if __name__ == "__main__":
    for name in NAMES:
        make(name)
    found = {name: expectations(HERE / f"{name}.mcap") for name in NAMES}
    (HERE / "digests.json").write_text(json.dumps(found, indent=1) + "\n")
