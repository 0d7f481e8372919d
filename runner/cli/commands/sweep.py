"""`dualtaxi sweep`: an experiment with many values, and its results."""

from __future__ import annotations

import contextlib
import dataclasses
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from runner.cli import view_command
from runner.cli.command import CommandGroup, argument, option
from runner.cli.options import (
    accept_changes_option,
    job_option,
    ray_option,
    workers_option,
)
from runner.cli.output import Reply, console, facts, say
from runner.cli.parameter_types import ConfigName
from runner.cli.progress import seldom
from runner.cli.runs import runs_folder
from runner.errors import ExitCode
from runner.runs.run import command_in
from runner.util.extras import VIEWS
from runner.util.humanize import UNKNOWN, amount, duration, size
from runner.util.values import checked_name

if TYPE_CHECKING:
    from runner.sweep.model import Parameter, Sweep
    from runner.sweep.running import Plan, SweepStatus
    from runner.sweep.trials import Trials


@click.group(
    "sweep",
    cls=CommandGroup,
    plugins=VIEWS,
    plugin=view_command,
    views={
        "show": "Rank the trials of the sweep NAME with intervals over seeds, and show which parameters "
        "mattered.",
        "ls": "List the sweeps of a recordings folder.",
    },
    prefix="sweep ",
)
def sweep_command() -> None:
    """Run an experiment with many values, and rank them.

    Examples:
      dualtaxi sweep run hyperparameters --dry-run
      dualtaxi sweep run hyperparameters --workers 2
      dualtaxi sweep show hyperparameters
    """


@sweep_command.command("run")
@job_option
def run(
    file: Path = argument(metavar="FILE", type=ConfigName("sweep")),
    workers: int | None = workers_option("one per processor"),
    ray: str | None = ray_option,
    is_resumed: bool = option("--resume", is_flag=True, help="Resume a sweep."),
    retry_failed: bool = option("--retry-failed", is_flag=True, help="With --resume: retry failed runs."),
    accept_changes: bool = accept_changes_option,
    dry_run: bool = option(
        "--dry-run", is_flag=True, help="Show what would run and how much disk it takes, and stop."
    ),
    name: str | None = option(
        "--name", help="Name of the sweep.  [default: the name in the file, or of the file]"
    ),
    folder: Path = runs_folder,
) -> Reply:
    """Run the sweep FILE: many runs of one experiment with other values.

    FILE may also be the name of a shipped sweep, which `dualtaxi config ls` lists.

    Each trial is one ordinary run per seed, tagged sweep=NAME, in the recordings folder. --resume continues a
    sweep that was killed or interrupted: finished runs are not repeated, unfinished ones are resumed, and the
    results are those of an undisturbed sweep. They depend neither on the number of workers nor on where they
    run.

    Exit code 0 when all is done, 1 when runs failed or a limit was reached, 130 when interrupted.

    Examples:
      dualtaxi sweep run hyperparameters --dry-run
      dualtaxi sweep run hyperparameters --workers 2
      dualtaxi sweep run hyperparameters --resume
    """
    from runner.api import interruptible
    from runner.execution.session import resolve_initial_q
    from runner.sweep.model import load_sweep
    from runner.sweep.running import plan_of, run_whole_sweep
    from runner.sweep.state import with_resolved_tables
    from runner.sweep.trials import require_optuna

    require_optuna()
    checks = {"initial_q": lambda config: resolve_initial_q(config, folder)}
    sweep = with_resolved_tables(load_sweep(file, checked_name(name), checks), folder)
    if dry_run:
        return _plan(sweep, plan_of(sweep))

    def planned(plan: Plan, before: int) -> None:
        started = f"; {before:,} started before" if before else ""
        say(f"{sweep.name}: {plan.runs:,} runs, about {size(plan.bytes)}{started}.")

    with (
        contextlib.redirect_stdout(sys.stderr),  # Ray prints messages about workers that died
        interruptible(second=signal.SIG_DFL) as interrupt,
        _live_status(sweep) as report,
    ):
        trials, status = run_whole_sweep(
            sweep,
            folder,
            workers,
            ray,
            resume=is_resumed,
            retry_failed=retry_failed,
            accept_changes=accept_changes,
            stop=interrupt,
            report=report,
            planned=planned,
        )
    code = ExitCode.DIFFERENT if status.stopped or status.failed else ExitCode.OK
    following = command_in(folder, "sweep", "show", sweep.name)
    code = ExitCode.INTERRUPTED if code and interrupt.came else code
    return _results(sweep, trials, status, following, code)


