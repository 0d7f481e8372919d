"""Which steps of a recording are exported."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.analysis.evaluations import Evaluation, evaluation_after, evaluations_of
from runner.export.contents import require_steps, shortcomings, whole_ranges, why_no_steps
from runner.recording import schema
from runner.recording.reader import Recording
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
class Episodes:
    """The steps of each episode of a phase; the last episode may not have ended."""

    start: NDArray[np.int64]
    """[E]: number of the first step within the phase; in a vector that of all environments with it."""
    stop: NDArray[np.int64]
    """[E]: number after that of the last step; in a vector of all environments with it."""
    ended: int

    @property
    def count(self) -> int:
        """The number of episodes with steps."""
        return len(self.start)

    @property
    def lengths(self) -> NDArray[np.int64]:
        """[E]: the number of steps."""
        return self.stop - self.start

    def steps_of(self, numbers: NDArray[np.int64]) -> list[range]:
        """Return the steps of these episodes; those that follow each other, or overlap, are one range."""
        joined: list[range] = []
        starts, stops = self.start[numbers], self.stop[numbers]
        for k in np.argsort(starts, kind="stable").tolist():
            start, stop = int(starts[k]), int(stops[k])
            if joined and start <= joined[-1].stop:
                start, stop = joined[-1].start, max(stop, joined.pop().stop)
            joined.append(range(start, stop))
        return joined


@dataclass
class Selection:
    """The selected steps, and the messages for the user about them."""

    train: list[range] = field(default_factory=list)
    """The numbers of the steps of successive whole episodes."""
    evaluations: list[tuple[Evaluation, range]] = field(default_factory=list)
    """Evaluations with their steps; the last steps of a loop's are one, whose other fields are 0."""
    drawn: dict[str, list[int]] = field(default_factory=dict)
    """Episodes of a loop of which pictures are drawn, by phase."""
    focus: tuple[int, int] | None = None
    """First and last step, on the timeline, of the episodes that were asked for by number."""
    exported: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @property
    def by_phase(self) -> dict[str, list[range]]:
        """The selected steps of each phase."""
        return {"train": self.train, "eval": [steps for _, steps in self.evaluations]}

    @property
    def steps(self) -> int:
        """The number of selected steps."""
        return sum(len(steps) for of_phase in self.by_phase.values() for steps in of_phase)


def select(recording: Recording, request: Request) -> Selection:
    """Return the steps of a request."""
    selection = Selection(warnings=shortcomings(recording), focus=_focus(recording, request))
    if not recording.has_tables:
        return _select_loop(recording, request, selection)
    if request.frames:
        selection.warnings.append("--frames draws loops only: the run was trained here.")
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
    available = evaluations_with_steps(recording, train, evals)
    numbers = _training_episodes(recording, request, train.lengths)
    selection.train = train.steps_of(numbers)
    chosen = {*_chosen(recording, request, available)}
    chosen |= {*(available if request.everything else available[-1:] if request.is_default else ())}
    evaluations = [one for one in available if one in chosen]
    selection.evaluations = [
        (one, steps) for one in evaluations for steps in evals.steps_of(np.arange(one.start, one.stop))
    ]
    _describe(selection, request, numbers, train.count, available, evaluations)
    if unknown := _steps_without_values(recording, selection.train):
        selection.warnings.append(
            f"{unknown:,} of these training steps are exported without Q-values: steps before them were "
            "lost, and the Q-tables are unknown until the next snapshot."
        )
    return selection


