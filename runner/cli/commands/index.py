"""`dualtaxi index`: the index of runs."""

from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from runner.cli import Group
from runner.cli.options import folders_option, json_option
from runner.cli.output import facts, print_json, say
from runner.errors import ExitCode
from runner.util.humanize import duration

if TYPE_CHECKING:
    from runner.runs.catalogue.index import Index


@dataclass(frozen=True)
class _Found:
    runs: int
    copies: int
    statuses: dict[str, int]
    problems: list[str]


@click.group("index", cls=Group)
def command() -> None:
    """Manage the index of runs, which makes listing them quick.

    \b
    Example:
      dualtaxi index rebuild
    """  # noqa: D301 - Click wants the backspace itself


@command.command("rebuild")
@folders_option
@json_option
@click.pass_context
def rebuild(ctx: click.Context, recordings: tuple[Path, ...], as_json: bool) -> None:
    """Rebuild the index from the runs in the recordings folder.

    This is never required: commands notice changes by themselves, and the index holds nothing of its own.
    Exit code 1 if there are folders with files of a run that cannot be read.

    \b
    Examples:
      dualtaxi index rebuild
      dualtaxi index rebuild --recordings /data/runs --recordings recordings
    """  # noqa: D301 - Click wants the backspace itself
    from runner.runs.catalogue.database import index_path
    from runner.runs.catalogue.index import look

    began = time.monotonic()
    found = look(recordings, _found, say, rebuild=True)
    took = time.monotonic() - began
    if as_json:
        told = {"runs": found.runs, "same_content": found.copies, "statuses": found.statuses}
        print_json(told | {"problems": found.problems, "seconds": round(took, 3), "index": str(index_path())})
    else:
        _print(found, took, str(index_path()))
    ctx.exit(ExitCode.DIFFERENT if found.problems else ExitCode.OK)


def _found(index: Index) -> _Found:
    from runner.runs.catalogue.columns import with_same_as
    from runner.runs.catalogue.filters import Filter

    rows = index.rows(Filter(None), columns=("root", "entry", "status", "digest"))
    statuses: Counter[str] = Counter()
    copies = 0
    for row in with_same_as(rows, index.originals()):
        statuses[row["status"]] += 1
        copies += row["same_as"] is not None
    return _Found(
        runs=statuses.total(),
        copies=copies,
        statuses=dict(sorted(statuses.items())),
        problems=index.problems(),
    )


def _print(found: _Found, took: float, index: str) -> None:
    from runner.cli.output import draw

    standing = ", ".join(f"{count:,} {status}" for status, count in found.statuses.items())
    told = {"runs": f"{found.runs:,}" + (f": {standing}" if standing else "")}
    if found.copies:
        told["same"] = f"{found.copies:,} of them recorded what another did before"
    draw(facts(told | {"took": duration(took), "index": index}))
    for problem in found.problems:
        say(problem)
