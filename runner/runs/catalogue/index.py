"""The index of recordings folders, brought up to date before each query.

A query runs in the transaction in which the index was seen to agree with the folders. Where the index file
cannot be used, the folders are read without it.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final, TypeVar

from peewee import DatabaseError, OperationalError, SqliteDatabase, chunked, fn

from runner.errors import RunnerError, nearest
from runner.runs.branches import BranchNode, Origin, parse_origin
from runner.runs.catalogue.columns import SETTING, IndexRow, Kind, field_of, with_same_as
from runner.runs.catalogue.database import Report, create, index_path, open_index, renew, tuples_of, version
from runner.runs.catalogue.filters import ANY_RUN, Filter, matches, setting_path
from runner.runs.catalogue.folders import Folders
from runner.runs.catalogue.rows import Candidate, Expression, Row, SqlRow, text
from runner.runs.run import check_folder_name

Result = TypeVar("Result")

MAX_TREE: Final = 300
"""Runs in a tree of branches."""
_MAX_VALUES: Final = 1000
"""Values in one query."""


class Index:
    """The index of some recordings folders, up to date when it was opened."""

    def __init__(self, database: SqliteDatabase, roots: Sequence[str]) -> None:
        self._database = database
        self.roots = roots
        database.register_function(matches, "matches", 2, deterministic=True)

    def problems(self) -> list[str]:
        """Return the problems of folders whose run files cannot be read."""
        damaged = Row.select(Row.problem).where(Row.root.in_(self.roots) & Row.problem.is_null(False))
        return [problem for (problem,) in self._tuples(damaged.order_by(Row.root, Row.entry))]

    def select(
        self, chosen: Filter, *order: Expression, columns: Sequence[str] | None = None
    ) -> list[IndexRow]:
        """Return the rows that match a filter; arguments as for `rows`."""
        return list(self.rows(chosen, *order, columns=columns))

    def rows(
        self, chosen: Filter, *order: Expression, columns: Sequence[str] | None = None
    ) -> Iterator[IndexRow]:
        """Yield the rows that match a filter, the newest first.

        Args:
            order: expressions to sort by before the age.
            columns: the stored columns that are needed; all by default.
        """
        self._check_settings(chosen)
        query = self._of(chosen, *_stored(columns)).order_by(*order, Row.created.desc(), Row.id, Row.root)
        return iter(query.dicts().bind(self._database).iterator())

    def count(self, chosen: Filter = ANY_RUN) -> int:
        """Return how many rows match a filter."""
        self._check_settings(chosen)
        ((count,),) = self._tuples(self._of(chosen, fn.COUNT(Row.entry)))
        return int(count)

    def page(
        self,
        chosen: Filter,
        *order: Expression,
        limit: int | None,
        offset: int = 0,
        columns: Sequence[str] | None = None,
    ) -> tuple[list[IndexRow], int]:
        """Return some of the rows that match a filter, and how many match.

        Args:
            limit: the maximum number of rows; None for all.
        """
        if limit is None:
            every = self.select(chosen, *order, columns=columns)
            return every[offset:], len(every)
        self._check_settings(chosen)
        query = self._of(chosen, Row.root, Row.entry)
        query = query.order_by(*order, Row.created.desc(), Row.id, Row.root)
        if chosen.condition is None:  # counted in an index of SQLite, without reading the rows
            places, total = list(self._tuples(query.limit(limit).offset(offset))), self.count(chosen)
        else:  # a filter may be slow: it is evaluated once for each row
            places = list(self._tuples(query))
            places, total = places[offset : offset + limit], len(places)
        return self._at(places, columns), total

    def _at(self, places: Sequence[SqlRow], columns: Sequence[str] | None) -> list[IndexRow]:
        """Return the rows of folders, given by root and entry, in their order."""
        by_place: dict[tuple[str, str], IndexRow] = {}
        for root in {root for root, _ in places}:
            for entries in chunked([entry for there, entry in places if there == root], _MAX_VALUES):
                some: Expression = Row.select(*_stored(columns)).where(
                    (Row.root == root) & Row.entry.in_(entries)
                )
                by_place |= {(root, row["entry"]): row for row in some.dicts().bind(self._database)}
        return [by_place[place] for place in places]

    def originals(self, digests: Sequence[str] | None = None) -> dict[str, tuple[str, str, str]]:
        """Return root, entry and id of the first run with each content that was recorded twice or more.

        Args:
            digests: the contents; all by default, or if they are very many.
        """
        recorded = Row.select(Row.digest).where(Row.digest.is_null(False) & Row.root.in_(self.roots))
        if digests is not None and len(digests) <= _MAX_VALUES:
            recorded = recorded.where(Row.digest.in_(digests))
        several = recorded.group_by(Row.digest).having(fn.COUNT(Row.entry) > 1)
        if not list(self._tuples(several.limit(1))):
            return {}
        first = self._of(Filter(Row.digest.in_(several)), Row.digest, Row.root, Row.entry, Row.id)
        ordered = first.order_by(Row.created.desc(), Row.id.desc(), Row.root.desc(), Row.entry.desc())
        return {digest: (root, entry, run_id) for digest, root, entry, run_id in self._tuples(ordered)}

    def with_same_as(self, rows: list[IndexRow]) -> list[IndexRow]:
        """Return rows with `same_as`: the id of another run that recorded the same content first, or None."""
        return list(with_same_as(rows, self.originals([row["digest"] for row in rows if row["digest"]])))

    def branches(self, run_id: str) -> dict[str, Origin]:
        """Return the branches of a run by run id, the newest first."""
        rows = self.rows(Filter(Row.parent == run_id), columns=("id", "origin"))
        return {row["id"]: origin for row in rows if (origin := parse_origin(json.loads(row["origin"])))}

    def branch_tree(self, run_id: str) -> BranchNode:
        """Return the tree of branches that a run belongs to, from the first run that it descends from.

        At most `MAX_TREE` runs; where there are more, the newest are left out.
        """
        columns = ("id", "name", "status", "success_percent", "mean_return", "parent", "origin")
        above, top = {run_id}, run_id
        while (rows := self.select(Filter(Row.id == top), columns=("parent",))) and rows[0]["parent"]:
            top = rows[0]["parent"]
            if top in above or len(above) == MAX_TREE:
                break  # a configuration that names itself
            above.add(top)
        by_id = {row["id"]: row for row in self.rows(Filter(Row.id == top), columns=columns)}
        below: dict[str, list[str]] = {}
        level = [top]
        while level and len(by_id) < MAX_TREE:
            rows = self.select(Filter(Row.parent.in_(level[:_MAX_VALUES])), Row.created, columns=columns)
            new = {row["id"]: row for row in rows[: MAX_TREE - len(by_id)] if row["id"] not in by_id}
            for row in new.values():
                below.setdefault(row["parent"], []).append(row["id"])
            by_id |= new
            level = list(new)

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
        return self._names(_begins(Row.id, name) | (Row.name == text(name)))

    def with_id_prefix(self, beginning: str) -> list[Candidate]:
        """Return runs whose ids begin with a text, at most the 1,000 newest."""
        return self._names(_begins(Row.id, beginning), _MAX_VALUES)

    def names_from(self, beginning: str) -> list[tuple[str, int]]:
        """Return names that begin with a text, at most 1,000, and how many runs have each."""
        query = self._of(Filter(_begins(Row.name, beginning)), Row.name, fn.COUNT(Row.entry))
        return [(name, count) for name, count in self._tuples(query.group_by(Row.name).limit(_MAX_VALUES))]

    def newest(self, name: str = "", limit: int = 1) -> list[Candidate]:
        """Return the newest runs, of a name if one is given."""
        return self._names(Row.name == text(name) if name else None, limit)

    def _names(self, condition: Expression, limit: int | None = None) -> list[Candidate]:
        columns = (Row.root, Row.entry, Row.id, Row.name, Row.seed, Row.created)
        query = self._of(Filter(condition), *columns).order_by(Row.created.desc(), Row.id.desc())
        return [Candidate(*row) for row in query.limit(limit).tuples().bind(self._database)]

    def _of(self, chosen: Filter, *columns: Expression) -> Expression:
        is_run = Row.root.in_(self.roots) & Row.id.is_null(False)
        return Row.select(*columns).where(is_run if chosen.condition is None else is_run & chosen.condition)

    def _tuples(self, query: Expression) -> Iterator[SqlRow]:
        return tuples_of(self._database, query)

    def _check_settings(self, chosen: Filter) -> None:
        """Refuse a filter with a path that no configuration has.

        Raises:
            RunnerError: it has one; the message suggests a similar path.
        """
        for path in sorted(chosen.settings):
            kind = fn.json_type(Row.settings, setting_path(path))
            some = self._of(ANY_RUN, Row.entry).limit(1)
            if list(self._tuples(some.where(kind.is_null(False)))) or not list(self._tuples(some)):
                continue
            newest = self._of(ANY_RUN, Row.settings).order_by(Row.created.desc()).limit(200)
            paths = {path for (settings,) in self._tuples(newest) for path in json.loads(settings)}
            raise RunnerError(f"filter: no run's configuration has {path!r}.{nearest(path, paths)}")


def look(
    roots: Sequence[Path],
    work: Callable[[Index], Result],
    report: Report = lambda _: None,
    rebuild: bool = False,
    cached: bool = False,
    quick: bool = False,
) -> Result:
    """Return the result of some work on the index of these folders, which is brought up to date before.

    Args:
        work: called once, or once more if the index turns out to be damaged.
        rebuild: read all runs again.
        cached: use the index as it is, without checking the folders.
        quick: miss files that were changed in place, as `runner.runs.catalogue.folders` explains.
    """
    paths = (os.path.abspath(root) for root in roots)  # noqa: PTH100 - links stay as they are
    places = list(dict.fromkeys(paths))
    for place in places:
        check_folder_name(place)
    for _ in range(2):
        before = version()
        try:
            with contextlib.closing(open_index(report)) as database:
                if cached and before is not None and before.file == (version() or before).file:
                    with database.atomic("DEFERRED"):
                        return work(Index(database, places))
                return _look(database, places, work, quick, rebuild)
        except (OperationalError, OSError) as error:
            report(f"The index {index_path()} cannot be used ({error}); the folders are read without it.")
            break
        except DatabaseError as error:
            report(f"The index {index_path()} is damaged ({error}); it is rebuilt.")
            renew()
            cached = False
    with contextlib.closing(create(":memory:")) as database:
        return _look(database, places, work, quick, rebuild)


def order_of(text: str) -> list[Expression]:
    """Return the order by a list of fields, `-FIELD` for descending, to sort rows by.

    Missing values come last. A value of the configuration is a field too: `config.discount`.
    """
    order = []
    for name in filter(None, (part.strip() for part in text.split(","))):
        descending, wanted = name.startswith("-"), name.removeprefix("-")
        if wanted.startswith(SETTING):
            column = fn.json_extract(Row.settings, setting_path(wanted.removeprefix(SETTING)))
        else:
            field = field_of(wanted)
            column = getattr(Row, field.stored[0])
            descending ^= field.kind is Kind.AGE
        order.append(column.desc(nulls="LAST") if descending else column.asc(nulls="LAST"))
    return order


def _look(
    database: SqliteDatabase,
    roots: Sequence[str],
    work: Callable[[Index], Result],
    quick: bool,
    rebuild: bool,
) -> Result:
    folders, index = Folders(database, roots, quick), Index(database, roots)
    if rebuild:
        folders.expire()
    before = _data_version(database)
    differences = folders.differences()
    if not differences:
        with database.atomic("DEFERRED"):
            if _data_version(database) == before or not folders.differences():
                return work(index)
    folders.apply(differences)
    with database.atomic("IMMEDIATE"):
        folders.apply(folders.differences())  # mostly none: what other processes did in the meantime
        return work(index)


def _stored(columns: Sequence[str] | None) -> list[Expression]:
    return [getattr(Row, name) for name in columns or ()]


def _begins(column: Expression, beginning: str) -> Expression:
    """Return the condition that a text begins so, for which SQLite uses an index."""
    first = text(beginning) or ""
    return (column >= first) & (column < first + chr(0x10FFFF))


def _data_version(database: SqliteDatabase) -> int:
    """Return a number that changes when another connection writes to the index; begins to read it."""
    return int(database.pragma("data_version"))
