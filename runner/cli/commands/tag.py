"""`dualtaxi tag`: tags on a run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from runner.cli.finding import find
from runner.cli.options import json_option, recordings_option, run_argument
from runner.cli.output import print_json, say


@click.command("tag")
@run_argument
@click.argument("tags", metavar="[TAG]...", nargs=-1)
@click.option("--remove", multiple=True, metavar="TAG", help="Remove this tag; may be repeated.")
@recordings_option
@json_option
def command(
    run_name: str, tags: tuple[str, ...], remove: tuple[str, ...], recordings: Path | None, as_json: bool
) -> None:
    """Add tags to a run, or remove them; print its tags.

    A run tagged `keep` is never removed by rm or prune. Tags are stored in labels.json next to the recording;
    search them by `dualtaxi ls tag:TAG`.

    \b
    Examples:
      dualtaxi tag @latest keep figure-3
      dualtaxi tag k3v9m2xq --remove keep
      dualtaxi ls --quiet name:quick | xargs -I{} dualtaxi tag {} first-try
    """  # noqa: D301 - Click wants the backspace itself
    from runner.runs.run import relabel

    run = find(run_name, recordings)
    missing = sorted(set(remove) - set(run.tags))
    labels = run.labels
    if tags or remove:
        labels = relabel(run, lambda was: replace(was, tags=_changed(was.tags, tags, remove)))
    if as_json:
        print_json({"run_id": run.run_id, "tags": list(labels.tags)})
    elif labels.tags:
        click.echo(" ".join(labels.tags))
    if missing:
        say(f"Run {run.run_id} had no tag {', '.join(missing)}.")


def _changed(was: tuple[str, ...], more: tuple[str, ...], less: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(sorted((set(was) | set(more)) - set(less)))
