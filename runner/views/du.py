"""`du`: what uses the disk."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from runner.views.view import NO_PROGRESS, ONLY_HERE, Progress, ReadyAnswer, View, view_input

if TYPE_CHECKING:
    from runner.analysis.sections import Section

_LARGEST: Final = 20
"""Runs in the text by default."""


def du(
    folders: Sequence[Path],
    words: Sequence[str] = ONLY_HERE,
    limit: int | None = view_input(
        "limit",
        f"Maximum number of rows, 0 for all.  [default: {_LARGEST}, with --json all]",
        kind=int,
        metavar="N",
    ),
    progress: Progress = NO_PROGRESS,
) -> ReadyAnswer:
    """Show the disk usage of the runs that match FILTER (as in `dualtaxi ls`), or of all, largest first.

    It counts recordings; exports made by `view` and recordings restored from archives, both kept in the
    user's cache and made again when needed; and other files in the folders of runs. The totals and what could
    be freed come last.

    Examples:
      dualtaxi du
      dualtaxi du 'status == "finished" and age > "30d"' --limit 5
    """
    from runner.analysis.summary import usage_sections
    from runner.runs.catalogue.filters import parse
    from runner.runs.catalogue.index import look
    from runner.runs.catalogue.usage import usage_of

    chosen = parse(" ".join(words))
    largest, sums = usage_of(lambda work: look(folders, work, progress.say), chosen, limit or None)
    freeable = sums.freeable(folders)

    def text() -> Iterator[Section]:
        if sums.runs:
            yield from usage_sections(largest[: _LARGEST if limit is None else None], sums, freeable)
        else:
            searched = ", ".join(map(str, folders))
            progress.say(f"No run in {searched} matches." if words else "No runs yet.")

    runs = [
        {
            "run_id": usage.row["id"],
            **{key: usage.row[key] for key in ("name", "status", "same_as")},
            "path": str(Path(usage.row["root"], usage.row["entry"])),
            **usage.bytes,
        }
        for usage in largest
    ]
    return ReadyAnswer({"runs": runs, "total": sums.bytes, "freeable": freeable}, text())


VIEW: Final = View("du", "Disk", du, subject="folders")
