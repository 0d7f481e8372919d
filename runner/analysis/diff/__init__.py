"""What differs between two runs: one object, which text, JSON, Markdown and HTML are made of.

with open_recording(path_a) as a, open_recording(path_b) as b:
    difference = diff(a, b)
print(difference.parting, difference.cause)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from runner.analysis.diff.causes import Cause, Row, Update, cause_of, kind_of
from runner.analysis.diff.loops import (
    comparable,
    loop_environment_diff,
    loop_means,
    loop_parting,
    parted_topics,
)
from runner.analysis.diff.metrics import MetricDiff, metric_diffs
from runner.analysis.diff.settings import (
    Change,
    EnvironmentDiff,
    TransitionChange,
    alike_in,
    changes_in,
    environment_diff,
)
from runner.analysis.diff.tables import Cell, TableDiff, table_diffs
from runner.analysis.diff.trajectory import (
    Overlap,
    Parting,
    evaluation_partings,
    training_overlap,
    training_parting,
    unbroken,
)
from runner.analysis.diff.visits import StateVisits, VisitsDiff, visits_diff
from runner.recording import schema
from runner.recording.reader import Recording

__all__ = [
    "Cause",
    "Cell",
    "Change",
    "EnvironmentDiff",
    "MetricDiff",
    "Overlap",
    "Parting",
    "Row",
    "RunDiff",
    "StateVisits",
    "TableDiff",
    "TransitionChange",
    "Update",
    "VisitsDiff",
    "can_compare_steps",
    "diff",
]

NOT_CONTENT = ("name", "recording")
"""Keys of the configuration whose difference alone leaves the content the same."""


PARTS = ("config", "provenance", "costs")
"""What of a `RunDiff` is a list of values by path."""


@dataclass(frozen=True)
class RunDiff:
    """Everything in which two runs differ; `a` and `b` say who they are."""

    a: dict[str, Any]
    b: dict[str, Any]
    same_content: bool
    """Whether both are finished and have the same content digest."""
    config: list[Change]
    provenance: list[Change]
    environment: EnvironmentDiff
    parting: Parting | None = None
    cause: Cause | None = None
    overlap: Overlap | None = None
    visits: VisitsDiff | None = None
    evaluations: list[tuple[Parting, Cause]] = field(default_factory=list)
    """The first evaluation that parts: where, and why; empty if none does."""
    loop_evaluation: Parting | None = None
    """The first step of evaluation at which somebody's own loops part."""
    tables: list[TableDiff] = field(default_factory=list)
    metrics: list[MetricDiff] = field(default_factory=list)
    costs: list[Change] = field(default_factory=list)
    """Steps, seconds and size."""
    alike: dict[str, dict[str, Any]] = field(default_factory=dict)
    """What is the same in both, by path, of config, provenance and costs."""
    ignored: list[str] = field(default_factory=list)
    """Paths of what differs, and was left out as asked."""
    notes: list[str] = field(default_factory=list)
    """What could not be compared, and why."""


def diff(
    a: Recording, b: Recording, targets: Mapping[str, float] | None = None, first: bool = False
) -> RunDiff:
    """Return in what two runs differ.

    Args:
        a: one run, finished or not.
        b: another.
        targets: metric to a level, whose first crossing is to be told.
        first: only settings, the first step of training at which they part, and what differs there; why the
            tables came to differ is left out.
    """
    if not (a.is_job and b.is_job):
        return _diff_of_loops(a, b)
    digests = [recording.result.content_digest for recording in (a, b)]
    same = digests[0] is not None and digests[0] == digests[1]
    notes = _notes(a, b)
    facts: dict[str, Any] = {
        "a": _who(a),
        "b": _who(b),
        "same_content": same,
        "environment": environment_diff(a.mdp, b.mdp),
        "notes": notes,
        **_values(a, b, ("config",) if first else PARTS),
    }
    if same:
        return RunDiff(**facts)
    seen = None
    if can_compare_steps(a, b):
        parting = training_parting(a, b)
        cause = None if parting is None else (kind_of if first else cause_of)(parting, a, b)
        facts |= {"parting": parting, "cause": cause}
        if not first:
            facts["overlap"], visits = training_overlap(a, b)
            facts["visits"] = visits_diff(a.mdp, *visits)
            seen = visits[0] + visits[1]
            known = None if parting is None or cause is None else (parting, cause)
            parted = next(evaluation_partings(a, b), None)
            facts["evaluations"] = [] if parted is None else [(parted, cause_of(parted, a, b, known))]
    if first:
        return RunDiff(**facts)
    facts["tables"] = list(table_diffs(a, b, seen)) if _same_sizes(a, b) else []
    facts["metrics"] = metric_diffs(a, b, targets or {})
    return RunDiff(**facts)


