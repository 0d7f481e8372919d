"""Which steps of a recording are exported, and where one of them is on the viewer's timeline."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from runner.analysis.contents import require_steps, shortcomings, whole_ranges, why_no_steps
from runner.analysis.diff import can_compare_steps, divergences
from runner.analysis.diff.sections import where_in_words
from runner.analysis.episodes import EpisodeRef
from runner.analysis.evaluations import Evaluation, evaluation_after, evaluations_of
from runner.drawing.svg import drawing_of
from runner.recording import schema
from runner.recording.messages import Message
from runner.recording.reader import Recording, open_recording
from runner.replay.recorded import ended_episode
from runner.runs.run import Run
from runner.util.arrays import Ints
from runner.util.values import Ranges

DEFAULT_EPISODES: Final = 20
"""Training episodes of the default selection."""
FRAME_STEPS: Final = 2_000
"""Steps at which the default choice of episodes that are drawn stops growing."""
MAX_MEMBERS: Final = 8
"""Environments of a vector that are shown in views, and drawn; the values of all are exported."""
DEFAULT_STEPS: Final = 50_000
"""Steps at which the default selection stops growing, however long episodes are."""


@dataclass(frozen=True)
class Request:
    """The steps to export; the default selection unless anything is given."""

    episodes: Ranges = ()
    """Ranges of training episodes, the second number excluded; None is the end."""
    evaluations: tuple[int, ...] = ()
    """Evaluations, by the number of training episodes before them."""
    every: int = 0
    """Every Nth training episode; 0 for none."""
    everything: bool = False
    """Whether all steps are exported."""
    with_default: bool = False
    """Whether the default selection is exported as well."""
    frames: bool = False
    """Whether the environment of a loop draws pictures of the selected episodes."""
    trials: tuple[int, ...] = ()
    """Evaluation episodes of a loop to draw as well, counted over the phase."""
    trust: bool = False
    """Whether what the recording names may be imported for that, see `runner.replay.makers`."""

    @property
    def is_default(self) -> bool:
        """Whether the default selection is part of it."""
        return self.with_default or not (self.episodes or self.evaluations or self.every or self.everything)


@dataclass(frozen=True, eq=False)
class SelectedEpisodes:
    """The steps of each episode of a phase; the last episode may not have ended."""

    start: Ints
    """[E]: first step of each episode, counted over the phase (in a vector, over all environments)."""
    stop: Ints
    """[E]: first step after each episode, counted in the same way."""
    ended: int
    """How many of the episodes ended."""

    def before(self, steps: Ints | int) -> Ints:
        """Return how many of the episodes had ended after these numbers of steps."""
        return np.searchsorted(self.stop[: self.ended], steps, side="right")

    @property
    def lengths(self) -> Ints:
        """[E]: the number of steps."""
        return self.stop - self.start

    def steps_of(self, numbers: Ints) -> list[range]:
        """Return the steps of these episodes as `joined` returns them."""
        return joined(map(range, self.start[numbers].tolist(), self.stop[numbers].tolist()))


@dataclass
class Selection:
    """The selected steps, and the messages for the user about them."""

    by_phase: dict[str, list[range]] = field(default_factory=lambda: {phase: [] for phase in schema.PHASES})
    """The numbers of the steps, of successive whole episodes as far as they are one range."""
    drawn: dict[str, list[int]] = field(default_factory=dict)
    """Episodes of a loop of which pictures are drawn, by phase."""
    trust: bool = False
    """Whether what the recording names may be imported for that."""
    focus: tuple[int, int] | None = None
    """First and last step, on the timeline, of the episodes that were asked for by number."""
    exported: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @property
    def steps(self) -> int:
        """The number of selected steps."""
        return sum(self.counts)

    @property
    def counts(self) -> list[int]:
        """The number of selected steps of each phase."""
        return [sum(map(len, spans)) for spans in self.by_phase.values()]


def joined(spans: Iterable[range]) -> list[range]:
    """Return ranges in order; those that follow each other, or overlap, are one range."""
    whole: list[range] = []
    for span in sorted(filter(None, spans), key=lambda span: span.start):
        before = whole.pop() if whole and span.start <= whole[-1].stop else span
        whole.append(range(before.start, max(before.stop, span.stop)))
    return whole


def select(recording: Recording, request: Request) -> Selection:
    """Return the steps of a request.

    Raises:
        NotInRecording: an episode or an evaluation does not exist.
    """
    selection = Selection(trust=request.trust, warnings=shortcomings(recording))
    is_job = recording.has_tables
    if is_job and request.frames:
        selection.warnings.append("--frames draws loops only: the run was trained here.")
    if is_job and drawing_of(recording.mdp) is None:
        selection.warnings.append("The environment has no scene: state and action are shown as series.")
    if is_job and not any(phase.steps for phase in recording.phases):
        if not request.is_default:
            require_steps(recording, "export")
        selection.warnings.append(
            f"Only metrics are exported, as there are no steps: {why_no_steps(recording)}."
        )
        return selection
    if recording.train.steps.dtype is None:
        selection.warnings.append("Observations and actions vary in size (texts): they are not drawn.")
    train, evals = (episodes_of(recording, phase) for phase in schema.PHASES)
    available, where = evaluations_with_steps(recording), str(recording.path)
    selected = [evaluation_after(available, after, where) for after in sorted(set(request.evaluations))]
    numbers = _asked_episodes(request, len(train.start), where)
    whole_ranges([(number, number + 1) for number in request.trials], len(evals.start), "eval", where)
    asked = {"train": numbers, "eval": np.array(request.trials, int)}
    if not request.everything:
        trials = asked["eval"] if request.trials else _trials(selected)
        spans = train.steps_of(numbers), evals.steps_of(trials)
        times = [
            time_of(phase.steps.one(step))
            for phase, ranges in zip(recording.phases, spans, strict=True)
            if ranges
            for step in (ranges[0][0], ranges[-1][-1])
        ]
        selection.focus = (min(times), max(times)) if times else None
    if request.is_default:
        numbers = np.union1d(numbers, _default_episodes(train.lengths))
    if is_job:
        selected += available if request.everything else available[-1:] if request.is_default else []
        selected = [evaluation for evaluation in available if evaluation in selected]
    selection.by_phase = {"train": train.steps_of(numbers), "eval": evals.steps_of(_trials(selected))}
    if is_job:
        _describe_job(selection, request, numbers, len(train.start), available, selected)
        if unknown := _steps_without_values(recording, selection.by_phase["train"]):
            selection.warnings.append(
                f"{unknown:,} of these training steps are exported without Q-values: steps before them were "
                "lost, and the Q-tables are unknown until the next snapshot."
            )
    else:
        _complete_loop(recording, request, selection, asked)
    return selection


def episodes_of(recording: Recording, phase: str) -> SelectedEpisodes:
    """Return the episodes of a phase that have steps."""
    records_of_phase = recording.phase(phase)
    n = recording.environments
    total = records_of_phase.steps.count() if records_of_phase.steps else 0
    records = records_of_phase.episodes.array()
    begin, last = (records[name].astype(np.int64) for name in ("first_step", "last_step"))
    if n > 1:  # from the beginning of a round to the end of one
        place = records["environment"].astype(np.int64)
        there = last < total
        return SelectedEpisodes((begin - place)[there], (last - place + n)[there], int(there.sum()))
    first = np.zeros(records_of_phase.episodes.count() + 1, np.int64)
    number = records["episode"].astype(np.int64).clip(max=len(first) - 2)
    first[number] = begin
    first[number + 1] = last + 1
    # Steps of episodes that were lost in a repair count as those of the first episode after them.
    first = np.maximum.accumulate(first)
    first = first[first <= total]
    ended = len(first) - 1
    first = np.append(first, total) if total > first[-1] else first
    return SelectedEpisodes(first[:-1], first[1:], ended)


def evaluations_with_steps(recording: Recording) -> list[Evaluation]:
    """Return the evaluations that have steps; of a job including an incomplete one."""
    if not recording.eval.has_metrics:
        return evaluations_of(recording)
    train, evals = (episodes_of(recording, phase) for phase in schema.PHASES)
    evaluations = []
    count = len(evals.start)
    trials = int(recording.config["evaluation"]["trials"]) if count else 1
    for start in range(0, count, trials):
        stop = min(start + trials, count)
        bounds = int(evals.start[start]), int(evals.stop[stop - 1])
        block = next(recording.eval.steps.blocks(*bounds), None)
        if block is not None:  # otherwise all of its steps were lost in a repair
            trained = time_of(block[0]) - (int(block["step"][0]) + 1)
            evaluations.append(Evaluation(int(train.before(trained)), trained, start, stop))
    return evaluations


def time_of(step: np.void | Message) -> int:
    """Return where a step, or another message, is on the timeline."""
    return int(step["log_time"]) // schema.STEP_NANOSECONDS


def _trials(evaluations: Sequence[Evaluation]) -> Ints:
    """Return the numbers of the trials of some evaluations."""
    return np.concatenate([np.empty(0, np.int64), *(evaluation.episodes for evaluation in evaluations)])


def _asked_episodes(request: Request, count: int, where: str) -> Ints:
    """Return the numbers of the training episodes that a request names, ascending; `count` exist."""
    if request.everything:
        return np.arange(count)
    ranges = [range(*bounds) for bounds in whole_ranges(request.episodes, count, "train", where)]
    ranges.append(range(0, count if request.every else 0, request.every or 1))
    return np.unique(np.concatenate(ranges).astype(np.int64))


def _default_episodes(lengths: Ints, limit: int = DEFAULT_STEPS) -> Ints:
    """Return episodes evenly spread from the first to the last, as many as the limits allow."""
    numbers = np.arange(0)
    for count in range(min(DEFAULT_EPISODES, len(lengths)), 0, -1):
        numbers = np.linspace(0, len(lengths) - 1, count).round().astype(np.int64)
        if lengths[numbers].sum() <= limit:
            break
    return numbers


def _steps_without_values(recording: Recording, ranges: Sequence[range]) -> int:
    """Return how many of the training steps in these ranges have unknown Q-values."""
    if not recording.lost and next((snapshot.step for snapshot in recording.snapshots()), -1) == 0:
        return 0
    from runner.replay.tables import are_within, known_steps  # loads Numba

    known = known_steps(recording)
    blocks = (block for steps in ranges for block in recording.train.steps.numbered(steps))
    return sum(int((~are_within(known, block["step"].astype(np.int64))).sum()) for block in blocks)


def _describe_job(
    selection: Selection,
    request: Request,
    numbers: Ints,
    count: int,
    available: Sequence[Evaluation],
    evaluations: Sequence[Evaluation],
) -> None:
    """Put in words what is exported of a job, and what is not: training episodes and evaluations."""
    spread = f", evenly spread from {numbers[0]} to {numbers[-1]:,}" if request.is_default and count else ""
    named = f" (after {', '.join(f'{evaluation.after:,}' for evaluation in evaluations)} episodes)"
    trained, tested = selection.counts
    selection.exported += [
        f"the {trained:,} steps of {len(numbers):,} of {count:,} training episodes{spread}",
        f"the {tested:,} steps of {len(evaluations):,} of {len(available):,} evaluations"
        + (named if 0 < len(evaluations) <= 4 else ""),
    ]
    if len(numbers) < count:
        selection.left_out.append(
            f"the steps of {count - len(numbers):,} training episodes "
            "(--episodes START..STOP or --every N includes them; --all: everything)"
        )
    if rest := [evaluation.after for evaluation in available if evaluation not in evaluations]:
        selection.left_out.append(
            f"the trials of {len(rest):,} evaluations (--evaluations {rest[-1]} includes the one "
            f"after {rest[-1]:,} episodes; --all: everything)"
        )


def _complete_loop(
    recording: Recording, request: Request, selection: Selection, asked: Mapping[str, Ints]
) -> None:
    """Add all steps of a loop if there are few, its last steps of evaluation, and episodes to draw."""
    total, tested = (phase.steps.count() if phase.steps else 0 for phase in recording.phases)
    if total and (request.everything or (request.is_default and total <= DEFAULT_STEPS)):
        selection.by_phase["train"] = [range(total)]
    if request.frames:
        _select_drawn(recording, request, selection, asked)
    first = 0 if request.everything else max(0, tested - DEFAULT_STEPS)
    selection.by_phase["eval"] = joined([*selection.by_phase["eval"], range(first, tested)])
    trained, evaluated = selection.counts
    environments = f" in {recording.environments} environments" if recording.environments > 1 else ""
    of_evaluation = f", {evaluated:,} of {tested:,} of evaluation" if tested else ""
    selection.exported.append(f"{trained:,} of {total:,} training steps{of_evaluation}{environments}")
    if rest := total + tested - trained - evaluated:
        selection.left_out.append(f"{rest:,} steps (--episodes START..STOP selects; --all: everything)")


def _select_drawn(
    recording: Recording, request: Request, selection: Selection, asked: Mapping[str, Ints]
) -> None:
    """Choose the episodes that are drawn: those asked for, by default a few of each environment."""
    n = recording.environments
    total = 0
    members = min(n, MAX_MEMBERS)
    for phase in schema.PHASES:
        if not recording.phase(phase).steps:
            continue
        lengths = episodes_of(recording, phase).lengths // n
        numbers = [np.arange(len(lengths)) if request.everything else asked[phase]]
        places = np.zeros(len(lengths))
        if n > 1:
            places = recording.phase(phase).episodes.array(0, len(lengths))["environment"]
        if request.is_default:
            for environment in range(members):
                in_environment = np.flatnonzero(places == environment)
                numbers.append(
                    in_environment[_default_episodes(lengths[in_environment], FRAME_STEPS // members)]
                )
        selection.drawn[phase] = np.unique(np.concatenate(numbers)).tolist()
        total += len(lengths)
    drawn = sum(map(len, selection.drawn.values()))
    selection.exported.append(f"pictures of {drawn:,} of {total:,} episodes")
    if drawn < total:
        selection.left_out.append(
            f"pictures of {total - drawn:,} episodes (--episodes START..STOP selects; --all: everything)"
        )


@dataclass(frozen=True)
class Location:
    """A point of the timeline, and a request that includes its episode."""

    time: int
    request: Request


def locate(run: Run, request: Request, step: EpisodeRef | None) -> Location:
    """Return where a step is on the timeline, and a request that adds it to what is exported anyway.

    Without a step it is the first one of the last evaluation exported, or of the last training episode if
    there is none.
    """
    with open_recording(run.recording) as recording:
        if step is None:
            by_phase = select(recording, request).by_phase
            phase = next((phase for phase in ("eval", "train") if by_phase[phase]), "")
            time = time_of(recording.phase(phase).steps.one(by_phase[phase][-1].start)) if phase else 0
            return Location(time, request)
        require_steps(recording, "look at")
        step = step.resolved(recording)
        number = step.episode
        episode = (step.episode, step.episode + 1)
        added: dict[str, Any] = {"episodes": (*request.episodes, episode)}
        if step.after is not None:
            where = str(recording.path)
            evaluation = evaluation_after(evaluations_with_steps(recording), step.after, where)
            number = evaluation.trial(step.episode, where)
            added = {"evaluations": (*request.evaluations, step.after), "trials": (number,)}
        steps = recording.phase(step.phase).episode(number)
        if step.t >= len(steps):
            raise step.no_step(recording, len(steps), step.t)
        time = time_of(steps.one(step.t))
    if not request.everything:
        request = dataclasses.replace(request, with_default=request.is_default, **added)
    return Location(time, request)


def locate_divergence(runs: Sequence[Run]) -> tuple[EpisodeRef | None, str]:
    """Return the step at which two runs diverge, as `locate` takes it, and a sentence about it.

    That is the first step of training that differs, or else the first evaluation's. None if they do not
    diverge, or if they cannot be compared.
    """
    with open_recording(runs[0].recording) as a, open_recording(runs[1].recording) as b:
        if not can_compare_steps(a, b):
            return (
                None,
                "Where they diverge is unknown: states or actions differ, or steps were not recorded.",
            )
        places = list(divergences(a, b))
        both = [place for place in places if None not in (place.a_step, place.b_step)]
        if not both:
            suffix = ", as far as the shorter goes" if places else ""
            return None, f"They never diverge: every step is the same{suffix}."
        words = f"They diverge {where_in_words(both[0])}."
        if a.environments == 1:
            return both[0].reference, words
        row = a.phase(both[0].phase).steps.one(both[0].step)
        number = ended_episode(a, both[0].phase, int(row["environment"]), both[0].step)
    return None if number is None or both[0].after is not None else EpisodeRef(number, both[0].t), words
