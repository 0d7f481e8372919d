"""Which steps of a recording are exported, and where a step is on the viewer's timeline."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.analysis.diff import can_compare_steps
from runner.analysis.diff.divergence import evaluation_divergences, training_divergence
from runner.analysis.diff.sections import where_in_words
from runner.analysis.evaluations import Evaluation, evaluation_after, evaluations_of
from runner.analysis.step_reference import StepRef
from runner.errors import RecordingError
from runner.export.contents import require_steps, shortcomings, whole_ranges, why_no_steps
from runner.recording import schema
from runner.recording.reader import Recording, open_recording
from runner.runs.run import Run

DEFAULT_EPISODES: Final = 20
"""Training episodes of the default selection."""
DEFAULT_STEPS: Final = 50_000
"""Steps at which the default selection stops growing, however long episodes are."""


@dataclass(frozen=True)
class Request:
    """The steps to export; the default selection unless anything is given."""

    episodes: tuple[tuple[int, int | None], ...] = ()
    """Ranges of training episodes, the second number excluded; None is the end."""
    evaluations: tuple[int, ...] = ()
    """Evaluations, by the number of training episodes before them."""
    every: int = 0
    """Every Nth training episode; 0 for none."""
    everything: bool = False
    """Whether all steps are exported."""
    with_default: bool = False
    """Whether the default selection is exported as well."""

    @property
    def is_default(self) -> bool:
        """Whether the default selection is part of it."""
        return self.with_default or not (self.episodes or self.evaluations or self.every or self.everything)


@dataclass(frozen=True, eq=False)
class Episodes:
    """The steps of each episode of a phase; the last episode may not have ended."""

    first_step: NDArray[np.int64]
    """[E + 1]: number of the first step within the phase; the last entry is the number of steps."""
    ended: int

    @property
    def count(self) -> int:
        """The number of episodes with steps."""
        return len(self.first_step) - 1

    def spans(self, numbers: NDArray[np.int64]) -> list[Span]:
        """Return the spans of these episodes, which ascend; neighbours form one span."""
        groups = np.split(numbers, np.flatnonzero(np.diff(numbers) != 1) + 1)
        first = self.first_step
        return [Span(int(first[g[0]]), int(first[g[-1] + 1]), int(g[0])) for g in groups if len(g)]


@dataclass(frozen=True)
class Span:
    """Steps `start` up to `stop` of a phase, of successive whole episodes."""

    start: int
    stop: int
    episode: int
    """The first of these episodes."""


@dataclass
class Selection:
    """The selected steps, and the messages for the user about them."""

    train: list[Span] = field(default_factory=list)
    evaluations: list[tuple[Evaluation, Span]] = field(default_factory=list)
    exported: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @property
    def steps(self) -> int:
        """The number of selected steps."""
        return _count([*self.train, *(span for _, span in self.evaluations)])


@dataclass(frozen=True)
class Location:
    """A point of the timeline, and a request that includes its episode."""

    time: int
    request: Request


def select(recording: Recording, request: Request) -> Selection:
    """Return the steps of a request.

    Raises:
        RecordingError: an episode or evaluation does not exist, or steps are requested and not recorded.
    """
    selection = Selection(warnings=shortcomings(recording))
    if not recording.is_job:
        return _select_loop(recording, request, selection)
    if recording.mdp.scene is None or recording.mdp.scene_cells is None:
        selection.warnings.append("The environment has no scene: state and action are shown as series.")
    if not recording.has_steps:
        if not request.is_default:
            require_steps(recording, "export")
        selection.warnings.append(
            f"Only metrics are exported, as there are no steps: {why_no_steps(recording)}."
        )
        return selection
    train, evals = episodes_of(recording, "train"), episodes_of(recording, "eval")
    available = _evaluations_with_steps(recording, train, evals)
    numbers = _training_episodes(recording, request, np.diff(train.first_step))
    selection.train = train.spans(numbers)
    where = str(recording.path)
    chosen = {evaluation_after(available, after, where) for after in request.evaluations}
    chosen |= set(available if request.everything else available[-1:] if request.is_default else ())
    evaluations = sorted(chosen, key=lambda one: one.after)
    selection.evaluations = [
        (one, span) for one in evaluations for span in evals.spans(np.arange(one.start, one.stop))
    ]
    _describe_training(selection, request, train, numbers)
    _describe_evaluations(selection, available, evaluations)
    if unknown := _steps_without_values(recording, selection.train):
        selection.warnings.append(
            f"{unknown:,} of these training steps are exported without Q-values: steps before them were "
            "lost, and the Q-tables are unknown until the next snapshot."
        )
    return selection


def locate(run: Run, request: Request, step: StepRef | None) -> Location:
    """Return where a step is on the timeline.

    Args:
        run: the run.
        request: what is exported anyway.
        step: the step; None for the first step of the last evaluation exported, or of the last training
            episode if there is none.

    Raises:
        RecordingError: there is no such step, or none at all.
    """
    with open_recording(run.recording) as recording:
        if step is None:
            return Location(_default_time(recording, request), request)
        require_steps(recording, "look at")
        phase = "train" if step.after is None else "eval"
        episodes, t = episodes_of(recording, phase), step.t
        if step.after is None:
            number, more = step.episode, Request(episodes=((step.episode, step.episode + 1),))
            if recording.environments == 1 and number >= episodes.count:
                raise RecordingError(
                    f"{recording.path}: found no training episode {number}; there are {episodes.count:,}, "
                    "from 0."
                )
        else:
            evaluations = evaluations_of(recording)
            if recording.is_job:
                evaluations = _evaluations_with_steps(recording, episodes_of(recording, "train"), episodes)
            where = str(recording.path)
            number = evaluation_after(evaluations, step.after, where).trial(step.episode, where)
            more = Request(
                evaluations=(step.after,) if recording.is_job else ()
            )  # a loop's are always exported
        if recording.environments > 1:
            steps = recording.episode_span(phase, number)
        else:
            steps = range(*episodes.first_step[number : number + 2].tolist())
        if t >= len(steps):
            raise RecordingError(
                f"{recording.path}: found no t = {t} there; the episode has {len(steps)} steps, from 0."
            )
        time = _time(recording, phase, steps[t])
    if request.everything:
        return Location(time, request)
    added = dataclasses.replace(
        request,
        episodes=request.episodes + more.episodes,
        evaluations=request.evaluations + more.evaluations,
        with_default=request.is_default,
    )
    return Location(time, added)


def locate_divergence(runs: Sequence[Run]) -> tuple[StepRef | None, str]:
    """Return the step at which two runs diverge, as `locate` takes it, and a sentence about it.

    That is the first step of training that differs, or else the first evaluation's. None if they do not
    diverge, or if they cannot be compared.
    """
    with open_recording(runs[0].recording) as a, open_recording(runs[1].recording) as b:
        if not (a.is_job and b.is_job):
            return None, "`dualtaxi diff` shows where two loops diverge."
        if not can_compare_steps(a, b):
            return (
                None,
                "Where they diverge is unknown: states or actions differ, or steps were not recorded.",
            )
        divergence = training_divergence(a, b)
        if divergence is None or None in (divergence.a_step, divergence.b_step):
            suffix = ", as far as the shorter goes" if divergence is not None else ""
            divergence = next(evaluation_divergences(a, b), None)
            if divergence is None:
                return None, f"They never diverge: every step is the same{suffix}."
    step = StepRef(divergence.episode, divergence.t, divergence.after)
    return step, f"They diverge {where_in_words(divergence)}."


def episodes_of(recording: Recording, phase: str) -> Episodes:
    """Return the episodes of a phase that have steps."""
    steps, episodes = schema.PHASES[phase]
    total = recording.count(steps)
    first = np.full(recording.count(episodes) + 1, -1, np.int64)
    first[0] = 0
    for block in recording.blocks(episodes):
        counted = block[block["episode"] < len(first) - 1]
        number, stop = counted["episode"].astype(np.int64), counted["last_step"].astype(np.int64) + 1
        first[number] = stop - counted["length"]
        first[number + 1] = stop
    # Steps of episodes that were lost in a repair count as those of the first episode after them.
    first = np.maximum.accumulate(first)
    first = first[first <= total]
    return Episodes(np.append(first, total) if total > first[-1] else first, len(first) - 1)


def _evaluations_with_steps(recording: Recording, train: Episodes, evals: Episodes) -> list[Evaluation]:
    """Return the evaluations that have steps, including an incomplete one."""
    evaluations = []
    trials = int(recording.config["evaluation"]["trials"]) if evals.count else 1
    for start in range(0, evals.count, trials):
        stop = min(start + trials, evals.count)
        bounds = int(evals.first_step[start]), int(evals.first_step[stop])
        block = next(recording.blocks(schema.EVAL_STEP, *bounds), None)
        if block is not None:  # otherwise all of its steps were lost in a repair
            trained = int(block["log_time"][0]) // schema.STEP_NANOSECONDS - (int(block["step"][0]) + 1)
            after = int(np.searchsorted(train.first_step[1 : train.ended + 1], trained, side="right"))
            evaluations.append(Evaluation(after, trained, start, stop))
    return evaluations


def _training_episodes(
    recording: Recording, request: Request, lengths: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the numbers of the training episodes of a request, ascending, given their lengths."""
    count = len(lengths)
    if request.everything:
        return np.arange(count)
    ranges = whole_ranges(request.episodes, count, "train", str(recording.path))
    numbers = [np.empty(0, np.int64), *(np.arange(start, stop) for start, stop in ranges)]
    if request.every:
        numbers.append(np.arange(0, count, request.every))
    if request.is_default and count:
        numbers.append(_default_episodes(lengths))
    return np.unique(np.concatenate(numbers))


