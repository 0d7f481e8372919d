"""What differs between two runs: one object, from which text, JSON, Markdown and HTML are rendered.

with open_recording(path_a) as a, open_recording(path_b) as b:
    difference = diff(a, b)
    print(difference.divergence, difference.cause)
"""

from __future__ import annotations

import fnmatch
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Final, TypedDict

import numpy as np
from numpy.typing import NDArray

from runner.analysis.contents import why_no_steps
from runner.analysis.diff.causes import Cause, branch_relation, find_cause, find_kind, with_branch
from runner.analysis.diff.code import FileChange, code_changes
from runner.analysis.diff.divergence import (
    Divergence,
    branch_divergence,
    evaluation_divergences,
    have_same_spaces,
    loop_divergence,
    training_divergence,
    unbroken,
)
from runner.analysis.diff.extent import (
    ActionDiff,
    MetricDiff,
    Overlap,
    TableDiff,
    VisitsDiff,
    metric_diffs,
    table_diffs,
    training_overlap,
    visits_diff,
)
from runner.environments.mdp import Mdp
from runner.environments.naming import actions_in_words, states_in_words
from runner.recording import schema
from runner.recording.reader import Recording
from runner.runs.branches import BranchOrigin, origin_in, training_branches
from runner.runs.checkpoints import read_checkpoints
from runner.runs.run import Run
from runner.util.arrays import Array
from runner.util.differences import Change, changes_in, equal_values
from runner.util.values import Json

NOT_CONTENT: Final = ("name", "recording")
"""Keys of the configuration whose difference alone leaves the content the same."""
_BY_PATH: Final = ("config", "provenance", "costs")
"""Fields of a `RunDiff` that list values by path."""
_MAX_EXAMPLES: Final = 10
"""Differing transitions that are described."""


class Identity(TypedDict):
    """What identifies a run."""

    run_id: str
    name: str
    seed: int | None
    status: str


@dataclass(frozen=True)
class EnvironmentDiff:
    """How two environments differ."""

    description: list[Change]
    transitions: int = 0
    """How many (state, action) pairs have other outcomes."""
    of: int = 0
    """How many pairs there are; 0 if the environments have other states or actions."""
    examples: list[ActionDiff[str]] = field(default_factory=list)
    """Some of these pairs, and descriptions of their outcomes."""
    other_starts: bool = False
    """Whether episodes start elsewhere."""

    @property
    def same(self) -> bool:
        """Whether nothing differs."""
        return not (self.description or self.transitions or self.other_starts)


@dataclass(frozen=True, kw_only=True)
class RunDiff:
    """All differences of two runs, `a` and `b`."""

    a: Identity
    b: Identity
    same_content: bool
    """Whether both are finished and have the same content digest."""
    config: list[Change]
    provenance: list[Change]
    environment: EnvironmentDiff
    code: list[FileChange]
    """The files of the user's code that differ."""
    divergence: Divergence | None = None
    """The first step of training that differs."""
    cause: Cause | None = None
    """Why it differs; None for loops, whose learning is unknown, but for a loop and a branch of it."""
    overlap: Overlap | None = None
    visits: VisitsDiff | None = None
    evaluation_divergence: Divergence | None = None
    """The first step of evaluation that differs."""
    evaluation_cause: Cause | None = None
    tables: list[TableDiff] = field(default_factory=list)
    metrics: list[MetricDiff] = field(default_factory=list)
    costs: list[Change]
    """Steps, seconds and size."""
    alike: dict[str, dict[str, object]]
    """What is the same in both, by path, of config, provenance and costs."""
    ignored: list[str] = field(default_factory=list)
    """Paths that differ but were excluded by the options."""
    notes: list[str] = field(default_factory=list)
    """What could not be compared, and why."""
    not_compared: list[str] = field(default_factory=list)
    """Titles of the sections without anything to compare, or left out by `first`."""


def diff(
    a: Recording, b: Recording, targets: Mapping[str, float] | None = None, first: bool = False
) -> RunDiff:
    """Return how two runs differ, finished or not.

    The first crossing of each target, metric to level, is reported. `first` compares only settings, and where
    and in what training first diverges, not the tables.
    """
    digest = a.result.content_digest
    are_jobs = _are_jobs(a, b)
    by_path: dict[str, list[Mapping[str, object]]] = {"config": [_settings(run) for run in (a, b)]}
    if not (first and are_jobs):
        by_path["provenance"] = [run.provenance for run in (a, b)]
        by_path["costs"] = [_costs(run) for run in (a, b)]
    changes = {name: changes_in(*values) for name, values in by_path.items()}
    difference = RunDiff(
        a=_identity(a),
        b=_identity(b),
        same_content=digest is not None and digest == b.result.content_digest,
        environment=environment_diff(a.mdp, b.mdp)
        if are_jobs
        else EnvironmentDiff(changes_in(*({"spaces": run.spaces, **run.environment} for run in (a, b)))),
        code=[] if first and are_jobs else code_changes(a, b),
        config=changes["config"],
        provenance=changes.get("provenance", []),
        costs=changes.get("costs", []),
        alike={name: equal_values(*values) for name, values in by_path.items()},
    )
    if are_jobs:
        difference = _diff_jobs(difference, a, b, targets or {}, first)
    elif (branch := _branch_of_the_other(a, b)) is not None:
        difference = _diff_branch(difference, a, b, *branch)
    else:
        difference = _diff_loops(difference, a, b, None if first else targets or {})
    if targets and not difference.metrics:
        difference.notes.append("no metrics are compared, so the levels of targets are not looked for")
    return replace(difference, not_compared=_not_compared(difference, a, b, first))


