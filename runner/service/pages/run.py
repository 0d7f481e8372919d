"""The pages of a run: how it stands, its metrics, any step of any episode, what it learned, what made it."""

from __future__ import annotations

import json
import re
from collections import deque
from datetime import UTC, datetime
from http import HTTPStatus
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

from fastapi import APIRouter, Path, Query, Request, Response
from fastapi.responses import RedirectResponse

from runner import amounts
from runner.errors import RecordingError, RunnerError
from runner.frames import agents_of, evaluation_record
from runner.recording import schema
from runner.recording.reader import Recording, open_recording
from runner.runs import Run
from runner.service import played
from runner.service.api.replay import LONG, part_of
from runner.service.api.runs import Labels, relabelled
from runner.service.dependencies import (
    ApartOf,
    CatalogueOf,
    FoundRun,
    JobsOf,
    KeptOf,
    OpenRecording,
    RecordedRun,
    state_of,
)
from runner.service.pages.forms import Form
from runner.service.pages.rendering import page
from runner.words import event_in_words

if TYPE_CHECKING:
    from runner.service.work import Jobs

router = APIRouter(prefix="/runs/{run}", include_in_schema=False)

TABS: Final = (
    ("", "Overview"),
    ("replay", "Replay"),
    ("episodes", "Episodes"),
    ("evaluations", "Evaluations"),
    ("learned", "What was learned"),
    ("config", "Configuration"),
    ("rerun", "Rerun"),
)
MOST_LINES: Final = 500
"""Lines of a run's log that its page shows: the last ones."""
MOST_EVALUATIONS: Final = 500
_SPOT: Final = re.compile(r"(\d{1,15}):(\d{1,15})|eval:(\d{1,15}):(\d{1,15}):(\d{1,15})")

Number = Annotated[int, Path(ge=0, lt=2**62)]
T = Annotated[int, Query(ge=0, lt=2**62)]


@router.get("")
def overview(request: Request, run: FoundRun, jobs: JobsOf) -> Response:
    """Show how a run stands, and its metrics."""
    return page(request, "run_overview.html", **framed(run, ""), standing=_standing(run, jobs), problem="")


@router.post("/labels")
def label(request: Request, run: FoundRun, form: Form, jobs: JobsOf, catalogue: CatalogueOf) -> Response:
    """Change what people say of a run."""
    tags = form.get("tags", "").split()
    changed = Labels.model_construct(
        name=form.get("name", "").strip(),
        add_tags=tags,
        remove_tags=sorted(set(run.tags) - set(tags)),
        note=form.get("note", ""),
    )
    try:
        relabelled(run, changed, catalogue)
    except RunnerError as error:
        told = framed(run, "") | {"standing": _standing(run, jobs), "problem": str(error)}
        return page(request, "run_overview.html", HTTPStatus.BAD_REQUEST, **told)
    return RedirectResponse(f"/runs/{run.run_id}#labels-title", HTTPStatus.SEE_OTHER)


@router.get("/standing")
def standing(request: Request, run: FoundRun, jobs: JobsOf) -> Response:
    """Return how a run stands, as a part of its page; 204 when it runs no more."""
    if run.status != "running":
        return Response(status_code=HTTPStatus.NO_CONTENT)
    return page(request, "run_standing.html", standing=_standing(run, jobs))


