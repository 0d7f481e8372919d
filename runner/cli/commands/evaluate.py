"""`dualtaxi evaluate`: play a recorded table in new episodes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from runner.cli import Command
from runner.cli.options import COUNT, INDEX, json_option, recordings_option, run_argument
from runner.cli.output import console, draw, facts, print_json, say
from runner.cli.runs import command_for, find_recorded, job_progress, run_as_json, run_facts
from runner.errors import ExitCode
from runner.runs.run import recordings_folder

if TYPE_CHECKING:
    from runner.execution.rerecord import Start

TRIALS: Final = 200


@click.command("evaluate", cls=Command)
@run_argument
@click.option("--step", type=INDEX, metavar="N", help="After N training steps.  [default: the last]")
@click.option("--trials", type=COUNT, metavar="K", help=f"Number of episodes.  [default: {TRIALS}]")
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
def evaluate_command(
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

    Examples:
      dualtaxi evaluate @latest
      dualtaxi evaluate k3v9m2xq --step 50000 --trials 1000 --seed 7
      dualtaxi evaluate k3v9m2xq --start each
    """
    if start not in ("random", "each") and not start.isdecimal():
        raise click.UsageError(f"--start: found {start!r}, expected random, each, or a state from 0.")
    if start == "each" and trials is not None:
        raise click.UsageError("--start each plays one episode per state: leave out --trials.")
    from runner.analysis.evaluations import evaluation_records
    from runner.cli.evaluations import evaluation_table
    from runner.execution.rerecord import evaluate
    from runner.recording.reader import open_recording

    source = find_recorded(run_name, recordings)
    count = None if start == "each" else trials or TRIALS
    start_state: Start = int(start) if start.isdecimal() else "random"
    with job_progress("", 0) as (report, interrupt):
        run = evaluate(
            source, recordings_folder(recordings), step, count, start_state, seed, report, interrupt
        )
    origin = run.file.config["initial_q"]
    if as_json:
        print_json(run_as_json(run) | {"origin": origin})
    elif run.status == "finished":
        with open_recording(run.recording) as recording:
            successes = recording.environment["success_events"]
            grid = evaluation_table(evaluation_records(recording), successes, console())
        table = f"of run {origin['run']} after {origin['step']:,} training steps"
        play = command_for(run, "play", "--eval 0:0")
        draw(grid, "", facts(run_facts(run) | {"table": table, "next": play}))
    if interrupt.came and run.status == "interrupted":
        say(f"Interrupted: the episodes so far are kept; `{command_for(run, 'resume')}` plays the rest.")
        ctx.exit(ExitCode.INTERRUPTED)
