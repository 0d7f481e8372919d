"""The index of recordings folders, brought up to date before each query.

A stat of each run's files, 10 us a run, shows which runs changed; these are read. Where the index file cannot
be used, the folders are read without it.
"""

from __future__ import annotations

import contextlib
import json
import os
import sqlite3
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple, TypeVar

from runner.errors import RunnerError, nearest
from runner.recording.labels import LABELS_FILE
from runner.runs.branches import BranchNode, Origin, parse_origin
from runner.runs.catalogue.columns import SETTING, ColumnKind, IndexRow, field_of, with_same_as
from runner.runs.catalogue.database import (
    SEED_SHIFT,
    STORED,
    Candidate,
    Sql,
    create,
    identity,
    index_path,
    open_index,
    renew,
    row_of,
    text,
    transaction,
    write_row,
)
from runner.runs.catalogue.filters import ANY_RUN, Filter, matches, setting_path
from runner.runs.run import RECORDING_FILE, RUN_FILE, check_folder_name, run_entries, run_in

if TYPE_CHECKING:
    from runner.util.processes import Tell

Result = TypeVar("Result")

MAX_TREE: Final = 300
"""Runs in a tree of branches."""
_MAX_VALUES: Final = 1000
"""Contents that are asked for by their digests, and names that are offered."""
_NEWEST: Final = Sql("created DESC, id, root")
_ALL_NEWEST: Final = Sql("+created DESC, id, root")
"""The same for all rows: SQLite reads them as they lie, and sorts them, in a fifth of the time."""
_AMONG: Final = "IN (SELECT value FROM json_each(?))"
"""The condition on a column to have one of the values in a JSON list."""


