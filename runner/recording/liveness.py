"""The process that owns a run, and whether it is alive."""

from __future__ import annotations

import contextlib
import os
import socket
import time
from functools import lru_cache
from pathlib import Path
from typing import Final

from runner.util.files import read_object
from runner.util.values import Json, JsonView

_MAX_RUN_FILE_BYTES: Final = 8 << 20
HEARTBEAT_SECONDS: Final = 15.0
"""On another host, a run without a heartbeat for this long counts as interrupted."""


def owner() -> Json:
    """Return the identity of this process: host, boot, process id and start."""
    return {"host": socket.gethostname(), **_of_process(os.getpid())}


@lru_cache(1)
def _of_process(pid: int) -> dict[str, object]:
    """Return what does not change while this process lives."""
    return {"boot_id": boot_id(), "pid": pid, "process_started": process_start(pid)}


def is_alive(owner: JsonView, heartbeat: Path) -> bool:
    """Return whether an owner is alive: its process, if it is on this machine; else by its last heartbeat.

    Args:
        heartbeat: the file whose modification time is set at each heartbeat.
    """
    if owner.get("host") == socket.gethostname() and owner.get("boot_id") == boot_id():
        started = process_start(owner.get("pid", 0))
        return started is not None and started == owner.get("process_started")
    with contextlib.suppress(OSError):
        return time.time() - heartbeat.stat().st_mtime < HEARTBEAT_SECONDS
    return False


def is_owned(folder: Path) -> bool:
    """Return whether a living process owns the run in a folder, according to its `run.json`."""
    try:
        facts = read_object(folder / "run.json", _MAX_RUN_FILE_BYTES)
    except (OSError, ValueError):
        return False
    process = facts.get("owner")
    return (
        facts.get("status") == "running"
        and isinstance(process, dict)
        and is_alive(process, folder / "run.json")
    )


def boot_id() -> str:
    """Return an identifier of this boot of the machine."""
    with contextlib.suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    import psutil

    return f"{psutil.boot_time():.0f}"


def process_start(pid: int) -> float | None:
    """Return when a process started, comparable within one boot of the machine; None if there is none.

    On Linux it is counted in ticks since the boot, so that setting the clock changes nothing.
    """
    if not isinstance(pid, int) or isinstance(pid, bool):
        return None  # a file may contain anything
    with contextlib.suppress(OSError, ValueError, IndexError):
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return None if fields[0] == "Z" else float(fields[19])
    if Path("/proc/self/stat").exists():
        return None
    import psutil

    try:
        process = psutil.Process(pid)
        return None if process.status() == psutil.STATUS_ZOMBIE else process.create_time()
    except (psutil.Error, ValueError, TypeError, OverflowError):
        return None