def episodes_of(recording: Recording, phase: str) -> Episodes:
    """Return the episodes of a phase that have steps."""
    steps, episodes = schema.PHASES[phase]
    total, n = recording.count(steps), recording.environments
    if n > 1:
        records = recording.episodes(phase)
        last, length = (records[name].astype(np.int64) for name in ("last_step", "length"))
        return Episodes((last - (length - 1) * n) // n * n, (last // n + 1) * n, len(records))
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
    ended = len(first) - 1
    first = np.append(first, total) if total > first[-1] else first
    return Episodes(first[:-1], first[1:], ended)


def evaluations_with_steps(recording: Recording, train: Episodes, evals: Episodes) -> list[Evaluation]:
    """Return the evaluations that have steps; of a job including an incomplete one."""
    if not recording.has_reports:
        return evaluations_of(recording)
    evaluations = []
    trials = int(recording.config["evaluation"]["trials"]) if evals.count else 1
    for start in range(0, evals.count, trials):
        stop = min(start + trials, evals.count)
        bounds = int(evals.start[start]), int(evals.stop[stop - 1])
        block = next(recording.blocks(schema.EVAL_STEP, *bounds), None)
        if block is not None:  # otherwise all of its steps were lost in a repair
            trained = int(block["log_time"][0]) // schema.STEP_NANOSECONDS - (int(block["step"][0]) + 1)
            after = int(np.searchsorted(train.stop[: train.ended], trained, side="right"))
            evaluations.append(Evaluation(after, trained, start, stop))
    return evaluations


def time_of(recording: Recording, phase: str, step: int) -> int:
    """Return where a step of a phase is on the timeline."""
    record: Any = next(recording.blocks(schema.PHASES[phase][0], step, step + 1))[0]
    return int(record["log_time"]) // schema.STEP_NANOSECONDS


def _focus(recording: Recording, request: Request) -> tuple[int, int] | None:
    explicit = dataclasses.replace(request, with_default=False)
    if explicit.is_default or request.everything or not recording.has_steps or recording.has_varying_values:
        return None
    train, evals = (episodes_of(recording, phase) for phase in schema.PHASES)
    trials = [np.array(request.trials, np.int64)]
    if not request.trials:
        chosen = _chosen(recording, request, evaluations_with_steps(recording, train, evals))
        trials += [np.arange(one.start, one.stop) for one in chosen]
    spans = {
        "train": train.steps_of(_training_episodes(recording, explicit, train.lengths)),
        "eval": evals.steps_of(np.concatenate(trials)),
    }
    times = [
        time_of(recording, phase, step)
        for phase, of_phase in spans.items()
        if of_phase
        for step in (of_phase[0].start, of_phase[-1].stop - 1)
    ]
    return (min(times), max(times)) if times else None


def _chosen(recording: Recording, request: Request, available: Sequence[Evaluation]) -> list[Evaluation]:
    """Return the evaluations that are asked for by number, in order."""
    return [
        evaluation_after(available, after, str(recording.path)) for after in sorted(set(request.evaluations))
    ]


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


def _default_episodes(lengths: NDArray[np.int64], limit: int = DEFAULT_STEPS) -> NDArray[np.int64]:
    """Return episodes evenly spread from the first to the last, as many as the limits allow."""
    for count in range(min(DEFAULT_EPISODES, len(lengths)), 1, -1):
        numbers = np.unique(np.linspace(0, len(lengths) - 1, count).round().astype(np.int64))
        if int(lengths[numbers].sum()) <= limit:
            return numbers
    return np.unique([0, len(lengths) - 1]).astype(np.int64)


def _steps_without_values(recording: Recording, ranges: Sequence[range]) -> int:
    """Return how many of the training steps in these ranges have unknown Q-values."""
    if not recording.lost and next((one.step for one in recording.snapshots()), -1) == 0:
        return 0
    from runner.replay.tables import known_steps  # loads Numba

    spans, unknown = known_steps(recording), 0
    for steps in ranges:
        for block in recording.blocks(schema.TRAIN_STEP, steps.start, steps.stop):
            inside = [(block["step"] >= first) & (block["step"] <= last) for first, last in spans]
            unknown += len(block) - int(np.any(inside, axis=0).sum())
    return unknown


def _describe(
    selection: Selection,
    request: Request,
    numbers: NDArray[np.int64],
    count: int,
    available: Sequence[Evaluation],
    evaluations: Sequence[Evaluation],
) -> None:
    """Put in words what is exported of a job, and what is not: training episodes and evaluations."""
    spread = f", evenly spread from {numbers[0]} to {numbers[-1]:,}" if request.is_default and count else ""
    named = f" (after {', '.join(f'{one.after:,}' for one in evaluations)} episodes)"
    trained, tested = (sum(map(len, spans)) for spans in selection.by_phase.values())
    selection.exported += [
        f"the {trained:,} steps of {len(numbers):,} of {count:,} training episodes{spread}",
        f"the {tested:,} steps of {len(evaluations):,} of {len(available):,} evaluations"
        + (named if 0 < len(evaluations) <= 4 else ""),
    ]
    if len(numbers) < count:
        selection.left_out.append(
            f"the steps of {count - len(numbers):,} training episodes "
            "(--episodes START:STOP or --every N includes them; --all: everything)"
        )
    if rest := [one.after for one in available if one not in evaluations]:
        selection.left_out.append(
            f"the trials of {len(rest):,} evaluations (--evaluations {rest[-1]} includes the one "
            f"after {rest[-1]:,} episodes; --all: everything)"
        )


def _select_loop(recording: Recording, request: Request, selection: Selection) -> Selection:
    """Return the steps of a loop in a request; by default all of them unless there are too many.

    Raises:
        NotInRecording: an episode or an evaluation does not exist.
    """
    if recording.has_varying_values:
        selection.warnings.append("Observations and actions vary in size (texts): they are not drawn.")
    total, tested = recording.count(schema.TRAIN_STEP), recording.count(schema.EVAL_STEP)
    n, train = recording.environments, episodes_of(recording, "train")
    is_short = total <= DEFAULT_STEPS or recording.has_varying_values
    if request.everything or (request.is_default and is_short):
        stop = total if request.everything else min(total, DEFAULT_STEPS)
        selection.train = [range(stop)] if stop else []
    else:
        selection.train = train.steps_of(_training_episodes(recording, request, train.lengths))
    if request.frames:
        _select_drawn(recording, request, selection)
    first = 0 if request.everything else max(0, tested - DEFAULT_STEPS)
    evals = episodes_of(recording, "eval")
    for one in _chosen(recording, request, evaluations_of(recording)) if request.evaluations else ():
        steps = evals.steps_of(np.arange(one.start, one.stop))
        selection.evaluations += [(one, range(each.start, min(each.stop, first))) for each in steps]
    if tested:
        selection.evaluations.append((Evaluation(0, 0, 0, 0), range(first, tested)))
    selection.evaluations = [(one, steps) for one, steps in selection.evaluations if len(steps)]
    first -= sum(len(steps) for _, steps in selection.evaluations[:-1])
    shown = sum(map(len, selection.train))
    evaluated = f", {tested - first:,} of {tested:,} of evaluation" if tested else ""
    environments = f" in {n} environments" if n > 1 else ""
    selection.exported.append(f"{shown:,} of {total:,} training steps{evaluated}{environments}")
    if shown < total or first:
        selection.left_out.append(
            f"{total - shown + first:,} steps (--episodes START:STOP selects; --all: everything)"
        )
    return selection


def _select_drawn(recording: Recording, request: Request, selection: Selection) -> None:
    """Choose the episodes that are drawn: those that were selected, by default a few of each environment."""
    n, total = recording.environments, 0
    for phase in schema.PHASES:
        if not recording.count(schema.PHASES[phase][0]):
            continue
        ended = recording.episodes(phase)
        lengths = episodes_of(recording, phase).lengths // n
        numbers = [np.empty(0, np.int64)]
        if request.everything:
            numbers.append(np.arange(len(lengths)))
        elif phase == "train":
            explicit = dataclasses.replace(request, with_default=False)
            if not explicit.is_default:
                numbers.append(_training_episodes(recording, explicit, lengths))
        else:
            numbers.append(np.array(request.trials, np.int64))
        if request.is_default:
            for environment in range(min(n, MAX_MEMBERS)):
                own = (
                    np.flatnonzero(ended["last_step"] % n == environment)
                    if n > 1
                    else np.arange(len(lengths))
                )
                if len(own):
                    numbers.append(own[_default_episodes(lengths[own], FRAME_STEPS // min(n, MAX_MEMBERS))])
        selection.drawn[phase] = np.unique(np.concatenate(numbers)).tolist()
        total += len(lengths)
    drawn = sum(map(len, selection.drawn.values()))
    selection.exported.append(f"pictures of {drawn:,} of {total:,} episodes")
    if drawn < total:
        selection.left_out.append(
            f"pictures of {total - drawn:,} episodes (--episodes START:STOP selects; --all: everything)"
        )
