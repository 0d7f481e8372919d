"""`dualtaxi index`: the index of runs."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click

from runner.cli import Group
from runner.cli.options import folders_option, json_option
from runner.cli.output import draw, facts, print_json, say
from runner.errors import ExitCode
from runner.util.humanize import duration

if TYPE_CHECKING:
    from runner.runs.catalogue.index import Index


class _Contents(NamedTuple):
    """What the index holds."""

    statuses: Counter[str]
    copies: int
    problems: list[str]


@click.group("index", cls=Group)
def index_command() -> None:
    """Manage the index of runs, which makes listing them quick.

    Example:
      dualtaxi index rebuild
    """


@index_command.command("rebuild")
@folders_option
@json_option
@click.pass_context
def rebuild(ctx: click.Context, recordings: tuple[Path, ...], as_json: bool) -> None:
    """Rebuild the index from the runs in the recordings folder.

    This is never required: commands notice changes by themselves, and the index holds nothing of its own.
    Exit code 1 if there are folders with files of a run that cannot be read.

    Examples:
      dualtaxi index rebuild
      dualtaxi index rebuild --recordings /data/runs --recordings recordings
    """
    from runner.runs.catalogue.database import index_path
    from runner.runs.catalogue.index import look

    began = time.monotonic()
    statuses, copies, problems = look(recordings, _contents, say, rebuild=True)
    took, runs = time.monotonic() - began, statuses.total()
    counts = dict(sorted(statuses.items()))
    if as_json:
        print_json(
            {
                "runs": runs,
                "same_content": copies,
                "statuses": counts,
                "problems": problems,
                "seconds": round(took, 3),
                "index": str(index_path()),
            }
        )
    else:
        listed = ", ".join(f"{count:,} {status}" for status, count in counts.items())
        rows = {"runs": f"{runs:,}" + (f": {listed}" if listed else "")}
        if copies:
            rows["same"] = f"{copies:,} of them recorded the same content as an earlier run"
        draw(facts(rows | {"took": duration(took), "index": str(index_path())}))
        for problem in problems:
            say(problem)
    ctx.exit(ExitCode.DIFFERENT if problems else ExitCode.OK)


def _contents(index: Index) -> _Contents:
    from runner.runs.catalogue.columns import with_same_as
    from runner.runs.catalogue.filters import Filter

    rows = index.rows(Filter(None), columns=("root", "entry", "status", "digest"))
    statuses: Counter[str] = Counter()
    copies = 0
    for row in with_same_as(rows, index.originals()):
        statuses[row["status"]] += 1
        copies += row["same_as"] is not None
    return _Contents(statuses, copies, index.problems())