def _branch_of_the_other(a: Recording, b: Recording) -> tuple[Cause, BranchOrigin] | None:
    """Return why two loops differ of which one is a branch of the other, and where; None if neither is."""
    for branch, parent, names in ((b, a, "B is a branch of A"), (a, b, "A is a branch of B")):
        origin = origin_in(branch.config)
        if (
            isinstance(origin, BranchOrigin)
            and origin.run == parent.run_id
            and have_same_spaces(a, b)
            and a.train.steps.dtype is not None
        ):
            return Cause("branch", f"{names}, {origin}"), origin
    return None


def _not_compared(difference: RunDiff, a: Recording, b: Recording, first: bool) -> list[str]:
    """Return the titles of the sections that have nothing to compare, or that `first` leaves out."""
    are_jobs = _are_jobs(a, b)
    is_same = difference.same_content
    has_steps = can_compare_steps(a, b)
    known = {
        "Training": is_same or has_steps,
        "Evaluation": is_same or (has_steps and not (are_jobs and first)),
        "Q-tables": are_jobs and (is_same or bool(difference.tables)),
        "Metrics": is_same or bool(difference.metrics),
    } | dict.fromkeys(("Costs", "Code", "Provenance"), not (are_jobs and first))
    return [title for title, is_known in known.items() if not is_known]


def _diff_jobs(
    difference: RunDiff, a: Recording, b: Recording, targets: Mapping[str, float], first: bool
) -> RunDiff:
    """Add to the difference of two jobs where and why they diverge, their tables and their metrics."""
    difference = replace(difference, notes=_notes(a, b))
    if difference.same_content:
        return difference
    visits = None
    relation = branch_relation(a, b)
    if can_compare_steps(a, b):
        divergence = training_divergence(a, b)
        cause = None
        if divergence is not None:
            cause = find_kind(divergence, a, b) if first else find_cause(divergence, a, b)
            cause = with_branch(cause, divergence, relation)
        difference = replace(difference, divergence=divergence, cause=cause)
        if not first:
            overlap, (visits_a, visits_b) = training_overlap(a, b)
            visits = visits_a + visits_b
            difference = replace(difference, overlap=overlap, visits=visits_diff(a.mdp, visits_a, visits_b))
            training = None if divergence is None or cause is None else (divergence, cause)
            if (divergence_in_trials := next(evaluation_divergences(a, b), None)) is not None:
                why = find_cause(divergence_in_trials, a, b, training)
                difference = replace(
                    difference, evaluation_divergence=divergence_in_trials, evaluation_cause=why
                )
    if relation is not None and difference.divergence is None:
        difference.notes.append(relation.text)
    if first:
        return difference
    tables = list(table_diffs(a, b, visits)) if _same_sizes(a, b) else []
    return replace(difference, tables=tables, metrics=metric_diffs(a, b, targets))


def _diff_branch(
    difference: RunDiff, a: Recording, b: Recording, cause: Cause, origin: BranchOrigin
) -> RunDiff:
    """Add to the difference of a loop and a branch of it where the branched episode diverges."""
    difference = replace(difference, notes=["of the parent only the branched episode is compared"])
    if (divergence := branch_divergence(a, b, origin)) is None:
        return difference
    if origin.phase == "train":
        return replace(difference, divergence=divergence, cause=cause)
    return replace(difference, evaluation_divergence=divergence, evaluation_cause=cause)


