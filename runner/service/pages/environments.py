"""The environments of a vector side by side, during an episode of one of them."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Final

from fastapi import APIRouter, Depends, Response

from runner.analysis.episodes import EpisodeRef
from runner.recording.reader import Recording, open_recording
from runner.recording.steps import EpisodeSteps
from runner.runs.run import Run
from runner.service.dependencies import EPISODES, RecordedRun
from runner.service.pages.frame import RunPage
from runner.service.pages.replay import T, panel_of

router = APIRouter(prefix="/runs/{run}/replay", include_in_schema=False)

MAX_PANELS: Final = 8
"""Environments of a vector that a page shows side by side."""


def _add_route(path: str, episode: Callable[..., Awaitable[EpisodeRef]]) -> None:
    @router.get(f"{path}/environments")
    def environments(
        run: RecordedRun,
        at: EpisodeRef = Depends(episode),  # noqa: B008 - as FastAPI reads it
        t: T = 0,
    ) -> Response:
        """Show all environments of a vector during an episode of one of them."""
        values = _environments(run, replace(at, t=t))
        return RunPage(run, "replay", "run_environments.html", values)


for _path, _episode in EPISODES.items():
    _add_route(_path, _episode)


def _environments(run: Run, at: EpisodeRef) -> dict[str, object]:
    """Return the values of the page: an episode, and the other environments' episodes at its first step."""
    base = f"/runs/{run.run_id}/replay"
    with open_recording(run.recording) as recording:
        shown = at.number_in(recording)
        steps = recording.phase(at.phase).episode(shown)
        turns = steps.table.round_of(steps.first)
        # The first trial of the evaluation, within which trials are numbered.
        first = shown - at.episode
        panels = []
        for environment, number in _episodes_at(recording, at.phase, steps, shown)[:MAX_PANELS]:
            begun = steps.table.round_of(recording.phase(at.phase).episode(number).first)
            path = replace(at, episode=number - first, t=0).episode_path
            name = "trial" if at.after is not None else "episode"
            panel = panel_of(
                recording,
                at.phase,
                f"/api/v1{base}/{path}",
                f"Environment {environment}: {name} {number - first:,}",
                offset=(begun.start - turns.start) // len(turns),
                address=f"{base}/{path}",
            )
            panels.append(panel)
        return {
            "title": at.heading,
            "alone": f"{base}/{at.episode_path}",  # the replay of the episode alone
            "shown": panels,
            "length": len(steps),
            "t": min(at.t, len(steps)),
            "left_out": max(0, recording.environments - len(panels)),
        }


def _episodes_at(
    recording: Recording, phase: str, steps: EpisodeSteps, episode: int
) -> list[tuple[int, int]]:
    """Return each environment and the number of its episode at the first step of another one, if it ended."""
    episodes, begin = recording.phase(phase).episodes, steps.table.round_of(steps.first).start
    by_environment = {steps.environment: episode}
    if not steps.table.have_turns:
        return list(by_environment.items())
    names = ("environment", "episode", "last_step")
    for block in episodes.blocks(episodes.first_from("last_step", begin)):
        for environment, number, last in zip(*(block[name].tolist() for name in names), strict=True):
            if last >= begin:
                by_environment.setdefault(environment, number)
        if len(by_environment) == recording.environments:
            break
    return sorted(by_environment.items())
