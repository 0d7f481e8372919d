"""`dualtaxi label`, `mark` and `index`: labels, marks and the index of runs."""

from __future__ import annotations

import sys
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import click

from runner.analysis.sections import Grid
from runner.cli.command import Command, CommandGroup, argument, option
from runner.cli.options import (
    folders_option,
    tags_option,
)
from runner.cli.output import Remark, Reply, say
from runner.cli.runs import found_run
from runner.errors import ExitCode, RunnerError
from runner.runs.catalogue.columns import with_same_as
from runner.runs.run import Run, label
from runner.util.humanize import UNKNOWN, duration

if TYPE_CHECKING:
    from runner.runs.catalogue.index import CatalogueIndex


@click.command("label", cls=Command)
def label_command(
    run: Run = found_run,
    name: str | None = option(
        "--name", metavar="NAME", help="Rename the run; an empty NAME restores the original name."
    ),
    note: str | None = option(
        "--note", metavar="TEXT", help="Replace the note; - reads it from stdin, an empty one removes it."
    ),
    tags: tuple[str, ...] = tags_option,
    untags: tuple[str, ...] = option(
        "--untag", multiple=True, metavar="TAG", help="Remove a tag; may be repeated."
    ),
) -> Reply:
    """Change the name, note and tags of RUN, and show them.

    They are stored in labels.json next to the recording, which stays as it is. A run tagged `keep` is never
    removed by rm or prune. `dualtaxi ls '"TAG" in tags'` and `dualtaxi ls '"WORD" in note'` find labelled
    runs.

    Examples:
      dualtaxi label @latest --name patient --tag keep --tag figure-3
      dualtaxi label patient --note 'the step size of the paper'
      dualtaxi label k3v9m2xq --note - < observations.txt
      dualtaxi ls --quiet 'name == "quick"' | xargs -I{} dualtaxi label {} --tag first-try
    """
    missing = sorted(set(untags) - set(run.tags))
    labels = run.labels
    if name is not None or note is not None or tags or untags:
        labels = label(run, name, _from_stdin() if note == "-" else note, tags, untags)
    shown_name = labels.name or run.file.name
    values = {"run_id": run.run_id, "name": shown_name, "tags": list(labels.tags), "note": labels.note}
    tag_list = " ".join(labels.tags) or UNKNOWN
    rows = {"run": run.run_id, "name": shown_name, "tags": tag_list, "note": labels.note or UNKNOWN}
    notes = [f"Run {run.run_id} had no tag {', '.join(missing)}."] if missing else []
    return Reply(values, [rows], notes=notes)


@click.command("mark", cls=Command)
def mark_command(
    run: Run = found_run,
    at: str | None = argument(metavar="[STEP]", required=False),
    text: str = argument(metavar="[TEXT]", required=False, default=""),
    tags: tuple[str, ...] = tags_option,
    removed: tuple[str, ...] = option(
        "--unmark", multiple=True, metavar="MARK", help="Remove a mark by its id; may be repeated."
    ),
) -> Reply:
    """Mark a STEP of RUN with a TEXT, and list the marks of the run.

    A STEP is EPISODE:T, eval:N:TRIAL:T, step:N, or typical, best, worst or last. Marks are stored in
    marks.json next to the recording, which stays as it is. Pages, Rerun, `dualtaxi show` and the view `marks`
    of `dualtaxi sql` show them. `export mcap`, `import`, `archive`, `remote push` and `remote pull` take them
    along, and merge them with the marks that are there.

    Examples:
      dualtaxi mark k3v9m2xq 812:57 "both stuck" --tag stuck
      dualtaxi mark @latest worst --tag look-again
      dualtaxi mark k3v9m2xq --unmark 3f2a9c01b7de
    """
    from runner.analysis.marking import mark, unmark

    if at is not None:
        mark(run, at, text, tags=tags)
    if removed:
        unmark(run, *removed)
    rows = [(mark.id, mark.at, mark.text, " ".join(mark.tags)) for mark in run.marks]
    headings = ("mark", "step", "text", "tags")
    grid = Grid(headings, rows, left=headings)
    values = {"run_id": run.run_id, "marks": [mark.as_row() for mark in run.marks]}
    return Reply(values, [grid if rows else f"Run {run.run_id} has no marks."])


def _from_stdin() -> str:
    try:
        return sys.stdin.read()
    except UnicodeDecodeError as error:
        raise RunnerError(f"stdin: found bytes that are not UTF-8 ({error}), expected text.") from error


@click.group("index", cls=CommandGroup)
def index_command() -> None:
    """Manage the index of runs, which makes listing them quick.

    Example:
      dualtaxi index rebuild
    """


@index_command.command("rebuild")
def rebuild(recordings: tuple[Path, ...] = folders_option) -> Reply:
    """Rebuild the index from the runs in the recordings folder.

    This is never required: commands notice changes by themselves, and the index holds nothing of its own.
    Exit code 1 if there are folders with files of a run that cannot be read.

    Examples:
      dualtaxi index rebuild
      dualtaxi index rebuild --recordings others --recordings recordings
    """
    from runner.runs.catalogue.database import index_path
    from runner.runs.catalogue.index import look

    began = time.monotonic()
    statuses, copies, problems = look(recordings, _contents, say, rebuild=True)
    took, runs = time.monotonic() - began, statuses.total()
    counts = dict(sorted(statuses.items()))
    values = {
        "runs": runs,
        "same_content": copies,
        "statuses": counts,
        "problems": problems,
        "seconds": round(took, 3),
        "index": str(index_path()),
    }
    listed = ", ".join(f"{count:,} {status}" for status, count in counts.items())
    rows = {
        "runs": f"{runs:,}" + (f": {listed}" if listed else ""),
        "same": f"{copies:,} of them recorded the same content as an earlier run" if copies else "",
        "took": duration(took),
        "index": str(index_path()),
    }
    code = ExitCode.DIFFERENT if problems else ExitCode.OK
    return Reply(values, [rows, *map(Remark, problems)], exit_code=code)


def _contents(index: CatalogueIndex) -> tuple[Counter[str], int, list[str]]:
    """Return the number of runs of each status, the number of copies, and the problems of folders."""
    from runner.runs.catalogue.filters import Filter

    rows = index.rows(Filter(None), columns=("root", "entry", "status", "digest"))
    statuses: Counter[str] = Counter()
    copies = 0
    for row in with_same_as(rows, index.originals()):
        statuses[row["status"]] += 1
        copies += row["same_as"] is not None
    return statuses, copies, index.problems()
