"""When something became true in training, exactly: an expression evaluated after every recorded step.

    found = runner.when(run, 'greedy[300] == "pickup + east"')
    print(found.first.at)                     # the step, as the replay finds it
    for interval in runner.when(run, "max(q[300]) > 20", every=True).intervals:
        print(interval.start.step, interval.end and interval.end.step)

`runner.debugging.expressions` lists what an expression may contain.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Final

import numpy as np

from runner.analysis.contents import require_steps
from runner.analysis.episodes import EXPECTED_OF_TRAINING, EpisodeRef, StepLike, training_step
from runner.analysis.sections import Answer, Grid, Link, Section
from runner.archive.places import opened
from runner.debugging.expressions import Array, Columns, Expression, JobColumns, JobParser, Series, check_lost
from runner.errors import RecordingError, RunnerError
from runner.recording.reader import Recording
from runner.runs.run import Run
from runner.util.expressions import CONDITION
from runner.util.humanize import UNKNOWN, counted
from runner.util.processes import Report
from runner.util.values import Json

MAX_INTERVALS: Final = 10_000
"""The most intervals of a result; further ones are counted."""
MAX_VALUES: Final = 60_000
"""The most parts of the expression, each with its values, at the ends of all intervals."""

Scalar = float | int | bool | str | None


@dataclass(frozen=True)
class Value:
    """A part of the expression before and after a step."""

    expression: str
    before: Scalar
    """None for NaN, and for any value before the first training step."""
    after: Scalar


@dataclass(frozen=True)
class WhenMoment:
    """A training step at which the expression changed."""

    step: int
    """The number of the training step, from 0."""
    episode: int
    t: int
    values: tuple[Value, ...]
    """The quantities of the expression, and the conditions that it combines."""

    @property
    def at(self) -> EpisodeRef:
        """The step, as replays are addressed."""
        return EpisodeRef(self.episode, self.t)


@dataclass(frozen=True)
class Interval:
    """Training steps after each of which the expression holds."""

    start: WhenMoment
    """The first of them."""
    end: WhenMoment | None
    """The step after which it no longer holds; None if it holds to the end, or only `start` was searched."""


@dataclass(frozen=True)
class When(Answer):
    """When an expression held."""

    run_id: str
    expression: str
    every: bool
    """Whether all intervals were searched, or only the beginning of the first."""
    searched: tuple[int, int]
    """The first and the last training step after which it was evaluated."""
    held_before: bool | None
    """Whether it held before the first of them; None if it depends on a step before the first one."""
    intervals: tuple[Interval, ...]
    """At most 10,000, fewer if the expression has many parts; the first one only unless `every`."""
    count: int
    """The number of all intervals that were found."""
    steps: int | None
    """The number of steps after which it holds; None unless `every`."""
    last: WhenMoment
    """The last step of the search."""
    states: tuple[tuple[int, str], ...]
    """The states in the expression, with their names."""

    @property
    def first(self) -> WhenMoment | None:
        """The first step after which the expression holds; None if there is none."""
        return self.intervals[0].start if self.intervals else None

    def as_json(self) -> Json:
        """Return the result as JSON can hold it; each moment with its step reference as `at`."""
        result = asdict(self)
        for moment in (
            result["last"],
            *(interval[k] for interval in result["intervals"] for k in ("start", "end")),
        ):
            if moment is not None:
                at = EpisodeRef(moment["episode"], moment["t"])
                moment |= {"at": str(at), "replay": at.replay_address(self.run_id)}
        return result

    @property
    def step_to_look_at(self) -> EpisodeRef | None:
        """The first step after which the expression holds."""
        return None if self.first is None else self.first.at

    def sections(self) -> list[Section]:
        """Return the result as sentences and tables: the first moment, and the intervals."""
        first, last = self.searched
        sentences = [f"State {number}: {name}." for number, name in self.states]
        if self.first is None:
            sentences.append(f"It holds after none of the training steps {first:,} to {last:,}.")
            rows = [(value.expression, _text(value.after)) for value in self.last.values]
            return [Section(self.expression, sentences, [Grid(("at the end", "value"), rows)])]
        moment = self.first
        where = (
            f"training step {moment.step:,}, step {moment.t:,} of episode {moment.episode:,} ({moment.at})"
        )
        if not self.every:
            sentences.append(f"It holds first after {where}.")
        else:
            sentences.append(
                f"It holds after {self.steps:,} of the training steps {first:,} to {last:,}, in "
                f"{counted(self.count, 'interval')}; first after {where}."
            )
        if self.held_before and moment.step == first:
            sentences.append("It held before that step too.")
        changes = [(value.expression, _text(value.before), _text(value.after)) for value in moment.values]
        grids = [Grid(("first", "before", "after"), changes)]
        if self.every:
            grids.append(_intervals_grid(self.intervals, last))
            if len(self.intervals) < self.count:
                sentences.append(f"The first {len(self.intervals):,} intervals are listed.")
        links = [Link("Replay this step", moment.at.replay)]
        return [Section(self.expression, sentences, grids, links=links)]


def when(
    run: Run | Recording,
    expression: str,
    *,
    every: bool = False,
    first: StepLike | None = None,
    last: StepLike | None = None,
    report: Report = lambda _: None,
    limit: int = MAX_INTERVALS,
) -> When:
    """Return the first training step after which an expression holds, or every interval in which it does.

    Args:
        run: a run that was trained here, with its steps, or its open recording.
        expression: such as `q[300, "north + east"] > 5 and visits[300] >= 100`.
        every: search all intervals.
        first: the first training step to evaluate it after: its number, `EPISODE:T` or `step:N`; 0 by
            default.
        last: the last one; by default that of the run.
        report: called with the number of steps searched so far.
        limit: the most intervals to list.

    Raises:
        RunnerError: the expression is invalid, with a mark at its place; or the run is a loop.
        RecordingError: there is no such step, steps are not recorded, or the recording is damaged.
    """
    with opened(run) as recording:
        recording.require_job("`when`", "A loop has no Q-tables; `dualtaxi plot` shows what it logged.")
        parser = JobParser(expression, recording)
        parsed = parser.parse()
        require_steps(recording, "search")
        start = 0 if first is None else _step_number(recording, first)
        stop = recording.train.steps.count() if last is None else _step_number(recording, last) + 1
        if not recording.train.steps.count():
            raise RecordingError(f"{recording.path}: has no training steps.")
        if start >= stop:
            raise RunnerError(
                f"found first step {start:,} and last step {stop - 1:,}, expected them in order."
            )
        columns = JobColumns(recording, list(parser.quantities), max(start - 1, 0))
        if start:  # bring the columns to the step before the first
            for block in recording.train.steps.blocks(start - 1, start):
                deque(columns.take(block, 0), maxlen=0)
        with np.errstate(all="ignore"):
            held_before = bool(_values(parsed.condition, columns.last)[0])
            is_known = not any(np.isnan(_values(term, columns.last)).any() for term in parsed.terms)
            moments, count, steps, end = _search(
                recording, parsed, columns, every, limit, start, stop, report
            )
        return When(
            run_id=recording.run_id,
            expression=parsed.text,
            every=every,
            searched=(start, end.step),
            held_before=held_before if is_known else None,
            intervals=tuple(map(Interval, moments[::2], [*moments[1::2], None])),
            count=count,
            steps=steps if every else None,
            last=end,
            states=parser.states,
        )


def _search(
    recording: Recording,
    expression: Expression,
    columns: JobColumns,
    every: bool,
    intervals: int,
    start: int,
    stop: int,
    report: Report,
) -> tuple[list[WhenMoment], int, int, WhenMoment]:
    """Evaluate an expression after the steps from `start` to before `stop`; unless `every`, to the first.

    Returns:
        The steps at which it begins and ceases to hold, in turn; the number of intervals; the number of steps
        after which it holds; and the last step.
    """
    moments: list[WhenMoment] = []
    count = 0
    steps = 0
    holds = False
    expected = start
    limit = 2 * min(intervals, MAX_INTERVALS, MAX_VALUES // (2 * max(1, len(expression.terms))))
    for block in recording.train.steps.blocks(start, stop):
        first = int(block["step"][0])
        check_lost(recording, expected, first)
        expected = first + len(block)
        for places, values in columns.take(block, 0 if first == start else -1):
            held = _values(expression.condition, values).copy()
            held[0] = holds  # what holds before `start` begins at `start`
            holds = bool(held[-1])
            changed = np.flatnonzero(held[1:] != held[:-1])
            if not len(changed):
                continue
            numbers = block["step"][places[changed]]
            begins = held[1:][changed]
            count += int(np.count_nonzero(begins))
            steps += int(numbers[~begins].sum()) - int(numbers[begins].sum())
            listed = changed[: limit - len(moments) if every else 1].tolist()
            if listed:
                parts = [(term, _values(term, values)) for term in expression.terms]
                moments += [_moment(block[places[k]], parts, k, k + 1) for k in listed]
            if not every:
                return moments, 1, 0, moments[0]
        report(expected - start)
    check_lost(recording, expected, stop)
    parts = [(term, _values(term, columns.last)) for term in expression.terms]
    return moments, count, steps + stop * holds, _moment(block[-1], parts, 0, 0)


def _values(term: Series, columns: Columns) -> Array:
    """Return the values of a term in all rows of the columns."""
    rows = len(next(iter(columns.values())))
    return np.broadcast_to(term.evaluate(columns), rows)


def _moment(step: np.void, parts: Sequence[tuple[Series, Array]], before: int, after: int) -> WhenMoment:
    have_values = [not any(np.isnan(column[row]) for _, column in parts) for row in (before, after)]
    values = [
        Value(
            term.text,
            _scalar(term, column[before], have_values[0]),
            _scalar(term, column[after], have_values[1]),
        )
        for term, column in parts
    ]
    return WhenMoment(int(step["step"]), int(step["episode"]), int(step["t"]), tuple(values))


def _scalar(term: Series, value: np.float64 | np.bool_, is_known: bool) -> Scalar:
    if term.kind == CONDITION:
        return bool(value) if is_known else None
    if np.isnan(value):
        return None
    if term.names:
        return term.names[int(value)]
    return int(value) if term.is_whole else float(value)


def _step_number(recording: Recording, at: StepLike) -> int:
    return training_step(recording, EpisodeRef.parse(at, EXPECTED_OF_TRAINING))


# --- as text ----------------------------------------------------------------------------------------------


def _intervals_grid(intervals: Sequence[Interval], last: int) -> Grid:
    rows = []
    for interval in intervals:
        end = interval.end
        steps = (last + 1 if end is None else end.step) - interval.start.step
        lost = (UNKNOWN, UNKNOWN) if end is None else (f"{end.step:,}", str(end.at))
        rows.append((f"{interval.start.step:,}", str(interval.start.at), *lost, f"{steps:,}"))
    headings = ("from step", "episode:t", "lost at step", "episode:t", "steps")
    return Grid(headings, rows, "Intervals", [interval.start.at.replay for interval in intervals])


def _text(value: Scalar) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return f"{value:,.6g}"
    return UNKNOWN if value is None else f"{value:,}" if isinstance(value, int) else value
