"""What the commands that remove runs share: showing what would go, asking, doing it, telling."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import click

from runner.cli.output import console, draw, print_json, say, table
from runner.errors import RunnerError
from runner.util.humanize import UNKNOWN, age, number, size

if TYPE_CHECKING:
    from runner.runs.catalogue.removal import Removal
    from runner.runs.run import Run

_MOST_DRAWN: Final = 1000
"""Rows that are fitted to a terminal; more are printed as in a file, which is far quicker."""

yes_option: Final = click.option("--yes", "-y", is_flag=True, help="Do not ask for confirmation.")
force_option: Final = click.option(
    "--force", is_flag=True, help="Also remove files and folders in a run's folder that no run writes."
)
dry_run_option: Final = click.option(
    "--dry-run", is_flag=True, help="Show what would be removed and how much is freed, and remove nothing."
)


def carry_out(
    removals: Sequence[Removal], kept: dict[str, str], force: bool, yes: bool, dry_run: bool, as_json: bool
) -> None:
    """Show what is to go, ask, remove it and tell what was freed.

    Args:
        removals: what is to go; none of them refused.
        kept: what stays for all that, id to why; for programs.
        force: remove strange files as well.
        yes: do not ask.
        dry_run: remove nothing.
        as_json: tell it as JSON.

    Raises:
        RunnerError: there is nobody to ask.
    """
    from runner.runs.catalogue.removal import clean, remove, total

    if removals and not as_json:
        _draw(removals)
    if removals and not dry_run:
        _ask(removals, yes)
        for removal in removals:
            remove(removal, force)
        for root in {removal.root for removal in removals}:
            clean(root)
    if as_json:
        print_json(_as_json(removals, kept, dry_run))
    elif dry_run:
        say(f"Nothing was removed; it would free {size(total(removals))}.")
    else:
        runs = "1 run" if len(removals) == 1 else f"{len(removals):,} runs"
        click.echo(f"Removed {runs}, freed {size(total(removals))}.")


def _ask(removals: Sequence[Removal], yes: bool) -> None:
    from runner.runs.catalogue.removal import total

    if yes:
        return
    if not sys.stdin.isatty():
        raise RunnerError("there is no terminal to ask on; --yes removes without asking, --dry-run tells.")
    runs = "this run" if len(removals) == 1 else f"these {len(removals):,} runs"
    click.confirm(f"Remove {runs} for good, and free {size(total(removals))}?", abort=True, err=True)


def _as_json(removals: Sequence[Removal], kept: dict[str, str], dry_run: bool) -> dict[str, Any]:
    from runner.runs.catalogue.removal import total

    runs = [
        {
            "run_id": removal.run_id,
            "name": removal.name,
            "status": removal.status,
            "path": str(removal.folder.absolute()),
            "bytes": removal.freed,
        }
        for removal in removals
    ]
    told = {"dry_run": dry_run, "freed": total(removals)}
    return {**told, "removed": runs, "kept": [{"run_id": key, "why": why} for key, why in kept.items()]}


def _draw(removals: Sequence[Removal]) -> None:
    from runner.cli.listing import aligned, printable

    headings = ("id", "name", "seed", "status", "success %", "age", "frees")
    left = ("id", "name", "status")
    if console().is_terminal and len(removals) <= _MOST_DRAWN:
        drawn = table(*headings, left=left, shrinking=("name",))
        for removal in removals:
            drawn.add_row(*_cells(removal))
        draw(drawn)
    else:
        lines = [list(map(printable, _cells(removal))) for removal in removals]
        for line in aligned([headings, *lines], [heading in left for heading in headings]):
            click.echo(line)
    for removal in removals:
        if removal.is_archived:
            say(_archive_in_words(removal.run()))


def _cells(removal: Removal) -> tuple[str, ...]:
    from datetime import UTC, datetime

    return (
        removal.run_id,
        removal.name,
        UNKNOWN if removal.seed is None else str(removal.seed),
        removal.status,
        UNKNOWN if removal.success_percent is None else number(removal.success_percent),
        age((datetime.now(UTC) - removal.created).total_seconds()),
        size(removal.freed),
    )


def _archive_in_words(run: Run) -> str:
    """Return what is left of a run in its archive. Object storage is not asked: that may take minutes."""
    from runner.archive.places import archive_place

    said = run.archive.target
    if "://" in said:
        return f"The archive of {run.run_id} at {said} is left alone."
    try:
        place = archive_place(run)
    except RunnerError as error:
        return f"Whether run {run.run_id} is still in its archive cannot be told: {error}"
    if place is None:
        return f"Run {run.run_id} was archived at {said}, but is not there: nothing of it will be left."
    return f"The archive of {run.run_id} at {place} stays."
