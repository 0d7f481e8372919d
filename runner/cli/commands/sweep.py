"""`dualtaxi sweep`: an experiment with many values, and what came of it."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from runner.cli import Group
from runner.cli.options import (
    ConfigName,
    all_option,
    json_option,
    markdown_option,
    recordings_option,
    workers_option,
)
from runner.cli.output import draw, facts, print_json, say
from runner.errors import ExitCode
from runner.util.humanize import amount, size

if TYPE_CHECKING:
    from runner.sweep.local import Workers
    from runner.sweep.model import Sweep
    from runner.sweep.plan import Plan
    from runner.sweep.running import SweepStatus
    from runner.sweep.trials import Trials


@click.group("sweep", cls=Group)
def command() -> None:
    """Run an experiment with many values, and rank them.

    \b
    Examples:
      dualtaxi sweep run hyperparameters --dry-run
      dualtaxi sweep run hyperparameters --workers 2
      dualtaxi sweep show hyperparameters
    """  # noqa: D301 - Click wants the backspace itself


@command.command("run")
@click.argument("file", metavar="FILE", type=ConfigName("sweep"))
@workers_option(None, "one per processor")
@click.option(
    "--ray",
    "ray",
    is_flag=False,
    flag_value="",
    metavar="[ADDRESS]",
    help="Run on Ray: on the cluster at ADDRESS, or on this machine.",
)
@click.option("--resume", "resuming", is_flag=True, help="Resume a sweep.")
@click.option("--retry-failed", is_flag=True, help="With --resume: retry failed runs.")
@click.option("--accept-changes", is_flag=True, help="Resume although the file or the code has changed.")
@click.option("--dry-run", is_flag=True, help="Show what would run and how much disk it takes, and stop.")
@click.option("--name", help="Name of the sweep.  [default: the name in the file, or of the file]")
@json_option
@recordings_option
@click.pass_context
def run(
    ctx: click.Context,
    file: Path,
    workers: int | None,
    ray: str | None,
    resuming: bool,
    retry_failed: bool,
    accept_changes: bool,
    dry_run: bool,
    name: str | None,
    as_json: bool,
    recordings: Path | None,
) -> None:
    """Run the sweep FILE: many runs of one experiment with other values.

    FILE may also be the name of a shipped sweep, which `dualtaxi config ls` lists.

    Each trial is one ordinary run per seed, tagged sweep=NAME, in the recordings folder. --resume continues a
    sweep that was killed or interrupted: finished runs are not repeated, unfinished ones are resumed, and the
    results are those of an undisturbed sweep. They depend neither on the number of workers nor on where they
    run.

    Exit code 0 when all is done, 1 when runs failed or a limit was reached, 130 when interrupted.

    \b
    Examples:
      dualtaxi sweep run hyperparameters --dry-run
      dualtaxi sweep run hyperparameters --workers 2
      dualtaxi sweep run hyperparameters --resume
    """  # noqa: D301 - Click wants the backspace itself
    from runner.api import interruptible
    from runner.runs.run import recordings_folder
    from runner.sweep import state
    from runner.sweep.loading import load_sweep
    from runner.sweep.plan import limit_of, plan_of, require_disk
    from runner.sweep.running import run_sweep
    from runner.sweep.search import require_optuna
    from runner.util.values import checked_name

    require_optuna()
    folder = recordings_folder(recordings)
    sweep = load_sweep(file, checked_name(name))
    plan = plan_of(sweep)
    if dry_run:
        _tell_plan(sweep, plan, as_json)
        return
    with state.locked(sweep.name, folder):
        state.require_startable(sweep, folder, resuming, accept_changes)
        before = len(state.runs_of(sweep.name, folder))
        require_disk(plan, before, folder)
        say(f"{sweep.name}: {plan.runs:,} runs, about {size(plan.bytes)}; {before:,} are begun already.")
        with (
            _workers(workers, ray, plan.runs) as those,
            interruptible(second=signal.SIG_DFL) as interrupt,
            _table(sweep) as report,
        ):
            state.begin(sweep, folder, resuming, accept_changes)
            if retry_failed:
                state.forget_failures(sweep.name, folder)
            trials, status = run_sweep(
                sweep,
                folder,
                those,
                stop=interrupt,
                report=report,
                limit=limit_of(sweep.file.limits, plan, folder, before),
                accept_changes=accept_changes,
            )
    _tell(sweep, trials, status, as_json)
    if status.stopped or status.failed:
        ctx.exit(ExitCode.INTERRUPTED if interrupt.came else ExitCode.DIFFERENT)


@command.command("show")
@click.argument("name")
@all_option
@click.option(
    "--best",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Write the best configuration, with fresh seeds.",
)
@click.option("--force", is_flag=True, help="Replace the file if it exists.")
@markdown_option
@json_option
@recordings_option
def show(
    name: str,
    everything: bool,
    best: Path | None,
    force: bool,
    as_markdown: bool,
    as_json: bool,
    recordings: Path | None,
) -> None:
    """Rank the trials of the sweep NAME with intervals over seeds, and show which parameters mattered.

    A trial counts by the median over its seeds; beside it stands the interquartile mean (IQM) with its 95 %
    bootstrap interval, for four seeds and more. What mattered is the share of the objective's variance that
    each parameter, and each two, explain (functional ANOVA).

    \b
    Examples:
      dualtaxi sweep show hyperparameters
      dualtaxi sweep show hyperparameters --best best.yaml
    """  # noqa: D301 - Click wants the backspace itself
    from runner.cli.output import print_sections, require_one_form
    from runner.cli.progress import stage_line
    from runner.errors import RunnerError
    from runner.export.places import require_new, write_text_new
    from runner.runs.run import recordings_folder
    from runner.sweep.results import SHOWN, results_of, sections
    from runner.sweep.state import read_sweep

    require_one_form(as_json, as_markdown)
    folder = recordings_folder(recordings)
    if best is not None:
        require_new(best, force)
    sweep = read_sweep(name, folder)
    with stage_line("ranking trials"):
        results = results_of(sweep, folder)
    if as_json:
        print_json(
            {
                "name": name,
                "objective": results.sweep.objective.model_dump(mode="json"),
                "trials": results.trials,
                "ranking": [dataclasses.asdict(entry) for entry in results.ranking],
                "effects": [dataclasses.asdict(effect) for effect in results.effects],
                "best": results.best and results.best.number,
            }
        )
    else:
        print_sections(sections(results, None if everything else SHOWN), as_markdown)
        if best is None and results.best is not None:
            number = results.best.number
            say(f"--best FILE writes the configuration of trial {number}, with fresh seeds to confirm it.")
    if best is not None:
        if results.best_yaml is None:
            raise RunnerError(f"the sweep {name!r} has no finished trial yet, so there is no best one.")
        write_text_new(best, force, results.best_yaml)
        say(f"{best}: the best configuration, with fresh seeds; `dualtaxi run {best}` confirms it.")


@command.command("ls")
@recordings_option
@json_option
def ls(recordings: Path | None, as_json: bool) -> None:
    """List the sweeps of a recordings folder.

    \b
    Example:
      dualtaxi sweep ls
    """  # noqa: D301 - Click wants the backspace itself
    from runner.runs.run import recordings_folder
    from runner.sweep import sweeps_in

    names = sweeps_in(recordings_folder(recordings))
    if as_json:
        print_json({"sweeps": names})
    elif names:
        click.echo("\n".join(names))
    else:
        say("No sweeps yet. `dualtaxi sweep run FILE` starts one.")


@contextlib.contextmanager
def _workers(count: int | None, ray: str | None, runs: int) -> Iterator[Workers]:
    """Give those who do the runs; not more of them than runs."""
    most = min(count or os.cpu_count() or 1, runs)
    if ray is None:
        from runner.sweep.local import LocalWorkers

        with LocalWorkers(most) as local:
            yield local
    else:
        from runner.sweep.cluster import RayWorkers

        # What Ray has to say, of a worker that died, it says on stdout, where only results belong.
        with contextlib.redirect_stdout(sys.stderr), RayWorkers(count, ray or None, runs) as remote:
            yield remote


@contextlib.contextmanager
def _table(sweep: Sweep) -> Iterator[Any]:
    """Give what is told the status: it keeps a table up to date, where there is a terminal."""
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.console import Console
    from rich.live import Live

    with Live(console=Console(stderr=True, highlight=False), transient=True, refresh_per_second=4) as live:
        yield lambda status: live.update(facts(_status(sweep, status)))


def _status(sweep: Sweep, status: SweepStatus) -> dict[str, str]:
    """Return how a sweep stands, in words."""
    from runner.sweep.results import reading, words
    from runner.util.humanize import duration

    left = status.runs - status.done - status.failed
    here = status.begun - status.running
    rate = here / status.seconds if status.seconds and here > 0 else 0.0
    bar = "█" * round(20 * status.done / max(status.runs, 1))
    told = {
        sweep.name: f"{bar:░<20} {status.done:,} of {status.runs:,} runs, {status.running} running"
        + (f", {status.pruned:,} given up" if status.pruned else "")
        + (f", {status.excluded:,} trials left out" if status.excluded else "")
        + (f", {status.failed:,} failed" if status.failed else ""),
        "rate": (f"{rate:.1f} runs/s, {duration(left / rate)} left" if rate else "–")
        + f", {duration(status.seconds)} so far, {size(status.bytes)} of disk",
    }
    if status.best is not None:
        told["best"] = f"{reading(status.best.value)} with {words(status.best.values)}"
    return told


def _tell_plan(sweep: Sweep, plan: Plan, as_json: bool) -> None:
    """Say what would run."""
    values = {path: _described(parameter) for path, parameter in sweep.file.parameters.items()}
    if as_json:
        print_json(dataclasses.asdict(plan) | {"name": sweep.name, "bytes": plan.bytes, "parameters": values})
        return
    draw(
        facts(
            {
                "sweep": f"{sweep.name}, {sweep.file.strategy}",
                "runs": f"{plan.runs:,}: {plan.trials:,} trials, {len(sweep.seeds)} seeds each, of "
                f"{amount(sweep.base.episodes)} episodes"
                + (
                    f"; {plan.excluded} trials left out, whose values do not go together"
                    if plan.excluded
                    else ""
                ),
                **values,
                "objective": sweep.objective.described,
                "disk": f"about {size(plan.bytes)}, {size(plan.bytes_a_run)} a run",
            }
        )
    )


def _described(parameter: Any) -> str:
    if isinstance(parameter, list):
        return ", ".join(map(str, parameter))
    kind = ", log" if parameter.log else f", step {parameter.step:g}" if parameter.step else ""
    return f"{parameter.low:g} to {parameter.high:g}{kind}"


def _tell(sweep: Sweep, trials: Trials, status: SweepStatus, as_json: bool) -> None:
    """Say what came of it."""
    from runner.analysis.compare.statistics import bounded
    from runner.sweep.results import reading, words

    best = trials.best()
    if as_json:
        value = None if best is None or best.value is None else bounded(best.value)
        print_json(
            {
                "name": sweep.name,
                "runs": status.runs,
                "done": status.done,
                "pruned": status.pruned,
                "failed": status.failed,
                "excluded": status.excluded,
                "stopped": status.stopped or None,
                "seconds": round(status.seconds, 3),
                "bytes": status.bytes,
                "best": best and {"trial": best.number, "value": value, "values": best.values},
            }
        )
    else:
        told = _status(sweep, status)
        if best is not None:
            told["best"] = f"{reading(best.value)} in trial {best.number}: {words(best.values)}"
        draw(facts(told | {"next": f"dualtaxi sweep show {sweep.name}"}))
    for trial in trials.done:
        for error in trial.errors if trial.state == "failed" else ():
            say(f"Failed: trial {trial.number}, {error}")
    if status.stopped:
        say(f"Stopped: {status.stopped}. --resume goes on from there.")
