"""Views of runs and sweeps: the lists of them, all about one, and the disk that runs use."""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Final

from runner.analysis.sections import Answer, Grid, Section
from runner.runs.catalogue.columns import (
    DEFAULT_JSON,
    FIELDS,
    HEADINGS,
    LEFT_KINDS,
    as_json,
    as_text,
    columns_of,
    needed_for,
    with_same_as,
)
from runner.sweep import sweeps_in
from runner.util.humanize import capitalised, first_remarks
from runner.util.row_text import csv_lines, json_list
from runner.util.values import Json
from runner.views.view import EVERYTHING, NO_PROGRESS, ONLY_HERE, ReadyAnswer, ShownProgress, View, view_input

if TYPE_CHECKING:
    from runner.analysis.summary import RunDetails
    from runner.runs.catalogue.filters import Filter
    from runner.runs.catalogue.index import CatalogueIndex
    from runner.runs.catalogue.usage import Sums, Usage
    from runner.runs.run import Run
    from runner.sweep.results import Results

ON_A_TERMINAL: Final = 50
"""Runs listed on a terminal by default."""
_READ_BYTES: Final = 1 << 20
_SPOOL_BYTES: Final = 8 << 20
"""Output up to this size is kept in memory, longer output in a temporary file."""

_DEFAULT_COLUMNS: Final = (
    "id",
    "name",
    "config",
    "seed",
    "status",
    "tag",
    "episodes",
    "success_percent",
    "mean_return",
    "logged",
    "bytes",
    "age",
    "same_as",
    "parent",
    "change",
    "folder",
)
"""Columns of the table, unless they hold nothing of interest."""
_OPTIONAL: Final = ("change", "config", "logged", "bytes", "episodes", "seed", "folder", "age")
"""Columns left out where a terminal is narrow, in this order."""
_CUT: Final = (
    "name",
    "config",
    "tags",
    "note",
    "logged",
    "change",
    "environment",
    "host",
    "archive",
    "folder",
    "path",
)
Row = Json
Render = Callable[[Iterable[Row], Sequence[str]], Iterator[str]]


class Listing(Answer):
    """The runs that match a filter; once one form of them is read, how many, and which are damaged."""

    def __init__(
        self,
        recordings: Sequence[Path],
        matching: Filter,
        columns: Sequence[str] | None,
        sort: str,
        limit: int | None,
        offset: int,
        say: Callable[[str], None],
    ) -> None:
        self._recordings, self._filter, self._columns, self._sort = recordings, matching, columns, sort
        self._limit, self._offset, self._say = limit, offset, say
        self._total, self._listed = 0, 0
        self._problems: list[str] = []
        names = columns or DEFAULT_JSON
        self.lines = {
            "quiet": self._lines(["id"], _ids),
            "csv": self._lines(names, _csv_lines),
            "json": self._lines(names, _objects),
        }
        self.remarks = self._remarks()

    def _lines(self, columns: Sequence[str], render: Render) -> Iterator[str]:
        """Yield a text of the runs in bounded memory.

        It goes to a temporary file first: the index is locked while it is read, and the reader of the output
        may be slow.
        """
        from runner.runs.catalogue.index import look, order_of

        order, limit = order_of(self._sort), self._limit or None
        needed = needed_for([*columns, "same_as"] if "same_as" in columns else columns)

        def work(index: CatalogueIndex) -> int:
            spool.seek(0)
            spool.truncate()
            self._listed, self._problems = 0, index.unreadable()
            rows: Iterable[Row]
            if limit is None:
                total = index.count(self._filter)
                rows = islice(index.rows(self._filter, *order, columns=needed), self._offset, None)
            else:
                rows, total = index.page(self._filter, *order, limit=limit, offset=self._offset)
            if "same_as" in columns:
                rows = with_same_as(rows, index.originals())
            for part in render(self._noted(rows), columns):
                spool.write(part)  # `writelines` would hold all of it in memory
            return total

        with tempfile.SpooledTemporaryFile(_SPOOL_BYTES, "w+", encoding="utf-8", newline="") as spool:
            self._total = look(self._recordings, work, self._say)
            spool.seek(0)
            while part := spool.read(_READ_BYTES):
                yield part

    def sections(self) -> Iterator[Section]:
        """Yield a table of the runs, by default of the columns that are of interest here."""
        from runner.runs.catalogue.index import look, order_of

        columns = self._columns
        order, needed = order_of(self._sort), needed_for([*(columns or _DEFAULT_COLUMNS), "same_as"])
        limit = ON_A_TERMINAL if self._limit is None and sys.stdout.isatty() else self._limit or None

        def work(index: CatalogueIndex) -> tuple[list[Row], int]:
            self._problems = index.unreadable()
            rows, total = index.page(self._filter, *order, limit=limit, offset=self._offset, columns=needed)
            return index.with_same_as(rows), total

        found, self._total = look(self._recordings, work, self._say)
        rows = [*self._noted(found)]
        if rows:
            spare = () if columns else _OPTIONAL
            columns_shown = columns or _informative(rows, len(self._recordings))
            yield Section("", grids=[_grid(rows, columns_shown, spare)])

    def _noted(self, rows: Iterable[Row]) -> Iterator[Row]:
        """Yield rows, noting their number and the problems of damaged runs."""
        for row in rows:
            self._listed += 1
            self._problems += [row["problem"]] if row["problem"] else []
            yield row

    def _remarks(self) -> Iterator[str]:
        """Yield what is damaged or cannot be read, how many matching runs are not listed, or why none is."""
        rest = "{} more runs are damaged: `dualtaxi ls 'status == \"damaged\"'`."
        yield from map(capitalised, first_remarks(self._problems, rest))
        folders = ", ".join(map(str, self._recordings))
        if self._listed < self._total:
            end = self._offset + self._listed
            more_runs = f", --offset {end} the next" if self._listed > 0 and end < self._total else ""
            yield f"Showing {self._listed:,} of {self._total:,} runs; --limit 0 shows all{more_runs}."
        elif not self._listed and self._filter.condition is not None:
            yield f"No run in {folders} matches."
        elif not self._listed and not self._problems:
            yield f"No runs in {folders} yet. `dualtaxi run CONFIG` makes one."


