"""`dualtaxi evaluate`: play a recorded table in new episodes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from runner.cli.options import json_option, recordings_option, run_argument
from runner.cli.output import console, draw, facts, print_json, say
from runner.cli.runs import command_for, find_recorded, job_progress, run_as_json, run_facts
from runner.errors import ExitCode

if TYPE_CHECKING:
    from runner.execution.rerecord import Start
    from runner.runs.run import Run

TRIALS = 200


@click.command("evaluate")
@run_argument
@click.option(
    "--step",
    type=click.IntRange(0),
    metavar="N",
    help="The table after N training steps.  [default: the last]",
)
@click.option(
    "--trials", type=click.IntRange(1), metavar="K", help=f"Number of episodes.  [default: {TRIALS}]"
)
@click.option(
    "--start",
    default="random",
    show_default=True,
    metavar="random|each|STATE",
    help="Start states: random ones, each one once, or this one.",
)
@click.option(
    "--seed",
    type=click.IntRange(0, 2**64 - 1),
    default=0,
    show_default=True,
    metavar="S",
    help="Seed of the new episodes.",
)
@recordings_option
@json_option
@click.pass_context
def command(
    ctx: click.Context,
    run_name: str,
    step: int | None,
    trials: int | None,
    start: str,
    seed: int,
    recordings: Path | None,
    as_json: bool,
) -> None:
    """Evaluate the trained Q-table of RUN greedily in new episodes.

    The table at any step can be evaluated. The episodes are recorded as a separate run, whose configuration
    names the run and the step of the table.

    \b
    Examples:
      dualtaxi evaluate @latest
      dualtaxi evaluate k3v9m2xq --step 50000 --trials 1000 --seed 7
      dualtaxi evaluate k3v9m2xq --start each
    """  # noqa: D301 - Click wants the backspace itself
    if start not in ("random", "each") and not start.isdecimal():
        raise click.UsageError(f"--start: found {start!r}, expected random, each, or a state from 0.")
    if start == "each" and trials is not None:
        raise click.UsageError("--start each plays one episode per state: leave out --trials.")
    from runner.execution.rerecord import evaluate
    from runner.runs.run import recordings_folder

    source, folder = find_recorded(run_name, recordings), recordings_folder(recordings)
    count = None if start == "each" else trials or TRIALS
    start_state: Start = int(start) if start.isdecimal() else "random"
    with job_progress("", 0) as (report, interrupt):
        run = evaluate(source, folder, step, count, start_state, seed, report, interrupt)
    origin = run.file.config["initial_q"]
    if as_json:
        print_json(run_as_json(run) | {"origin": origin}, indent=None)
    elif run.status == "finished":
        _summarise(run, origin)
    if interrupt.came and run.status == "interrupted":
        say(f"Interrupted: what was played is kept; `{command_for(run, 'resume')}` plays the rest.")
        ctx.exit(ExitCode.INTERRUPTED)


def _summarise(run: Run, origin: dict[str, object]) -> None:
    from runner.analysis.evaluations import evaluation_records
    from runner.cli.evaluations import evaluation_table
    from runner.recording.reader import open_recording

    with open_recording(run.recording) as recording:
        table = evaluation_table(
            evaluation_records(recording), recording.environment["success_events"], console()
        )
    told = run_facts(run)
    told |= {"table": f"of run {origin['run']} after {origin['step']:,} training steps"}
    draw(table, "", facts(told | {"next": command_for(run, "play", "--eval 0:0")}))
