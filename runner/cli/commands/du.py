"""`dualtaxi du`: disk usage."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from runner.cli import Command
from runner.cli.options import filter_argument, folders_option, json_option, limit_option
from runner.cli.output import draw, facts, print_json, say, table, title
from runner.util.humanize import UNKNOWN, size

if TYPE_CHECKING:
    from runner.runs.catalogue.usage import Sums, Usage

_FREED_BY: Final = {
    "same_content": (
        "recorded before",
        "the same content is there already: `dualtaxi rm` those with `same as`",
    ),
    "unfinished": (
        "unfinished",
        "`dualtaxi prune --status interrupted --status failed`, if they are not to be resumed",
    ),
    "left_over": ("left over", "damaged originals kept by repairs, and files of interrupted commands"),
    "cached": ("cached", "made again when needed; remove the folder dualtaxi in your cache"),
    "half_removed": ("half removed", "the next `dualtaxi rm` or `prune` removes the rest"),
}
"""Reason why bytes can be freed -> its name, and how to free them."""


@click.command("du", cls=Command)
@filter_argument
@folders_option
@limit_option(20)
@json_option
def du_command(words: tuple[str, ...], recordings: tuple[Path, ...], limit: int, as_json: bool) -> None:
    """Show the disk usage of the runs that match FILTER (as in `dualtaxi ls`), or of all, largest first.

    It counts recordings; exports made by `view` and recordings restored from archives, both kept in the
    user's cache and made again when needed; and other files in the folders of runs. The totals and what could
    be freed come last.

    Examples:
      dualtaxi du
      dualtaxi du status:finished age:>30d --limit 5
    """
    from runner.runs.catalogue.filters import parse
    from runner.runs.catalogue.index import look
    from runner.runs.catalogue.usage import sizes, usage_of

    chosen = parse(" ".join(words))
    largest, sums = usage_of(
        lambda work: look(recordings, work, say), chosen, None if as_json or not limit else limit
    )
    freeable = sums.freeable(recordings)
    if as_json:
        runs = [
            {
                "run_id": usage.row["id"],
                **{key: usage.row[key] for key in ("name", "status", "same_as")},
                "path": str(Path(usage.row["root"], usage.row["entry"])),
                **sizes([usage]),
            }
            for usage in largest
        ]
        print_json({"runs": runs, "total": sums.by_kind(), "freeable": freeable})
    elif sums.runs:
        _draw(largest, sums, freeable)
    else:
        say(f"No run in {', '.join(map(str, recordings))} matches." if words else "No runs yet.")


def _draw(largest: Sequence[Usage], sums: Sums, freeable: dict[str, int]) -> None:
    from runner.runs.catalogue.usage import sizes

    total, shown = sums.by_kind(), sizes(largest)
    kinds = [kind for kind, count in total.items() if count or kind == "total"]

    def cells(counts: dict[str, int]) -> list[str]:
        return [size(counts[kind]) if counts[kind] else UNKNOWN for kind in kinds]

    same_as = ["same as"] if any(usage.row["same_as"] for usage in largest) else []
    left = ("id", "name", "status", "same as")
    grid = table("id", "name", "status", *kinds, *same_as, left=left, shrinking=("name",))
    for usage in largest:
        row = usage.row
        originals = [row["same_as"] or ""] if same_as else []
        grid.add_row(row["id"], row["name"], row["status"], *cells(sizes([usage])), *originals)
    if sums.runs > len(largest):
        rest = {kind: count - shown[kind] for kind, count in total.items()}
        grid.add_row(f"{sums.runs - len(largest):,} more", "", "", *cells(rest))
    grid.add_row("all", "", "", *cells(total), style="bold")
    draw(grid)
    reasons = {
        _FREED_BY[kind][0]: f"{size(count)}  {_FREED_BY[kind][1]}"
        for kind, count in freeable.items()
        if count
    }
    if reasons:
        draw(title("Could be freed"), facts(reasons))
