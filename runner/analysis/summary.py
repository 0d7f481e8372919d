"""All about one run: what `show` and the service report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from runner.analysis.evaluations import (
    EvaluationRecord,
    TrainingRecord,
    evaluation_records,
    loop_summary,
    training_records,
)
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.clock import Clock, read_clock
from runner.recording.composition import Composition, composition_of
from runner.recording.maker import Shard
from runner.recording.messages import Message
from runner.recording.reader import Recording, open_recording
from runner.recording.run_file import Summary
from runner.recording.spaces import Description
from runner.replay.recorded import RecordedReset, resets_of
from runner.runs.checkpoints import Checkpoint, read_checkpoints
from runner.runs.run import Run
from runner.util.processes import Tell
from runner.util.values import Json, JsonView


@dataclass(frozen=True)
class TableFill:
    """How full a learner's Q-table is, as last reported; None where nothing was."""

    agent: str
    step: int | None = None
    """Training steps before the report."""
    zero_cells: int | None = None
    percent_filled: float | None = None

    def as_json(self) -> Json:
        """Return what is known, by name."""
        return {name: value for name, value in vars(self).items() if value is not None}


@dataclass(frozen=True)
class RecordedExtras:
    """The values that a loop recorded with the steps of a phase."""

    steps: int
    """The number of steps with such values."""
    names: Mapping[str, tuple[str, tuple[int | None, ...]]]
    """Name to dtype, or `str`, and shape, which begins with None where the first axis varies in length."""

    def as_json(self) -> Json:
        """Return it as JSON can hold it."""
        names = {name: {"dtype": dtype, "shape": list(shape)} for name, (dtype, shape) in self.names.items()}
        return {"steps": self.steps, "names": names}


@dataclass(frozen=True)
class RunDetails:
    """All about a run; if its recording is missing or unreadable, only the contents of `run.json`."""

    run: Run
    config: JsonView
    episodes: int | None = None
    train_steps: int | None = None
    eval_steps: int | None = None
    environment: Composition | None = None
    """What its environment consists of; None if it has none, or its recording cannot be read."""
    bytes: int = 0
    """Size of the recording; 0 if it is missing or unreadable."""
    provenance: Mapping[str, str] = field(default_factory=dict)
    success_events: tuple[str, ...] = ()
    tables: tuple[TableFill, ...] = ()
    evaluations: tuple[EvaluationRecord, ...] = ()
    optimality: tuple[Message, ...] = ()
    """The exact measures of the evaluations."""
    training: tuple[TrainingRecord, ...] = ()
    loop: Summary | None = None
    """The last results of a loop; None for a job."""
    extras: Mapping[str, RecordedExtras] = field(default_factory=dict)
    """The values that a loop recorded with the steps of each phase, where there are some."""

    first_resets: Mapping[str, RecordedReset] = field(default_factory=dict)
    """The first reset of each phase of a loop that has one."""
    checkpoints: tuple[Checkpoint, ...] = ()
    """What a loop kept of its agent."""
    shards: tuple[Shard, ...] = ()
    """The processes that recorded a loop together; empty if it was one."""
    clock: Clock | None = None
    """The time that was recorded; None without samples."""

    def facts(self) -> dict[str, object]:
        """Return everything but the series, as JSON can hold it."""
        run, summary = self.run, self.run.summary
        return {
            "run_id": run.run_id,
            "name": run.name,
            "seed": run.seed if run.has_seed else None,
            "status": run.status,
            "created": run.created_text,
            **({"damage": run.problem} if run.problem else {}),
            "path": str(run.recording.absolute()),
            "bytes": self.bytes,
            "content_digest": summary.content_digest,
            "topic_digests": dict(summary.topic_digests) if "topic_digests" in summary else None,
            **{key: getattr(self, key) for key in ("episodes", "train_steps", "eval_steps")},
            "environment": None if self.environment is None else self.environment.as_json(),
            "seconds": summary.seconds,
            "recorded_seconds": None if self.clock is None else self.clock.duration,
            "steps_a_second": None if self.clock is None else self.clock.steps_a_second,
            "processes": [vars(shard) for shard in self.shards],
            "marks": [mark.as_row() for mark in run.marks],
            "config": dict(self.config),
            "provenance": dict(self.provenance),
            "success_events": list(self.success_events),
            "tables": [table.as_json() for table in self.tables],
            "loop": None if self.loop is None else _loop_as_json(self.loop),
            "extras": {phase: extras.as_json() for phase, extras in self.extras.items()},
            "first_resets": {phase: reset.arguments for phase, reset in self.first_resets.items()},
        }

    def as_json(self) -> Json:
        """Return everything, as JSON can hold it."""
        return self.facts() | {
            "eval": [record.as_json() for record in self.evaluations],
            "optimality": [dict(measures) for measures in self.optimality],
            "train": [record.as_json() for record in self.training],
            "checkpoints": [checkpoint.as_json() for checkpoint in self.checkpoints],
        }


