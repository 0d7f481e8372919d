"""`dualtaxi export mcap`: a run as one file."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli import Command
from runner.cli.options import force_option, json_option, output_option, recordings_option, run_argument
from runner.cli.output import draw, facts, print_json, say
from runner.cli.runs import find_recorded
from runner.util.humanize import size


@click.command("mcap", cls=Command)
@run_argument
@output_option("NAME-RUN.mcap")
@click.option("--anonymous", is_flag=True, help="Leave out host, user, command line and folder.")
@force_option
@recordings_option
@json_option
def command(
    run_name: str, output: Path | None, anonymous: bool, force: bool, recordings: Path | None, as_json: bool
) -> None:
    """Write RUN into one MCAP file with its labels, for `dualtaxi import` on another machine.

    Every MCAP reader opens the file. The same run gives the same bytes. An interrupted run can be exported,
    and stays interrupted.

    Examples:
      dualtaxi export mcap @latest
      dualtaxi export mcap k3v9m2xq --anonymous -o for_review.mcap
    """
    from runner.cli.progress import stage_line
    from runner.export.mcap import export_mcap

    run = find_recorded(run_name, recordings)
    path = output or Path(f"{run.file_stem}.mcap")
    with stage_line(f"exporting {run.run_id}"):
        exported = export_mcap(run, path, anonymous, force)
    for warning in exported.warnings:
        say(warning)
    if as_json:
        print_json({"path": str(path.absolute()), "bytes": path.stat().st_size, "anonymous": anonymous})
        return
    draw(facts({"file": f"{path}  {size(path.stat().st_size)}", "next": f"dualtaxi import {path}"}))
