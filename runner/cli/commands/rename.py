"""`dualtaxi rename`: another name for a run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from runner.cli.finding import find
from runner.cli.options import json_option, recordings_option, run_argument
from runner.cli.output import print_json


@click.command("rename")
@run_argument
@click.argument("name", required=False)
@click.option("--original", is_flag=True, help="Restore the original name.")
@recordings_option
@json_option
def command(run_name: str, name: str | None, original: bool, recordings: Path | None, as_json: bool) -> None:
    """Rename a run; its id and its recording stay as they are.

    The name is stored in labels.json next to the recording.

    \b
    Examples:
      dualtaxi rename @latest patient
      dualtaxi rename patient --original
    """  # noqa: D301 - Click wants the backspace itself
    from runner.runs.run import relabel
    from runner.util.values import checked_run_name

    if original == (name is not None):
        raise click.UsageError("expected a NAME, or --original.")
    called = checked_run_name(name) or ""
    run = find(run_name, recordings)
    before, first = run.name, run.file.name
    labels = relabel(run, lambda was: replace(was, name="" if called == first else called))
    now = labels.name or first
    if as_json:
        print_json({"run_id": run.run_id, "name": now})
    else:
        click.echo(f"{run.run_id}  {now}" + (f", was {before}" if now != before else ""))
