"""`dualtaxi plot` and `dualtaxi report`: a figure or a page about runs, or about a sweep."""

from __future__ import annotations

from dataclasses import astuple
from pathlib import Path
from typing import TYPE_CHECKING

import click

from runner.cli.command import Command, option
from runner.cli.options import (
    Writing,
    compared_argument,
    curve_options,
    writing_options,
)
from runner.cli.output import Reply, require_page, say, written
from runner.cli.parameter_types import EPISODE, TRIAL
from runner.cli.progress import count_line, stage_line
from runner.cli.runs import find_all_recorded, runs_folder
from runner.cli.views import option_of
from runner.sweep import is_sweep
from runner.util.files import new_file, write_text_new
from runner.util.humanize import counted, sentence, size
from runner.views.compare import AXIS, NORMALISE

if TYPE_CHECKING:
    from runner.analysis.episodes import EpisodeRef
    from runner.analysis.series import RunSeries
    from runner.export.plots.curves import CurveStyle


@click.command("plot", cls=Command)
def plot_command(
    run_names: tuple[str, ...] = compared_argument,
    axis: str = option_of(AXIS),
    style: CurveStyle = curve_options,
    normalise: Path | None = option_of(NORMALISE),
    to: Writing = writing_options("exports/plot.png", "FILE.png|svg|pdf"),
    folder: Path = runs_folder,
) -> Reply:
    """Draw every metric of one or several runs over an axis, in one figure; or a sweep.

    Runs that differ in nothing but the seed are drawn as one line, their interquartile mean, with its 95 %
    interval as a band; below four runs, their mean and range. A run that was recorded twice counts once, with
    a message. A name shared by several runs stands for all of them, and a filter, as in `dualtaxi ls`, for
    the runs that match it.

    With --normalise the figure has normalised scores over environments instead, as in `dualtaxi compare`:
    aggregates, performance profiles and sample-efficiency curves of the returns.

    For a sweep, given by its name, the objective is drawn against each parameter and in parallel coordinates,
    and over episodes for the best and the median trial.

    Examples:
      dualtaxi plot @latest
      dualtaxi plot cooperative competitive -o comparison.pdf
      dualtaxi plot ppo dqn --axis steps --smooth 5 --log-y
      dualtaxi plot ppo dqn --axis steps --normalise minmax
      dualtaxi plot hyperparameters -o hyperparameters.png
    """
    from runner.analysis.axes import axis_of
    from runner.analysis.contents import shortcomings
    from runner.analysis.groups import duplicates, groups_of, panels_of
    from runner.analysis.series import read_series, values_left_out
    from runner.export.plots.chart import check_suffix, save
    from runner.export.plots.curves import CurveStyle, curves_sheet
    from runner.recording.reader import open_recording

    output = to.path()
    check_suffix(output)
    if normalise is not None and style != CurveStyle():
        raise click.UsageError(
            "--normalise has a figure of its own: leave out --lines, --smooth, --log-x and --log-y."
        )
    if is_sweep(run_names, folder):
        _refuse_style(axis, style)
        if normalise is not None:
            raise click.UsageError("--normalise: found a sweep, expected runs.")
        return _plot_sweep(run_names[0], folder, to)
    series, over = [], axis_of(axis)
    runs = find_all_recorded(run_names, folder)
    with count_line("runs read", len(runs)) as progress:
        for run in runs:
            with open_recording(run.recording) as recording:
                series.append(read_series(recording, over))
                for shortcoming in shortcomings(recording):
                    say(shortcoming)
            progress(len(series))
    if normalise is not None:
        return _plot_tasks(series, normalise, to)
    groups = groups_of(series)
    for note in duplicates(groups):
        say(sentence(note))
    for left_out in values_left_out(series):
        say(left_out)
    panels = panels_of(groups)
    with stage_line("drawing"), new_file(output, to.force) as path:
        save(curves_sheet(groups, panels, style), path)
    count = sum(len(group.runs) for group in groups)
    text = f"{output}: {counted(len(panels), 'metric')} of {counted(count, 'run')}"
    return written(text, output, metrics=len(panels), runs=count)