@contextlib.contextmanager
def _live_status(sweep: Sweep) -> Iterator[Callable[[SweepStatus], None]]:
    """Yield a function that shows the status on a terminal's stderr; elsewhere a line a minute."""
    if not sys.stderr.isatty():
        yield seldom(lambda status: say(", ".join(_status_rows(sweep, status).values())))
        return
    from rich.live import Live

    with Live(console=console(stderr=True), transient=True, refresh_per_second=4) as live:
        yield lambda status: live.update(facts(_status_rows(sweep, status)))


def _status_rows(sweep: Sweep, status: SweepStatus) -> dict[str, str]:
    from runner.sweep.results import objective_text, values_text

    left = status.runs - status.done - status.failed
    ended = status.started - status.running
    rate = ended / status.seconds if status.seconds and ended > 0 else 0.0
    bar = "█" * round(20 * status.done / max(status.runs, 1))
    counts = [
        f"{bar:░<20} {status.done:,} of {status.runs:,} runs",
        f"{status.running} running",
        *([f"{status.pruned:,} pruned"] if status.pruned else []),
        *([f"{status.excluded:,} trials left out"] if status.excluded else []),
        *([f"{status.failed:,} failed"] if status.failed else []),
    ]
    speed = f"{rate:.1f} runs/s, {duration(left / rate)} left" if rate else UNKNOWN
    rows = {
        sweep.name: ", ".join(counts),
        "rate": f"{speed}, {duration(status.seconds)} so far, {size(status.bytes)} of disk",
    }
    if status.best is not None:
        rows["best"] = f"{objective_text(status.best.value)} with {values_text(status.best.values)}"
    return rows


def _plan(sweep: Sweep, plan: Plan) -> Reply:
    """Return what would run."""
    values = {path: _range_text(parameter) for path, parameter in sweep.file.parameters.items()}
    more = {"name": sweep.name, "bytes": plan.bytes, "parameters": values}
    runs = f"{plan.runs:,}: {plan.trials:,} trials, {len(sweep.seeds)} seeds each, of "
    runs += f"{amount(sweep.base.episodes)} episodes"
    if plan.excluded:
        runs += f"; {plan.excluded} trials left out, whose values do not go together"
    rows = {
        "sweep": f"{sweep.name}, {sweep.file.strategy}",
        "runs": runs,
        **values,
        "objective": sweep.objective.description,
        "disk": f"about {size(plan.bytes)}, {size(plan.bytes_per_run)} per run",
    }
    return Reply(dataclasses.asdict(plan) | more, [rows])


def _range_text(parameter: Parameter) -> str:
    """Return the values of a parameter as text."""
    if isinstance(parameter, list):
        return ", ".join(map(str, parameter))
    kind = ", log" if parameter.log else f", step {parameter.step:g}" if parameter.step else ""
    return f"{parameter.low:g} to {parameter.high:g}{kind}"


def _results(sweep: Sweep, trials: Trials, status: SweepStatus, following: str, exit_code: int) -> Reply:
    from runner.analysis.statistics import bounded
    from runner.sweep.results import objective_text, values_text

    best = status.best
    value = None if best is None or best.value is None else bounded(best.value)
    keys = ("runs", "done", "pruned", "failed", "excluded")
    values = {
        "name": sweep.name,
        **{key: getattr(status, key) for key in keys},
        "stopped": status.stopped or None,
        "seconds": round(status.seconds, 3),
        "bytes": status.bytes,
        "best": best and {"trial": best.number, "value": value, "values": best.values},
    }
    rows = _status_rows(sweep, status)
    if best is not None:
        rows["best"] = f"{objective_text(best.value)} in trial {best.number}: {values_text(best.values)}"
    failed = [trial for trial in trials.done if trial.state == "failed"]
    notes = [f"Failed: trial {trial.number}, {error}" for trial in failed for error in trial.errors]
    if status.stopped:
        notes.append(f"Stopped: {status.stopped}. --resume continues from there.")
    text = [rows | {"next": following}]
    return Reply(values, text, notes=notes, exit_code=exit_code)
