"""`dualtaxi note`: a note on a run."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import click

from runner.cli.finding import find
from runner.cli.options import json_option, recordings_option, run_argument
from runner.cli.output import print_json
from runner.errors import RunnerError


@click.command("note")
@run_argument
@click.argument("text", required=False)
@click.option("--clear", is_flag=True, help="Remove the note.")
@recordings_option
@json_option
def command(run_name: str, text: str | None, clear: bool, recordings: Path | None, as_json: bool) -> None:
    """Write a note on a run, replacing its present one; without TEXT, print it. - reads it from stdin.

    Notes are stored in labels.json next to the recording; search them by `dualtaxi ls note:WORD`.

    \b
    Examples:
      dualtaxi note @latest 'the step size of the paper'
      dualtaxi note k3v9m2xq
      dualtaxi note k3v9m2xq - < observations.txt
    """  # noqa: D301 - Click wants the backspace itself
    from runner.runs.run import relabel

    if clear and text is not None:
        raise click.UsageError("found TEXT and --clear, expected one of them.")
    run = find(run_name, recordings)
    labels = run.labels
    if clear or text is not None:
        try:
            note = (sys.stdin.read() if text == "-" else text or "").strip()
        except UnicodeDecodeError as error:
            raise RunnerError(f"stdin: found bytes that are not UTF-8 ({error}), expected text.") from error
        labels = relabel(run, lambda was: replace(was, note=note))
    if as_json:
        print_json({"run_id": run.run_id, "note": labels.note})
    elif labels.note and text is None:
        click.echo(labels.note)
