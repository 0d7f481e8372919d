"""What the figures were measured on."""

from __future__ import annotations

import os
import platform

import psutil

from runner.provenance import provenance


def machine() -> dict[str, str]:
    """Return processor, cores, memory, load, and the versions that speed depends on."""
    facts = provenance()
    keys = ("processor", "platform", "git", "python")
    packages = {key: value for key, value in facts.items() if key.startswith("package.")}
    return {
        **{key: facts[key] for key in keys if key in facts},
        "cores": str(os.cpu_count()),
        "memory": f"{psutil.virtual_memory().total / 2**30:.1f} GiB",
        "load": f"{os.getloadavg()[0]:.2f} at the start: other work on the machine shows in the figures",
        "packages": ", ".join(f"{key.removeprefix('package.')} {value}" for key, value in packages.items()),
        "system": platform.system(),
    }
