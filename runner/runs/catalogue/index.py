"""The index of every recordings folder that was looked at, and what can be asked of it.

Whenever it is asked, what changed in the folders is taken in first; it answers in the transaction in which
they were seen to agree. Where its file cannot be used, the folders are read without it.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

from peewee import DatabaseError, OperationalError, SqliteDatabase, Tuple, Value, chunked, fn

from runner.errors import RunnerError, nearest
from runner.runs.catalogue.database import Tell, index_path, made, opened, renew, tuples_of, version
from runner.runs.catalogue.fields import SETTING, Kind, field_of
from runner.runs.catalogue.filters import Filter, matches, setting_path
from runner.runs.catalogue.folders import Depth, Folders
from runner.runs.catalogue.rows import Row, text
from runner.runs.run import check_folder_name

Found = TypeVar("Found")

ANY_RUN: Final = Filter(None)
_FEW: Final = 1000
"""Values that one query may name."""


class Index:
    """The index of some recordings folders, up to date when it was opened."""

    def __init__(self, database: SqliteDatabase, roots: Sequence[str]) -> None:
        self._database = database
        self._roots = roots
        database.register_function(matches, "matches", 2, deterministic=True)

    def problems(self) -> list[str]:
        """Return what is wrong with the folders that have files of a run of which nothing can be made."""
        wrong = Row.select(Row.problem).where(Row.root.in_(self._roots) & Row.problem.is_null(False))
        return [problem for (problem,) in self._tuples(wrong.order_by(Row.root, Row.entry))]

    def select(
        self, chosen: Filter, *order: Any, columns: Sequence[str] | None = None
    ) -> list[dict[str, Any]]:
        """Return the rows that pass a filter, by column; the newest first unless another order is given."""
        return list(self.rows(chosen, *order, columns=columns))

    def rows(
        self, chosen: Filter, *order: Any, columns: Sequence[str] | None = None
    ) -> Iterator[dict[str, Any]]:
        """Yield the rows that `select` returns, one at a time.

        Args:
            chosen: the filter.
            order: what the rows are sorted by before their age.
            columns: the columns of the index that are needed; all unless given.
        """
        self._check_settings(chosen)
        needed = [getattr(Row, name) for name in columns or ()]
        query = self._of(chosen, *needed).order_by(*order, Row.created.desc(), Row.id, Row.root)
        found: Any = query.dicts().bind(self._database)
        return iter(found.iterator())

    def count(self, chosen: Filter = ANY_RUN) -> int:
        """Return how many rows pass a filter."""
        self._check_settings(chosen)
        (counted,) = self._tuples(self._of(chosen, fn.COUNT(Row.entry)))
        return int(counted[0])

    def page(
        self,
        chosen: Filter,
        *order: Any,
        limit: int | None,
        offset: int = 0,
        columns: Sequence[str] | None = None,
    ) -> tuple[list[dict[str, Any]], int]:
        """Return some of the rows that pass a filter, as `select` does, and how many do.

        Args:
            chosen: the filter.
            order: as for `select`.
            limit: how many rows at most; all if None.
            offset: how many to pass over.
            columns: as for `rows`.
        """
        if limit is None:
            every = self.select(chosen, *order, columns=columns)
            return every[offset:], len(every)
        self._check_settings(chosen)
        known = self._of(chosen, Row.root, Row.entry).order_by(*order, Row.created.desc(), Row.id, Row.root)
        if chosen.condition is None:  # counted in an index, without a look at the rows
            shown, total = list(self._tuples(known.limit(limit).offset(offset))), self.count(chosen)
        else:  # a filter may be slow: it is asked once of each row
            places = list(self._tuples(known))
            shown, total = places[offset : offset + limit], len(places)
        rows: dict[tuple[str, str], dict[str, Any]] = {}
        for root in {root for root, _ in shown}:
            entries = [entry for there, entry in shown if there == root]
            for some in chunked(entries, 500):
                found: Any = Row.select().where((Row.root == root) & Row.entry.in_(some)).dicts()
                rows |= {(root, row["entry"]): row for row in found.bind(self._database)}
        return [rows[place] for place in shown], total

    def largest(
        self, chosen: Filter, size: Any, limit: int | None, columns: Sequence[str]
    ) -> list[dict[str, Any]]:
        """Return the rows of the largest runs that pass a filter, the largest first.

        Args:
            chosen: the filter.
            size: the expression that they are sorted by.
            limit: how many rows at most; all if None.
            columns: as for `rows`.
        """
        self._check_settings(chosen)
        needed = [getattr(Row, name) for name in columns]
        if limit is None:
            every: Any = self._of(chosen, *needed).order_by(size.desc(), Row.id).dicts()
            return list(every.bind(self._database))
        # Sorting only the places needs no look at whole rows, which are ten times as large.
        places = self._of(chosen, Row.root, Row.entry).order_by(size.desc(), Row.id).limit(limit)
        rows: list[dict[str, Any]] = []
        for root, entry in list(self._tuples(places)):
            found: Any = Row.select(*needed).where((Row.root == root) & (Row.entry == entry)).dicts()
            rows.extend(found.bind(self._database))
        return rows

    def sums(self, chosen: Filter, columns: Sequence[Any]) -> list[int]:
        """Return aggregates over the rows that pass a filter; 0 where there is nothing to add up."""
        self._check_settings(chosen)
        (found,) = self._tuples(self._of(chosen, *columns))
        return [number or 0 for number in found]

    def is_copy(self) -> Any:
        """Return the condition that another run, the one in `originals`, recorded a row's content first."""
        recorded = Row.select(Row.digest).where(Row.digest.is_null(False) & Row.root.in_(self._roots))
        several = recorded.group_by(Row.digest).having(fn.COUNT(Row.entry) > 1)  # mostly few, found quickly
        first = Row.alias()
        age, of_first = ((each.created, each.id, each.root, each.entry) for each in (Row, first))
        earlier = first.select(Value(1)).where(
            (first.digest == Row.digest)
            & first.root.in_(self._roots)
            & first.id.is_null(False)
            & (Tuple(*of_first) < Tuple(*age))
        )
        return Row.digest.in_(several) & fn.EXISTS(earlier)

    def named(self, name: str) -> list[tuple[Any, ...]]:
        """Return the runs that an id, the beginning of one or a name may stand for, the newest first.

        Each is root, entry, id, name, seed and creation (ms).
        """
        return self._names(_begins(Row.id, name) | (Row.name == text(name)))

    def with_id_prefix(self, beginning: str) -> list[tuple[Any, ...]]:
        """Return runs whose ids begin so, at most the 1,000 newest, as `named` does."""
        return self._names(_begins(Row.id, beginning), _FEW)

    def names_from(self, beginning: str) -> list[tuple[str, int]]:
        """Return names that begin so, at most 1,000, and how many runs have each."""
        chosen = self._of(Filter(_begins(Row.name, beginning)), Row.name, fn.COUNT(Row.entry))
        return [(name, count) for name, count in self._tuples(chosen.group_by(Row.name).limit(_FEW))]

    def newest(self, name: str = "", limit: int = 1) -> list[tuple[Any, ...]]:
        """Return the newest runs, of a name if one is given, as `named` does."""
        return self._names(Row.name == text(name) if name else None, limit)

    def _names(self, condition: Any, limit: int | None = None) -> list[tuple[Any, ...]]:
        columns = (Row.root, Row.entry, Row.id, Row.name, Row.seed, Row.created)
        query = self._of(Filter(condition), *columns).order_by(Row.created.desc(), Row.id.desc())
        return list(query.limit(limit).tuples().bind(self._database))

    def originals(self, digests: Sequence[str] | None = None) -> dict[str, tuple[str, str, str]]:
        """Return root, entry and id of the run that was first, for each content recorded twice or more.

        Args:
            digests: of these contents; of all unless given, or if they are very many.
        """
        recorded = Row.select(Row.digest).where(Row.digest.is_null(False) & Row.root.in_(self._roots))
        if digests is not None and len(digests) <= _FEW:
            recorded = recorded.where(Row.digest.in_(digests))
        several = recorded.group_by(Row.digest).having(fn.COUNT(Row.entry) > 1)
        if not list(self._tuples(several.limit(1))):
            return {}
        first = self._of(Filter(Row.digest.in_(several)), Row.digest, Row.root, Row.entry, Row.id)
        found = self._tuples(
            first.order_by(Row.created.desc(), Row.id.desc(), Row.root.desc(), Row.entry.desc())
        )
        return {digest: (root, entry, run_id) for digest, root, entry, run_id in found}

    def _of(self, chosen: Filter, *columns: Any) -> Any:
        known = Row.root.in_(self._roots) & Row.id.is_null(False)
        return Row.select(*columns).where(known if chosen.condition is None else known & chosen.condition)

    def _tuples(self, query: Any) -> Iterator[tuple[Any, ...]]:
        return tuples_of(self._database, query)

    def _check_settings(self, chosen: Filter) -> None:
        """Refuse a filter that asks for a value which no configuration has.

        Raises:
            RunnerError: it does; the nearest is told.
        """
        for path in sorted(chosen.settings):
            kind = fn.json_type(Row.settings, setting_path(path))
            some = self._of(Filter(None), Row.entry).limit(1)
            having = some.where(kind.is_null(False))
            if not list(self._tuples(having)) and list(self._tuples(some)):
                raise RunnerError(
                    f"filter: no run's configuration has {path!r}.{nearest(path, self._settings())}"
                )

    def _settings(self) -> set[str]:
        import json

        newest = self._of(Filter(None), Row.settings).order_by(Row.created.desc()).limit(200)
        return {path for (settings,) in self._tuples(newest) for path in json.loads(settings)}


