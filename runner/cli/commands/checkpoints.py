"""`dualtaxi checkpoints` and `dualtaxi checkpoint get`: what a loop recorded by `rec.checkpoint`."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Final

import click

from runner.cli import Command, Group
from runner.cli.options import force_option, json_option, output_option, recordings_option, run_argument
from runner.cli.output import draw, print_json, say, table
from runner.cli.runs import find_recorded
from runner.export.places import write_new
from runner.util.humanize import size

_HEADINGS: Final = ("checkpoint", "phase", "episode", "format", "size", "digest", "content")
_LEFT: Final = ("checkpoint", "phase", "format", "digest", "content")


@click.command("checkpoints", cls=Command)
@run_argument
@recordings_option
@json_option
def checkpoints_command(run_name: str, recordings: Path | None, as_json: bool) -> None:
    """List the checkpoints of RUN, which a loop recorded by `rec.checkpoint(name, ...)`.

    Examples:
      dualtaxi checkpoints @latest
      dualtaxi checkpoints cartpole --json
    """
    checkpoints = find_recorded(run_name, recordings).checkpoints()
    if as_json:
        print_json([checkpoint.as_json() for checkpoint in checkpoints])
        return
    if not checkpoints:
        say("There are no checkpoints; a loop records one by rec.checkpoint(name, value).")
        return
    grid = table(*_HEADINGS, left=_LEFT)
    for each in checkpoints:
        content = "here" if each.is_here else "missing"
        grid.add_row(
            each.reference,
            each.phase,
            f"{each.episode:,}",
            each.format,
            size(each.size),
            each.digest[:16],
            content,
        )
    draw(grid)


@click.group("checkpoint", cls=Group)
def checkpoint_command() -> None:
    """Get a checkpoint of a run.

    Example:
      dualtaxi checkpoint get cartpole @latest -o policy.safetensors
    """


@checkpoint_command.command("get", short_help="Write a checkpoint into a file.")
@run_argument
@click.argument("reference", metavar="[NAME]@STEP")
@output_option("NAME-STEP.FORMAT")
@force_option
@recordings_option
@json_option
def get_command(
    run_name: str, reference: str, output: Path | None, force: bool, recordings: Path | None, as_json: bool
) -> None:
    """Write a checkpoint of RUN into a file, after comparing its digest.

    @STEP is the last checkpoint at or before that step, NAME@STEP the last one of that name; @latest is the
    last of all. Nothing is unpickled.

    Examples:
      dualtaxi checkpoint get cartpole @20000 -o policy.safetensors
      dualtaxi checkpoint get cartpole policy@latest -o policy.safetensors
    """
    from runner.runs.checkpoints import find_checkpoint

    run = find_recorded(run_name, recordings)
    checkpoint = find_checkpoint(run.checkpoints(), reference, f"run {run.run_id}")
    name = re.sub(r"[^\w.+=-]", "_", checkpoint.name)
    path = output or Path(f"{name}-{checkpoint.step}.{checkpoint.format}")
    checkpoint.check()
    write_new(path, force, lambda fresh: shutil.copyfile(checkpoint.path, fresh))
    if as_json:
        print_json(checkpoint.as_json() | {"output": str(path.absolute())})
    else:
        click.echo(f"{path}  {size(checkpoint.size)}, {checkpoint.reference}, {checkpoint.format}")
