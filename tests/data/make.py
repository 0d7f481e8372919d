"""Make the kept recordings and what is expected of them: only when the format gets a new version.

python -m tests.data.make
"""

from __future__ import annotations

import json
import os
import platform
import tempfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from blake3 import blake3
from gymnasium.vector import SyncVectorEnv

import runner
from runner.config import load
from runner.config.model import Job
from runner.execution import session
from runner.loops import loop_run
from runner.recording.reader import open_recording
from runner.replay.steps import last_step
from runner.replay.tables import tables_at
from runner.runs.provenance import CODE_VARIABLE
from runner.runs.run import Run
from tests.runner.loops.making import Leaving, drive, parallel, play
from tests.runner.loops.making import make as make_env

HERE = Path(__file__).parent
NAMES = ("cooperative", "competitive")
LOOPS = {"taxi": "Taxi-v4", "pole": "CartPole-v1", "rooms": "RoomsText"}
"""Loops over states, over values of one size, and over values of varying size."""
TOGETHER = ("vector", "game")
"""Loops over several environments at once, and over agents of which one after the other leaves."""


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
                [one["success_percent"], one["eval_mean_length"]] for one in recording.eval.all_metrics()
            ],
        }


def loop_expectations(path: Path) -> dict[str, Any]:
    """Return what a recording of a loop holds, in few words: every step of it among them, as a hash."""
    with open_recording(path) as recording:
        hashes = {phase: blake3() for phase in ("train", "eval")}
        for phase, whole in hashes.items():
            for step in recording.phase(phase).transitions():
                whole.update(repr(step).encode())
        return {
            "content_digest": recording.result["content_digest"],
            "messages": recording.result["messages"],
            "steps": {phase: whole.hexdigest() for phase, whole in hashes.items()},
        }


def make(name: str) -> None:
    """Make one of them, with nothing about the machine but its kind."""
    config = load(HERE / f"{name}.yaml")
    facts = {
        "run_id": name,
        "name": config.name,
        "seed": config.seeds[0],
        "created": "2026-01-01T00:00:00+00:00",
    }
    with tempfile.TemporaryDirectory() as folder:
        run = Run(Path(folder), facts | {"status": "running", "config": config.to_mapping()})
        done = session.run_job(Job(config, config.seeds[0]), run)
        done.recording.replace(HERE / f"{name}.mcap")


def make_loop(name: str) -> None:
    """Make the recording of a loop that acts at random, with all that a loop can record but frames."""
    with tempfile.TemporaryDirectory() as folder:
        env = make_env(LOOPS[name])
        with runner.record(env, folder, name=name, seed=5, info=["luck"], config={"kept": True}) as rec:
            for _ in play(rec, 150):
                pass
            rec.log("loss", 0.25)
            rec.log("note", "half way")
            rec.snapshot("weights", np.arange(6.0).reshape(2, 3))
            with rec.phase("eval"):
                for _ in play(rec, 30, seed=6):
                    pass
        rec.run.recording.replace(HERE / f"{name}.mcap")


def make_together(name: str) -> None:
    """Make the recording of a loop over environments side by side, or of a game of several agents."""
    with tempfile.TemporaryDirectory() as folder:
        if name == "vector":
            envs = SyncVectorEnv([lambda: make_env("CartPole-v1")] * 3)
            with runner.record_vector(envs, folder, name=name, seed=5) as rec:
                drive(rec, 80)
        else:
            with runner.record_parallel(Leaving(), folder, name=name, seed=5, info=["left"]) as rec:
                parallel(rec, 20)
        rec.run.recording.replace(HERE / f"{name}.mcap")


def made_by(with_command: bool = True) -> dict[str, str]:
    """Return a provenance with nothing about the machine but its kind."""
    packages = {f"package.{package}": version(package) for package in ("numpy", "numba", "llvmlite")}
    own = {"dualtaxi": runner.__version__, "python": platform.python_version()}
    return own | packages | {"machine": platform.machine()}


if __name__ == "__main__":
    os.environ[CODE_VARIABLE] = "off"
    session.provenance_entries = loop_run.provenance_entries = made_by
    for name in NAMES:
        make(name)
    for name in LOOPS:
        make_loop(name)
    for name in TOGETHER:
        make_together(name)
    found = {name: expectations(HERE / f"{name}.mcap") for name in NAMES}
    found |= {name: loop_expectations(HERE / f"{name}.mcap") for name in (*LOOPS, *TOGETHER)}
    (HERE / "digests.json").write_text(json.dumps(found, indent=1) + "\n")