@router.get("/replay")
async def replay_chosen(
    run: RecordedRun,
    kept: KeptOf,
    apart: ApartOf,
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
        key = ("typical", state_of(run))
        place = (await kept.awaited(key, lambda: apart(played.typical, run.recording))).decode()
    return RedirectResponse(f"/runs/{run.run_id}/replay/{place}", HTTPStatus.FOUND)


@router.get("/replay/train/{episode}")
async def replay_training(
    request: Request, run: RecordedRun, kept: KeptOf, apart: ApartOf, episode: Number, t: T = 0
) -> Response:
    """Show a step of a training episode."""
    return await _replay(request, run, kept, apart, (episode,), t)


@router.get("/replay/eval/{after}/{trial}")
async def replay_trial(
    request: Request, run: RecordedRun, kept: KeptOf, apart: ApartOf, after: Number, trial: Number, t: T = 0
) -> Response:
    """Show a step of a trial of an evaluation."""
    return await _replay(request, run, kept, apart, (after, trial), t)


@router.get("/evaluations")
def evaluations(request: Request, run: RecordedRun, recording: OpenRecording) -> Response:
    """Show the last evaluations."""
    is_job = recording.kind == "job"
    last = deque(recording.iter_metrics("eval") if is_job else (), MOST_EVALUATIONS)
    learners, events = agents_of(recording), recording.environment["event_names"]
    return page(
        request,
        "run_evaluations.html",
        **framed(run, "evaluations"),
        evaluations=[evaluation_record(metrics, learners, events) for metrics in last],
        of=recording.count(recording.topic("/eval/metrics")) if is_job else 0,
        learners=learners,
        event_names=[event_in_words(name) for name in events],
    )


@router.get("/learned")
async def learned(request: Request, run: RecordedRun, kept: KeptOf, apart: ApartOf) -> Response:
    """Show policy and values at stages of learning."""
    key = ("learned", state_of(run))
    maps = await kept.awaited(key, lambda: apart(played.learned, run.recording), LONG)
    broad = any(len(row["svgs"][0][1]) > 60_000 for row in json.loads(maps) if row["svgs"])
    return page(request, "run_learned.html", **framed(run, "learned"), maps=json.loads(maps), broad=broad)


@router.get("/config")
def config(request: Request, run: FoundRun) -> Response:
    """Show configuration, provenance and log."""
    from runner.config.document import write_yaml

    facts, provenance, log = _recorded_facts(run)
    return page(
        request,
        "run_config.html",
        **framed(run, "config"),
        yaml=write_yaml(run.facts.get("config", {})),
        facts=facts,
        provenance=provenance,
        log=log,
    )


@router.get("/rerun")
def rerun(request: Request, run: RecordedRun, at: Annotated[str, Query(max_length=60)] = "") -> Response:
    """Show the Rerun viewer, opened at a step."""
    spot = parse_spot(at)
    query = f"?at={at}" if spot else ""
    return page(
        request,
        "run_rerun.html",
        **framed(run, "rerun"),
        told=_spot_in_words(spot),
        back=_replay_address(run, spot),
        frame=f"/runs/{run.run_id}/rerun/frame{query}",
    )


# --- inside -------------------------------------------------------------------------------------------


def parse_spot(text: str) -> tuple[int, ...]:
    """Return (episode, t) or (training episodes before, trial, t) of a spot as `view --at` takes it.

    Raises:
        RunnerError: it is none.
    """
    if not text:
        return ()
    found = _SPOT.fullmatch(text)
    if found is None:
        raise RunnerError(f"at: found {text!r}, expected EPISODE:T such as 120:5, or eval:N:TRIAL:T.")
    return tuple(int(part) for part in found.groups() if part is not None)


def framed(run: Run, here: str) -> dict[str, Any]:
    """Return what every page of a run has."""
    return {"run": head_of(run), "tabs": TABS, "here": here}


def head_of(run: Run) -> dict[str, Any]:
    """Return what the pages say of a run above all else."""
    return {
        "id": run.run_id,
        "name": run.name,
        "seed": run.seed,
        "status": run.status,
        "created": run.created.isoformat(),
        "tags": run.tags,
        "note": run.note,
    }


def _standing(run: Run, jobs: Jobs) -> dict[str, Any]:
    """Return how a run stands: what it did, how far it is, which job makes it."""
    number, progress = _job_of(run, jobs)
    summary = progress or run.summary
    last = summary.get("last_evaluation") or {}
    done = summary.get("episode", summary.get("episodes"))
    to_do = run.facts.get("config", {}).get("episodes")
    facts = {
        "Success in the last evaluation": _percent(last.get("finish_percent")),
        "Mean length of its trials": amounts.number(last.get("mean_length")),
        "Penalties a trial": amounts.number(last.get("mean_penalties")),
        "Training episodes": amounts.UNKNOWN if done is None else f"{done:,}",
        "Steps of training": amounts.number(summary.get("train_steps"), 0),
        "Steps of evaluation": amounts.number(summary.get("eval_steps"), 0),
        "Time": _seconds(run),
        "Recording": amounts.size(summary["bytes"]) if summary.get("bytes") else amounts.UNKNOWN,
    }
    running = run.status == "running" and bool(to_do) and done is not None
    return {
        "facts": list(facts.items()),
        "share": min(1.0, done / to_do) if running else None,
        "said": f"{done:,} of {to_do:,} training episodes" if running else "",
        "error": run.summary.get("error", ""),
        "job": number,
    }


def _job_of(run: Run, jobs: Jobs) -> tuple[int | None, dict[str, Any]]:
    """Return the job that makes a run now, and how far the run is; None and nothing if there is none."""
    for job in jobs.queue.jobs():
        if job.state == "running" and run.run_id in jobs.queue.runs_of(job.number).values():
            progress = jobs.progress(job.number) or {}
            return job.number, progress if progress.get("run_id") == run.run_id else {}
    return None, {}


def _seconds(run: Run) -> str:
    if run.status == "running":
        return f"{amounts.duration((datetime.now(UTC) - run.created).total_seconds())} so far"
    seconds = run.summary.get("seconds")
    return amounts.UNKNOWN if seconds is None else amounts.duration(seconds)


def _percent(value: float | None) -> str:
    return amounts.UNKNOWN if value is None else f"{amounts.number(value)} %"


async def _replay(
    request: Request, run: Run, kept: KeptOf, apart: ApartOf, which: tuple[int, ...], t: int
) -> Response:
    """Return the page of a step of an episode."""
    place = "/".join(map(str, which))
    phase = "train" if len(which) == 1 else "eval"
    shown: dict[str, Any] = {"problem": "", "part": None}
    status = HTTPStatus.OK
    try:
        shown |= _shown(json.loads(await part_of(run, kept, apart, which, _start(t))), t)
    except RunnerError as error:
        shown["problem"], status = str(error), HTTPStatus.NOT_FOUND
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
        source=f"/api/v1/runs/{run.run_id}/replay/{phase}/{place}",
        spot=f"{which[0]}" if phase == "train" else f"eval:{which[0]}:{which[1]}",
    )