def _ids(rows: Iterable[Row], _columns: Sequence[str]) -> Iterator[str]:
    return (f"{row['id']}\n" for row in rows)


def _objects(rows: Iterable[Row], columns: Sequence[str]) -> Iterator[str]:
    return json_list("runs", (as_json(row, columns) for row in rows))


def _csv_lines(rows: Iterable[Row], columns: Sequence[str]) -> Iterator[str]:
    """Return lines of CSV after a heading; tags are separated by blanks, logged values are a JSON object."""

    def cell(value: object) -> object:
        if isinstance(value, list):
            return " ".join(value)
        return json.dumps(value) if isinstance(value, dict) else value

    return csv_lines(columns, (map(cell, as_json(row, columns).values()) for row in rows))


def _informative(rows: Sequence[Row], folders: int) -> list[str]:
    """Return the default columns without those that hold nothing of interest here."""
    has_success = any(row["success_percent"] is not None for row in rows)
    has_return = any(row["mean_return"] is not None for row in rows)
    is_informative = {
        "config": any(row["name"] != row["config"] for row in rows),
        "tag": any(row["tags"] for row in rows),
        "same_as": any(row["same_as"] for row in rows),
        "parent": any(row["parent"] for row in rows),
        "change": any(row["origin"] for row in rows),
        "folder": folders > 1,
        "success_percent": has_success or not has_return,
        "mean_return": has_return,
        "logged": any(row["logged"] != "{}" for row in rows),
    }
    return [column for column in _DEFAULT_COLUMNS if is_informative.get(column, True)]


def _grid(rows: Sequence[Row], columns: Sequence[str], spare: Sequence[str]) -> Grid:
    """Return a table, in which ids are never cut."""
    texts = [column for column in columns if column not in FIELDS or FIELDS[column].kind in LEFT_KINDS]
    headings, left, cut, spare = (
        tuple(HEADINGS.get(column, column) for column in of) for of in (columns, texts, _CUT, spare)
    )
    cells = [tuple(as_text(row, column) for column in columns) for row in rows]
    return Grid(headings, cells, left=left, cut=cut, spare=spare)


def ls(
    folders: Sequence[Path],
    words: Sequence[str] = ONLY_HERE,
    sort: str = view_input(
        "sort", "Sort by these fields; -FIELD for descending order.", default="", metavar="FIELD,..."
    ),
    columns: str | None = view_input("columns", "Show these fields.", metavar="FIELD,..."),
    limit: int | None = view_input(
        "limit",
        f"Maximum number of rows, 0 for all.  [default: {ON_A_TERMINAL} in a terminal's table, else all]",
        kind=int,
    ),
    offset: int = view_input("offset", "Skip the first N.", kind=int, default=0),
    progress: ShownProgress = NO_PROGRESS,
) -> Listing:
    """List the runs that match FILTER, or all, newest first.

    A filter is a list of words, searched for in id, name, configuration, tags and note, or a condition in
    Python's syntax: comparisons of fields, "TEXT" in FIELD, FIELD in ("A", "B"), like(FIELD, "A*"),
    FIELD is None, and, or, not, arithmetic, max(), min(), abs(). The fields:

    \b
      id name config seed status tag note created age episodes steps success_percent
      mean_length mean_penalties mean_return logged seconds bytes digest parent mode
      environment host git archive folder, and config.PATH for any value of the
      configuration

    The table shows the training episodes done (and to do, if some are missing), the percentage of the last
    evaluation's trials that succeeded, their mean return (of a loop without evaluations that of its last 100
    training episodes), the size of the recording, how long ago the run began, which run recorded the same
    content before, which run it is a branch of, and what was changed. For a loop it also shows the last
    values that it logged. A narrow terminal has fewer columns.

    Examples:
      dualtaxi ls
      dualtaxi ls tutorial
      dualtaxi ls 'status == "finished" and config.discount > 0.9' --sort -success_percent --limit 5
      dualtaxi ls 'created >= "2026-01-01" and (seed < 3 or age < "12h")' --columns id,seed,config,digest
      dualtaxi ls --quiet '"tutorial" and "keep" not in tags'
    """  # noqa: D301 - Click's mark for preformatted text
    from runner.runs.catalogue.filters import parse

    names, matching = columns_of(columns) if columns else None, parse(" ".join(words))
    return Listing(folders, matching, names, sort, limit, offset, progress.say)


