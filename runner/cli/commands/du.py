"""`dualtaxi du`: what uses the disk."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from runner.cli.options import filter_argument, folders_option, json_option
from runner.cli.output import UNKNOWN, draw, facts, print_json, say, size, table, title

if TYPE_CHECKING:
    from runner.runs.catalogue.index import Index
    from runner.runs.catalogue.usage import Usage


@click.command("du")
@filter_argument
@folders_option
@click.option(
    "--limit",
    type=click.IntRange(min=0),
    default=20,
    show_default=True,
    metavar="N",
    help="Show the N largest runs, 0 for all.",
)
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
    from runner.runs.catalogue.columns import with_originals
    from runner.runs.catalogue.filters import parse
    from runner.runs.catalogue.index import look
    from runner.runs.catalogue.usage import USED_BY, freeable_of, totals, usages

    chosen = parse(" ".join(words))

    def work(index: Index) -> list[dict[str, Any]]:
        return with_originals(index.select(chosen, columns=USED_BY), index)

    found = usages(look(recordings, work, say))
    freeable = freeable_of(found, recordings)
    if as_json:
        print_json(
            {"runs": [_as_json(usage) for usage in found], "total": totals(found), "freeable": freeable}
        )
    elif found:
        _draw(found, freeable, limit or len(found))
    else:
        say(f"No run in {', '.join(map(str, recordings))} fits." if words else "No runs yet.")


def _as_json(usage: Usage) -> dict[str, Any]:
    from runner.runs.catalogue.usage import totals

    row = usage.row
    told = {key: row[key] for key in ("name", "status", "same_as")}
    path = str(Path(row["root"], row["entry"]))
    return {"run_id": row["id"], **told, "path": path, **totals([usage])}


def _draw(found: Sequence[Usage], freeable: dict[str, int], limit: int) -> None:
    from runner.runs.catalogue.usage import totals

    every = dict(
        zip(("recording", "exports", "restored", "other", "total"), totals(found).values(), strict=True)
    )
    kinds = [kind for kind, number in every.items() if number or kind == "total"]  # none of nothing

    def sizes(usages: Sequence[Usage]) -> list[str]:
        numbers = dict(zip(every, totals(usages).values(), strict=True))
        return [_bytes(numbers[kind]) for kind in kinds]

    same = ["same as"] if any(usage.row["same_as"] for usage in found) else []
    drawn = table(
        *("id", "name", "status", *kinds, *same),
        left=("id", "name", "status", "same as"),
        shrinking=("name",),
    )
    for usage in found[:limit]:
        row = usage.row
        others = [row["same_as"] or ""] if same else []
        drawn.add_row(row["id"], row["name"], row["status"], *sizes([usage]), *others)
    if found[limit:]:
        drawn.add_row(f"{len(found) - limit:,} more", "", "", *sizes(found[limit:]))
    drawn.add_row("all", "", "", *sizes(found), style="bold")
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