def _diff_loops(
    difference: RunDiff, a: Recording, b: Recording, targets: Mapping[str, float] | None
) -> RunDiff:
    """Add to the difference of two runs, of which one is a loop, where they diverge; with targets metrics."""
    if difference.same_content:
        return difference
    if targets is not None:
        difference = replace(difference, metrics=metric_diffs(a, b, targets))
    if not have_same_spaces(a, b):
        return replace(difference, notes=["the environments have other spaces: no steps are compared"])
    runs = {"A": a, "B": b}
    notes = [_left_out(name, run) for name, run in runs.items() if run.leaves_out_steps]
    notes += _differing_checkpoints(a, b)
    train, evaluation = (loop_divergence(a, b, phase) for phase in schema.PHASES)
    if train or evaluation:
        settings = [change for change in difference.config if change.path.split(".")[0] not in NOT_CONTENT]
        if not (difference.code or settings):
            notes.append("how a loop learns is not recorded, so only where they diverge is known, not why")
    elif (ours := a.result.topic_digests) and (theirs := b.result.topic_digests):
        topics = [name for name in sorted(ours.keys() | theirs.keys()) if ours.get(name) != theirs.get(name)]
        compared = "actions" if any(run.leaves_out_steps for run in runs.values()) else "steps"
        if topics and (compared == "steps" or (a.has_actions and b.has_actions)):
            notes.append(f"all {compared} are the same; what differs is in {', '.join(topics)}")
    return replace(difference, divergence=train, evaluation_divergence=evaluation, notes=notes)


def _differing_checkpoints(a: Recording, b: Recording) -> list[str]:
    """Return a note on the checkpoints of both runs that differ, and the first of them; none if all agree."""
    ours, theirs = [
        {
            (checkpoint.phase, checkpoint.reference): checkpoint.digest
            for checkpoint in read_checkpoints(recording, recording.path.parent)
        }
        for recording in (a, b)
    ]
    shared = [key for key in ours if key in theirs]
    differing = [key for key in shared if ours[key] != theirs[key]]
    if not differing:
        return []
    count = f"of the checkpoints of both runs, {len(differing):,} of {len(shared):,} differ"
    return [f"{count}, the first of them {differing[0][1]}"]


def _left_out(name: str, recording: Recording) -> str:
    """Return what a recording left out of its steps, and what is compared instead."""
    if recording.has_actions:
        again = f"`dualtaxi rerecord {recording.run_id}` records them whole"
        return f"{name} holds the actions of its steps alone, which are compared; {again}"
    return f"{name} holds no steps, so none are compared: {why_no_steps(recording)}"


def with_seconds(difference: RunDiff, a: Run, b: Run) -> RunDiff:
    """Return the difference with the duration of the runs, which recordings do not hold."""
    seconds = [{"seconds": run.summary.get("seconds")} for run in (a, b)]
    return replace(difference, costs=[*difference.costs, *changes_in(*seconds)])


def without_ignored(difference: RunDiff, ignore: Sequence[str], everything: bool = False) -> RunDiff:
    """Return the difference without the paths that match a pattern; they are listed as ignored.

    With `everything`, what is alike stays.
    """

    def is_ignored(path: str) -> bool:
        return any(fnmatch.fnmatchcase(path, pattern) for pattern in ignore)

    by_field: dict[str, list[Change]] = {name: getattr(difference, name) for name in _BY_PATH}
    left: dict[str, Any] = {
        name: [change for change in changes if not is_ignored(change.path)]
        for name, changes in by_field.items()
    }
    alike = {
        name: {path: value for path, value in values.items() if not is_ignored(path)}
        for name, values in difference.alike.items()
        if everything
    }
    paths = [change.path for changes in by_field.values() for change in changes]
    return replace(difference, **left, alike=alike, ignored=[path for path in paths if is_ignored(path)])


def as_json(difference: RunDiff) -> Json:
    """Return the difference as JSON can hold it, without the whole records of steps."""
    facts = asdict(difference)
    for divergence in (facts["divergence"], facts["evaluation_divergence"]):
        if divergence is not None:
            del divergence["a_step"], divergence["b_step"]
    return facts


def can_compare_steps(a: Recording, b: Recording) -> bool:
    """Return whether two runs have recorded training steps of the same states and actions, or spaces."""
    are_alike = _same_sizes(a, b) if _are_jobs(a, b) else have_same_spaces(a, b)
    return are_alike and bool(a.train.steps and b.train.steps)


def divergences(a: Recording, b: Recording) -> Iterator[Divergence]:
    """Yield the first steps of training and of evaluation at which two runs diverge, if they do.

    Runs diverge in training, too, where one has no more steps; the divergence has no step of that run then.
    """
    if _are_jobs(a, b):
        both = [training_divergence(a, b), next(evaluation_divergences(a, b), None)]
    else:
        both = [loop_divergence(a, b, phase) for phase in schema.PHASES]
    yield from filter(None, both)


def _are_jobs(a: Recording, b: Recording) -> bool:
    """Return whether tables of both runs can be replayed, so that a cause of a divergence can be found."""
    return a.has_tables and b.has_tables


def _same_sizes(a: Recording, b: Recording) -> bool:
    return a.mdp.next_state.shape[:2] == b.mdp.next_state.shape[:2]