class CatalogueIndex:
    """The index of some recordings folders, up to date when it was opened."""

    def __init__(self, database: sqlite3.Connection, roots: Sequence[str]) -> None:
        self._database = database
        self.roots = roots
        database.create_function("matches", 2, matches, deterministic=True)

    def problems(self) -> list[str]:
        """Return the problems of folders whose run files cannot be read."""
        where = f"root {self._is_here} AND problem IS NOT NULL ORDER BY root, entry"
        damaged = self._database.execute(f"SELECT problem FROM runs WHERE {where}", self.roots)
        return [problem for (problem,) in damaged]

    def unreadable(self) -> list[str]:
        """Return the problems of folders that have the files of a run, of which none can be read as one."""
        where = f"id IS NULL AND +root {self._is_here} AND problem IS NOT NULL ORDER BY root, entry"
        folders = self._database.execute(f"SELECT problem FROM runs WHERE {where}", self.roots)
        return [problem for (problem,) in folders]

    def select(self, run_filter: Filter, *order: Sql, columns: Sequence[str] = ("*",)) -> list[IndexRow]:
        """Return the rows that match a filter; arguments as for `rows`."""
        return list(self.rows(run_filter, *order, columns=columns))

    def rows(self, run_filter: Filter, *order: Sql, columns: Sequence[str] = ("*",)) -> Iterator[IndexRow]:
        """Yield the rows that match a filter, the newest first.

        Args:
            order: what to sort by before the age.
            columns: the stored columns that are needed; all by default.
        """
        self._check_settings(run_filter)
        return _as_rows(self._query(", ".join(columns), run_filter, _ordered(*order, _ALL_NEWEST)))

    def count(self, run_filter: Filter = ANY_RUN) -> int:
        """Return how many rows match a filter."""
        self._check_settings(run_filter)
        return int(self._query("COUNT(*)", run_filter).fetchone()[0])

    def page(
        self,
        run_filter: Filter,
        *order: Sql,
        limit: int | None,
        offset: int = 0,
        columns: Sequence[str] = ("*",),
    ) -> tuple[list[IndexRow], int]:
        """Return some of the rows that match a filter, and how many match.

        Args:
            limit: the maximum number of rows; None for all.
        """
        if limit is None:
            every = self.select(run_filter, *order, columns=columns)
            return every[offset:], len(every)
        self._check_settings(run_filter)
        ordered = _ordered(*order, _NEWEST)
        if run_filter.condition is None:  # counted in an index of SQLite, without reading the rows
            part = Sql(f"{ordered.text} LIMIT ? OFFSET ?", (*ordered.values, limit, offset))
            places = self._query("root, entry", run_filter, part).fetchall()
            total = self.count(run_filter)
        else:  # a filter may be slow: it is evaluated once for each row
            places = self._query("root, entry", run_filter, ordered).fetchall()
            places, total = places[offset : offset + limit], len(places)
        select = f"SELECT {', '.join(columns)} FROM runs WHERE root = ? AND entry = ?"
        return [row for place in places for row in _as_rows(self._database.execute(select, place))], total

    def page_by_name(self, sort: str, *, limit: int, offset: int) -> tuple[list[tuple[IndexRow, int]], int]:
        """Return the first run of each name, the number of its runs, and how many names there are.

        Args:
            sort: a field that runs, and so the names, are sorted by, as for `order_of`; by default the newest
                come first.
            limit: the maximum number of names.
        """
        column, descending = (_sort_keys(sort) or [(Sql("created"), True)])[0]
        best = f"{'MAX' if descending else 'MIN'}({column.text})"  # SQLite takes root and entry of that row
        condition = f"FROM runs WHERE root {self._is_here} AND id IS NOT NULL"
        places = self._database.execute(
            f"SELECT root, entry, COUNT(*), {best} AS best {condition} GROUP BY name "
            f"ORDER BY best {'DESC' if descending else 'ASC'} NULLS LAST, name LIMIT ? OFFSET ?",
            (*column.values, *self.roots, limit, offset),
        ).fetchall()
        select = "SELECT * FROM runs WHERE root = ? AND entry = ?"
        rows = [next(_as_rows(self._database.execute(select, place))) for *place, _, _ in places]
        (names,) = self._database.execute(
            f"SELECT COUNT(*) FROM (SELECT 1 {condition} GROUP BY name)", self.roots
        ).fetchone()
        return list(zip(rows, (runs for *_, runs, _ in places), strict=True)), int(names)

    def originals(self, digests: Sequence[str] | None = None) -> dict[str, tuple[str, str, str]]:
        """Return root, entry and id of the first run with each content that was recorded twice or more.

        Args:
            digests: the contents; all by default, or if they are very many.
        """
        recorded = f"digest IS NOT NULL AND root {self._is_here}"
        values = [*self.roots]
        if digests is not None and len(digests) <= _MAX_VALUES:
            recorded = f"{recorded} AND digest {_AMONG}"
            values = [*values, json.dumps(digests)]
        several = f"SELECT digest FROM runs WHERE {recorded} GROUP BY digest HAVING COUNT(*) > 1"
        repeated = [digest for (digest,) in self._database.execute(several, values)]
        if not repeated:
            return {}
        first = self._query(
            "digest, root, entry, id",
            Filter(Sql(f"digest {_AMONG}", (json.dumps(repeated),))),
            Sql("ORDER BY created DESC, id DESC, root DESC, entry DESC"),
        )
        return {digest: (root, entry, run_id) for digest, root, entry, run_id in first}

    def with_same_as(self, rows: list[IndexRow]) -> list[IndexRow]:
        """Return rows with `same_as`: the id of another run that recorded the same content first, or None."""
        return list(with_same_as(rows, self.originals([row["digest"] for row in rows if row["digest"]])))

    def branches(self, run_id: str) -> dict[str, Origin]:
        """Return the branches of a run by run id, the newest first."""
        rows = self.rows(Filter(Sql("parent = ?", (run_id,))), columns=("id", "origin"))
        return {row["id"]: origin for row in rows if (origin := parse_origin(json.loads(row["origin"])))}

    def branch_tree(self, run_id: str) -> BranchNode:
        """Return the tree of branches that a run belongs to, from the first run that it descends from.

        At most `MAX_TREE` runs; where there are more, the newest are left out.
        """
        among = f"root {self._is_here}"
        ancestors = (
            "WITH RECURSIVE above(id, depth) AS (SELECT ?, 0 UNION SELECT parent, depth + 1 FROM runs "
            f"JOIN above USING (id) WHERE parent > '' AND depth < {MAX_TREE} AND {among}) "
            "SELECT id FROM above ORDER BY depth DESC LIMIT 1"
        )
        (top,) = self._database.execute(ancestors, (run_id, *self.roots)).fetchone()
        descendants = (
            "WITH RECURSIVE tree(id) AS (SELECT ? UNION SELECT runs.id FROM runs "
            f"JOIN tree ON parent = tree.id WHERE {among}) "
            "SELECT id, name, status, success_percent, mean_return, parent, origin FROM runs "
            f"WHERE id IN tree AND {among} ORDER BY created LIMIT {MAX_TREE}"
        )
        by_id = dict[str, IndexRow]()
        below = dict[str, list[str]]()
        for row in _as_rows(self._database.execute(descendants, (top, *self.roots, *self.roots))):
            if row["id"] not in by_id:
                by_id[row["id"]] = row
                if row["id"] != top:  # or a configuration names itself
                    below.setdefault(row["parent"], []).append(row["id"])

        def node(name: str) -> BranchNode:
            row = by_id.get(name, {})
            return BranchNode(
                run=name,
                name=row.get("name"),
                status=row.get("status") or "removed",
                success_percent=row.get("success_percent"),
                mean_return=row.get("mean_return"),
                origin=parse_origin(json.loads(row.get("origin") or "null")),
                branches=tuple(map(node, below.get(name, ()))),
            )

        return node(top)

    def named(self, name: str) -> list[Candidate]:
        """Return the runs of a name, or whose ids begin with it, the newest first."""
        ids = _begins("id", name)
        return self._names(Sql(f"({ids.text} OR name = ?)", (*ids.values, text(name))))

    def with_id_prefix(self, beginning: str) -> list[Candidate]:
        """Return runs whose ids begin with a text, at most the 1,000 newest."""
        return self._names(_begins("id", beginning), _MAX_VALUES)

    def names_from(self, beginning: str) -> list[tuple[str, int]]:
        """Return names that begin with a text, at most 1,000, and how many runs have each."""
        part = Sql("GROUP BY name LIMIT ?", (_MAX_VALUES,))
        return list(self._query("name, COUNT(*)", Filter(_begins("name", beginning)), part))

    def newest(self, name: str = "", limit: int = 1) -> list[Candidate]:
        """Return the newest runs, of a name if one is given."""
        return self._names(Sql("name = ?", (text(name),)) if name else None, limit)

    def candidates(self, run_filter: Filter) -> list[Candidate]:
        """Return the runs that match a filter, the newest first."""
        self._check_settings(run_filter)
        return self._names(run_filter.condition)

    def _names(self, condition: Sql | None, limit: int = -1) -> list[Candidate]:
        columns = "root, entry, id AS run_id, name, seed, created AS milliseconds"
        part = Sql("ORDER BY created DESC, id DESC LIMIT ?", (limit,))
        return [Candidate(**row) for row in _as_rows(self._query(columns, Filter(condition), part))]

    @property
    def _is_here(self) -> str:
        """The condition on a root to be one of these folders, whose parameters they are."""
        return f"IN ({', '.join('?' * len(self.roots))})"

    def _query(self, columns: str, run_filter: Filter, part: Sql = Sql("")) -> sqlite3.Cursor:  # noqa: B008 - frozen
        """Select columns of the runs that match a filter; `part` follows the condition."""
        condition = run_filter.condition or Sql("TRUE")
        return self._database.execute(
            f"SELECT {columns} FROM runs WHERE root {self._is_here} AND id IS NOT NULL "
            f"AND {condition.text} {part.text}",
            (*self.roots, *condition.values, *part.values),
        )

    def _check_settings(self, run_filter: Filter) -> None:
        """Refuse a filter with a path that no configuration has.

        Raises:
            RunnerError: it has one; the message suggests a similar path.
        """
        for path, lines in sorted(run_filter.settings):
            kind = Sql("json_type(settings, ?) IS NOT NULL", (setting_path(path),))
            if self._query("1", Filter(kind), Sql("LIMIT 1")).fetchone() or not self.count():
                continue
            newest = self._query("settings", ANY_RUN, Sql("ORDER BY created DESC LIMIT 200"))
            paths = {path for (settings,) in newest for path in json.loads(settings)}
            raise RunnerError(f"filter: no run's configuration has {path!r}.{nearest(path, paths)}{lines}")


