"""`dualtaxi plot`: every metric over episodes."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli.options import EXPORTS, recordings_option, runs_argument
from runner.cli.output import say
from runner.cli.progress import count_line, stage_line
from runner.cli.runs import find_all_recorded


@click.command("plot")
@runs_argument
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    default=EXPORTS / "plot.png",
    show_default=True,
    metavar="FILE",
    help="The file to write: FILE.png, FILE.svg or FILE.pdf.",
)
@click.option("--force", is_flag=True, help="Replace the file if it exists.")
@recordings_option
def command(run_names: tuple[str, ...], output: Path, force: bool, recordings: Path | None) -> None:
    """Draw every metric of one or several runs over episodes, in one figure; or a sweep.

    Runs that differ in nothing but the seed are drawn as one line, their median, with a band from the lowest
    to the highest; a run that was recorded twice counts once, with a message. A name shared by several runs
    stands for all of them.

    The name of a sweep stands for it: its objective is drawn against each parameter and in parallel
    coordinates, and over episodes for the best and the median trial.

    \b
    Examples:
      dualtaxi plot @latest
      dualtaxi plot cooperative competitive -o comparison.pdf
      dualtaxi plot hyperparameters -o hyperparameters.png
    """  # noqa: D301 - Click wants the backspace itself
    from runner.analysis.groups import duplicates, groups_of
    from runner.analysis.series import read_series, values_left_out
    from runner.export.contents import shortcomings
    from runner.export.places import write_new
    from runner.export.plots.curves import curves_sheet
    from runner.export.plots.image import check_suffix, save
    from runner.export.plots.metrics import panels_of
    from runner.recording.reader import open_recording
    from runner.runs.run import recordings_folder
    from runner.sweep import is_sweep

    check_suffix(output)
    folder = recordings_folder(recordings)
    if is_sweep(run_names, folder):
        _draw_sweep(run_names[0], folder, output, force)
        return
    series = []
    runs = find_all_recorded(run_names, folder)
    with count_line("runs read", len(runs)) as progress:
        for run in runs:
            with open_recording(run.recording) as recording:
                series.append(read_series(recording))
                for shortcoming in shortcomings(recording):
                    say(shortcoming)
            progress(len(series))
    groups = groups_of(series)
    for note in duplicates(groups):
        say(f"{note[0].upper()}{note[1:]}.")
    for sentence in values_left_out(series):
        say(sentence)
    panels = panels_of(groups)
    with stage_line("drawing"):
        write_new(output, force, lambda path: save(curves_sheet(groups, panels), path))
    drawn = sum(len(group.runs) for group in groups)
    click.echo(f"{output}: {len(panels)} metrics of {drawn} run{'s' if drawn > 1 else ''}")


def _draw_sweep(name: str, recordings: Path, output: Path, force: bool) -> None:
    from runner.export.places import write_new
    from runner.export.plots.image import save
    from runner.sweep.charts import sweep_sheet
    from runner.sweep.plots import learning, panel_of, picture_of
    from runner.sweep.results import results_of
    from runner.sweep.state import read_sweep

    results = results_of(read_sweep(name, recordings), recordings)
    picture = picture_of(results)
    groups, panels = learning(results, recordings)
    panel = panel_of(results.sweep.objective.metric, panels)
    with stage_line("drawing"):
        sheet = sweep_sheet(f"Sweep {name}", picture, groups, panel)
        write_new(output, force, lambda path: save(sheet, path))
    click.echo(f"{output}: the sweep {name}, {len(picture.trials)} trials")
