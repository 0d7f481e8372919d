"""`dualtaxi export tensorboard`: an event file for TensorBoard."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli import Command
from runner.cli.options import EXPORTS, recordings_option, run_argument
from runner.cli.output import say
from runner.cli.runs import find_recorded


@click.command("tensorboard", cls=Command)
@run_argument
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    metavar="FOLDER",
    help="The folder to write.  [default: exports/tensorboard/NAME-RUN]",
)
@click.option("--force", is_flag=True, help="Replace the folder if it exists.")
@recordings_option
def command(run_name: str, output: Path | None, force: bool, recordings: Path | None) -> None:
    """Export RUN for TensorBoard: every measure, and length and return of each training episode.

    Each number stands at its training step. TensorBoard itself keeps them as 32-bit numbers, and shows a
    thousand of a curve unless told otherwise.

    Examples:
      dualtaxi export tensorboard @latest
      dualtaxi export tensorboard k3v9m2xq -o logs/patient --force
    """
    from runner.cli.progress import stage_line
    from runner.export.contents import shortcomings
    from runner.export.places import new_folder
    from runner.export.tensorboard import OURS, require_packages, write_events
    from runner.recording.reader import open_recording

    require_packages()
    run = find_recorded(run_name, recordings)
    path = output or EXPORTS / "tensorboard" / run.file_stem
    with open_recording(run.recording) as recording:
        with new_folder(path, force, OURS) as folder, stage_line("writing events"):
            count = write_events(recording, folder)
        for shortcoming in shortcomings(recording):
            say(shortcoming)
    click.echo(
        f"{path}  {count:,} numbers; look at them by: "
        f"tensorboard --logdir {path.parent} --samples_per_plugin scalars=100000"
    )
