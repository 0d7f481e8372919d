"""Where to look: a step of an episode as a point of the timeline."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

from runner.analysis.diff import can_compare_steps
from runner.analysis.diff.divergence import evaluation_divergences, training_divergence
from runner.analysis.diff.sections import where_in_words
from runner.analysis.evaluations import evaluation_after, evaluations_of
from runner.errors import RecordingError
from runner.export.contents import require_steps
from runner.export.rerun.selection import Request, episodes_of, evaluations_with_steps, select
from runner.recording import schema
from runner.recording.reader import Recording, open_recording
from runner.runs.run import Run


@dataclass(frozen=True)
class Spot:
    """A point of the timeline, and a request that its episode is part of."""

    time: int
    request: Request


def with_spot(run: Run, request: Request, spot: tuple[int, ...] | None) -> Spot:
    """Return where a spot is.

    Args:
        run: whose.
        request: what is exported anyway.
        spot: (episode, t) of training, (training episodes, trial, t) of an evaluation, or None for the
            beginning of what is most worth looking at.

    Raises:
        RecordingError: there is no such step, or none at all.
    """
    with open_recording(run.recording) as recording:
        if spot is None:
            return Spot(_beginning(recording, request), request)
        require_steps(recording, "look at")
        phase, step, more = _train_step(recording, *spot) if len(spot) == 2 else _eval_step(recording, *spot)
        topic = schema.PHASES[phase][0]
        record = next(recording.blocks(topic, step, step + 1))[0]
    return Spot(int(record["log_time"]) // schema.STEP_NANOSECONDS, _including(request, more))


def where_they_diverge(runs: Sequence[Run]) -> tuple[tuple[int, ...] | None, str]:
    """Return where two runs diverge, as `with_spot` takes it, and a sentence about it.

    That is the first step of training that differs, or else the first evaluation's. None where they do not
    diverge, or where it cannot be known.
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
            further = divergence is not None
            divergence = next(evaluation_divergences(a, b), None)
            if divergence is None:
                ends = ", as far as the shorter goes" if further else ""
                return None, f"They never diverge: every step is the same{ends}."
    if divergence.after is None:
        return (divergence.episode, divergence.t), f"They diverge {where_in_words(divergence)}."
    return (divergence.after, divergence.episode, divergence.t), f"They diverge {where_in_words(divergence)}."


def _train_step(recording: Recording, episode: int, t: int) -> tuple[str, int, Request]:
    train = episodes_of(recording, "train")
    if episode >= train.count:
        raise RecordingError(
            f"{recording.path}: found no training episode {episode}; there are {train.count:,}, from 0."
        )
    step = _within(recording, train.first_step[episode], train.first_step[episode + 1], t)
    return "train", step, Request(episodes=((episode, episode + 1),))


def _eval_step(recording: Recording, after: int, trial: int, t: int) -> tuple[str, int, Request]:
    train, evals = episodes_of(recording, "train"), episodes_of(recording, "eval")
    job, where = recording.is_job, str(recording.path)
    known = evaluations_with_steps(recording, train, evals) if job else evaluations_of(recording)
    evaluation = evaluation_after(known, after, where)
    number = evaluation.trial(trial, where)
    step = _within(recording, evals.first_step[number], evals.first_step[number + 1], t)
    return "eval", step, Request(evaluations=(after,)) if job else Request()  # a loop's are there anyway


def _within(recording: Recording, first: int, stop: int, t: int) -> int:
    if first + t >= stop:
        raise RecordingError(
            f"{recording.path}: found no t = {t} there; the episode has {stop - first} steps, from 0."
        )
    return int(first + t)


def _including(request: Request, more: Request) -> Request:
    """Return a request with another's episodes in it; the default choice stays what it is beside them."""
    if request.everything:
        return request
    return dataclasses.replace(
        request,
        episodes=request.episodes + more.episodes,
        evaluations=request.evaluations + more.evaluations,
        spread=request.spread or request.is_default,
    )


def _beginning(recording: Recording, request: Request) -> int:
    """Return the first step of the last evaluation exported, or else of the last training episode."""
    selection = select(recording, request)
    if recording.kind == "variable":
        return 0
    topic, first = schema.EVAL_STEP, [span.start for _, span in selection.evaluations[-1:]]
    if not first:
        topic, first = schema.TRAIN_STEP, [span.start for span in selection.train[-1:]]
    if not first:
        return 0
    return (
        int(next(recording.blocks(topic, first[0], first[0] + 1))[0]["log_time"]) // schema.STEP_NANOSECONDS
    )
