"""Which steps of a recording are exported: chosen by episode, or a spread of them when nothing is asked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.analysis.evaluations import Evaluation, evaluation_after
from runner.errors import RecordingError
from runner.export.contents import require_steps, shortcomings, whole_ranges, why_no_steps
from runner.recording import schema
from runner.recording.reader import Recording

SPREAD: Final = 20
"""Training episodes of the default choice."""
SPREAD_STEPS: Final = 50_000
"""Steps at which the default choice of training episodes stops growing, however long episodes are."""


@dataclass(frozen=True)
class Request:
    """What was asked for; nothing of it means the default choice."""

    episodes: tuple[tuple[int, int | None], ...] = ()
    """Ranges of training episodes, the second number not included; None is the end."""
    evaluations: tuple[int, ...] = ()
    """Evaluations, named by the training episodes before them."""
    every: int = 0
    """Each so many training episodes; 0 for none."""
    everything: bool = False
    spread: bool = False
    """The default choice beside the rest."""

    @property
    def is_default(self) -> bool:
        """Whether the default choice is exported: nothing was asked for, or it was."""
        return self.spread or not (self.episodes or self.evaluations or self.every or self.everything)


@dataclass(frozen=True, eq=False)
class Episodes:
    """Where each episode of a phase lies; the last may be one that never ended."""

    phase: str
    first_step: NDArray[np.int64]
    """[E + 1]: number of the first step within the phase; the last entry is the number of steps."""
    ended: int

    @property
    def count(self) -> int:
        """Episodes that have steps."""
        return len(self.first_step) - 1


@dataclass(frozen=True)
class Span:
    """Steps `start` up to `stop` of a phase, of whole episodes that follow each other."""

    start: int
    stop: int
    episode: int
    """The first of them."""


@dataclass
class Selection:
    """The chosen steps, and what to say about the choice."""

    train: list[Span] = field(default_factory=list)
    evaluations: list[tuple[Evaluation, Span]] = field(default_factory=list)
    chosen: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @property
    def steps(self) -> int:
        """How many steps are chosen."""
        spans = [*self.train, *(span for _, span in self.evaluations)]
        return sum(span.stop - span.start for span in spans)


def select(recording: Recording, request: Request) -> Selection:
    """Return the steps that a request means.

    Raises:
        RecordingError: an episode or evaluation does not exist, or steps are asked for and not recorded.
    """
    if not recording.is_job:
        return _select_loop(recording, request)
    selection = Selection(warnings=shortcomings(recording))
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
    evaluations = evaluations_with_steps(recording, train, evals)
    numbers = _training_episodes(recording, request, train)
    selection.train = spans_of(train, numbers)
    wanted = _evaluations(recording, request, evaluations)
    selection.evaluations = [
        (one, span) for one in wanted for span in spans_of(evals, np.arange(one.start, one.stop))
    ]
    _tell(selection, request, train, numbers, evaluations, wanted)
    unknown = _steps_without_values(recording, selection.train)
    if unknown:
        selection.warnings.append(
            f"{unknown:,} of these training steps are exported without Q-values: steps before them were "
            "lost, and the Q-tables are unknown until the next snapshot."
        )
    return selection


def chosen_spans(recording: Recording, request: Request) -> list[Span]:
    """Return the training steps that a request means.

    Raises:
        RecordingError: an episode does not exist.
    """
    train = episodes_of(recording, "train")
    return spans_of(train, _training_episodes(recording, request, train))


def episodes_of(recording: Recording, phase: str) -> Episodes:
    """Return where the episodes of a phase lie, one that never ended among them."""
    steps, episodes = schema.PHASES[phase]
    total = recording.count(steps)
    first = np.full(recording.count(episodes) + 1, -1, np.int64)
    first[0] = 0
    for block in recording.blocks(episodes):
        counted = block[block["episode"] < len(first) - 1]
        number, stop = counted["episode"].astype(np.int64), counted["last_step"].astype(np.int64) + 1
        first[number] = stop - counted["length"]
        first[number + 1] = stop
    first = np.maximum.accumulate(first)  # steps of episodes that were lost in a repair count as the first's
    first = first[first <= total]
    ended = len(first) - 1
    return Episodes(phase, np.append(first, total) if total > first[-1] else first, ended)


def evaluations_with_steps(recording: Recording, train: Episodes, evals: Episodes) -> list[Evaluation]:
    """Return the evaluations that have steps, one that was cut off among them."""
    if not evals.count:
        return []
    trials = int(recording.config["evaluation"]["trials"])
    found = []
    for start in range(0, evals.count, trials):
        stop = min(start + trials, evals.count)
        bounds = int(evals.first_step[start]), int(evals.first_step[stop])
        block = next(recording.blocks(schema.EVAL_STEP, *bounds), None)
        if block is None:  # all of its steps were lost in a repair
            continue
        trained = int(block["log_time"][0]) // schema.STEP_NANOSECONDS - (int(block["step"][0]) + 1)
        after = int(np.searchsorted(train.first_step[1 : train.ended + 1], trained, side="right"))
        found.append(Evaluation(after, trained, start, stop))
    return found


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


def spans_of(episodes: Episodes, numbers: NDArray[np.int64]) -> list[Span]:
    """Return the spans of these episodes, ascending; neighbours are one span."""
    if not len(numbers):
        return []
    breaks = np.flatnonzero(np.diff(numbers) != 1) + 1
    runs = np.split(numbers, breaks)
    first = episodes.first_step
    return [Span(int(first[run[0]]), int(first[run[-1] + 1]), int(run[0])) for run in runs]


def _training_episodes(recording: Recording, request: Request, train: Episodes) -> NDArray[np.int64]:
    """Return the numbers of the training episodes that are meant, ascending."""
    if request.everything:
        return np.arange(train.count)
    numbers = [_spread(train)] if request.is_default else []
    if request.every:
        numbers.append(np.arange(0, train.count, request.every))
    ranges = whole_ranges(request.episodes, train.count, "train", str(recording.path))
    numbers += [np.arange(start, stop) for start, stop in ranges]
    return np.unique(np.concatenate(numbers)) if numbers else np.empty(0, np.int64)


def _spread(train: Episodes) -> NDArray[np.int64]:
    """Return episodes evenly spread from the first to the last, no more than are worth it."""
    if not train.count:
        return np.empty(0, np.int64)
    lengths = np.diff(train.first_step)
    for count in range(min(SPREAD, train.count), 1, -1):
        numbers = np.unique(np.linspace(0, train.count - 1, count).round().astype(np.int64))
        if int(lengths[numbers].sum()) <= SPREAD_STEPS:
            return numbers
    return np.unique([0, train.count - 1]).astype(np.int64)


def _evaluations(
    recording: Recording, request: Request, evaluations: Sequence[Evaluation]
) -> list[Evaluation]:
    """Return the evaluations that are meant."""
    if request.everything:
        return list(evaluations)
    where = str(recording.path)
    asked = [evaluation_after(evaluations, after, where) for after in request.evaluations]
    if request.is_default:
        asked += evaluations[-1:]
    return sorted(set(asked), key=lambda one: one.after)


def _tell(
    selection: Selection,
    request: Request,
    train: Episodes,
    numbers: NDArray[np.int64],
    evaluations: Sequence[Evaluation],
    wanted: Sequence[Evaluation],
) -> None:
    """Say what is exported, what is not, and what would include it."""
    spread = (
        f", evenly spread from {numbers[0]} to {numbers[-1]:,}" if request.is_default and len(numbers) else ""
    )
    selection.chosen.append(
        f"the {_steps(selection.train)} steps of {len(numbers):,} of {train.count:,} training episodes"
        + spread
    )
    spans = [span for _, span in selection.evaluations]
    named = (
        f" (after {', '.join(f'{one.after:,}' for one in wanted)} episodes)" if 0 < len(wanted) <= 4 else ""
    )
    selection.chosen.append(
        f"the {_steps(spans)} steps of {len(wanted):,} of {len(evaluations):,} evaluations{named}"
    )
    if len(numbers) < train.count:
        selection.left_out.append(
            f"the steps of {train.count - len(numbers):,} training episodes "
            "(--episodes START:STOP or --every N includes them; --all: everything)"
        )
    if len(wanted) < len(evaluations):
        rest = [one.after for one in evaluations if one not in wanted]
        selection.left_out.append(
            f"the trials of {len(rest):,} evaluations "
            f"(--evaluations {rest[-1]} includes the one after {rest[-1]:,} episodes; --all: everything)"
        )


def _steps(spans: Sequence[Any]) -> str:
    return f"{sum(span.stop - span.start for span in spans):,}"


def _select_loop(recording: Recording, request: Request) -> Selection:
    """Return the steps of a loop that a request means: all, if there are not too many.

    Raises:
        RecordingError: an episode does not exist, or an evaluation is asked for, of which a loop has none.
    """
    if request.evaluations:
        raise RecordingError(
            f"{recording.path}: a loop has no numbered evaluations; --all exports all steps."
        )
    selection = Selection(warnings=shortcomings(recording))
    if recording.kind == "variable":
        selection.warnings.append("Observations and actions vary in size (texts): they are not drawn.")
    total = recording.count(schema.TRAIN_STEP)
    if recording.environments > 1 or recording.kind == "variable" or total <= SPREAD_STEPS:
        stop = total if request.everything else min(total, SPREAD_STEPS)
        selection.train = [Span(0, stop, 0)] if stop else []
    else:
        selection.train = chosen_spans(recording, request)
    tested = recording.count(schema.EVAL_STEP)
    first = 0 if request.everything else max(0, tested - SPREAD_STEPS)
    if tested:
        selection.evaluations = [(Evaluation(0, 0, 0, 0), Span(first, tested, 0))]
    shown = sum(span.stop - span.start for span in selection.train)
    evaluated = f", {tested - first:,} of {tested:,} of evaluation" if tested else ""
    whose = f"of {several} environments the first, in " if (several := recording.environments) > 1 else ""
    selection.chosen.append(f"{whose}{shown:,} of {total:,} training steps{evaluated}")
    if shown < total or first:
        selection.left_out.append(
            f"{total - shown + first:,} steps (--episodes START:STOP chooses; --all: everything)"
        )
    return selection
