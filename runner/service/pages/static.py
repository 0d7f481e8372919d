"""The files of the pages: style, scripts and the chart library, compressed once and cached by browsers.

Their addresses contain a digest of all of them, so that a browser never requests what it has, and never uses
an older file after an upgrade.
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

from runner.export.reports.rendering import TEMPLATES as REPORT_TEMPLATES
from runner.export.reports.rendering import page_style

router = APIRouter(include_in_schema=False)

FOLDER: Final = files("runner.service.pages") / "static"
UPLOT: Final = "vendor/uplot-1.6.32"
_TYPES: Final = {"css": "text/css", "js": "text/javascript", "svg": "image/svg+xml", "LICENSE": "text/plain"}
_FOREVER: Final = "public, max-age=31536000, immutable"


@dataclass(frozen=True)
class Asset:
    """A file of the pages."""

    media_type: str
    body: bytes
    compressed: bytes


@functools.cache
def assets() -> Mapping[str, Asset]:
    """Return the files by name."""
    bodies = {entry.name: entry.read_bytes() for entry in FOLDER.iterdir() if entry.is_file()}
    bodies |= {
        name: (FOLDER / name).read_bytes() for name in (f"{UPLOT}/uPlot.iife.min.js", f"{UPLOT}/LICENSE")
    }
    bodies["replay.js"] = (REPORT_TEMPLATES / "replay.js").read_bytes()
    layouts = (FOLDER / UPLOT / "uPlot.min.css").read_text("utf-8"), bodies.pop("pages.css").decode()
    bodies["style.css"] = "\n".join([page_style(), *layouts]).encode()
    return {
        name: Asset(_TYPES[name.rpartition("/")[2].rpartition(".")[2]], body, gzip.compress(body, mtime=0))
        for name, body in bodies.items()
    }


@functools.cache
def version() -> str:
    """Return a digest of all files."""
    digest = hashlib.sha256()
    for name, asset in sorted(assets().items()):
        digest.update(name.encode() + b"\0" + asset.body)
    return digest.hexdigest()[:12]


def address(name: str) -> str:
    """Return the address of a file."""
    assets()[name]
    return f"/static/{version()}/{name}"


@router.api_route("/static/{digest}/{name:path}", methods=["GET", "HEAD"])
def static(digest: str, name: str, request: Request) -> Response:
    """Return a file of the pages."""
    asset = assets().get(name)
    if asset is None:
        raise HTTPException(HTTPStatus.NOT_FOUND)
    headers = {"vary": "accept-encoding", "cache-control": _FOREVER if digest == version() else "no-cache"}
    if "gzip" in request.headers.get("accept-encoding", ""):
        headers["content-encoding"] = "gzip"
        return Response(asset.compressed, media_type=asset.media_type, headers=headers)
    return Response(asset.body, media_type=asset.media_type, headers=headers)
