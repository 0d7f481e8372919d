"""`du`: what uses the disk."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from runner.analysis.sections import Answer
from runner.views.view import NO_PROGRESS, ONLY_HERE, ShownProgress, View, view_input

if TYPE_CHECKING:
    from runner.analysis.sections import Section
    from runner.runs.catalogue.usage import Sums, Usage
    from runner.util.values import Json

_LARGEST: Final = 20
"""Runs in the text by default."""


@dataclass(frozen=True)
class DiskUsage(Answer):
    """The disk usage of runs, measured when a form of it is needed: the text has a few, JSON has all."""

    measured: Callable[[int | None], tuple[list[Usage], Sums]]
    """Takes the number of the largest runs to return, None for all."""
    folders: Sequence[Path]
    limit: int | None
    nothing: str
    """The message where there are no runs."""
    say: Callable[[str], None]

    def as_json(self) -> Json:
        """Return the runs, the totals and what could be freed, in bytes."""
        largest, sums = self.measured(self.limit or None)
        runs = [
            {
                "run_id": usage.row["id"],
                **{key: usage.row[key] for key in ("name", "status", "same_as")},
                "path": str(Path(usage.row["root"], usage.row["entry"])),
                **usage.bytes,
            }
            for usage in largest
        ]
        return {"runs": runs, "total": sums.bytes, "freeable": sums.freeable(self.folders)}

    def sections(self) -> Iterator[Section]:
        """Yield the largest runs and the totals, and what could be freed."""
        from runner.analysis.summary import usage_sections

        largest, sums = self.measured(_LARGEST if self.limit is None else self.limit or None)
        if sums.runs:
            yield from usage_sections(largest, sums, sums.freeable(self.folders))
        else:
            self.say(self.nothing)


def du(
    folders: Sequence[Path],
    words: Sequence[str] = ONLY_HERE,
    limit: int | None = view_input(
        "limit",
        f"Maximum number of rows, 0 for all.  [default: {_LARGEST}, with --json all]",
        kind=int,
    ),
    progress: ShownProgress = NO_PROGRESS,
) -> DiskUsage:
    """Show the disk usage of the runs that match FILTER (as in `dualtaxi ls`), or of all, largest first.

    It counts recordings; exports made by `view` and recordings restored from archives, both kept in the
    user's cache and made again when needed; and other files in the folders of runs. The totals and what could
    be freed come last.

    Examples:
      dualtaxi du
      dualtaxi du 'status == "finished" and age > "30d"' --limit 5
    """
    from runner.runs.catalogue.filters import parse
    from runner.runs.catalogue.index import look
    from runner.runs.catalogue.usage import usage_of

    chosen, searched = parse(" ".join(words)), ", ".join(map(str, folders))
    return DiskUsage(
        lambda count: usage_of(lambda work: look(folders, work, progress.say), chosen, count),
        folders,
        limit,
        f"No run in {searched} matches." if words else "No runs yet.",
        progress.say,
    )


VIEW: Final = View("du", "Disk", du, subject="folders")
