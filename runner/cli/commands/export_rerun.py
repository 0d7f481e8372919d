"""`dualtaxi export rerun`: an `.rrd` file for the Rerun viewer."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from runner.cli import Command
from runner.cli.options import (
    EXPORTS,
    Ranges,
    force_option,
    output_option,
    recordings_option,
    run_argument,
    selection_options,
)
from runner.cli.output import say
from runner.cli.runs import find_recorded
from runner.util.humanize import duration, size

if TYPE_CHECKING:
    from runner.export.rerun.selection import Selection


@click.command("rerun", cls=Command)
@run_argument
@output_option("exports/NAME-RUN.rrd", "FILE.rrd")
@selection_options
@force_option
@recordings_option
def command(
    run_name: str,
    output: Path | None,
    episodes: Ranges | None,
    evaluations: tuple[int, ...] | None,
    every: int | None,
    everything: bool,
    force: bool,
    recordings: Path | None,
) -> None:
    """Export RUN for the Rerun viewer, arranged and ready to look at.

    All metrics are exported. By default the steps are those of 20 training episodes spread from the first to
    the last, and the trials of the last evaluation; what is left out is reported.

    Examples:
      dualtaxi export rerun @latest
      dualtaxi export rerun k3v9m2xq -o look.rrd --episodes 0:20,49980: --evaluations 49000
      dualtaxi export rerun k3v9m2xq --all --force
    """
    import time

    from runner.cli.progress import stage_line
    from runner.cli.runs import compilation_notice
    from runner.export.places import require_new
    from runner.export.rerun.viewer import require_rerun
    from runner.recording.reader import open_recording

    require_rerun("export rerun")
    from runner.export.rerun.selection import Request
    from runner.export.rerun.writing import Source, export

    started = time.monotonic()
    run = find_recorded(run_name, recordings)
    path = output or EXPORTS / f"{run.file_stem}.rrd"
    require_new(path, force)
    request = Request(episodes or (), evaluations or (), every or 0, everything)
    with open_recording(run.recording) as recording, compilation_notice(), stage_line("exporting"):
        source = Source(recording, f"{run.title} ({run.run_id})")
        (selection,) = export([source], request, path)
    print_selection(selection)
    took = duration(time.monotonic() - started)
    click.echo(f"{path}  {size(path.stat().st_size)}, {selection.steps:,} steps, in {took}")


def print_selection(selection: Selection) -> None:
    """Print which steps are exported, and which are not."""
    for warning in selection.warnings:
        say(warning)
    if selection.exported:
        say("Exported: all metrics; " + "; ".join(selection.exported) + ".")
    for left_out in selection.left_out:
        say(f"Left out: {left_out}.")
