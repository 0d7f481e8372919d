"""All about one run: what `show`, the pages, reports and notebooks say of it."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Final

import numpy as np

from runner.analysis.contents import damage_of
from runner.analysis.evaluations import (
    EvaluationRecord,
    TrainingRecord,
    evaluation_records,
    evaluations_grid,
    loop_summary,
    training_records,
)
from runner.analysis.sections import Answer, Grid, Section
from runner.config.document import write_yaml
from runner.environments.naming import states_in_words
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.environment import Composition, composition_of
from runner.recording.machine import Clock, read_clock
from runner.recording.maker import Shard
from runner.recording.messages import Message
from runner.recording.reader import Recording, open_recording
from runner.recording.run_file import RecentTraining, Summary, has_environment
from runner.recording.spaces import Description
from runner.replay.recorded import RecordedReset, resets_of
from runner.runs.branches import Origin, origin_in
from runner.runs.catalogue.usage import FREED_BY, Sums, Usage
from runner.runs.checkpoints import Checkpoint, read_checkpoints
from runner.runs.run import Run, command_for
from runner.util.humanize import UNKNOWN, counted, duration, measure, number, size
from runner.util.processes import Tell
from runner.util.values import Json, JsonView

MAX_PROCESSES: Final = 16
"""Names of processes shown."""
MAX_CYCLES: Final = 8
"""Cycles of states shown, in which episodes reach the step limit."""


@dataclass(frozen=True)
class TableFill:
    """How full a learner's Q-table is, as last reported; None where nothing was."""

    agent: str
    step: int | None = None
    """Training steps before the report."""
    zero_cells: int | None = None
    percent_filled: float | None = None

    def __str__(self) -> str:
        if self.step is None:
            return UNKNOWN
        filled = f"{self.percent_filled:.1f} % filled, {self.zero_cells:,} cells are still zero"
        return f"{filled}, after {self.step:,} steps"

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
class RunDetails(Answer):
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
    damage: str = ""
    """What is wrong with `run.json` or with the recording, as far as reading it shows."""
    job: str = ""
    """The hash of its job."""
    spaces: str = ""
    """The spaces of a loop's environment, in words."""
    environments: int = 1
    branches: Mapping[str, Origin] = field(default_factory=dict)
    """Where its branches begin, by run id, if that was looked up."""

    def facts(self) -> dict[str, object]:
        """Return everything but the series, as JSON can hold it."""
        run = self.run
        summary = self.run.summary
        return {
            "run_id": run.run_id,
            "name": run.name,
            "seed": run.seed if run.has_seed else None,
            "status": run.status,
            "created": run.created_text,
            **({"damage": self.damage} if self.damage else {}),
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
        origin = origin_in(self.config)
        return self.facts() | {
            "origin": None if origin is None else asdict(origin),
            "branches": {name: asdict(branch) for name, branch in self.branches.items()},
            "eval": [record.as_json() for record in self.evaluations],
            "optimality": [dict(measures) for measures in self.optimality],
            "train": [record.as_json() for record in self.training],
            "checkpoints": [checkpoint.as_json() for checkpoint in self.checkpoints],
        }

    def sections(self) -> list[Section]:
        """Return what people see of the run: what it is, its results, its configuration and provenance."""
        first, *made = self.origin_sections()
        results = self.result_sections()
        if self.evaluations:
            grid = evaluations_grid(self.evaluations, self.success_events)
            results.insert(0, Section("Evaluations", grids=[grid]))
        return [first, *results, *made]

    def result_sections(self) -> list[Section]:
        """Return the results but the evaluations."""
        results = [
            Section("Last results", facts={} if self.loop is None else results_in_words(self.loop)),
            Section("Values recorded with steps", facts=_extras_in_words(self.extras)),
            Section("Branches", facts={name: str(origin) for name, origin in self.branches.items()}),
            Section("Greedy policy, exactly", facts=self._optimality()),
            Section("Tables", facts={table.agent: str(table) for table in self.tables}),
        ]
        if self.checkpoints:
            last = self.checkpoints[-1].reference
            listing = f"`{command_for(self.run, 'checkpoints')}` lists them."
            results.append(Section("Checkpoints", [f"{len(self.checkpoints):,}, the last {last}; {listing}"]))
        if self.run.marks:
            rows = [(mark.at, mark.text, " ".join(mark.tags)) for mark in self.run.marks]
            results.append(Section("Marks", grids=[Grid(("step", "text", "tags"), rows)]))
        return [section for section in results if section.facts or section.grids or section.sentences]

    def origin_sections(self) -> list[Section]:
        """Return what identifies the run, its configuration and its provenance."""
        given = {key: value for key, value in self.config.items() if value not in ([], {})}
        if (frames := given.get("frames")) and isinstance(frames, Mapping) and not frames.get("every"):
            del given["frames"]
        if not has_environment(given):
            given.pop("env", None)
        yaml = write_yaml(given, is_compact=True).rstrip()
        sections = [
            Section("The run", facts={name: text for name, text in self._identity().items() if text}),
            Section("Configuration", [yaml]),
            Section("Provenance", facts=brief_provenance(self.provenance)),
        ]
        return sections if self.provenance else sections[:2]

    def _identity(self) -> dict[str, str]:
        run = self.run
        summary = self.run.summary
        clock = self.clock
        origin = origin_in(self.config)
        environment = str(self.environment or "")
        folder = f"{run.folder}{os.sep}"
        steps = ""
        if environment and None not in (self.train_steps, self.episodes, self.eval_steps):
            ended = counted(self.episodes or 0, "episode")
            ended = f"in {ended}" if self.episodes or not self.train_steps else "(no episode ended)"
            steps = f"{self.train_steps:,} of training {ended}, "
            steps += f"{self.eval_steps:,} of evaluation"
        if self.environments > 1:
            environment += f", {self.environments:,} in parallel"
        time = ""
        if clock is not None and clock.duration > 0:
            rate = clock.steps_a_second if self.train_steps or self.eval_steps else None
            time = f"{duration(clock.duration)} recorded"
            time += "" if rate is None else f", {rate:,.0f} steps a second"
        took = "" if summary.seconds is None else f", took {duration(summary.seconds)}"
        by = self.config.get("made_by")
        return {
            "run": f"{run.run_id}  {run.title}",
            "status": f"{run.status}, begun {run.created:%Y-%m-%d %H:%M:%S} UTC{took}",
            "damage": self.damage.replace(folder, ""),
            "error": (summary.error or "").replace(folder, ""),
            "branch": "" if origin is None else f"of run {origin.run} {origin}",
            "processes": _processes(self.shards),
            "recorded": f"{'from a loop' if environment else 'logged values'}, by {by}" if by else "",
            "environment": environment,
            "spaces": self.spaces,
            "steps": steps,
            "first reset": "; ".join(
                f"{schema.PHASE_NAMES[phase]} with {reset.in_words}"
                for phase, reset in self.first_resets.items()
                if reset.in_words
            ),
            "time": time,
            "job": self.job,
            "digest": summary.content_digest or f"{UNKNOWN} (written when a run ends properly)",
            "size": size(self.bytes) if self.bytes else "no recording",
        }

    def _optimality(self) -> dict[str, str]:
        """Return the last exact measures, next to the optimum; empty without any."""
        if not self.optimality:
            return {}
        measures = self.optimality[-1]
        with open_recording(self.run.recording) as recording:
            states = states_in_words(recording.mdp)
            gains = zip(recording.agents, measures["values"], measures["best_responses"], strict=True)
        gain = " and ".join(f"{best - learned:.3f} ({agent})" for agent, learned, best in gains)
        rows = {
            "succeeds": f"{measures['success_percent']:.1f} % of {measures['starts']:,} start states "
            f"(the optimum {measures['optimal_success_percent']:.1f} %)",
            "length": f"{measures['mean_length']:.2f} steps "
            f"(the optimum {measures['optimal_mean_length']:.2f})",
            "value": f"{sum(measures['values']):.3f} of {measures['optimal_value']:.3f} that are possible",
            "to gain": f"{gain}, by a best response",
        }
        cycles = zip(*(measures[f"cycle_{key}"] for key in ("states", "lengths", "percents")), strict=True)
        lines = [
            f"{percent:.1f} %  {f'round {length} states' if length > 1 else 'one state'}: {states[state]}"
            for state, length, percent in cycles
        ]
        if len(lines) > MAX_CYCLES:
            lines[MAX_CYCLES:] = [f"and {len(lines) - MAX_CYCLES:,} more cycles (--json)"]
        return rows | ({"stuck in": "\n".join(lines)} if lines else {})


def describe_run(run: Run, report: Tell = lambda _: None, with_results: bool = True) -> RunDetails:
    """Return all about a run; `report` is called with a sentence if the recording cannot be read."""
    summary, damage = run.summary, run.problem
    if run.recording.is_file():
        try:
            with open_recording(run.recording) as recording:
                return describe_recording(run, recording, with_results)
        except RecordingError as error:
            report(f"Only what run.json says: {error}")
            damage = damage or str(error)
    known = summary.episodes, summary.train_steps, summary.eval_steps
    return RunDetails(run, run.file.config, *known, damage=damage)


def describe_recording(run: Run, recording: Recording, with_results: bool = True) -> RunDetails:
    """Return all about a run whose recording is open; without the results it takes no time.

    Raises:
        RecordingError: it is damaged.
    """
    config = run.file.config
    is_loop = not recording.can_train_again
    done = recording.done() | {key: run.summary[key] for key in recording.done() if key in run.summary}
    spaces = recording.spaces if is_loop and has_environment(recording.config) else {}
    details = RunDetails(
        run,
        config if config == recording.config else recording.config,  # the former in better order
        **done,
        environment=composition_of(recording),
        bytes=recording.file.size,
        shards=recording.shards,
        clock=read_clock(recording),
        provenance=recording.provenance,
        success_events=tuple(recording.environment["success_events"]),
        first_resets={
            phase: reset
            for phase in schema.PHASES
            if (reset := next(resets_of(recording, phase), None)) is not None
        },
        damage=run.problem or damage_of(run, recording),
        job=recording.run["job"],
        spaces=", ".join(f"{name} {space['type']}" for name, space in spaces.items()),
        environments=recording.environments,
    )
    if not with_results:
        return details
    return replace(
        details,
        tables=_tables(recording),
        evaluations=tuple(evaluation_records(recording)),
        optimality=tuple(
            {key: value for key, value in measures.items() if key != "log_time"}
            for measures in recording.table(schema.OPTIMALITY_TOPIC).decoded()
        ),
        training=tuple(training_records(recording)),
        loop=None if recording.eval.has_metrics else loop_summary(recording),
        extras=_extras(recording),
        checkpoints=tuple(read_checkpoints(recording, run.folder.parent)),
    )


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


def _processes(shards: Sequence[Shard]) -> str:
    """Return the names of the processes that recorded a run, and how they ended if not properly."""
    ill = [shard for shard in shards[1:] if shard.status != "finished"]  # the run has the status of the first
    names = [shard.name or "the one that began the run" for shard in shards[:MAX_PROCESSES]]
    more = [f"{len(shards) - MAX_PROCESSES:,} more"] if len(shards) > MAX_PROCESSES else []
    ends = [f"{shard.name} {shard.status}" for shard in ill[:MAX_PROCESSES]]
    ends += [f"{len(ill) - MAX_PROCESSES:,} more"] if len(ill) > MAX_PROCESSES else []
    return "; ".join(", ".join(part) for part in (names + more, ends) if part)


def results_in_words(loop: Summary) -> dict[str, str]:
    """Return the known means of a loop's last training episodes, and the values it logged last."""
    recent = loop.recent_training or RecentTraining(episodes=0)
    episodes = counted(recent.episodes or 0, "training episode").removeprefix("1 ")
    means = {
        f"Mean return of the last {episodes}": number(recent.mean_return),
        f"Mean length of the last {episodes}": f"{number(recent.mean_length)} steps",
    }
    logged = {f"Logged last: {name}": measure(value) for name, value in loop.logged.items()}
    return {name: text for name, text in means.items() if UNKNOWN not in text} | logged


def usage_sections(largest: Sequence[Usage], sums: Sums, freeable: Mapping[str, int]) -> Iterator[Section]:
    """Yield the disk usage of the largest runs and of all, and what could be freed."""
    total = sums.bytes
    kinds = [kind for kind, count in total.items() if count or kind == "total"]

    def cells(counts: dict[str, int]) -> list[str]:
        return [size(counts[kind]) if counts[kind] else UNKNOWN for kind in kinds]

    same_as = ["same as"] if any(usage.row["same_as"] for usage in largest) else []
    left = ("id", "name", "status", "same as")
    rows, links = [], []
    for usage in largest:
        row = usage.row
        originals = [row["same_as"] or ""] if same_as else []
        rows.append((row["id"], row["name"], row["status"], *cells(usage.bytes), *originals))
        links.append(f"/runs/{row['id']}")
    if sums.runs > len(largest):
        rest = {kind: total[kind] - sum(usage.bytes[kind] for usage in largest) for kind in kinds}
        rows.append((f"{sums.runs - len(largest):,} more", "", "", *cells(rest), *[""] * len(same_as)))
        links.append("")
    rows.append(("all", "", "", *cells(total), *[""] * len(same_as)))
    headings = ("id", "name", "status", *kinds, *same_as)
    links.append("")
    grid = Grid(headings, rows, links=links, left=left, cut=("name",), status="status", runs="same as")
    yield Section("", grids=[grid])
    reasons = {
        FREED_BY[kind][0]: f"{size(count)}. {FREED_BY[kind][1]}" for kind, count in freeable.items() if count
    }
    if reasons:
        yield Section("Could be freed", facts=reasons)


def _extras_in_words(extras: Mapping[str, RecordedExtras]) -> dict[str, str]:
    """Return the number of steps with extras, and dtype and shape of each name: `int64 [T]`."""
    rows = {f"{schema.PHASE_NAMES[phase]} steps": f"{recorded.steps:,}" for phase, recorded in extras.items()}
    for recorded in extras.values():
        for name, (dtype, shape) in recorded.names.items():
            lengths = ", ".join("T" if n is None else str(n) for n in shape)
            rows[name] = f"{dtype} [{lengths}]" if shape else dtype
    return rows
