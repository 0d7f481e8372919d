"""The settings of the service, given when it starts."""

from __future__ import annotations

import ipaddress
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from platformdirs import user_config_path

from runner.archive.places import default_target
from runner.errors import RunnerError
from runner.util.files import cache_folder

MB: Final = 1_000_000


def tokens_file() -> Path:
    """Return the file of hashed tokens, in the user's configuration folder; it need not exist."""
    return user_config_path("dualtaxi") / "tokens.json"


def without_folders(text: str, *folders: Path) -> str:
    """Return a message with paths relative to some folders: a client must not learn where they are."""
    for folder in folders:
        for form in {os.fspath(folder.absolute()), os.fspath(folder.resolve())} - {folder.absolute().anchor}:
            text = text.replace(form + os.sep, "").replace(form, folder.name)
    return text


@dataclass(frozen=True)
class ServiceLimits:
    """What a client may use at most; more is refused, with a message."""

    body_bytes: int = MB
    """Body of a request, other than uploads, which are streamed."""
    upload_bytes: int = 1 << 40
    """Size of an upload."""
    uploads: int = 1000
    """Uploads that are being received or verified; and those that are over whose result is kept."""
    uploads_each: int = 100
    """Uploads of one client that are being received or verified."""
    spare_bytes: int = 256 << 20
    """Disk space that uploads leave free for runs that are being recorded."""
    connections: int = 1000
    header_seconds: float = 10.0
    """Time until a request's head is complete."""
    idle_seconds: float = 30.0
    """Time without a byte of an expected body, or of a response that is not read."""
    keep_alive_seconds: int = 15
    stop_seconds: int = 20
    """Time until running requests are cut off when the service stops."""
    jobs: int = 1000
    """Unfinished jobs."""
    page_runs: int = 1000
    """Runs in a response."""
    page_records: int = 20_000
    """Steps or episodes in a JSON response."""
    page_arrow: int = 1_000_000
    """Steps or episodes in an Arrow response."""
    work_seconds: float = 600.0
    """Time for a comparison, a plot or an export, which are computed in child processes."""
    work_bytes: int = 4 * 10**9
    """Memory that one of them may allocate."""
    cache_bytes: int = 20 * MB
    """Size of the cache of responses."""


@dataclass(frozen=True)
class ServiceSettings:
    """The settings of the service."""

    recordings: tuple[Path, ...]
    """Recordings folders; the first is written to."""
    host: str = "127.0.0.1"
    port: int = 8000
    tokens: Path = field(default_factory=tokens_file)
    hosts: tuple[str, ...] = ()
    """Host names to accept besides `localhost` and addresses: those of a proxy."""
    proxies: str = ""
    """Addresses of proxies whose X-Forwarded-* headers are trusted, separated by commas."""
    tokens_for_all: bool = False
    """Whether reading needs a token on a loopback host too."""
    workers: int = 2
    """Processes that run jobs at the same time."""
    ray: str | None = None
    """The address of a Ray cluster that runs the jobs; None for processes of this machine."""
    limits: ServiceLimits = ServiceLimits()

    def __post_init__(self) -> None:
        if not self.recordings:
            raise RunnerError("recordings: found none, expected at least one folder.")

    @property
    def is_loopback(self) -> bool:
        """Whether no other machine can reach it."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"

    @property
    def needs_token(self) -> bool:
        """Whether reading needs a token."""
        return self.tokens_for_all or not self.is_loopback

    def without_folders(self, text: str) -> str:
        """Return a message with paths relative to the service's folders."""
        archives = Path(default_target(self.recordings[0]))
        return without_folders(text, *self.recordings, archives, self.tokens.parent, cache_folder())
