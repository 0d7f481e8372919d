"""`dualtaxi rerecord`: record the steps of a run that left them out."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli.options import json_option, recordings_option, run_argument
from runner.cli.output import draw, facts, print_json, say
from runner.cli.runs import command_for, find, job_progress, require_over, run_as_json, run_facts


@click.command("rerecord")
@run_argument
@recordings_option
@json_option
def command(run_name: str, recordings: Path | None, as_json: bool) -> None:
    """Record the steps of RUN, which was run with recording.steps: none.

    The run is trained again. The full recording replaces the old one once it is complete and has the same
    content digest, which proves that these are its steps. Nothing is done for a run that has its steps.

    \b
    Example:
      dualtaxi run quick --set recording.steps=none
      dualtaxi rerecord @latest
    """  # noqa: D301 - Click wants the backspace itself
    from runner.execution.rerecord import holds_steps, rerecord

    run = find(run_name, recordings)
    require_over(run)
    nothing_to_do = run.status == "finished" and holds_steps(run)
    with job_progress("", run.episodes_to_do or 0) as (report, interrupt):
        run = rerecord(run, report, interrupt)
    if as_json:
        print_json(run_as_json(run), indent=None)
    elif not nothing_to_do:
        proof = {"proof": "the content digest is the one that the run had"}
        draw(facts(run_facts(run) | proof | {"next": command_for(run, "play")}))
    if nothing_to_do:
        say(f"Run {run.run_id} holds its steps already; there is nothing to do.")