def _identity(recording: Recording) -> Identity:
    return {
        "run_id": recording.run_id,
        "name": recording.name,
        "seed": recording.seed,
        "status": recording.status,
    }


def _settings(recording: Recording) -> dict[str, object]:
    """Return the configuration of a run, in which a branch has its origin as one text."""
    config = {key: value for key, value in recording.config.items() if key != "seeds"}
    config["seed"] = recording.seed
    origin = origin_in(recording.config)
    loop = config.get("config")
    if branches := training_branches(recording.config):
        config["branches"] = ", then ".join(f"{branch.run} {branch}" for branch in branches)
    elif origin is not None and isinstance(loop, Mapping):
        config["config"] = {**loop, "origin": f"{origin.run} {origin}"}
    return config


def _costs(recording: Recording) -> dict[str, object]:
    """Return steps taken, whether recorded or not, episodes, and the size of the file."""
    done = recording.done()
    return {
        "train_steps": done["train_steps"],
        "eval_steps": done["eval_steps"],
        "episodes": recording.train.episodes.count(),
        "bytes": recording.file.size,
    }


def _notes(a: Recording, b: Recording) -> list[str]:
    notes = []
    for name, recording in (("A", a), ("B", b)):
        if recording.status != "finished":
            notes.append(f"{name} is not finished: compared as far as it got")
        if recording.leaves_out_steps:
            notes.append(_left_out(name, recording))
        elif not recording.train.steps:
            notes.append(f"{name} has no training steps, so no trajectory of training is compared")
        whole = unbroken(recording)[0]
        if recording.train.steps and whole < recording.train.steps.count():
            notes.append(f"{name} lost steps from step {whole:,} on: training is compared up to there")
        if any(topic.startswith("/eval/") for topic in recording.lost):
            notes.append(f"{name} lost parts of evaluations: those that are not whole are not compared")
    if not _same_sizes(a, b):
        notes.append("the environments have other states or actions: neither steps nor tables are compared")
    elif len(a.agents) != len(b.agents):
        notes.append("other modes: rewards are compared summed, and Q-tables not at all")
    return notes


# --- environments -------------------------------------------------------------------------------------


def environment_diff(a: Mdp, b: Mdp) -> EnvironmentDiff:
    """Return how two environments differ, down to single transitions."""
    description = changes_in(a.description(), b.description())
    if a.next_state.shape[:2] != b.next_state.shape[:2]:
        sizes = Change("states x actions", a.next_state.shape[:2], b.next_state.shape[:2])
        return EnvironmentDiff(description=[sizes, *description])
    differs = np.zeros(a.next_state.shape[:2], np.bool_)  # padding does not count
    for k in range(max(a.next_state.shape[2], b.next_state.shape[2])):
        for left, right in zip(_outcome(a, k), _outcome(b, k), strict=True):
            differs |= left != right
    pairs = np.argwhere(differs)
    return EnvironmentDiff(
        description=description,
        transitions=len(pairs),
        of=differs.size,
        examples=_examples(a, b, pairs[:: max(1, len(pairs) // _MAX_EXAMPLES)][:_MAX_EXAMPLES]),
        other_starts=not np.array_equal(a.start, b.start),
    )


def _outcome(mdp: Mdp, k: int) -> list[Array]:
    """Return outcome k of every pair: probability, next state, summed reward, terminated, events."""
    shape = mdp.next_state.shape
    if k >= shape[2]:
        return [np.zeros(shape[:2])] * 5
    real = mdp.probability[..., k] > 0
    columns: list[NDArray[Any]] = [mdp.next_state, mdp.summed_rewards, mdp.terminated, mdp.events]
    return [mdp.probability[..., k], *(np.where(real, column[..., k], 0) for column in columns)]


def _examples(a: Mdp, b: Mdp, pairs: NDArray[np.intp]) -> list[ActionDiff[str]]:
    if not len(pairs):
        return []
    states, actions = states_in_words(a), actions_in_words(a)
    states_b = states_in_words(b)
    return [
        ActionDiff(
            state=str(states[s]),
            action=str(actions[j]),
            a=_outcomes_in_words(a, states, s, j),
            b=_outcomes_in_words(b, states_b, s, j),
        )
        for s, j in pairs.tolist()
    ]


def _outcomes_in_words(mdp: Mdp, states: NDArray[np.object_], s: int, j: int) -> str:
    outcomes = []
    for k in np.flatnonzero(mdp.probability[s, j] > 0):
        chance = mdp.probability[s, j, k]
        rewards = ", ".join(f"{reward:g}" for reward in mdp.rewards[s, j, k])
        end = ", the end" if mdp.terminated[s, j, k] else ""
        share = "" if chance == 1 else f"{chance:.3g}: "
        outcomes.append(f"{share}{states[mdp.next_state[s, j, k]]}; reward {rewards}{end}")
    return " | ".join(outcomes)