def look(
    roots: Sequence[Path],
    work: Callable[[CatalogueIndex], Result],
    report: Tell = lambda _: None,
    rebuild: bool = False,
    cached: bool = False,
) -> Result:
    """Return the result of some work on the index of these folders, which is brought up to date before.

    Args:
        work: called once, or once more if the index turns out to be damaged.
        rebuild: read all runs again.
        cached: use the index as it is, without checking the folders.
    """
    paths = (os.path.abspath(root) for root in roots)  # noqa: PTH100 - links stay as they are
    places = list(dict.fromkeys(paths))
    for place in places:
        check_folder_name(place)
    for _ in range(2):
        seen = identity()
        try:
            with contextlib.closing(open_index(report)) as database:
                if not cached or seen is None or seen != identity():
                    update(database, places, rebuild)
                with transaction(database, "DEFERRED"):
                    return work(CatalogueIndex(database, places))
        except (sqlite3.OperationalError, OSError) as error:
            if getattr(error, "sqlite_errorcode", None) == sqlite3.SQLITE_READONLY_DBMOVED:
                continue  # another process replaced it
            report(f"The index {index_path()} cannot be used ({error}); the folders are read without it.")
            break
        except sqlite3.DatabaseError as error:
            report(f"The index {index_path()} is damaged ({error}); it is rebuilt.")
            renew(seen)
            cached = False
    with contextlib.closing(create(":memory:")) as database:
        update(database, places)
        return work(CatalogueIndex(database, places))


