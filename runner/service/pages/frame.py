"""What stands around every page of a run."""

from __future__ import annotations

from typing import Any, Final

from runner.runs import Run

TABS: Final = (
    ("", "Overview"),
    ("replay", "Replay"),
    ("episodes", "Episodes"),
    ("evaluations", "Evaluations"),
    ("learned", "What was learned"),
    ("config", "Configuration"),
    ("rerun", "Rerun"),
)


def framed(run: Run, here: str) -> dict[str, Any]:
    """Return what every page of a run has."""
    return {"run": head_of(run), "tabs": TABS, "here": here}


def head_of(run: Run) -> dict[str, Any]:
    """Return what the pages say of a run above all else."""
    return {
        "id": run.run_id,
        "name": run.name,
        "seed": run.seed,
        "status": run.status,
        "created": run.created.isoformat(),
        "tags": run.tags,
        "note": run.note,
    }
