"""`dualtaxi label`: the name, note and tags of a run."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from runner.cli import Command
from runner.cli.options import json_option, recordings_option, run_argument
from runner.cli.output import draw, facts, print_json, say
from runner.cli.runs import find
from runner.errors import RunnerError
from runner.util.humanize import UNKNOWN


@click.command("label", cls=Command)
@run_argument
@click.option("--name", metavar="NAME", help="Rename the run; an empty NAME restores the original name.")
@click.option(
    "--note", metavar="TEXT", help="Replace the note; - reads it from stdin, an empty one removes it."
)
@click.option("--tag", "tags", multiple=True, metavar="TAG", help="Add a tag; may be repeated.")
@click.option("--untag", "untags", multiple=True, metavar="TAG", help="Remove a tag; may be repeated.")
@recordings_option
@json_option
def label_command(
    run_name: str,
    name: str | None,
    note: str | None,
    tags: tuple[str, ...],
    untags: tuple[str, ...],
    recordings: Path | None,
    as_json: bool,
) -> None:
    """Change the name, note and tags of RUN, and show them.

    They are stored in labels.json next to the recording, which stays as it is. A run tagged `keep` is never
    removed by rm or prune. `dualtaxi ls tag:TAG` and `dualtaxi ls note:WORD` find labelled runs.

    Examples:
      dualtaxi label @latest --name patient --tag keep --tag figure-3
      dualtaxi label patient --note 'the step size of the paper'
      dualtaxi label k3v9m2xq --note - < observations.txt
      dualtaxi ls --quiet name:quick | xargs -I{} dualtaxi label {} --tag first-try
    """
    from runner.runs.run import label

    run = find(run_name, recordings)
    missing = sorted(set(untags) - set(run.tags))
    labels = run.labels
    if name is not None or note is not None or tags or untags:
        labels = label(run, name, _from_stdin() if note == "-" else note, tags, untags)
    shown_name = labels.name or run.file.name
    if as_json:
        print_json({"run_id": run.run_id, "name": shown_name, "tags": list(labels.tags), "note": labels.note})
    else:
        tag_list = " ".join(labels.tags) or UNKNOWN
        draw(facts({"run": run.run_id, "name": shown_name, "tags": tag_list, "note": labels.note or UNKNOWN}))
    if missing:
        say(f"Run {run.run_id} had no tag {', '.join(missing)}.")


def _from_stdin() -> str:
    try:
        return sys.stdin.read()
    except UnicodeDecodeError as error:
        raise RunnerError(f"stdin: found bytes that are not UTF-8 ({error}), expected text.") from error
