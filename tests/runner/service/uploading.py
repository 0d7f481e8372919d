"""Uploads as tests send them."""

from __future__ import annotations

import secrets
from pathlib import Path

from blake3 import blake3

from runner.service.settings import ServiceLimits
from runner.service.uploads import Uploads, UploadSource
from tests.waiting import until

ANNA = "anna"


BEN = "ben"


def start(folder: Path, **limits) -> Uploads:
    """Return the uploads of a service, with the default limits but for these."""
    return Uploads(folder, ServiceLimits(**limits), lambda _: None)


def source(data: bytes, **more) -> UploadSource:
    """Return the description of an upload of bytes."""
    return UploadSource(digest=blake3(data).hexdigest(), size=len(data), **more)


def begin(uploads, owner, data, **more):
    """Begin the upload of bytes, or find the one that has begun."""
    return uploads.put(owner, blake3(data).hexdigest(), source(data, **more))


def grow(uploads, owner, **known):
    """Begin an upload of unknown bytes."""
    return uploads.put(owner, secrets.token_hex(32), UploadSource(**known))


def send(uploads, data, owner=ANNA, labels=None, **details):
    """Upload bytes in one go, and return the upload when its verification is over."""
    upload = begin(uploads, owner, data, run=details | ({"labels": labels} if labels else {}))
    if upload.state == "receiving" and data:
        upload = uploads.append(owner, upload.id, 0, data)
    return over(uploads, upload)


def over(uploads, upload):
    """Return an upload when its verification is over."""
    return until(lambda upload: upload.state != "verifying", lambda: uploads.get(upload.owner, upload.id))


def visible(folder: Path) -> list[str]:
    """Return the names in a folder that are not hidden."""
    return sorted(path.name for path in folder.iterdir() if path.name[0] != ".")
