"""`dualtaxi export tensorboard`: an event file for TensorBoard."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli import Command
from runner.cli.commands.export import opened_run
from runner.cli.options import EXPORTS, force_option, output_option, recordings_option, run_argument


@click.command("tensorboard", cls=Command)
@run_argument
@output_option("exports/tensorboard/NAME-RUN", "FOLDER")
@force_option
@recordings_option
def command(run_name: str, output: Path | None, force: bool, recordings: Path | None) -> None:
    """Export RUN for TensorBoard: every metric, and length and return of each training episode.

    Each number is at its training step. TensorBoard itself keeps numbers as 32-bit floats, and shows a
    thousand of a curve by default.

    Examples:
      dualtaxi export tensorboard @latest
      dualtaxi export tensorboard k3v9m2xq -o logs/patient --force
    """
    from runner.cli.progress import stage_line
    from runner.export.places import new_folder
    from runner.export.tensorboard import PATTERNS, require_packages, write_events

    require_packages()
    with opened_run(run_name, recordings) as (run, recording):
        path = output or EXPORTS / "tensorboard" / run.file_stem
        with new_folder(path, force, PATTERNS) as folder, stage_line("writing events"):
            count = write_events(recording, folder)
    click.echo(
        f"{path}  {count:,} numbers; view them by: "
        f"tensorboard --logdir {path.parent} --samples_per_plugin scalars=100000"
    )