def _default_episodes(lengths: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return episodes evenly spread from the first to the last, as many as the limits allow."""
    for count in range(min(DEFAULT_EPISODES, len(lengths)), 1, -1):
        numbers = np.unique(np.linspace(0, len(lengths) - 1, count).round().astype(np.int64))
        if int(lengths[numbers].sum()) <= DEFAULT_STEPS:
            return numbers
    return np.unique([0, len(lengths) - 1]).astype(np.int64)


def _steps_without_values(recording: Recording, spans: Sequence[Span]) -> int:
    """Return how many of the training steps in these spans have unknown Q-values."""
    if not recording.lost and next((one.step for one in recording.snapshots()), -1) == 0:
        return 0
    from runner.replay.tables import known_steps  # loads Numba

    known, unknown = known_steps(recording), 0
    for span in spans:
        for block in recording.blocks(schema.TRAIN_STEP, span.start, span.stop):
            inside = [(block["step"] >= first) & (block["step"] <= last) for first, last in known]
            unknown += len(block) - int(np.any(inside, axis=0).sum())
    return unknown


def _describe_training(
    selection: Selection, request: Request, train: Episodes, numbers: NDArray[np.int64]
) -> None:
    is_spread = request.is_default and len(numbers)
    spread = f", evenly spread from {numbers[0]} to {numbers[-1]:,}" if is_spread else ""
    selection.exported.append(
        f"the {_count(selection.train):,} steps of {len(numbers):,} of {train.count:,} training episodes"
        + spread
    )
    if len(numbers) < train.count:
        selection.left_out.append(
            f"the steps of {train.count - len(numbers):,} training episodes "
            "(--episodes START:STOP or --every N includes them; --all: everything)"
        )


def _describe_evaluations(
    selection: Selection, available: Sequence[Evaluation], evaluations: Sequence[Evaluation]
) -> None:
    steps = _count([span for _, span in selection.evaluations])
    named = f" (after {', '.join(f'{one.after:,}' for one in evaluations)} episodes)"
    selection.exported.append(
        f"the {steps:,} steps of {len(evaluations):,} of {len(available):,} evaluations"
        + (named if 0 < len(evaluations) <= 4 else "")
    )
    if rest := [one.after for one in available if one not in evaluations]:
        selection.left_out.append(
            f"the trials of {len(rest):,} evaluations (--evaluations {rest[-1]} includes the one "
            f"after {rest[-1]:,} episodes; --all: everything)"
        )


def _select_loop(recording: Recording, request: Request, selection: Selection) -> Selection:
    """Return the steps of a loop in a request; by default all of them unless there are too many.

    Raises:
        RecordingError: an episode does not exist, or an evaluation is requested, of which a loop has none.
    """
    if request.evaluations:
        raise RecordingError(
            f"{recording.path}: a loop has no numbered evaluations; --all exports all steps."
        )
    if recording.kind == "variable":
        selection.warnings.append("Observations and actions vary in size (texts): they are not drawn.")
    total, tested = recording.count(schema.TRAIN_STEP), recording.count(schema.EVAL_STEP)
    n = recording.environments
    is_short = total <= DEFAULT_STEPS or recording.kind == "variable"
    if request.everything or (request.is_default and is_short):
        stop = total if request.everything else min(total, DEFAULT_STEPS)
        selection.train = [Span(0, stop, 0)] if stop else []
    elif n > 1:
        lengths = recording.episodes("train")["length"].astype(np.int64) * n
        numbers = _training_episodes(recording, request, lengths)
        selection.train = _joined([recording.episode_span("train", int(number)) for number in numbers])
    else:
        train = episodes_of(recording, "train")
        selection.train = train.spans(_training_episodes(recording, request, np.diff(train.first_step)))
    first = 0 if request.everything else max(0, tested - DEFAULT_STEPS)
    if tested:
        selection.evaluations = [(Evaluation(0, 0, 0, 0), Span(first, tested, 0))]
    shown = _count(selection.train)
    evaluated = f", {tested - first:,} of {tested:,} of evaluation" if tested else ""
    environments = f" in {n} environments" if n > 1 else ""
    selection.exported.append(f"{shown:,} of {total:,} training steps{evaluated}{environments}")
    if shown < total or first:
        selection.left_out.append(
            f"{total - shown + first:,} steps (--episodes START:STOP selects; --all: everything)"
        )
    return selection


def _joined(episodes: Sequence[range]) -> list[Span]:
    """Return the steps of episodes of a vector, and of its other environments meanwhile, as few spans."""
    spans: list[Span] = []
    for steps in sorted(episodes, key=lambda steps: steps.start):
        start = steps.start // steps.step * steps.step
        stop = steps.stop + -steps.stop % steps.step
        if spans and start <= spans[-1].stop:
            spans[-1] = dataclasses.replace(spans[-1], stop=max(stop, spans[-1].stop))
        else:
            spans.append(Span(start, stop, 0))
    return spans


def _default_time(recording: Recording, request: Request) -> int:
    selection = select(recording, request)
    spans = {"eval": [span for _, span in selection.evaluations], "train": selection.train}
    for phase, of_phase in spans.items():
        if of_phase and recording.kind != "variable":
            return _time(recording, phase, of_phase[-1].start)
    return 0


def _time(recording: Recording, phase: str, step: int) -> int:
    """Return the time of a step of a phase."""
    record: Any = next(recording.blocks(schema.PHASES[phase][0], step, step + 1))[0]
    return int(record["log_time"]) // schema.STEP_NANOSECONDS


def _count(spans: Sequence[Span]) -> int:
    return sum(span.stop - span.start for span in spans)
