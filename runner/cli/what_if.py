"""`dualtaxi branch` of a run that was trained here, without training: where each action at a step leads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from runner.cli.output import draw, facts, print_json, say, table
from runner.cli.runs import compilation_notice

if TYPE_CHECKING:
    from runner.analysis.step_reference import StepRef
    from runner.runs.run import Run


def print_what_if(run: Run, at: StepRef, actions: Sequence[str], as_json: bool) -> None:
    """Print where joint actions at a step lead: each of those that are named, or all."""
    from runner.debugging.what_if import what_if

    with compilation_notice():
        found = what_if(run, at=at, actions=actions)
    if as_json:
        print_json(found.as_json())
        return
    grid = found.grid
    drawn = table(*grid.headings, left=("action", "end"))
    for row in grid.rows:
        drawn.add_row(*row)
    draw(facts({"run": f"{run.run_id}  {run.title}"} | found.facts), "", drawn)
    for note in found.notes:
        say(f"Note: {note}.")