LS: Final = View(
    "ls",
    "Runs",
    ls,
    subject="folders",
    lead="Words are searched in id, name, configuration, tags and note. A condition compares fields in "
    'Python\'s syntax: `name == "quick"`, `0 < seed < 10`, `"keep" in tags`, `like(name, "q*")`, '
    '`age < "12h"`, `digest is None`, joined by `and`, `or`, `not` and parentheses.',
    forms=("quiet", "csv", "json", "markdown"),
)


def show(run: Run, progress: ShownProgress = NO_PROGRESS) -> ReadyAnswer:
    """Show a run: its evaluations, tables, configuration and provenance.

    --json also prints the whole series: `eval` has an object for each evaluation, with the training episodes
    before it, success_percent, mean_length, mean_penalties and the count of every event; `optimality` its
    exact measures, if the run takes them; `train` an object for each report of training; `loop` the last
    results of a loop: its last evaluation, the means of its last 100 training episodes and the last values it
    logged; `extras` the names of the values that it recorded with its steps; `first_resets` the seed and the
    options of the first reset of each phase; `checkpoints` those of its agent; `marks` the marks at its
    steps; `processes` the processes that recorded it together; `origin` the run and step that it was branched
    from; and `branches` its branches by run id.

    Examples:
      dualtaxi show @latest
      dualtaxi show k3v9m2xq --json
    """
    from runner.analysis.summary import describe_run
    from runner.runs.catalogue.index import look

    folders = [] if run.stands_alone else [run.folder.parent]
    branches = look(folders, lambda index: index.branches(run.run_id), progress.say)
    details = replace(describe_run(run, progress.say), branches=branches)
    return ReadyAnswer(details.as_json(), _show_sections(details, progress))


def _show_sections(details: RunDetails, progress: ShownProgress) -> Iterator[Section]:
    from runner.analysis.summary import random_policy_sentence
    from runner.recording.reader import open_recording

    first, *others = details.sections()
    file = {"file": str(details.run.recording)} if details.bytes else {}
    yield replace(first, facts={**first.facts, **file})
    yield from others
    if details.evaluations:  # after all else: it may take seconds to compute
        with (
            progress.stage("evaluating a random policy"),
            open_recording(details.run.recording) as recording,
        ):
            sentence = random_policy_sentence(recording)
        if sentence:
            yield Section("Baseline", [sentence])


SHOW: Final = View("show", "Overview", show, subject="any run")


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

    run_filter, searched = parse(" ".join(words)), ", ".join(map(str, folders))
    return DiskUsage(
        lambda count: usage_of(lambda work: look(folders, work, progress.say), run_filter, count),
        folders,
        limit,
        f"No run in {searched} matches." if words else "No runs yet.",
        progress.say,
    )


DU: Final = View("du", "Disk", du, subject="folders")


def sweep_ls(recordings: Path) -> ReadyAnswer:
    """List the sweeps of a recordings folder.

    Example:
      dualtaxi sweep ls
    """
    names = sweeps_in(recordings)
    return ReadyAnswer(
        {"sweeps": names},
        [Section("", names)] if names else [],
        lines={"text": [f"{name}\n" for name in names]},
        remarks=[] if names else ["No sweeps yet. `dualtaxi sweep run FILE` starts one."],
    )


SWEEP_LS: Final = View("sweep ls", "Sweeps", sweep_ls, subject="folder")


def sweep_show(
    sweep: tuple[str, Path],
    everything: bool = EVERYTHING,
    progress: ShownProgress = NO_PROGRESS,
) -> Results:
    """Rank the trials of the sweep NAME with intervals over seeds, and show which parameters mattered.

    The value of a trial is the median over its seeds, shown with the interquartile mean (IQM) and its 95 %
    bootstrap interval, for four seeds and more. What mattered is the share of the objective's variance that
    each parameter explains (functional ANOVA), and each pair in a completed grid. --all lists every trial.

    Examples:
      dualtaxi sweep show hyperparameters
      dualtaxi sweep show hyperparameters --write-best best.yaml
    """
    from runner.sweep.results import results_of

    with progress.stage("ranking trials"):
        results = results_of(*sweep)
    return replace(results, shown=None) if everything else results


SWEEP_SHOW: Final = View(
    "sweep show",
    "Sweep",
    sweep_show,
    subject="sweep",
    file_ending=".yaml",
    file_flags=("--write-best",),
    file_help="Write the best configuration, with fresh seeds; `dualtaxi run` confirms it.",
)
