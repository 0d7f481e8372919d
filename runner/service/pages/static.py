"""The files of the pages: style, scripts, the chart library; compressed once, and kept by browsers.

Their addresses hold a digest of them all, so that a browser never asks again for what it has, and never
shows an older one after an upgrade.
"""

from __future__ import annotations

import functools
import gzip
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from importlib.resources import files
from typing import Final

from fastapi import APIRouter, HTTPException, Request, Response

from runner.export.reports.rendering import page_style

router = APIRouter(include_in_schema=False)

FOLDER: Final = files("runner.service.pages") / "static"
REPORT: Final = files("runner.export") / "templates"
"""Of reports, whose code is not imported for it: it brings Numba along, and its memory."""
UPLOT: Final = "vendor/uplot-1.6.32"
_TYPES: Final = {
    "css": "text/css",
    "js": "text/javascript",
    "svg": "image/svg+xml",
    "LICENSE": "text/plain",
}
_FOREVER: Final = "public, max-age=31536000, immutable"
_OWN: Final = (
    *(
        "ages.js",
        "asked.js",
        "charts.js",
        "episode.js",
        "job.js",
        "later.js",
        "live.js",
        "parts.js",
        "rerun.css",
        "rerun.js",
    ),
    *("stepping.js", "submit.js", "table.js"),
)
_OTHERS: Final = ("icon.svg", f"{UPLOT}/uPlot.iife.min.js", f"{UPLOT}/LICENSE")


@dataclass(frozen=True)
class Asset:
    """A file of the pages."""

    media_type: str
    body: bytes
    packed: bytes
    """The same, by gzip."""


@functools.cache
def assets() -> Mapping[str, Asset]:
    """Return the files by name."""
    bodies = {name: (FOLDER / name).read_bytes() for name in (*_OWN, *_OTHERS)}
    bodies["replay.js"] = (REPORT / "replay.js").read_bytes()
    bodies["style.css"] = _style().encode()
    return {
        name: Asset(_TYPES[name.rpartition("/")[2].rpartition(".")[2]], body, gzip.compress(body, mtime=0))
        for name, body in bodies.items()
    }


@functools.cache
def version() -> str:
    """Return a digest of all the files."""
    digest = hashlib.sha256()
    for name, asset in sorted(assets().items()):
        digest.update(name.encode() + b"\0" + asset.body)
    return digest.hexdigest()[:12]


def address(name: str) -> str:
    """Return where a file is.

    Raises:
        KeyError: there is none of that name.
    """
    assets()[name]
    return f"/static/{version()}/{name}"


@router.api_route("/static/{digest}/{name:path}", methods=["GET", "HEAD"])
def static(digest: str, name: str, request: Request) -> Response:
    """Return a file of the pages."""
    asset = assets().get(name)
    if asset is None:
        raise HTTPException(HTTPStatus.NOT_FOUND)
    packed = "gzip" in request.headers.get("accept-encoding", "")
    headers = {"vary": "accept-encoding", "cache-control": _FOREVER if digest == version() else "no-cache"}
    return Response(
        asset.packed if packed else asset.body,
        media_type=asset.media_type,
        headers=headers | ({"content-encoding": "gzip"} if packed else {}),
    )


def _style() -> str:
    """Return the style of a report and of the pictures, and what pages have besides."""
    parts = [
        page_style(),
        (FOLDER / UPLOT / "uPlot.min.css").read_text("utf-8"),
        (FOLDER / "pages.css").read_text("utf-8"),
    ]
    return "\n".join(parts)
