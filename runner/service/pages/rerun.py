"""The Rerun web viewer, from this service: its files are those of the installed package.

The package has them only inside its executable, which serves them. So they are taken from there once, over
loopback, and kept in the user's cache.
"""

from __future__ import annotations

import contextlib
import http.client
import tempfile
from http import HTTPStatus
from pathlib import Path
from typing import Annotated, Any, Final

from fastapi import APIRouter, HTTPException, Query, Request, Response
from fastapi.responses import FileResponse

from runner.analysis.step_reference import parse_step_reference
from runner.service import played
from runner.service.api.replay import LONG
from runner.service.dependencies import CacheOf, ProcessesOf, RecordedRun, recording_state
from runner.service.guard import POLICY
from runner.service.pages.frame import framed
from runner.service.pages.rendering import link, page
from runner.service.pages.step_address import episode_in_words, replay_address
from runner.util.files import cache_folder, replacing, storage_errors

router = APIRouter(include_in_schema=False)

FILES: Final = {"re_viewer.js": "text/javascript", "re_viewer_bg.wasm": "application/wasm"}
FRAME_POLICY: Final = POLICY.replace(
    "default-src 'self';", "default-src 'self'; script-src 'self' 'wasm-unsafe-eval';"
)
"""WebAssembly is compiled in this one page, and nothing else is allowed in it that is not elsewhere."""
OVERVIEW: Final = "Some training episodes and the last evaluation."
"""What the viewer shows unless it is opened at a step."""
_FOREVER: Final = "public, max-age=31536000, immutable"
_SECONDS: Final = 60


@router.get("/runs/{run}/rerun")
def viewer(request: Request, run: RecordedRun, at: Annotated[str, Query(max_length=60)] = "") -> Response:
    """Show the Rerun viewer, opened at a step."""
    spot = parse_step_reference(at) if at else ()
    return page(
        request,
        "run_rerun.html",
        **framed(run, "rerun"),
        told=f"{episode_in_words(spot)}, step {spot[-1]}." if spot else OVERVIEW,
        back=replay_address(run, spot) if spot else "",
        frame=link(f"/runs/{run.run_id}/rerun/frame", {"at": at}),
    )


@router.get("/runs/{run}/rerun/frame")
async def frame(
    request: Request,
    run: RecordedRun,
    cache: CacheOf,
    processes: ProcessesOf,
    at: Annotated[str, Query(max_length=60)] = "",
) -> Response:
    """Show nothing but the viewer, at a step."""
    spot = parse_step_reference(at) if at else ()
    key = ("spot", recording_state(run), spot)
    step = await cache.get_or_await(key, lambda: processes(played.spot, run, spot), LONG)
    asked: dict[str, Any] = {"episodes": spot[0]} if len(spot) == 2 else {"evaluations": list(spot[:1])}
    found = page(
        request,
        "rerun_frame.html",
        title=f"{run.name}, {run.run_id}",
        files=f"/static/rerun/{version()}",
        recording=link(f"/api/v1/runs/{run.run_id}/replay.rrd", asked),
        step=int(step),
    )
    found.headers["content-security-policy"] = FRAME_POLICY
    return found


@router.api_route("/static/rerun/{number}/{name}", methods=["GET", "HEAD"])
def viewer_file(number: str, name: str) -> Response:
    """Return a file of the viewer."""
    if name not in FILES or number != version():
        raise HTTPException(HTTPStatus.NOT_FOUND)
    return FileResponse(viewer_files() / name, media_type=FILES[name], headers={"cache-control": _FOREVER})


def version() -> str:
    """Return the version of the installed viewer.

    Raises:
        MissingExtra: there is none.
    """
    from importlib.metadata import PackageNotFoundError
    from importlib.metadata import version as installed

    from runner.util.extras import missing

    try:
        return installed("rerun-sdk")
    except PackageNotFoundError as error:
        raise missing("rerun", "all", "the Rerun viewer") from error


def viewer_files() -> Path:
    """Return the folder of the viewer's files, which are taken from the package when first asked for.

    Raises:
        ViewerError: the viewer cannot be started.
        StorageError: the cache cannot be written.
    """
    from filelock import FileLock

    folder = cache_folder() / "viewer" / version()
    if _is_whole(folder):
        return folder
    with storage_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(folder / "lock", timeout=_SECONDS):
            if not _is_whole(folder):
                _take(folder)
    return folder


def _is_whole(folder: Path) -> bool:
    return all((folder / name).is_file() for name in FILES)


def _take(folder: Path) -> None:
    """Take the files from the executable, which serves them."""
    from runner.export.rerun import viewer

    port, data = viewer.free_port(), viewer.free_port()
    with tempfile.TemporaryDirectory() as place:
        log = Path(place) / "viewer.log"
        options = ("--serve-web", "--web-viewer-port", str(port))
        with viewer.viewer(data, *options, log=log) as process:
            viewer.wait_for(process, port, log)
            for name in FILES:
                with replacing(folder / name) as fresh:
                    fresh.write_bytes(_fetched(port, name))


def _fetched(port: int, name: str) -> bytes:
    from runner.export.rerun import viewer

    with contextlib.closing(
        http.client.HTTPConnection(viewer.LOOPBACK, port, timeout=_SECONDS)
    ) as connection:
        connection.request("GET", f"/{name}")
        answer = connection.getresponse()
        body = answer.read()
    if answer.status != HTTPStatus.OK or len(body) < 1000:
        raise viewer.ViewerError(f"the Rerun viewer has no {name}; install rerun-sdk again.")
    return body
