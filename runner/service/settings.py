"""What the service is told when it starts."""

from __future__ import annotations

import ipaddress
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from runner.errors import RunnerError
from runner.util.files import cache_folder

CONFIG_VARIABLE: Final = "XDG_CONFIG_HOME"
MB: Final = 1_000_000


def tokens_file() -> Path:
    """Return the file of hashed tokens, in the user's configuration folder; it need not exist."""
    base = os.environ.get(CONFIG_VARIABLE)
    return (Path(base) if base else Path.home() / ".config") / "dualtaxi" / "tokens.json"


def without_folders(text: str, *folders: Path) -> str:
    """Return a message with the paths below some folders as they are seen from there.

    Whoever reads it elsewhere learns what it is about, and not where on this machine that is.
    """
    for folder in folders:
        for form in {os.fspath(folder.absolute()), os.fspath(folder.resolve())} - {folder.absolute().anchor}:
            text = text.replace(form + os.sep, "").replace(form, folder.name)
    return text


@dataclass(frozen=True)
class Limits:
    """How much of anything a client may have; what is beyond is refused, and said."""

    body_bytes: int = MB
    """Of a request, but for uploads, which are streamed and have a limit of their own."""
    upload_bytes: int = 1 << 40
    """Of one recording or archive."""
    connections: int = 1000
    header_seconds: float = 10.0
    """Until a request's head is there whole."""
    idle_seconds: float = 30.0
    """Without a byte of a body that is awaited, or of an answer that is not taken."""
    keep_alive_seconds: int = 15
    stop_seconds: int = 20
    """Until what is under way is cut off when the service stops."""
    jobs: int = 1000
    """That are not over."""
    page_runs: int = 1000
    """Runs in one answer."""
    page_records: int = 20_000
    """Steps or episodes in one answer of JSON."""
    page_arrow: int = 1_000_000
    """And in one of Arrow."""
    work_seconds: float = 600.0
    """Of a comparison, a picture or an export, which are made in processes of their own."""
    work_bytes: int = 4 << 30
    """Of memory that one of them may allocate."""
    cache_bytes: int = 20 * MB
    """Of answers that are kept for who asks the same next."""


@dataclass(frozen=True)
class Settings:
    """What the service is told when it starts."""

    recordings: tuple[Path, ...]
    """Recordings folders; the first is written to."""
    host: str = "127.0.0.1"
    port: int = 8000
    tokens: Path = field(default_factory=tokens_file)
    hosts: tuple[str, ...] = ()
    """Names by which it may be asked for besides `localhost` and addresses: those behind a proxy."""
    proxies: str = ""
    """Addresses of proxies, separated by commas, that are believed who asks through them."""
    tokens_for_all: bool = False
    """Whether reading needs a token too; it always does when the host is not a loopback one."""
    workers: int = 2
    """Processes that do jobs at the same time."""
    ray: str | None = None
    """The address of a cluster of Ray that does the jobs' runs; None: processes beside the service."""
    limits: Limits = Limits()

    def __post_init__(self) -> None:
        if not self.recordings:
            raise RunnerError("recordings: found none, expected at least one folder.")

    @property
    def is_loopback(self) -> bool:
        """Whether nobody beyond this machine can reach it."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"

    @property
    def needs_token(self) -> bool:
        """Whether reading needs a token."""
        return self.tokens_for_all or not self.is_loopback

    def without_folders(self, text: str) -> str:
        """Return a message with its paths as they are seen from the service's folders, not from the root."""
        return without_folders(text, *self.recordings, self.tokens.parent, cache_folder())

    def told(self) -> dict[str, Any]:
        """Return what is logged of them when the service starts."""
        return {
            "recordings": [str(folder) for folder in self.recordings],
            "host": self.host,
            "port": self.port,
            "needs_token": self.needs_token,
            "workers": self.workers,
        }
