"""All about one run, as JSON can hold it: what `show` prints and the service answers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from runner.analysis.evaluations import evaluation_records, loop_summary, training_records
from runner.errors import RecordingError
from runner.recording.reader import Recording, open_recording
from runner.runs.run import Run


def described(run: Run, tell: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Return all about a run; what `run.json` says where its recording is missing or cannot be read."""
    if run.recording.is_file():
        try:
            with open_recording(run.recording) as recording:
                return describe(run, recording)
        except RecordingError as error:
            tell(f"Only what run.json says: {error}")
    return _without_recording(run)


def describe(run: Run, recording: Recording) -> dict[str, Any]:
    """Return all about a run as JSON can hold it."""
    summary = run.summary
    return {
        **_identity(run),
        "bytes": recording.size,
        "content_digest": summary.content_digest,
        "topic_digests": dict(summary.topic_digests) if "topic_digests" in summary else None,
        **{key: summary.get(key, count) for key, count in recording.done().items()},
        "seconds": summary.seconds,
        "config": _config(run, recording),
        "provenance": recording.provenance,
        "success_events": recording.environment["success_events"],
        "tables": _tables(recording),
        "eval": evaluation_records(recording),
        "optimality": [_without_times(measures) for measures in recording.optimality()],
        "train": training_records(recording),
        "loop": None if recording.is_job else loop_summary(recording),
    }


def random_policy_sentence(recording: Recording) -> str:
    """Return what a random policy achieves in a recording's environment; empty where that says nothing.

    It says nothing of a loop, whose environment is not known as a table, and of a run that acts at random
    itself. It takes about a second unless it was computed for this environment before.
    """
    from runner.planning import random_baseline

    if not recording.is_job or recording.config["algorithm"] == "random":
        return ""
    baseline = random_baseline(recording.mdp)
    return baseline.sentence if baseline else ""


def _config(run: Run, recording: Recording) -> dict[str, Any]:
    """Return the recording's configuration, in the order of keys in which people read it."""
    readable = dict(run.file.config)
    return readable if readable == recording.config else recording.config


def _identity(run: Run) -> dict[str, Any]:
    return {
        "run_id": run.run_id,
        "name": run.name,
        "seed": run.seed if run.has_seed else None,
        "status": run.status,
        "created": run.created_text,
        **({"damage": run.problem} if run.problem else {}),
        "path": str(run.recording.absolute()),
    }


def _without_recording(run: Run) -> dict[str, Any]:
    """Return what `run.json` alone tells: the run never came to record anything, or its file is gone."""
    unknown = dict.fromkeys(("content_digest", "train_steps", "eval_steps", "episodes", "seconds"))
    nothing: dict[str, Any] = {"bytes": 0, "provenance": {}}
    nothing |= {part: [] for part in ("tables", "eval", "optimality", "train")} | {"loop": None}
    told = {key: run.summary.get(key) for key in unknown}
    return {**_identity(run), **told, **nothing, "config": dict(run.file.config)}


def _tables(recording: Recording) -> list[dict[str, Any]]:
    """Return size and fill of each table, as last reported."""
    if not recording.is_job:
        return []  # what a loop learned is its own
    reports = [*recording.metrics("train"), *recording.metrics("eval")]
    last = max(reports, key=lambda report: report["step"], default=None)
    agents = recording.agents
    if last is None:
        return [{"agent": agent} for agent in agents]
    return [
        {"agent": agent, "step": last["step"], "zero_cells": zero, "percent_filled": filled}
        for agent, zero, filled in zip(agents, last["zero_cells"], last["percent_filled"], strict=True)
    ]


def _without_times(measures: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in measures.items() if key != "log_time"}
