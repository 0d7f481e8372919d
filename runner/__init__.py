"""Train tabular agents from a YAML file and record every step; replay, compare and archive the runs.

    import runner

    run = runner.run("quick")                              # train, and record every step
    print(runner.frames.evaluations(run))                  # its metrics as a pandas frame
    for run in runner.run_all("quick", overrides=["seeds=[1, 2, 3]"]):
        print(run.run_id, run.summary["content_digest"])

The names below are imported when they are first used, so that `import runner` is quick.
"""

from __future__ import annotations

import importlib
import sys
from typing import TYPE_CHECKING, Any

from runner.util import __version__

if TYPE_CHECKING:
    import runner.analysis.frames as frames  # noqa: PLR0402
    import runner.integrations as integrations  # noqa: PLR0402
    from runner.analysis.episodes import mark, unmark
    from runner.api import run, run_all
    from runner.config import ExperimentConfig
    from runner.debugging.branch import branch
    from runner.debugging.explain import explain
    from runner.debugging.what_if import what_if
    from runner.debugging.when import when
    from runner.debugging.why import why
    from runner.errors import RunnerError
    from runner.execution.rerecord import evaluate, rerecord
    from runner.execution.resume import resume
    from runner.execution.verify import verify
    from runner.export.notebook import plot, report
    from runner.loops.batches import record_batches
    from runner.loops.env import record, record_aec, record_parallel
    from runner.loops.vector import record_vector
    from runner.query.find import find
    from runner.query.sql import sql
    from runner.recording.gym_spaces import register_space
    from runner.recording.reader import Recording, open_recording
    from runner.runs.resolve import find_run
    from runner.runs.run import Run, label, list_runs

__all__ = [
    "ExperimentConfig",
    "Recording",
    "Run",
    "RunnerError",
    "__version__",
    "branch",
    "evaluate",
    "explain",
    "find",
    "find_run",
    "frames",
    "integrations",
    "label",
    "list_runs",
    "mark",
    "open_recording",
    "plot",
    "record",
    "record_aec",
    "record_batches",
    "record_parallel",
    "record_vector",
    "register_space",
    "report",
    "rerecord",
    "resume",
    "run",
    "run_all",
    "sql",
    "unmark",
    "verify",
    "what_if",
    "when",
    "why",
]

_HOME = {
    "ExperimentConfig": "runner.config",
    "Recording": "runner.recording.reader",
    "Run": "runner.runs.run",
    "RunnerError": "runner.errors",
    "branch": "runner.debugging.branch",
    "evaluate": "runner.execution.rerecord",
    "explain": "runner.debugging.explain",
    "find": "runner.query.find",
    "find_run": "runner.runs.resolve",
    "label": "runner.runs.run",
    "list_runs": "runner.runs.run",
    "mark": "runner.analysis.episodes",
    "open_recording": "runner.recording.reader",
    "plot": "runner.export.notebook",
    "record": "runner.loops.env",
    "record_aec": "runner.loops.env",
    "record_batches": "runner.loops.batches",
    "record_parallel": "runner.loops.env",
    "record_vector": "runner.loops.vector",
    "register_space": "runner.recording.gym_spaces",
    "report": "runner.export.notebook",
    "rerecord": "runner.execution.rerecord",
    "resume": "runner.execution.resume",
    "run": "runner.api",
    "run_all": "runner.api",
    "sql": "runner.query.sql",
    "unmark": "runner.analysis.episodes",
    "verify": "runner.execution.verify",
    "what_if": "runner.debugging.what_if",
    "when": "runner.debugging.when",
    "why": "runner.debugging.why",
}
"""The module of each public name that is not a module itself."""


def __getattr__(name: str) -> Any:
    if name == "frames":
        return importlib.import_module("runner.analysis.frames")
    if name == "integrations":
        return importlib.import_module("runner.integrations")
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


if "IPython" in sys.modules:  # a notebook or an IPython shell: show runs as reports
    from runner.export.notebook import register_formatters

    register_formatters()
