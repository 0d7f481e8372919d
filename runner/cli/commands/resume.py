"""`dualtaxi resume` and `dualtaxi rerecord`: train a run again to complete its recording."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli import Command
from runner.cli.options import accept_changes_option, json_option, recordings_option, run_argument
from runner.cli.output import draw, facts, print_json, say
from runner.cli.runs import command_for, find, job_progress, require_over, run_as_json, run_facts
from runner.errors import ExitCode


@click.command("resume", cls=Command)
@run_argument
@accept_changes_option
@recordings_option
@json_option
@click.pass_context
def resume_command(
    ctx: click.Context, run_name: str, accept_changes: bool, recordings: Path | None, as_json: bool
) -> None:
    """Resume RUN, which was interrupted or failed, as if it had never stopped.

    The run is trained again without recording, which is quick, and compared byte for byte with its recording;
    what is missing is then recorded. The content digest is that of an uninterrupted run. A recording that
    lost something in its middle is written again and replaced at the end. Nothing is done for a finished run.

    A run that was started with another version of the code, the environment or a numerical library is
    refused, with a list of what differs. --accept-changes resumes it anyway, and the recording notes that.

    Examples:
      dualtaxi resume @latest
      dualtaxi resume k3v9m2xq --json
    """
    from runner.execution.resume import is_finished, resume

    run = find(run_name, recordings)
    was_finished = is_finished(run)
    with job_progress("", run.episodes_to_do or 0) as (report, interrupt):
        run = resume(run, accept_changes, report, interrupt)
    if as_json:
        print_json(run_as_json(run))
    elif not was_finished:
        draw(facts(run_facts(run) | {"next": command_for(run, "show")}))
    if was_finished:
        say(f"Run {run.run_id} is finished; there is nothing to do.")
    if interrupt.came and run.status == "interrupted":
        say(f"Interrupted again; `{command_for(run, 'resume')}` continues from there.")
        ctx.exit(ExitCode.INTERRUPTED)


@click.command("rerecord", cls=Command)
@run_argument
@recordings_option
@json_option
def rerecord_command(run_name: str, recordings: Path | None, as_json: bool) -> None:
    """Record the steps of RUN, which was run with recording.steps: none.

    The run is trained again. The full recording replaces the old one once it is complete and has the same
    content digest, which proves that these are its steps. Nothing is done for a run that has its steps.

    Example:
      dualtaxi run quick --set recording.steps=none
      dualtaxi rerecord @latest
    """
    from runner.execution.rerecord import holds_steps, rerecord

    run = find(run_name, recordings)
    require_over(run)
    had_steps = run.status == "finished" and holds_steps(run)
    with job_progress("", run.episodes_to_do or 0) as (report, interrupt):
        run = rerecord(run, report, interrupt)
    if as_json:
        print_json(run_as_json(run))
    elif not had_steps:
        proof = {"proof": "the content digest is the one that the run had"}
        draw(facts(run_facts(run) | proof | {"next": command_for(run, "play")}))
    if had_steps:
        say(f"Run {run.run_id} holds its steps already; there is nothing to do.")
