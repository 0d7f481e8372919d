"""`dualtaxi prune`: remove the runs that are old, unfinished or unwanted."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import click

from runner.cli.options import filter_argument, folders_option, json_option
from runner.cli.output import say
from runner.cli.removing import carry_out, dry_run_option, force_option, yes_option
from runner.errors import RunnerError
from runner.runs.catalogue.columns import STATUSES

if TYPE_CHECKING:
    from runner.runs.catalogue.removal import Criteria, Removal


@click.command("prune")
@filter_argument
@folders_option
@click.option("--older-than", metavar="AGE", help="Runs that started longer ago than this: 30d, 12h, 2w.")
@click.option(
    "--keep-last",
    type=click.IntRange(min=0),
    metavar="N",
    help="Keep the newest N runs of each configuration.",
)
@click.option(
    "--status",
    "statuses",
    multiple=True,
    type=click.Choice([status for status in STATUSES if status != "running"]),
    help="Runs with this status; may be repeated. Archived runs are removed only with --status archived.",
)
@dry_run_option
@yes_option
@force_option
@json_option
def command(
    words: tuple[str, ...],
    recordings: tuple[Path, ...],
    older_than: str | None,
    keep_last: int | None,
    statuses: tuple[str, ...],
    dry_run: bool,
    yes: bool,
    force: bool,
    as_json: bool,
) -> None:
    """Remove the runs that match FILTER (as in `dualtaxi ls`) and all options, after confirmation.

    At least one of them must be given. --keep-last keeps the newest runs of each configuration name, counted
    over all runs. Runs that are running or tagged `keep` stay, and so do those whose folder holds files of
    other origin.

    \b
    Examples:
      dualtaxi prune --older-than 30d --keep-last 5 --status interrupted --dry-run
      dualtaxi prune 'config:quick success_percent:<50' --yes
    """  # noqa: D301 - Click wants the backspace itself
    from runner.runs.catalogue.filters import parse
    from runner.runs.catalogue.removal import Criteria

    criteria = Criteria(parse(" ".join(words)), _seconds(older_than), keep_last, statuses)
    if criteria.filter.condition is None and older_than is None and keep_last is None and not statuses:
        raise click.UsageError("expected a FILTER, --older-than, --keep-last or --status: which runs?")
    removals, protected = _chosen(recordings, criteria, force, dry_run)
    kept = {each.run_id: each.refusal for each in removals if each.refusal}
    for run_id, why in kept.items():
        say(f"Run {run_id} stays: {why}.")
    if protected:
        say("Left alone: " + ", ".join(f"{count:,} {why}" for why, count in sorted(protected.items())) + ".")
    going = [each for each in removals if not each.refusal]
    if not going and not as_json:
        say("There is nothing to remove.")
        return
    carry_out(going, kept, force, yes, dry_run, as_json)


def _seconds(text: str | None) -> float | None:
    """Return the age in a text.

    Raises:
        RunnerError: there is none.
    """
    from runner.runs.catalogue.filters import seconds_of

    try:
        return None if text is None else seconds_of(text)
    except ValueError:
        raise RunnerError(f"--older-than: found {text!r}, expected an age such as 30d, 12h or 2w.") from None


def _chosen(
    recordings: tuple[Path, ...], criteria: Criteria, force: bool, dry_run: bool
) -> tuple[list[Removal], Counter[str]]:
    """Return what may go, and how many runs are protected, by reason."""
    from runner.runs.catalogue.index import look
    from runner.runs.catalogue.removal import plan, plan_row, unwanted
    from runner.runs.run import runs_in

    rows, protected = look(recordings, lambda index: unwanted(index, criteria, time.time()), say)
    if dry_run:
        return [plan_row(row, force) for row in rows], protected
    places = [(Path(row["root"]), row["entry"]) for row in rows]
    planned = [plan(run, root, force) for root, entry in places for run in runs_in(root / entry)]
    return planned, protected
