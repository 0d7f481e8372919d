"""`dualtaxi init`: a folder to start in."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli.options import json_option
from runner.cli.output import print_json, say


@click.command("init")
@click.argument("folder", metavar="[FOLDER]", default=".", type=click.Path(file_okay=False, path_type=Path))
@json_option
def command(folder: Path, as_json: bool) -> None:
    """Create a folder to start in, with configs/, recordings/ and a README of what to type.

    FOLDER defaults to the current one. Files that exist already are left as they are.

    \b
    Examples:
      dualtaxi init
      dualtaxi init experiments
    """  # noqa: D301 - Click wants the backspace itself
    from runner.config.shipped import start_folder

    made: list[Path] = []
    kept: list[Path] = []
    for path, is_new in start_folder(folder):
        (made if is_new else kept).append(path)
    if as_json:
        print_json({"folder": str(folder.absolute()), "made": [*map(str, made)], "kept": [*map(str, kept)]})
        return
    for path in made:
        click.echo(path)
    if kept:
        say(f"{len(kept)} of {len(made) + len(kept)} existed already and were left as they are.")
    change = "" if folder == Path() else f"cd {folder} && "
    say(f"Next: {change}dualtaxi run configs/quick.yaml")
