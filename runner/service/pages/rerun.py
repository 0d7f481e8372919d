"""The Rerun web viewer, served with the files of the installed package.

The package contains them only inside its executable, which serves them. So they are fetched from there once,
over loopback, and kept in the user's cache.
"""

from __future__ import annotations

import json
from http import HTTPStatus
from importlib import metadata
from pathlib import Path
from typing import Final

import httpx2
from fastapi import APIRouter, HTTPException, Response
from fastapi.responses import FileResponse
from filelock import FileLock

from runner.export.rerun import viewer as native_viewer
from runner.recording.fields import varint
from runner.service import computed
from runner.service.computed import link
from runner.service.dependencies import At, ComputationOf, RecordedRun
from runner.service.guard import POLICY
from runner.service.pages.rendering import Page, run_page
from runner.service.pages.replay import step_of
from runner.util.extras import missing
from runner.util.files import cache_folder, replacing, storage_errors

router = APIRouter(include_in_schema=False)

FILES: Final = {"re_viewer.js": "text/javascript", "re_viewer_bg.wasm": "application/wasm"}
FRAME_POLICY: Final = POLICY.replace(
    "default-src 'self';", "default-src 'self'; script-src 'self' 'wasm-unsafe-eval';"
)
"""The policy of all pages, except that this one may compile WebAssembly."""
OVERVIEW: Final = "Some training episodes and the last evaluation."
"""Content of the viewer unless it is opened at a step."""
_FOREVER: Final = "public, max-age=31536000, immutable"
_SECONDS: Final = 60


@router.get("/runs/{run}/rerun")
async def viewer(run: RecordedRun, compute: ComputationOf, at: At = "") -> Response:
    """Show the Rerun viewer, opened at a step."""
    step = await step_of(run, compute, at) if at else None
    if step:  # an error is shown here rather than in the frame
        await compute(computed.viewer_place, run, step)
    content = f"{step.heading}, step {step.t}." if step else OVERVIEW
    back = step.replay_address(run.run_id) if step else ""
    frame = link(f"/runs/{run.run_id}/rerun/frame", {"at": at})
    values = {"content": content, "back": back, "frame": frame}
    return run_page(run, "rerun", "run_rerun.html", values)


@router.get("/runs/{run}/rerun/frame")
async def frame(run: RecordedRun, compute: ComputationOf, at: At = "") -> Response:
    """Show the viewer alone, opened at a step."""
    step = await step_of(run, compute, at) if at else None
    place = json.loads(await compute(computed.viewer_place, run, step))
    query: dict[str, object] = {}
    if step:
        query = {"episodes": step.episode} if step.after is None else {"evaluations": step.after}
        if not run.can_train_again:
            query |= {"trials": place["trials"], "frames": "true"}
    response = Page(
        "rerun_frame.html",
        lambda: {
            "title": f"{run.name}, {run.run_id}",
            "files": f"/static/rerun/{version()}",
            "recording": link(f"/api/v1/runs/{run.run_id}/replay.rrd", query),
            "step": place["time"],
            "command": _set_time(place["time"]),
        },
    )
    response.headers["content-security-policy"] = FRAME_POLICY
    return response


@router.api_route("/static/rerun/{number}/{name}", methods=["GET", "HEAD"])
def viewer_file(number: str, name: str) -> Response:
    """Return a file of the viewer."""
    if name not in FILES or number != version():
        raise HTTPException(HTTPStatus.NOT_FOUND)
    return FileResponse(viewer_files() / name, media_type=FILES[name], headers={"cache-control": _FOREVER})


def _set_time(time: int) -> str:
    """Return the command that pauses the viewer at a step: Protobuf of `rerun.viewer_control.v1alpha1`."""

    def part(number: int, content: bytes) -> bytes:
        return bytes((number << 3 | 2, len(content))) + content

    cursor = part(2, part(1, b"step")) + part(3, b"\x08" + varint(time)) + b"\x28\x01"
    return part(6, cursor).hex()


def version() -> str:
    """Return the version of the installed viewer."""
    try:
        return metadata.version("rerun-sdk")
    except metadata.PackageNotFoundError as error:
        raise missing("rerun", "all", "the Rerun viewer") from error


def viewer_files() -> Path:
    """Return the folder of the viewer's files, which are fetched from the package on first use."""
    folder = cache_folder() / "viewer" / version()
    if all((folder / name).is_file() for name in FILES):
        return folder
    with storage_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(folder / "lock", timeout=_SECONDS):
            if not all((folder / name).is_file() for name in FILES):
                _fetch_files(folder)
    return folder


def _fetch_files(folder: Path) -> None:
    """Fetch the files from the executable, which serves them."""
    port = native_viewer.free_port()
    client = httpx2.Client(
        base_url=f"http://{native_viewer.LOOPBACK}:{port}", timeout=_SECONDS, trust_env=False
    )
    with native_viewer.web_viewer(port), client:
        for name in FILES:
            response = client.get(f"/{name}")
            if response.status_code != HTTPStatus.OK or len(response.content) < 1000:
                raise native_viewer.ViewerError(f"the Rerun viewer has no {name}; install rerun-sdk again.")
            with replacing(folder / name) as fresh:
                fresh.write_bytes(response.content)
