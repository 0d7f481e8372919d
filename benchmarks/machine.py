"""The machine on which the figures are measured."""

from __future__ import annotations

import os
import time
from types import TracebackType
from typing import Final, Self

import psutil

from runner.runs.provenance import provenance

_PACKAGES: Final = (
    "numpy",
    "numba",
    "llvmlite",
    "gymnasium",
    "mcap",
    "protobuf",
    "zstandard",
    "blake3",
    "pydantic",
)


def machine() -> dict[str, str]:
    """Return processor, cores, memory, and the versions that speed depends on."""
    facts = provenance()
    keys = ("processor", "platform", "git", "python")
    packages = {key: facts[key] for name in _PACKAGES if (key := f"package.{name}") in facts}
    return {
        **{key: facts[key] for key in keys if key in facts},
        "cores": str(os.cpu_count()),
        "memory": f"{psutil.virtual_memory().total / 2**30:.1f} GiB",
        "packages": ", ".join(f"{key.removeprefix('package.')} {value}" for key, value in packages.items()),
    }


class OtherWork:
    """Measures how many cores other processes used during a `with` block, because they disturb figures."""

    def __enter__(self) -> Self:
        self.cores = 0.0
        self._begin = _moment()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        clock, busy = (now - then for now, then in zip(_moment(), self._begin, strict=True))
        self.cores = max(busy / clock, 0.0)


def _moment() -> tuple[float, float]:
    """Return the clock, and the processor seconds used by other processes so far."""
    all_of_it, own = psutil.cpu_times(), os.times()
    busy = all_of_it.user + all_of_it.system + getattr(all_of_it, "nice", 0.0)
    return time.perf_counter(), busy - sum(own[:4])