def _plot_tasks(series: list[RunSeries], normalise: Path, to: Writing) -> Reply:
    from runner.analysis.compare.tasks import compare_algorithms, scores_of
    from runner.export.plots.chart import save
    from runner.export.plots.comparisons import tasks_sheet

    output, table = to.path(), scores_of(normalise)
    with stage_line("computing intervals") as stage:
        comparison = compare_algorithms(series, table)
        stage("drawing")
        with new_file(output, to.force) as path:
            save(tasks_sheet(comparison), path)
    for note in comparison.notes:
        say(f"Note: {note}.")
    text = f"{output}: {len(comparison.algorithms)} groups in {len(comparison.tasks)} environments"
    return written(text, output, groups=len(comparison.algorithms), environments=len(comparison.tasks))


def _refuse_style(axis: str, style: CurveStyle) -> None:
    if axis != "episodes":
        raise click.UsageError(f"--axis: found {axis}, expected episodes, as sweeps are drawn over them.")
    if any(astuple(style)):
        raise click.UsageError("--lines, --smooth, --log-x, --log-y: found a sweep, expected runs.")


def _plot_sweep(name: str, recordings: Path, to: Writing) -> Reply:
    from runner.analysis.groups import panels_of
    from runner.export.plots.chart import save
    from runner.sweep.charts import drawn_trials, learning, panel_of, sweep_sheet
    from runner.sweep.results import results_of

    results = results_of(name, recordings)
    drawn = drawn_trials(results)
    groups = learning(results, recordings)
    panel = panel_of(results.sweep.objective.metric, panels_of(groups))
    with stage_line("drawing"), new_file(to.path(), to.force) as path:
        save(sweep_sheet(f"Sweep {name}", drawn, groups, panel), path)
    count = len(drawn.trials)
    return written(f"{to.path()}: the sweep {name}, {count} trials", to.path(), sweep=name, trials=count)


@click.command("report", cls=Command)
def report_command(
    run_names: tuple[str, ...] = compared_argument,
    episodes: tuple[EpisodeRef, ...] = option(
        "--episode",
        type=EPISODE,
        multiple=True,
        metavar="EPISODE",
        help="Also show this episode: N of training, counted from 0, eval:N:TRIAL, best or worst; may be "
        "repeated.",
    ),
    trials: tuple[EpisodeRef, ...] = option(
        "--eval",
        type=TRIAL,
        multiple=True,
        metavar="N:TRIAL",
        help="Also show this trial of the evaluation after N training episodes; may be repeated.",
    ),
    axis: str = option_of(AXIS),
    style: CurveStyle = curve_options,
    to: Writing = writing_options("exports/report.html", "FILE.html"),
    folder: Path = runs_folder,
) -> Reply:
    """Write one self-contained page about one or several runs, or about a sweep.

    It has the plots, what was learned before, in the middle of and after training, all evaluations, the
    configuration and provenance, and a replay of the best and the worst trial of the last evaluation and
    of the first and the last training episode. It needs no network. Runs are named as for `dualtaxi plot`.

    The page of a sweep, given by its name, has the objective against each parameter, parallel coordinates,
    the ranking, what mattered, and the learning curves of the best and the median trial.

    Examples:
      dualtaxi report @latest
      dualtaxi report cooperative competitive -o comparison.html
      dualtaxi report hyperparameters -o hyperparameters.html
      dualtaxi report k3v9m2xq --episode 500 --eval 3000:7 --force
    """
    from runner.analysis.axes import axis_of
    from runner.export.reports.report import render_report

    output = to.path()
    require_page(output, to.force)
    if is_sweep(run_names, folder):
        if episodes or trials:
            raise click.UsageError("the page of a sweep shows no episode: leave out --episode and --eval.")
        _refuse_style(axis, style)
        return _report_sweep(run_names[0], folder, to)
    paths = [run.recording for run in find_all_recorded(run_names, folder)]
    with stage_line("reading") as progress:
        page, notes = render_report(paths, [*episodes, *trials], progress, axis_of(axis), style)
    write_text_new(output, to.force, page)
    for note in notes:
        say(note)
    text = f"{output}: {size(output.stat().st_size)}, {counted(len(paths), 'run')}"
    return written(text, output, runs=len(paths))


def _report_sweep(name: str, recordings: Path, to: Writing) -> Reply:
    from runner.sweep.charts import render_sweep
    from runner.sweep.results import results_of

    results = results_of(name, recordings)
    with stage_line("drawing"):
        write_text_new(to.path(), to.force, render_sweep(results, recordings))
    output = to.path()
    return written(f"{output}: {size(output.stat().st_size)}, the sweep {name}", output, sweep=name)
