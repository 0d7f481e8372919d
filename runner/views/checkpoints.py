"""`checkpoints`: what a loop recorded of its agent."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from runner.analysis.sections import Grid, Section
from runner.util.humanize import counted, size
from runner.views.view import ReadyAnswer, View

if TYPE_CHECKING:
    from runner.runs.checkpoints import Checkpoint
    from runner.runs.run import Run

_TEXTS: Final = ("checkpoint", "phase", "format", "digest", "content")
_HEADINGS: Final = ("checkpoint", "phase", "last episode", "format", "size", "digest", "content")


def checkpoints(run: Run) -> ReadyAnswer:
    """List the checkpoints of RUN, which a loop recorded by `rec.checkpoint(name, ...)`.

    Examples:
      dualtaxi checkpoints @latest
      dualtaxi checkpoints cartpole --json
    """
    found = run.checkpoints()
    return ReadyAnswer({"checkpoints": [checkpoint.as_json() for checkpoint in found]}, [_table(run, found)])


def _table(run: Run, found: Sequence[Checkpoint]) -> Section:
    """Return a table with a row for each checkpoint."""
    if not found:
        nothing = "There are no checkpoints; a loop records one by `rec.checkpoint(name, value)`."
        return Section("Checkpoints", [nothing])
    rows = [
        (
            checkpoint.reference,
            checkpoint.phase,
            f"{checkpoint.episode:,}",
            checkpoint.format,
            size(checkpoint.size),
            checkpoint.digest[:16],
            "here" if checkpoint.is_here else "missing",
        )
        for checkpoint in found
    ]
    command = f"dualtaxi checkpoint get {run.run_id} {rows[-1][0]}"
    sentence = f"{counted(len(rows), 'checkpoint')}. `{command}` writes the last."
    address = f"/api/v1/runs/{run.run_id}/checkpoints/"
    links = [f"{address}{checkpoint.digest}" if checkpoint.is_here else "" for checkpoint in found]
    return Section("Checkpoints", [sentence], [Grid(_HEADINGS, rows, links=links, left=_TEXTS)])


VIEW: Final = View(
    "checkpoints",
    "Checkpoints",
    checkpoints,
    has_default=True,
    needs="checkpoints",
    subject="run",
)
