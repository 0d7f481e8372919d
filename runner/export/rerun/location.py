"""Where a step is on the viewer's timeline, and the request that exports it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from runner.analysis.contents import require_steps
from runner.analysis.diff import can_compare_steps, divergences
from runner.analysis.diff.sections import where_in_words
from runner.analysis.episodes import EpisodeRef
from runner.analysis.evaluations import evaluation_after
from runner.export.rerun.selection import Request, evaluations_with_steps, select, time_of
from runner.recording.reader import Recording, open_recording
from runner.replay.recorded import ended_episode
from runner.runs.run import Run


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
            return Location(_default_time(recording, request), request)
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


def _default_time(recording: Recording, request: Request) -> int:
    selected = select(recording, request).by_phase
    for phase in ("eval", "train"):
        if selected[phase]:
            return time_of(recording.phase(phase).steps.one(selected[phase][-1].start))
    return 0