def _start(t: int) -> int:
    """Return where the part of an episode begins that a page at a step shows first: as the script asks."""
    return max(0, t - 250)


def _shown(part: dict[str, Any], t: int) -> dict[str, Any]:
    """Return the picture and the words of a step."""
    import numpy as np

    from runner.export import svg

    episode = part["episode"]
    at = min(t, episode["length"])
    i = at - episode["first"]
    picture, key, broad = "", "", False
    if episode["places"]:
        drawing = svg.Drawing(part["scene"])
        places = np.array(episode["places"], np.int16)[episode["state"]].reshape(len(episode["state"]), -1, 3)
        words = episode["states"][episode["state"][i]]
        picture = drawing.frame(places[i], f"The grid: {words}", places[: i + 1], style="")
        picture = picture.replace("<style></style>", "")
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
        for metrics in (recording.iter_metrics("eval") if recording.kind == "job" else [])
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


def _recorded_facts(run: Run) -> tuple[dict[str, str], dict[str, str], list[dict[str, Any]]]:
    """Return what identifies a recording, where it was made, and what its run said; as far as it is there."""
    facts = {
        "Run": run.run_id,
        "Begun": f"{run.created:%Y-%m-%d %H:%M:%S} UTC",
        "Content digest": run.summary.get("content_digest") or "none: told when a run ends properly",
        "Steps": f"{amounts.number(run.summary.get('train_steps'), 0)} of training, "
        f"{amounts.number(run.summary.get('eval_steps'), 0)} of evaluation",
    }
    try:
        with open_recording(run.recording) as recording:
            facts |= {"Job": recording.run.get("job", ""), "Size": amounts.size(recording.size)}
            return facts, recording.provenance, _log(recording)
    except RecordingError as error:
        return facts | {"Recording": str(error)}, {}, []


def _log(recording: Recording) -> list[dict[str, Any]]:
    from collections import deque

    lines = deque(recording.decoded(schema.LOG_TOPIC), MOST_LINES)
    return [
        {
            "step": line["log_time"] // schema.STEP_NANOSECONDS,
            "level": _LEVELS.get(line["level"], str(line["level"])),
            "message": line["message"],
        }
        for line in lines
    ]


_LEVELS: Final = {1: "debug", 2: "info", 3: "warning", 4: "error", 5: "fatal"}
BROAD: Final = 850
"""A grid wider than this is shown over the whole width."""


def _spot_in_words(spot: tuple[int, ...]) -> str:
    match spot:
        case (episode, t):
            return f"Training episode {episode:,}, step {t}."
        case (after, trial, t):
            return f"Trial {trial} of the evaluation after {after:,} episodes, step {t}."
    return "Some training episodes and the last evaluation."


def _replay_address(run: Run, spot: tuple[int, ...]) -> str:
    match spot:
        case (episode, t):
            return f"/runs/{run.run_id}/replay/train/{episode}?t={t + 1}"
        case (after, trial, t):
            return f"/runs/{run.run_id}/replay/eval/{after}/{trial}?t={t + 1}"
    return ""


def _whole(text: str) -> int:
    """Return a whole number from a form; 0 where nothing was typed.

    Raises:
        RunnerError: something else was.
    """
    if text and not (text.isdecimal() and len(text) < 16):
        raise RunnerError(f"found {text[:40]!r}, expected a number of an episode or a trial, from 0.")
    return int(text or 0)
