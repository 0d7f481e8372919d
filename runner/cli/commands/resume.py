"""`dualtaxi resume`: go on with a run."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli.options import json_option, recordings_option, run_argument
from runner.cli.output import draw, facts, print_json, say
from runner.cli.runs import command_for, find, job_progress, run_as_json, run_facts
from runner.errors import ExitCode


@click.command("resume")
@run_argument
@click.option(
    "--accept-changes",
    is_flag=True,
    help="Resume although code, environment or numerical libraries have changed.",
)
@recordings_option
@json_option
@click.pass_context
def command(
    ctx: click.Context, run_name: str, accept_changes: bool, recordings: Path | None, as_json: bool
) -> None:
    """Resume RUN, which was interrupted or failed, as if it had never stopped.

    The run is trained again without recording, which is quick, and compared byte for byte with its recording;
    what is missing is then recorded. The content digest is that of an uninterrupted run. A recording that
    lost something in its middle is written again and replaced at the end. Nothing is done for a finished run.

    A run that was started with another version of the code, the environment or a numerical library is
    refused, with a list of what differs. --accept-changes resumes it anyway, and the recording notes that.

    \b
    Examples:
      dualtaxi resume @latest
      dualtaxi resume k3v9m2xq --json
    """  # noqa: D301 - Click wants the backspace itself
    from runner.execution.resume import is_finished, resume

    run = find(run_name, recordings)
    nothing_to_do = is_finished(run)
    with job_progress("", run.episodes_to_do or 0) as (report, interrupt):
        run = resume(run, accept_changes, report, interrupt)
    if as_json:
        print_json(run_as_json(run), indent=None)
    elif not nothing_to_do:
        draw(facts(run_facts(run) | {"next": command_for(run, "show")}))
    if nothing_to_do:
        say(f"Run {run.run_id} is finished; there is nothing to do.")
    if interrupt.came and run.status == "interrupted":
        say(f"Interrupted again; `{command_for(run, 'resume')}` goes on from what is kept.")
        ctx.exit(ExitCode.INTERRUPTED)
