"""Which process a run belongs to, and whether it still lives."""

from __future__ import annotations

import contextlib
import os
import socket
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from runner.util.files import read_object

_MAX_BYTES: Final = 8 << 20
HEARTBEAT_SECONDS: Final = 15.0
"""On another host, a run without a heartbeat for this long counts as interrupted."""


def owner() -> dict[str, Any]:
    """Return who this process is: host, boot, process id and its start."""
    pid = os.getpid()
    return {
        "host": socket.gethostname(),
        "boot_id": boot_id(),
        "pid": pid,
        "process_started": process_start(pid),
    }


def lives(owner: Mapping[str, Any], heart: Path) -> bool:
    """Return whether an owner lives: its process, if it is of this machine; else its heart's last beat.

    Args:
        owner: who it said it is.
        heart: the file whose time of change is set at each beat.
    """
    if owner.get("host") == socket.gethostname() and owner.get("boot_id") == boot_id():
        started = process_start(owner.get("pid", 0))
        return started is not None and started == owner.get("process_started")
    with contextlib.suppress(OSError):
        return time.time() - heart.stat().st_mtime < HEARTBEAT_SECONDS
    return False


def is_owned(folder: Path) -> bool:
    """Return whether a living process is at the run in a folder, as its `run.json` says."""
    try:
        facts = read_object(folder / "run.json", _MAX_BYTES)
    except (OSError, ValueError):
        return False
    process = facts.get("owner")
    if facts.get("status") != "running" or not isinstance(process, dict):
        return False
    return lives(process, folder / "run.json")


def boot_id() -> str:
    """Return what tells this start of the machine from any other."""
    with contextlib.suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    import psutil

    return f"{psutil.boot_time():.0f}"


def process_start(pid: int) -> float | None:
    """Return when a process began; None if there is none. To be compared within one start of the machine.

    On Linux it is counted in ticks since the machine started, so that setting the clock changes nothing.
    """
    if not isinstance(pid, int) or isinstance(pid, bool):
        return None  # a file may say anything
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return None if fields[0] == "Z" else float(fields[19])
    except (OSError, ValueError, IndexError):
        return None if Path("/proc/self/stat").exists() else _process_start_elsewhere(pid)


def _process_start_elsewhere(pid: int) -> float | None:
    import psutil

    try:
        process = psutil.Process(pid)
        return None if process.status() == psutil.STATUS_ZOMBIE else process.create_time()
    except (psutil.Error, ValueError, TypeError, OverflowError):
        return None
