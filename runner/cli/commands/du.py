"""`dualtaxi du`: what uses the disk."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from runner.cli.options import filter_argument, folders_option, json_option, limit_option
from runner.cli.output import draw, facts, print_json, say, table, title
from runner.util.humanize import UNKNOWN, size

if TYPE_CHECKING:
    from runner.runs.catalogue.usage import Sums, Usage


@click.command("du")
@filter_argument
@folders_option
@limit_option(20)
@json_option
def command(words: tuple[str, ...], recordings: tuple[Path, ...], limit: int, as_json: bool) -> None:
    """Show the disk usage of the runs that match FILTER (as in `dualtaxi ls`), or of all, largest first.

    It counts recordings; exports made by `view` and recordings restored from archives, both kept in the
    user's cache and made again when needed; and other files in the folders of runs. The totals and what could
    be freed come last.

    \b
    Examples:
      dualtaxi du
      dualtaxi du status:finished age:>30d --limit 5
    """  # noqa: D301 - Click wants the backspace itself
    from runner.runs.catalogue.filters import parse
    from runner.runs.catalogue.index import look
    from runner.runs.catalogue.usage import usage_of

    chosen = parse(" ".join(words))
    most = None if as_json or not limit else limit
    largest, sums = usage_of(lambda work: look(recordings, work, say), chosen, most)
    freeable = sums.freeable(recordings)
    if as_json:
        print_json(
            {"runs": [_as_json(usage) for usage in largest], "total": sums.by_kind(), "freeable": freeable}
        )
    elif sums.runs:
        _draw(largest, sums, freeable)
    else:
        say(f"No run in {', '.join(map(str, recordings))} fits." if words else "No runs yet.")


def _as_json(usage: Usage) -> dict[str, Any]:
    from runner.runs.catalogue.usage import sizes

    row = usage.row
    facts = {key: row[key] for key in ("name", "status", "same_as")}
    path = str(Path(row["root"], row["entry"]))
    return {"run_id": row["id"], **facts, "path": path, **sizes([usage])}


def _draw(largest: Sequence[Usage], sums: Sums, freeable: dict[str, int]) -> None:
    from runner.runs.catalogue.usage import sizes

    every, shown = sums.by_kind(), sizes(largest)
    kinds = [kind for kind, number in every.items() if number or kind == "total"]  # none of nothing

    def cells(numbers: dict[str, int]) -> list[str]:
        return [_bytes(numbers[kind]) for kind in kinds]

    same = ["same as"] if any(usage.row["same_as"] for usage in largest) else []
    drawn = table(
        *("id", "name", "status", *kinds, *same),
        left=("id", "name", "status", "same as"),
        shrinking=("name",),
    )
    for usage in largest:
        row = usage.row
        others = [row["same_as"] or ""] if same else []
        drawn.add_row(row["id"], row["name"], row["status"], *cells(sizes([usage])), *others)
    if sums.runs > len(largest):
        rest = {kind: number - shown[kind] for kind, number in every.items()}
        drawn.add_row(f"{sums.runs - len(largest):,} more", "", "", *cells(rest))
    drawn.add_row("all", "", "", *cells(every), style="bold")
    draw(drawn)
    told = {
        _FREED_BY[kind][0]: f"{size(number)}  {_FREED_BY[kind][1]}"
        for kind, number in freeable.items()
        if number
    }
    if told:
        draw(title("Could be freed"), facts(told))


_FREED_BY = {
    "same_content": (
        "recorded before",
        "the same content is there already: `dualtaxi rm` those with `same as`",
    ),
    "unfinished": (
        "unfinished",
        "`dualtaxi prune --status interrupted --status failed`, if not to be resumed",
    ),
    "left_over": ("left over", "damaged originals that a repair kept, and what interrupted commands left"),
    "cached": ("cached", "made again when needed; remove the folder dualtaxi in your cache"),
    "half_removed": ("half removed", "the next `dualtaxi rm` or `prune` removes the rest"),
}


def _bytes(number: int) -> str:
    return size(number) if number else UNKNOWN
