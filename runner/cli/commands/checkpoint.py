"""`dualtaxi checkpoint get`: checkpoints that a loop recorded."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import click

from runner.cli.command import CommandGroup, argument
from runner.cli.options import force_option, output_option
from runner.cli.output import Reply, path_and_size, written
from runner.cli.runs import recorded_run
from runner.export.places import new_file
from runner.runs.run import Run


@click.group("checkpoint", cls=CommandGroup)
def checkpoint_command() -> None:
    """Get a checkpoint of a run.

    Example:
      dualtaxi checkpoint get cartpole @latest -o policy.safetensors
    """


@checkpoint_command.command("get", short_help="Write a checkpoint into a file.")
def get_command(
    run: Run = recorded_run,
    reference: str = argument(metavar="[NAME]@STEP", default="@latest"),
    output: Path | None = output_option("NAME-STEP.FORMAT"),
    force: bool = force_option,
) -> Reply:
    """Write a checkpoint of RUN into a file, after comparing its digest.

    @STEP is the last checkpoint at or before that step, NAME@STEP the last one of that name; @latest is the
    last of all, and the default. Nothing is unpickled.

    Examples:
      dualtaxi checkpoint get cartpole @20000 -o policy.safetensors
      dualtaxi checkpoint get cartpole policy@latest -o policy.safetensors
    """
    from runner.runs.checkpoints import find_checkpoint

    checkpoint = find_checkpoint(run.checkpoints(), reference, f"run {run.run_id}")
    name = re.sub(r"[^\w.+=-]", "_", checkpoint.name)
    path = output or Path(f"{name}-{checkpoint.step}.{checkpoint.format}")
    checkpoint.check()
    with new_file(path, force) as temporary:
        shutil.copyfile(checkpoint.path, temporary)
    text = f"{path_and_size(path)}, {checkpoint.reference}, {checkpoint.format}"
    return written(text, path, **checkpoint.as_json())
