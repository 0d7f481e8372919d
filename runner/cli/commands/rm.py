"""`dualtaxi rm`: remove runs."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli.options import json_option, recordings_option, runs_argument
from runner.cli.removing import carry_out, dry_run_option, force_option, yes_option
from runner.cli.runs import find
from runner.errors import RunnerError
from runner.runs.run import recordings_folder


@click.command("rm")
@runs_argument
@recordings_option
@yes_option
@dry_run_option
@force_option
@json_option
def command(
    run_names: tuple[str, ...], recordings: Path | None, yes: bool, dry_run: bool, force: bool, as_json: bool
) -> None:
    """Remove runs and their recordings, after confirmation.

    If a run is running or tagged `keep`, or its folder holds files of other origin, nothing is removed. Links
    are not followed. Archives stay.

    \b
    Examples:
      dualtaxi rm k3v9m2xq p7
      dualtaxi rm @latest --dry-run
      dualtaxi ls --quiet status:failed | xargs dualtaxi rm --yes
    """  # noqa: D301 - Click wants the backspace itself
    from runner.runs.catalogue.removal import plan

    root = recordings_folder(recordings)
    runs = {run.folder.resolve(): run for run in (find(name, recordings) for name in run_names)}
    removals = [plan(run, root, force) for run in runs.values()]
    refused = [f"run {each.run_id} stays: {each.refusal}." for each in removals if each.refusal]
    if refused:
        raise RunnerError("\n".join([*refused, "Nothing was removed."]))
    carry_out(removals, {}, force, yes, dry_run, as_json)