def look(
    roots: Sequence[Path],
    work: Callable[[Index], Found],
    tell: Tell = lambda _: None,
    anew: bool = False,
    as_known: bool = False,
    depth: Depth = Depth.FILES,
) -> Found:
    """Return what some work finds in the index of these folders, brought up to date before.

    Args:
        roots: recordings folders; one that is missing has no runs.
        work: done once, or once more if the index turns out to be damaged.
        tell: told what a user is to know of the index itself.
        anew: whether to read every run again, changed or not.
        as_known: whether to answer from what is known of them, without looking at them again.
        depth: which changes of them are looked for.

    Raises:
        StorageError: a recordings folder cannot be read.
    """
    paths = (os.path.abspath(root) for root in roots)  # noqa: PTH100 - links stay what they are
    places = list(dict.fromkeys(paths))
    for place in places:
        check_folder_name(place)
    for _ in range(2):
        before = version()
        try:
            with contextlib.closing(opened(tell)) as database:
                if as_known and before is not None and before.file == (version() or before).file:
                    with database.atomic("DEFERRED"):
                        return work(Index(database, places))
                return _look(database, places, work, depth, anew)
        except (OperationalError, OSError) as error:
            tell(f"The index {index_path()} cannot be used ({error}); the folders are read without it.")
            break
        except DatabaseError as error:
            tell(f"The index {index_path()} is damaged ({error}); it is made anew.")
            renew()
            as_known = False
    with contextlib.closing(made(":memory:")) as database:
        return _look(database, places, work, depth, anew)


