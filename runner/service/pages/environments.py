"""The environments of a vector side by side, during an episode of one of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

from fastapi import APIRouter, Depends, Request, Response

from runner.analysis.episodes import EpisodeRef
from runner.recording.reader import Recording, open_recording
from runner.runs.run import Run
from runner.service.dependencies import EPISODES, RecordedRun
from runner.service.pages.frame import run_page
from runner.service.pages.replay import T, panel_of

router = APIRouter(prefix="/runs/{run}/replay", include_in_schema=False)

MAX_PANELS: Final = 8
"""Environments of a vector that a page shows side by side."""


def _add_route(path: str, episode: Callable[..., EpisodeRef]) -> None:
    @router.get(f"{path}/environments")
    def environments(
        request: Request,
        run: RecordedRun,
        at: EpisodeRef = Depends(episode),  # noqa: B008 - as FastAPI reads it
        t: T = 0,
    ) -> Response:
        """Show all environments of a vector during an episode of one of them."""
        values = _environments(run, replace(at, t=t))
        return run_page(request, run, "replay", "run_environments.html", values)


for _path, _episode in EPISODES.items():
    _add_route(_path, _episode)


def _environments(run: Run, at: EpisodeRef) -> dict[str, object]:
    """Return the values of the page of an episode and those of the other environments at its first step."""
    base = f"/runs/{run.run_id}/replay"
    with open_recording(run.recording) as recording:
        shown = at.number_in(recording)
        span = recording.phase(at.phase).episode_span(shown)
        # Trials are numbered within their evaluation, whose first one this is.
        first = shown - at.episode
        panels = []
        for environment, number in _episodes_at(recording, at.phase, shown, span)[:MAX_PANELS]:
            own = recording.phase(at.phase).episode_span(number)
            path = replace(at, episode=number - first, t=0).episode_path
            name = "trial" if at.after is not None else "episode"
            panel = panel_of(
                recording,
                at.phase,
                f"/api/v1{base}/{path}",
                f"Environment {environment}: {name} {number - first:,}",
                offset=own.start // own.step - span.start // span.step,
                address=f"{base}/{path}",
            )
            panels.append(panel)
        return {
            "title": at.heading,
            "alone": f"{base}/{at.episode_path}",  # the replay of the episode alone
            "shown": panels,
            "length": len(span),
            "t": min(at.t, len(span)),
            "left_out": max(0, recording.environments - len(panels)),
        }


def _episodes_at(recording: Recording, phase: str, episode: int, span: range) -> list[tuple[int, int]]:
    """Return each environment and the number of its episode at the first step of another one, if it ended."""
    episodes, n = recording.phase(phase).episodes, span.step
    begin = span.start // n * n
    by_environment = {span.start % n: episode}
    for block in episodes.blocks(episodes.first_from("last_step", begin)):
        for last, number in zip(block["last_step"].tolist(), block["episode"].tolist(), strict=True):
            if last >= begin:
                by_environment.setdefault(last % n, number)
        if len(by_environment) == n:
            break
    return sorted(by_environment.items())
