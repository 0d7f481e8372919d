"""`dualtaxi run`: train, evaluate and record."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from runner.cli.command import Command, option
from runner.cli.options import config_argument, job_option, set_option, workers_option
from runner.cli.output import Reply, say
from runner.cli.parameter_types import INDEX
from runner.cli.progress import count_line, progress_line
from runner.cli.runs import compilation_notice, run_as_json, run_facts, runs_folder
from runner.errors import ExitCode
from runner.runs.run import Run, command_for, create_run, unless_empty
from runner.util.humanize import amount, size
from runner.util.row_text import json_lines
from runner.util.values import checked_name

if TYPE_CHECKING:  # a run is written to disk before heavy packages are imported
    from runner.cli.output import Part
    from runner.config import ExperimentConfig
    from runner.config.model import Job


@click.command("run", cls=Command)
@job_option
def run_command(
    config: Path = config_argument,
    seed: int | None = option("--seed", type=INDEX, help="The seed, instead of the configuration's."),
    overrides: tuple[str, ...] = set_option,
    name: str | None = option("--name", help="Name of the run.  [default: the configuration's name]"),
    workers: int = workers_option(1),
    folder: Path = runs_folder,
) -> Iterator[Reply]:
    """Train, evaluate and record the experiment CONFIG: a file, or a shipped one (`dualtaxi config ls`).

    Each run gets a folder with a recording of every step. Several seeds make one run each, one after the
    other or in parallel with --workers; the recordings are the same. Ctrl-C ends a run properly and keeps
    what it recorded; a second Ctrl-C kills it.

    Steps and disk are estimated first, for a quick and for a slow learner. A slow one takes half the step
    limit in trials and in its first 500 training episodes, then a tenth; "at most" assumes the whole limit.

    --json prints one line for each run.

    Examples:
      dualtaxi run quick
      dualtaxi run mine.yaml
      dualtaxi run cooperative --seed 7 --set discount=0.9 --name patient
      dualtaxi run quick --set 'seeds={count: 3}' --json
      dualtaxi run quick --set 'seeds={count: 100}' --set recording.steps=none --workers 2
    """
    from runner.api import experiment_of, jobs_in

    experiment = experiment_of(config, overrides, seed)
    run_name = checked_name(name)
    if workers > 1:
        yield from _run_parallel(experiment, folder, run_name, workers)
        return
    for number, job in enumerate(jobs_in(experiment, folder)):
        run, is_interrupted = _run_one(job, folder, run_name, number)
        yield _reply(run, number)
        if is_interrupted:
            episodes = f"{run.summary['episodes']:,} of {experiment.episodes:,} episodes"
            notes = [f"Interrupted: {episodes} are kept in {run.recording}."]
            if run.status == "interrupted":
                notes.append(f"`{command_for(run, 'resume')}` continues from there.")
            yield _interrupted(notes, experiment, number + 1)
            return


def _run_one(job: Job, folder: Path, name: str | None, number: int) -> tuple[Run, bool]:
    """Run a job; return its run, and whether it was interrupted."""
    from runner.api import interruptible

    run = create_run(folder, job.config, job.seed, name)
    from runner.environments.loading import load_mdp  # the run is on disk before NumPy is imported

    label = f"seed {run.seed}" if len(job.config.seeds) > 1 else ""
    with unless_empty(run):
        if number == 0:
            load_mdp(job.config.env.id, job.config.env.kwargs, job.config.rewards)  # refuse it first of all
            _announce(job.config, folder)
        with (
            interruptible(second=signal.SIG_DFL) as interrupt,
            progress_line(label, job.config.episodes) as report,
        ):
            from runner.execution.session import run_job

            with compilation_notice():
                run = run_job(job, run, report, interrupt)
    return run, interrupt.came


def _run_parallel(config: ExperimentConfig, folder: Path, name: str | None, workers: int) -> Iterator[Reply]:
    """Run the seeds of an experiment in parallel."""
    from runner.api import interruptible, jobs_in, run_parallel
    from runner.environments.loading import load_mdp

    load_mdp(config.env.id, config.env.kwargs, config.rewards)  # refuse it first of all
    _announce(config, folder)
    runs: list[Run] = []
    with (
        interruptible(second=signal.SIG_DFL) as interrupt,
        compilation_notice(),
        count_line("runs", len(config.seeds)) as report,
    ):
        for run in run_parallel(jobs_in(config, folder), folder, name, workers, interrupt):
            runs.append(run)
            report(len(runs))
            yield _reply(run, len(runs) - 1)
    if interrupt.came:
        notes = [
            f"Interrupted: {run.recording}; `{command_for(run, 'resume')}` continues from there."
            for run in runs
            if run.status == "interrupted"
        ]
        yield _interrupted(notes, config, len(runs))


def _announce(config: ExperimentConfig, folder: Path) -> None:
    """Print the estimate; if the disk may be too small and there is a terminal, ask whether to continue."""
    from runner.execution.estimate import LEAST, estimate, free_bytes, step_limit

    limit, seeds, free = step_limit(config), len(config.seeds), free_bytes(folder)
    runs = f"{seeds} runs of {config.episodes:,} episodes" if seeds > 1 else f"{config.episodes:,} episodes"
    if limit is None:
        return
    if limit == 0:
        say(f"{runs} without a step limit, so the size is unknown; {size(free)} of disk are free.")
        return
    estimated = estimate(config, limit)
    steps, disk = estimated.typical_steps * seeds, estimated.typical_bytes * seeds
    say(
        f"{runs}: about {amount(LEAST * steps)} to {amount(steps)} steps, "
        f"{size(LEAST * disk)} to {size(disk)} "
        f"(at most {amount(estimated.max_steps * seeds)}, {size(estimated.max_bytes * seeds)})."
    )
    if free >= disk:
        return
    say(f"The disk of {folder} has {size(free)} left, which may be too little.")
    if _is_interactive() and not click.confirm("Continue?", err=True):
        raise click.exceptions.Exit(ExitCode.DIFFERENT)


def _is_interactive() -> bool:
    return sys.stdin.isatty() and sys.stderr.isatty()


def _interrupted(notes: list[str], config: ExperimentConfig, begun: int) -> Reply:
    """Return notes of an interrupted command, with the seeds that were not begun."""
    if left := len(config.seeds) - begun:
        notes.append(f"Not begun: {left} of {len(config.seeds)} seeds, from {config.seeds[begun]} on.")
    return Reply(notes=notes, exit_code=ExitCode.INTERRUPTED)


def _reply(run: Run, number: int) -> Reply:
    return Reply(text=_text(run, number), lines={"json": json_lines([run_as_json(run)])})


def _text(run: Run, number: int) -> Iterator[Part]:
    """Yield a run that is over: its evaluations, facts and what to type next."""
    from runner.analysis.evaluations import evaluation_records, evaluations_grid, spread
    from runner.recording.reader import open_recording

    with open_recording(run.recording) as recording:
        records = evaluation_records(recording)
        successes = recording.environment["success_events"]
    if number > 0:
        yield ""
    if records:
        spread_records = spread(records)
        yield evaluations_grid(spread_records, successes)
        if len(spread_records) < len(records):
            show = command_for(run, "show")
            yield f"{len(spread_records)} of {len(records)} evaluations; `{show}` has all."
        yield ""
    yield _result(run, records[-1].episode if records else None)


def _result(run: Run, evaluated: int | None) -> dict[str, str]:
    """Return the facts of a run at its end; `evaluated` is the episode of its last evaluation."""
    summary = run.summary
    following = [command_for(run, "show")]
    if not summary["steps_recorded"]:
        following += [command_for(run, "rerecord")] * (run.status == "finished")
    elif evaluated is not None:
        following.append(command_for(run, "play", f"--eval {evaluated}:0"))
    elif summary["train_steps"]:
        following.append(command_for(run, "play", "--episode 0"))
    rows = run_facts(run)
    steps = (summary["train_steps"] + summary["eval_steps"]) * summary["steps_recorded"]
    if steps:
        rows["file"] += f", {summary['bytes'] / steps:.0f} bytes per step"
    return rows | {"next": "\n".join(following)}