def order_of(text: str) -> list[Any]:
    """Return the order that a list of fields asks for, `-FIELD` with the largest first.

    What is not known comes last. A value of the configuration is a field too: `config.discount`.

    Raises:
        RunnerError: there is no such field.
    """
    order = []
    for name in filter(None, (part.strip() for part in text.split(","))):
        falling, wanted = name.startswith("-"), name.removeprefix("-")
        if wanted.startswith(SETTING):
            column = fn.json_extract(Row.settings, setting_path(wanted.removeprefix(SETTING)))
        else:
            found = field_of(wanted)
            column = getattr(Row, found.column or found.name)
            falling ^= found.kind is Kind.AGE
        order.append(column.desc(nulls="LAST") if falling else column.asc(nulls="LAST"))
    return order


def _look(
    database: SqliteDatabase,
    roots: Sequence[str],
    work: Callable[[Index], Found],
    depth: Depth,
    anew: bool = False,
) -> Found:
    """Return what the work finds in the transaction in which the index was seen to agree with the folders."""
    folders, index = Folders(database, roots, depth, anew), Index(database, roots)
    if anew:
        folders.forget_missing()
    before = _data_version(database)
    found = folders.differences()
    if not found:
        with database.atomic("DEFERRED"):
            if _data_version(database) == before or not folders.differences():
                return work(index)
    folders.take_in(found)
    with database.atomic("IMMEDIATE"):
        folders.take_in(folders.differences())  # mostly nothing: what other processes did meanwhile
        return work(index)


def _begins(column: Any, beginning: str) -> Any:
    """Return the condition that a text begins so, which SQLite answers from an index."""
    first = text(beginning) or ""
    return (column >= first) & (column < first + chr(0x10FFFF))


def _data_version(database: SqliteDatabase) -> int:
    """Return what changes when another connection writes to the index; begins to read it."""
    return int(database.pragma("data_version"))