def order_of(text: str) -> list[Sql]:
    """Return the order by a list of fields, `-FIELD` for descending, to sort rows by.

    Missing values come last. A value of the configuration is a field too: `config.discount`.
    """
    return [
        Sql(f"{column.text} {'DESC' if descending else 'ASC'} NULLS LAST", column.values)
        for column, descending in _sort_keys(text)
    ]


def _sort_keys(text: str) -> list[tuple[Sql, bool]]:
    """Return the columns of an order, and whether their largest values come first."""
    keys = []
    for name in filter(None, (part.strip() for part in text.split(","))):
        descending, wanted = name.startswith("-"), name.removeprefix("-")
        if wanted.startswith(SETTING):
            column = Sql("json_extract(settings, ?)", (setting_path(wanted.removeprefix(SETTING)),))
        else:
            field = field_of(wanted)
            column = Sql(field.stored[0])
            descending ^= field.kind is ColumnKind.AGE
        keys.append((column, descending))
    return keys


def _as_rows(cursor: sqlite3.Cursor) -> Iterator[IndexRow]:
    names = [column[0] for column in cursor.description]
    for values in cursor:
        row = dict(zip(names, values, strict=True))
        if row.get("seed") is not None:
            row["seed"] += SEED_SHIFT
        yield row


def _ordered(*order: Sql) -> Sql:
    text = ", ".join(part.text for part in order)
    return Sql(f"ORDER BY {text}", tuple(value for part in order for value in part.values))


def _begins(column: str, beginning: str) -> Sql:
    """Return the condition that a text begins so, for which SQLite uses an index."""
    first = text(beginning) or ""
    return Sql(f"({column} >= ? AND {column} < ?)", (first, first + chr(0x10FFFF)))


