"""All about one run, as JSON can hold it: the output of `show --json` and of the service."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from runner.analysis.evaluations import evaluation_records, loop_summary, training_records
from runner.errors import RecordingError
from runner.recording.reader import Recording, open_recording
from runner.runs.run import Run


def describe_run(run: Run, report: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Return all about a run; only the contents of `run.json` if its recording is missing or unreadable.

    Args:
        run: the run.
        report: called with a sentence if the recording cannot be read.
    """
    if run.recording.is_file():
        try:
            with open_recording(run.recording) as recording:
                return describe_recorded(run, recording)
        except RecordingError as error:
            report(f"Only what run.json says: {error}")
    summary_keys = ("content_digest", "train_steps", "eval_steps", "episodes", "seconds")
    return {
        **_identity(run),
        **{key: run.summary.get(key) for key in summary_keys},
        "bytes": 0,
        "provenance": {},
        **{key: [] for key in ("tables", "eval", "optimality", "train")},
        "loop": None,
        "config": dict(run.file.config),
    }


def describe_recorded(run: Run, recording: Recording) -> dict[str, Any]:
    """Return all about a run whose recording is open."""
    summary, config = run.summary, dict(run.file.config)
    return {
        **_identity(run),
        "bytes": recording.size,
        "content_digest": summary.content_digest,
        "topic_digests": dict(summary.topic_digests) if "topic_digests" in summary else None,
        **{key: summary.get(key, count) for key, count in recording.done().items()},
        "seconds": summary.seconds,
        "config": config if config == recording.config else recording.config,  # run.json has the better order
        "provenance": recording.provenance,
        "success_events": recording.environment["success_events"],
        "tables": _tables(recording),
        "eval": evaluation_records(recording),
        "optimality": [
            {key: value for key, value in measures.items() if key != "log_time"}
            for measures in recording.optimality()
        ],
        "train": training_records(recording),
        "loop": None if recording.is_job else loop_summary(recording),
    }


def random_policy_sentence(recording: Recording) -> str:
    """Return what a random policy achieves in a recording's environment; empty where that is no measure.

    That is so of a loop, whose environment is not known as a table, and of a run that acts at random itself.
    It takes about a second unless it was computed for this environment before.
    """
    from runner.planning import random_baseline

    if not recording.is_job or recording.config["algorithm"] == "random":
        return ""
    baseline = random_baseline(recording.mdp)
    return baseline.sentence if baseline else ""


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


def _tables(recording: Recording) -> list[dict[str, Any]]:
    """Return the fill of each table as last reported; nothing of a loop, whose learning is its own."""
    if not recording.is_job:
        return []
    reports = [*recording.metrics("train"), *recording.metrics("eval")]
    last = max(reports, key=lambda report: report["step"], default=None)
    if last is None:
        return [{"agent": agent} for agent in recording.agents]
    return [
        {"agent": agent, "step": last["step"], "zero_cells": zero, "percent_filled": filled}
        for agent, zero, filled in zip(
            recording.agents, last["zero_cells"], last["percent_filled"], strict=True
        )
    ]
