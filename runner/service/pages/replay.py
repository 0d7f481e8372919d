"""The replay of a run in its page: any step of any episode."""

from __future__ import annotations

import json
from http import HTTPStatus
from typing import Annotated, Any, Final, Literal

from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.responses import RedirectResponse
from starlette.concurrency import run_in_threadpool

from runner.analysis.step_reference import episode_reference
from runner.errors import RunnerError
from runner.recording.reader import Recording, open_recording
from runner.runs.run import Run
from runner.service import played
from runner.service.api.replay import part_of
from runner.service.dependencies import CacheOf, ProcessesOf, RecordedRun, recording_state
from runner.service.pages.frame import framed
from runner.service.pages.problems import message_of
from runner.service.pages.rendering import page
from runner.service.pages.step_address import episode_place

router = APIRouter(prefix="/runs/{run}/replay", include_in_schema=False)

BROAD: Final = 850
"""A grid wider than this is shown over the whole width."""
BEFORE: Final = 250
"""Steps before the one that is asked for in the part that a page shows first, as in `parts.js`."""

Number = Annotated[int, Path(ge=0, lt=2**62)]
T = Annotated[int, Query(ge=0, lt=2**62)]


@router.get("")
async def replay_chosen(
    run: RecordedRun,
    cache: CacheOf,
    processes: ProcessesOf,
    phase: Literal["train", "eval"] | None = None,
    episode: str = "",
    after: str = "",
    trial: str = "",
) -> Response:
    """Lead to the episode that a form asks for, or to the one that is most worth looking at."""
    if phase == "train":
        place = f"train/{_whole(episode)}"
    elif phase == "eval" and after:
        place = f"eval/{_whole(after)}/{_whole(trial)}"
    else:
        key = ("typical", recording_state(run))
        place = (await cache.get_or_await(key, lambda: processes(played.typical, run.recording))).decode()
    return RedirectResponse(f"/runs/{run.run_id}/replay/{place}", HTTPStatus.FOUND)


@router.get("/train/{episode}")
async def replay_training(
    request: Request, run: RecordedRun, cache: CacheOf, processes: ProcessesOf, episode: Number, t: T = 0
) -> Response:
    """Show a step of a training episode."""
    return await _replay(request, run, cache, processes, (episode,), t)


@router.get("/eval/{after}/{trial}")
async def replay_trial(
    request: Request,
    run: RecordedRun,
    cache: CacheOf,
    processes: ProcessesOf,
    after: Number,
    trial: Number,
    t: T = 0,
) -> Response:
    """Show a step of a trial of an evaluation."""
    return await _replay(request, run, cache, processes, (after, trial), t)


# --- inside -------------------------------------------------------------------------------------------


async def _replay(
    request: Request, run: Run, cache: CacheOf, processes: ProcessesOf, which: tuple[int, ...], t: int
) -> Response:
    """Return the page of a step of an episode, rendered by a thread: it reads the recording."""
    part: bytes | RunnerError
    try:
        part = await part_of(run, cache, processes, which, max(0, t - BEFORE))
    except RunnerError as error:
        part = error
    return await run_in_threadpool(_rendered, request, run, which, t, part)


def _rendered(
    request: Request, run: Run, which: tuple[int, ...], t: int, part: bytes | RunnerError
) -> Response:
    """Return the page of a step, or of the error that came of its episode."""
    spot = (*which, t)
    shown: dict[str, Any] = {"problem": "", "part": None}
    status = HTTPStatus.OK
    if isinstance(part, RunnerError):
        shown["problem"], status = message_of(part, request), HTTPStatus.NOT_FOUND
    else:
        shown |= _shown(json.loads(part), t)
    with open_recording(run.recording) as recording:
        around = _around(run, recording, which)
    return page(
        request,
        "run_replay.html",
        status,
        **framed(run, "replay"),
        **around,
        **shown,
        which=which,
        source=f"/api/v1/runs/{run.run_id}/replay/{episode_place(spot)}",
        spot=episode_reference(spot),
    )


def _shown(part: dict[str, Any], t: int) -> dict[str, Any]:
    """Return the picture and the words of a step."""
    import numpy as np

    from runner.drawing import svg

    episode = part["episode"]
    at = min(t, episode["length"])
    i = at - episode["first"]
    picture, key, broad = "", "", False
    if episode["places"]:
        drawing = svg.Drawing(part["scene"])
        places = np.array(episode["places"], np.int16)[episode["state"]].reshape(len(episode["state"]), -1, 3)
        words = episode["states"][episode["state"][i]]
        picture = drawing.frame(places[i], f"The grid: {words}", places[: i + 1], style="")
        key, broad = drawing.key(), drawing.width > BROAD
    action = "none yet: the episode begins" if i == 0 else part["actions"][episode["action"][i - 1]]
    return {
        "part": part,
        "at": at,
        "picture": picture,
        "key": key,
        "broad": broad,
        "state": episode["states"][episode["state"][i]],
        "action": action,
    }


def _around(run: Run, recording: Recording, which: tuple[int, ...]) -> dict[str, Any]:
    """Return which episodes there are, and the addresses of those before and after one."""
    episodes = recording.count(recording.topic("/train/episode"))
    found = [
        {"after": metrics["episode"], "trials": metrics["trials"]}
        for metrics in (recording.iter_metrics("eval") if recording.is_job else [])
    ]
    base = f"/runs/{run.run_id}/replay"
    if len(which) == 1:
        before = f"{base}/train/{which[0] - 1}" if which[0] else ""
        after = f"{base}/train/{which[0] + 1}" if which[0] + 1 < episodes else ""
    else:
        trials = next((each["trials"] for each in found if each["after"] == which[0]), 0)
        before = f"{base}/eval/{which[0]}/{which[1] - 1}" if which[1] else ""
        after = f"{base}/eval/{which[0]}/{which[1] + 1}" if which[1] + 1 < trials else ""
    return {"episodes": episodes, "evaluations": found, "before": before, "after": after}


def _whole(text: str) -> int:
    """Return a whole number from a form; 0 where nothing was typed.

    Raises:
        RunnerError: something else was.
    """
    if text and not (text.isdecimal() and len(text) < 16):
        raise RunnerError(f"found {text[:40]!r}, expected a number of an episode or a trial, from 0.")
    return int(text or 0)
