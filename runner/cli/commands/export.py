"""`dualtaxi export`: a run in another form, for other programs."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import click

from runner.cli.command import Command, CommandGroup, option
from runner.cli.commands import export_film, export_tables, export_tools
from runner.cli.options import Writing, selection_options, writing_options
from runner.cli.output import Reply, path_and_size, say, written
from runner.cli.progress import stage_line
from runner.cli.runs import compilation_notice, recorded_run
from runner.export.places import new_file, require_new
from runner.export.plugin import installed_export
from runner.runs.run import Run
from runner.util.extras import EXPORTS
from runner.util.humanize import duration

if TYPE_CHECKING:
    from runner.export.rerun.selection import Request, Selection


class ExportGroup(CommandGroup):
    """The exports, with those that installed packages add."""

    plugins = EXPORTS

    def plugin(self, name: str) -> Command:
        """Return the command of an export that an installed package adds."""
        added = installed_export(name)

        def call(run: Run, to: Writing) -> Reply:
            from runner.recording.reader import open_recording

            path = to.path(run)
            with (
                new_file(path, to.force) as temporary,
                open_recording(run.recording) as recording,
                stage_line(f"exporting {run.run_id}"),
            ):
                added.write(recording, temporary)
            return written(path_and_size(path), path)

        to = writing_options(f"NAME-RUN{added.ending}", f"FILE{added.ending}")
        return Command(name, call, {"run": recorded_run, "to": to}, help=added.help)


@click.group("export", cls=ExportGroup)
def export_command() -> None:
    """Export a run for other programs.

    Example:
      dualtaxi export rerun @latest
    """


@export_command.command("rerun", short_help="For the Rerun viewer: every view of selected episodes.")
def rerun(
    run: Run = recorded_run,
    selected: Request = selection_options,
    to: Writing = writing_options("exports/NAME-RUN.rrd", "FILE.rrd"),
) -> Reply:
    """Export RUN for the Rerun viewer, arranged and ready to look at.

    All metrics are exported. By default the steps are those of 20 training episodes spread from the first to
    the last, and the trials of the last evaluation; what is left out is reported.

    Examples:
      dualtaxi export rerun @latest
      dualtaxi export rerun k3v9m2xq -o look.rrd --episodes 0..20,49980.. --evaluations 49000
      dualtaxi export rerun k3v9m2xq --all --force
      dualtaxi export rerun my-loop --episodes 0..5 --frames
    """
    from runner.export.rerun.viewer import require_rerun

    require_rerun("export rerun")
    from runner.export.rerun.writing import export

    started = time.monotonic()
    path = to.path(run)
    require_new(path, to.force)
    with compilation_notice(), stage_line("exporting") as stage:
        (selection,) = export([run], selected, path, stage)
    print_selection(selection)
    took = duration(time.monotonic() - started)
    text = f"{path_and_size(path)}, {selection.steps:,} steps, in {took}"
    return written(text, path, steps=selection.steps, left_out=selection.left_out)


def print_selection(selection: Selection) -> None:
    """Print which steps are exported, and which are not."""
    for warning in selection.warnings:
        say(warning)
    if selection.exported:
        say("Exported: all metrics; " + "; ".join(selection.exported) + ".")
    for left_out in selection.left_out:
        say(f"Left out: {left_out}.")


@export_command.command("mcap", short_help="One file with everything, for `dualtaxi import`.")
def mcap(
    run: Run = recorded_run,
    anonymous: bool = option(
        "--anonymous", is_flag=True, help="Leave out host, user, command line and folder."
    ),
    to: Writing = writing_options("NAME-RUN.mcap"),
) -> Reply:
    """Write RUN into one MCAP file with its labels, for `dualtaxi import` on another machine.

    Every MCAP reader opens the file. The same run gives the same bytes. An interrupted run can be exported,
    and stays interrupted.

    Examples:
      dualtaxi export mcap @latest
      dualtaxi export mcap k3v9m2xq --anonymous -o for_review.mcap
    """
    from runner.export.mcap import export_mcap

    path = to.path(run)
    with stage_line(f"exporting {run.run_id}"):
        exported = export_mcap(run, path, anonymous, to.force)
    for warning in exported.warnings:
        say(warning)
    text = f"{path_and_size(path)}; `dualtaxi import {path}` takes it in"
    return written(text, path, anonymous=anonymous)


for _command in (
    export_film.command,
    export_tables.parquet,
    export_tables.csv,
    export_tools.minari,
    export_tools.tensorboard,
):
    export_command.add_command(_command)