def _diff_of_loops(a: Recording, b: Recording) -> RunDiff:
    """Return in what two runs differ of which one is somebody's own loop."""
    digests = [recording.result.content_digest for recording in (a, b)]
    same = digests[0] is not None and digests[0] == digests[1]
    notes = ["recorded from a loop: what it learned is not known, so no cause and no tables are told"]
    alike = comparable(a, b)
    if not alike:
        notes.append("the environments have other spaces: no steps are compared")
    partings = [loop_parting(a, b, phase) if alike and not same else None for phase in ("train", "eval")]
    if alike and not any(partings) and (topics := parted_topics(a, b)):
        notes.append(f"all steps are the same; what differs is in {', '.join(topics)}")
    return RunDiff(
        a=_who(a),
        b=_who(b),
        same_content=same,
        environment=loop_environment_diff(a, b),
        parting=partings[0],
        loop_evaluation=partings[1],
        notes=notes,
        **_values(a, b, PARTS),
    )


def _values(a: Recording, b: Recording, parts: Sequence[str]) -> dict[str, Any]:
    """Return what differs in these parts of a `RunDiff`, nothing for the others; and what is alike."""
    jobs = a.is_job and b.is_job
    told = {
        "config": (_settings(a), _settings(b)),
        "provenance": (a.provenance, b.provenance),
        "costs": [_costs(one) | ({} if jobs else loop_means(one)) for one in (a, b)],
    }
    changes = {part: changes_in(*told[part]) if part in parts else [] for part in PARTS}
    return changes | {"alike": {part: alike_in(*told[part]) for part in parts}}


def _same_sizes(a: Recording, b: Recording) -> bool:
    """Return whether states and actions of both can be the same."""
    return a.mdp.next_state.shape[:2] == b.mdp.next_state.shape[:2]


def can_compare_steps(a: Recording, b: Recording) -> bool:
    """Return whether both have steps, of as many states and actions."""
    return _same_sizes(a, b) and all(recording.count(schema.TRAIN_STEP) for recording in (a, b))


def _who(recording: Recording) -> dict[str, Any]:
    run = recording.run
    named = {"run_id": run["run_id"], "name": recording.name, "seed": recording.seed}
    return named | {"status": recording.status}


def _settings(recording: Recording) -> dict[str, Any]:
    """Return the configuration with the run's own seed instead of the list."""
    settings = {key: value for key, value in recording.config.items() if key != "seeds"}
    return settings | {"seed": recording.seed}


def _costs(recording: Recording) -> dict[str, Any]:
    """Return steps taken, whether recorded or not, episodes, and the size of the file."""
    done = recording.done()
    return {
        "train_steps": done["train_steps"],
        "eval_steps": done["eval_steps"],
        "episodes": recording.count(schema.TRAIN_EPISODE),
        "bytes": recording.size,
    }


def _notes(a: Recording, b: Recording) -> list[str]:
    notes = []
    for name, recording in (("A", a), ("B", b)):
        if recording.status != "finished":
            notes.append(f"{name} is not finished: compared as far as it got")
        if recording.leaves_out_steps:
            again = f"`dualtaxi rerecord {recording.run_id}` records them"
            notes.append(f"{name} holds no steps, so no trajectory is compared; {again}")
        elif not recording.count(schema.TRAIN_STEP):
            notes.append(f"{name} has no training steps, so no trajectory of training is compared")
        whole = unbroken(recording)[0]
        if whole < recording.count(schema.TRAIN_STEP):
            notes.append(f"{name} lost steps from step {whole:,} on: training is compared up to there")
        if any(topic.startswith("/eval/") for topic in recording.lost):
            notes.append(f"{name} lost parts of evaluations: those that are not whole are not compared")
    if not _same_sizes(a, b):
        notes.append("the environments have other states or actions: neither steps nor tables are compared")
    elif len(a.agents) != len(b.agents):
        notes.append("other modes: rewards are compared summed, and Q-tables not at all")
    return notes
