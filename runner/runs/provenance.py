"""The provenance of a run: versions, host and source; it may explain a difference, and is never compared."""

from __future__ import annotations

import getpass
import os
import platform
import socket
import subprocess
import sys
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from runner.util.values import as_utf8
from runner.util.version import __version__

PACKAGES = ("numpy", "numba", "llvmlite", "gymnasium", "mcap", "protobuf", "zstandard", "blake3", "pydantic")


def provenance() -> dict[str, str]:
    """Return versions, host, processor, git state and command line, as text by key."""
    return _installed() | {
        "host": socket.gethostname(),
        "user": as_utf8(_user()),
        "command": as_utf8(" ".join(sys.argv)),
        "directory": as_utf8(_directory()),
    }


Differences = dict[str, tuple[str, str]]
"""Differences in provenance: key to (recorded, here)."""


def differing_provenance(recorded: Mapping[str, str]) -> Differences:
    """Return the differences between recorded provenance and this process's."""
    here = provenance()
    return {
        key: (recorded.get(key, ""), here.get(key, ""))
        for key in sorted({*recorded, *here})
        if recorded.get(key) != here.get(key)
    }


@cache
def _installed() -> dict[str, str]:
    """Return what does not change during a process: the machine, and the versions of the code."""
    facts = {
        "dualtaxi": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "machine": platform.machine(),
        "processor": _processor(),
    }
    return facts | {f"package.{name}": _version(name) for name in PACKAGES} | _git()


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _directory() -> str:
    try:
        return str(Path.cwd())
    except OSError:  # it was removed
        return ""


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):
        return ""


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor()


def _git() -> dict[str, str]:
    """Return commit and state of the source tree this code runs from; nothing outside one."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return {}
    command = ["git", "-C", os.fspath(root), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        found = subprocess.run(command, capture_output=True, text=True, timeout=5, check=True)
    except (OSError, subprocess.SubprocessError):
        return {}
    return {"git": found.stdout.strip()}