def describe_run(run: Run, report: Tell = lambda _: None) -> RunDetails:
    """Return all about a run; `report` is called with a sentence if the recording cannot be read."""
    summary, config = run.summary, run.file.config
    if run.recording.is_file():
        try:
            with open_recording(run.recording) as recording:
                done = recording.done() | {key: summary[key] for key in recording.done() if key in summary}
                return RunDetails(
                    run,
                    config if config == recording.config else recording.config,  # the former in better order
                    **done,
                    environment=composition_of(recording),
                    bytes=recording.file.size,
                    shards=recording.shards,
                    clock=read_clock(recording),
                    provenance=recording.provenance,
                    success_events=tuple(recording.environment["success_events"]),
                    tables=_tables(recording),
                    evaluations=tuple(evaluation_records(recording)),
                    optimality=tuple(
                        {key: value for key, value in measures.items() if key != "log_time"}
                        for measures in recording.table(schema.OPTIMALITY_TOPIC).decoded()
                    ),
                    training=tuple(training_records(recording)),
                    loop=None if recording.eval.has_metrics else loop_summary(recording),
                    extras=_extras(recording),
                    first_resets={
                        phase: reset
                        for phase in schema.PHASES
                        if (reset := next(resets_of(recording, phase), None)) is not None
                    },
                    checkpoints=tuple(read_checkpoints(recording, run.folder.parent)),
                )
        except RecordingError as error:
            report(f"Only what run.json says: {error}")
    return RunDetails(run, config, summary.episodes, summary.train_steps, summary.eval_steps)


def _extras(recording: Recording) -> dict[str, RecordedExtras]:
    return {
        phase: RecordedExtras(extras.count, {name: _kind(column) for name, column in extras.columns.items()})
        for phase in schema.PHASES
        if (extras := recording.phase(phase).extras)
    }


def _kind(column: Description) -> tuple[str, tuple[int | None, ...]]:
    """Return dtype and shape of an extra."""
    if column["type"] == "Text":
        return "str", ()
    return np.dtype(column["dtype"]).name, tuple(column["shape"])


def brief_provenance(provenance: Mapping[str, str]) -> dict[str, str]:
    """Return provenance with the number of packages in place of each one's version."""
    packages = sum(key.startswith("package.") for key in provenance)
    brief = {key: text for key, text in provenance.items() if not key.startswith("package.")}
    return brief | ({"packages": f"{packages:,}"} if packages else {})


def random_policy_sentence(recording: Recording) -> str:
    """Return what a random policy achieves in a recording's environment; empty where that is no measure.

    It is none for a loop, as its environment is not known as a table, and for a run that acts at random.
    Computing it takes about a second unless it was computed for this environment before.
    """
    from runner.planning.baseline import random_baseline

    if recording.config.get("algorithm", "random") == "random":
        return ""
    baseline = random_baseline(recording.mdp)
    return baseline.sentence if baseline else ""


def _loop_as_json(loop: Summary) -> Json:
    last, recent = loop.last_evaluation, loop.recent_training
    return {
        "last_evaluation": last.as_json() if last else None,
        "recent_training": vars(recent) if recent else None,
        "logged": dict(loop.logged),
    }


def _tables(recording: Recording) -> tuple[TableFill, ...]:
    """Return the fill of each table; a loop has none that the runner knows."""
    reports = [*recording.train.all_metrics(), *recording.eval.all_metrics()]
    last = max(reports, key=lambda report: report["step"], default=None)
    if last is None:
        return tuple(map(TableFill, recording.agents if recording.table(schema.Q_TABLE_TOPIC) else ()))
    fill = zip(recording.agents, last["zero_cells"], last["percent_filled"], strict=True)
    return tuple(TableFill(agent, last["step"], zero, filled) for agent, zero, filled in fill)
