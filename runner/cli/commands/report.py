"""`dualtaxi report`: one self-contained page about runs."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli.options import EXPORTS, TRIAL, recordings_option, runs_argument
from runner.cli.output import say
from runner.cli.progress import stage_line
from runner.cli.runs import find_all_recorded
from runner.util.humanize import size


@click.command("report")
@runs_argument
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    default=EXPORTS / "report.html",
    show_default=True,
    metavar="FILE",
    help="The file to write.",
)
@click.option(
    "--episode",
    "episodes",
    type=click.IntRange(0),
    multiple=True,
    metavar="N",
    help="Show this training episode too, counted from 0; may be repeated.",
)
@click.option(
    "--eval",
    "trials",
    type=TRIAL,
    multiple=True,
    metavar="N:TRIAL",
    help="Show this trial of the evaluation after N training episodes too; may be repeated.",
)
@click.option("--force", is_flag=True, help="Replace the file if it exists.")
@recordings_option
def command(
    run_names: tuple[str, ...],
    output: Path,
    episodes: tuple[int, ...],
    trials: tuple[tuple[int, int], ...],
    force: bool,
    recordings: Path | None,
) -> None:
    """Write one self-contained page about one or several runs, or about a sweep.

    It has the plots, what was learned before, in the middle of and after training, all evaluations, the
    configuration and provenance, and a replay of the best and the worst trial of the last evaluation and
    of the first and the last training episode. It needs no network.

    The page of a sweep, which its name stands for, has the objective against each parameter, parallel
    coordinates, the ranking, what mattered, and the learning curves of the best and the median trial.

    \b
    Examples:
      dualtaxi report @latest
      dualtaxi report cooperative competitive -o comparison.html
      dualtaxi report hyperparameters -o hyperparameters.html
      dualtaxi report k3v9m2xq --episode 500 --eval 3000:7 --force
    """  # noqa: D301 - Click wants the backspace itself
    from runner.export.places import write_new
    from runner.export.reports.report import require_packages, write_report
    from runner.runs.run import recordings_folder
    from runner.sweep import is_sweep

    require_packages()
    folder = recordings_folder(recordings)
    if is_sweep(run_names, folder):
        if episodes or trials:
            raise click.UsageError("a sweep's page shows no episode: leave out --episode and --eval.")
        _report_sweep(run_names[0], folder, output, force)
        return
    chosen = [("train", number, 0) for number in episodes]
    chosen += [("eval", *trial) for trial in trials]
    paths = [run.recording for run in find_all_recorded(run_names, folder)]
    said: list[str] = []
    with stage_line("reading") as progress:
        write_new(output, force, lambda path: said.extend(write_report(path, paths, chosen, progress)))
    for sentence in said:
        say(sentence)
    click.echo(f"{output}: {size(output.stat().st_size)}, {len(paths)} run{'s' if len(paths) > 1 else ''}")


def _report_sweep(name: str, recordings: Path, output: Path, force: bool) -> None:
    from runner.export.places import write_text_new
    from runner.sweep.page import render_sweep
    from runner.sweep.results import results_of
    from runner.sweep.state import read_sweep

    results = results_of(read_sweep(name, recordings), recordings)
    with stage_line("drawing"):
        write_text_new(output, force, render_sweep(results, recordings))
    click.echo(f"{output}: {size(output.stat().st_size)}, the sweep {name}")