# --- the folders ------------------------------------------------------------------------------------------

_STABLE_NS: Final = 2 * 10**9
"""Files that changed this recently may change again with the same time: they are read again next time."""
_RUN_FILES: Final = (RUN_FILE, LABELS_FILE, RECORDING_FILE)
_EMPTY: Final[dict[str, object]] = dict.fromkeys(STORED)


def update(database: sqlite3.Connection, roots: Sequence[str], rebuild: bool = False) -> None:
    """Read the runs of these folders that changed since they were written to the index, and write them.

    Args:
        rebuild: read all runs, and delete the rows of folders that no longer exist.
    """
    if rebuild:
        with transaction(database, "IMMEDIATE"):
            for (root,) in database.execute("SELECT DISTINCT root FROM runs").fetchall():
                if not os.path.isdir(root):  # noqa: PTH112
                    database.execute("DELETE FROM runs WHERE root = ?", (root,))
            expired = "UPDATE runs SET fingerprint = '' WHERE root = ?"
            database.executemany(expired, [(root,) for root in roots])
    for root in roots:
        if changed := changed_entries(database, root):
            with transaction(database, "IMMEDIATE"):  # no other process writes what it read before
                for entry in changed:
                    _index(database, root, entry)


def changed_entries(database: sqlite3.Connection, root: str) -> list[str]:
    """Return the names of the runs' folders that are new, changed or gone, or whose process was killed."""
    known = "SELECT entry, fingerprint, stable, status FROM runs WHERE root = ?"
    indexed = {entry: row for entry, *row in database.execute(known, (root,))}
    entries = sorted(entry for entry in run_entries(Path(root)) if entry.isprintable())
    changed = list(indexed.keys() - set(entries))
    for entry in entries:
        state = _state_of(root, entry)
        fingerprint, is_stable, status = indexed.get(entry, (None, True, ""))
        is_same = fingerprint == (state.fingerprint if state else None)
        # The recording of a running one grows in place.
        if not (is_same and is_stable) or (status == "running" and not _is_running(root, entry)):
            changed.append(entry)
    return changed


def _index(database: sqlite3.Connection, root: str, entry: str) -> None:
    """Write the row of a run's folder, or delete it if the folder has no files of a run."""
    state = _state_of(root, entry)  # before the files are read: later changes are found next time
    if state is None:
        database.execute("DELETE FROM runs WHERE root = ? AND entry = ?", (root, entry))
        return
    row = _EMPTY | {
        "root": root,
        "entry": entry,
        "fingerprint": state.fingerprint,
        "stable": state.changed + _STABLE_NS < time.time_ns(),
    }
    if run := run_in(Path(root, entry)):
        row |= row_of(run, state.size)
    else:
        row["problem"] = f"{Path(root, entry)}: neither {RUN_FILE} nor {RECORDING_FILE} can be read as a run."
    write_row(database, row)


class _FileState(NamedTuple):
    """The state of a run's files, without reading them."""

    fingerprint: str
    changed: int
    """When one of them last changed, in nanoseconds since 1970."""
    size: int | None
    """Bytes of its recording."""


def _state_of(root: str, entry: str) -> _FileState | None:
    """Return the state of a run's files; None if there are none."""
    marks = []
    changed = 0
    size = None
    for name in _RUN_FILES:
        try:
            facts = os.stat(f"{root}{os.sep}{entry}{os.sep}{name}")  # noqa: PTH116 - Path takes three times as long
        except OSError:
            marks.append("")
            continue
        marks.append(f"{facts.st_mtime_ns}.{facts.st_size}.{facts.st_ino}")
        changed = max(changed, facts.st_mtime_ns)
        size = facts.st_size if name == RECORDING_FILE else None
    return _FileState(" ".join(marks), changed, size) if marks[0] or marks[2] else None


def _is_running(root: str, entry: str) -> bool:
    run = run_in(Path(root, entry))
    return run is not None and run.status == "running"
