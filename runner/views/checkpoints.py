"""`checkpoints`: what a loop recorded of its agent."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from runner.analysis.sections import Answer, Grid, Section
from runner.util.humanize import counted, size
from runner.views.view import View

if TYPE_CHECKING:
    from runner.runs.checkpoints import Checkpoint
    from runner.runs.run import Run
    from runner.util.values import Json

_HEADINGS: Final = ("checkpoint", "phase", "last episode", "format", "size", "digest", "content")


@dataclass(frozen=True)
class CheckpointRows(Answer):
    """The checkpoints of a run, in order."""

    run_id: str
    checkpoints: Sequence[Checkpoint]

    def as_json(self) -> Json:
        """Return the checkpoints."""
        return {"checkpoints": [checkpoint.as_json() for checkpoint in self.checkpoints]}

    def sections(self) -> list[Section]:
        """Return a table with a row for each checkpoint."""
        if not self.checkpoints:
            nothing = "There are no checkpoints; a loop records one by `rec.checkpoint(name, value)`."
            return [Section("Checkpoints", [nothing])]
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
            for checkpoint in self.checkpoints
        ]
        command = f"dualtaxi checkpoint get {self.run_id} {rows[-1][0]}"
        sentence = f"{counted(len(rows), 'checkpoint')}. `{command}` writes the last."
        address = f"/api/v1/runs/{self.run_id}/checkpoints/"
        links = [f"{address}{one.digest}" if one.is_here else "" for one in self.checkpoints]
        return [Section("Checkpoints", [sentence], [Grid(_HEADINGS, rows, links=links)])]


def checkpoints(run: Run) -> CheckpointRows:
    """List the checkpoints of RUN, which a loop recorded by `rec.checkpoint(name, ...)`.

    Examples:
      dualtaxi checkpoints @latest
      dualtaxi checkpoints cartpole --json
    """
    return CheckpointRows(run.run_id, run.checkpoints())


VIEW: Final = View(
    "checkpoints",
    "Checkpoints",
    checkpoints,
    has_default=True,
    needs="checkpoints",
    subject="run",
)
