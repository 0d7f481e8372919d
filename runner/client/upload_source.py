"""What goes to a server, and how it stands there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from runner.errors import RunnerError
from runner.runs.run import Run


@dataclass(frozen=True)
class UploadSource:
    """What is sent: a file, and what its sender says of the run in it."""

    path: Path
    name: str = ""
    run_id: str = ""
    content_digest: str | None = None
    run: Mapping[str, Any] = field(default_factory=dict)
    labels: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, run: Run) -> UploadSource:
        """Return a run that is over, to be sent.

        Raises:
            RunnerError: it is running, or in an archive alone.
        """
        if run.status not in ("finished", "interrupted", "failed"):
            raise RunnerError(
                f"run {run.run_id} is {run.status}; only one that is over and here can be pushed."
            )
        summary, labels = run.summary, run.labels
        if run.stands_alone:  # an exported recording carries its own record of the run
            return cls(run.recording, run.name, run.run_id, summary.get("content_digest"))
        told = {"name": run.file.name, "status": run.status, "proof": run.file.proof}
        told |= {key: summary.get(key) for key in ("seconds", "error")}
        return cls(
            run.recording,
            run.name,
            run.run_id,
            summary.get("content_digest"),
            {key: value for key, value in told.items() if value is not None},
            {"name": labels.name, "tags": list(labels.tags), "note": labels.note},
        )


@dataclass(frozen=True)
class UploadStatus:
    """An upload as the server says it stands."""

    id: str
    state: str
    offset: int
    run_id: str = ""
    already: bool = False
    problem: str = ""
