"""The index: one SQLite file in the user's cache, of every recordings folder that was looked at.

Whenever it is asked, each run's files are looked at (size and time), and read where they changed; it
answers in the transaction in which that is seen to. It is made at one stroke and thrown away when it is
damaged or of another version; where it cannot be used, the folders are read without it. It keeps a journal,
not a write-ahead log: users' caches stand on network disks too, and transactions are short.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

from peewee import DatabaseError, OperationalError, SchemaManager, SqliteDatabase, chunked, fn

from runner.cache import cache_folder
from runner.catalogue.fields import SETTING, Kind, field_of
from runner.catalogue.filters import Filter, matches, setting_path
from runner.catalogue.rows import Row, row_of
from runner.errors import RunnerError, nearest
from runner.labels import LABELS_FILE
from runner.runs import RECORDING_FILE, RUN_FILE, run_entries, runs_in

Found = TypeVar("Found")
Tell = Callable[[str], None]

INDEX_FILE: Final = "catalogue.sqlite"
_APPLICATION: Final = 0x44546178  # "DTax"
_VERSION: Final = zlib.crc32(",".join(["4", *Row._meta.sorted_field_names]).encode()) >> 1
"""Of the columns, and of what is put in them (the number before them); another one is thrown away."""
_HEAD_BYTES: Final = 100
"""Of an SQLite file; at 24 stands how often it was changed."""
_BUSY_SECONDS: Final = 60
_FEW: Final = 1000
"""Values that one query may name."""
_SETTLED_NS: Final = 2 * 10**9
"""Files that changed so recently may change again without a trace: they are read again next time."""
_RUN_FILES: Final = (RUN_FILE, LABELS_FILE, RECORDING_FILE)


@dataclass(frozen=True)
class News:
    """What is not yet in the index of a recordings folder."""

    root: str
    changed: list[dict[str, Any]]
    """The rows of the folders that are new, or not as they were."""
    died: list[str]
    """Runs whose process is no more, and could not say so."""
    gone: list[str]
    """Folders that are no more."""


class Index:
    """The index of some recordings folders, up to date when it was opened."""

    def __init__(self, database: SqliteDatabase, roots: Sequence[Path]) -> None:
        self._database = database
        absolute = (os.path.abspath(root) for root in roots)  # noqa: PTH100 - links stay what they are
        self.roots = list(dict.fromkeys(absolute))
        self.read: set[tuple[str, str]] = set()
        """The folders that were read, as root and entry."""
        self._found: dict[str, dict[str, Seen]] = {}
        database.register_function(matches, "matches", 2, deterministic=True)

    def news(self) -> list[News]:
        """Return how the folders, as they were when first asked, differ from what is in the index now.

        Raises:
            StorageError: a recordings folder cannot be read.
        """
        if not self._found:
            self._found = {root: dict(_scan(root)) for root in self.roots}
        found = [self._news(root) for root in self._found]
        return [news for news in found if news.changed or news.died or news.gone]

    def write(self, found: Sequence[News]) -> None:
        """Take in what was found; within a transaction."""
        for news in found:
            for rows in chunked(news.changed, 500):
                Row.insert_many(rows).on_conflict_replace().execute(self._database)
            here = Row.root == news.root
            for entries in chunked(news.died, 500):
                died = Row.update(status="interrupted").where(here & Row.entry.in_(entries))
                died.execute(self._database)
            for entries in chunked(news.gone, 500):
                Row.delete().where(here & Row.entry.in_(entries)).execute(self._database)
            self.read |= {(news.root, row["entry"]) for row in news.changed}

    def problems(self) -> list[str]:
        """Return what is wrong with the folders that have files of a run of which nothing can be made."""
        wrong = Row.select(Row.problem).where(Row.root.in_(self.roots) & Row.problem.is_null(False))
        return [problem for (problem,) in self._tuples(wrong.order_by(Row.root, Row.entry))]

    def forget(self) -> None:
        """Forget all about these folders, and about those that are no more."""
        known = [root for (root,) in self._tuples(Row.select(Row.root).distinct())]
        stale = [root for root in known if root in self.roots or not os.path.isdir(root)]  # noqa: PTH112
        self._delete(Row.root.in_(stale))

    def select(
        self, chosen: Filter, *order: Any, limit: int | None = None, offset: int = 0
    ) -> list[dict[str, Any]]:
        """Return the rows that pass a filter, by column; the newest first unless another order is given."""
        self._check_settings(chosen)
        query = self._of(chosen).order_by(*order, Row.created.desc(), Row.id, Row.root)
        if limit is not None or offset:
            query = query.limit(-1 if limit is None else limit).offset(offset)
        return list(query.dicts().bind(self._database))

    def count(self, chosen: Filter) -> int:
        """Return how many rows pass a filter."""
        self._check_settings(chosen)
        (counted,) = self._tuples(self._of(chosen, fn.COUNT(Row.entry)))
        return int(counted[0])

    def page(
        self, chosen: Filter, *order: Any, limit: int, offset: int = 0
    ) -> tuple[list[dict[str, Any]], int]:
        """Return some of the rows that pass a filter, as `select` does, and how many do, in one pass."""
        self._check_settings(chosen)
        known = self._of(chosen, Row.root, Row.entry).order_by(*order, Row.created.desc(), Row.id, Row.root)
        places = list(self._tuples(known))
        shown = places[offset : offset + limit]
        rows: dict[tuple[str, str], dict[str, Any]] = {}
        for root in {root for root, _ in shown}:
            entries = [entry for there, entry in shown if there == root]
            for some in chunked(entries, 500):
                found: Any = Row.select().where((Row.root == root) & Row.entry.in_(some)).dicts()
                rows |= {(root, row["entry"]): row for row in found.bind(self._database)}
        return [rows[place] for place in shown], len(places)

    def names(self) -> list[tuple[Any, ...]]:
        """Return root, entry, id, name, seed and creation (ms) of every run, the newest first."""
        columns = (Row.root, Row.entry, Row.id, Row.name, Row.seed, Row.created)
        query = self._of(Filter(None), *columns).order_by(Row.created.desc(), Row.id.desc())
        return list(query.tuples().bind(self._database))

    def originals(self, digests: Sequence[str] | None = None) -> dict[str, tuple[str, str, str]]:
        """Return root, entry and id of the run that was first, for each content recorded twice or more.

        Args:
            digests: of these contents; of all unless given, or if they are very many.
        """
        recorded = Row.select(Row.digest).where(Row.digest.is_null(False) & Row.root.in_(self.roots))
        if digests is not None and len(digests) <= _FEW:
            recorded = recorded.where(Row.digest.in_(digests))
        several = recorded.group_by(Row.digest).having(fn.COUNT(Row.entry) > 1)
        if not list(self._tuples(several.limit(1))):
            return {}
        first = self._of(Filter(Row.digest.in_(several)), Row.digest, Row.root, Row.entry, Row.id)
        found = self._tuples(first.order_by(Row.created.desc(), Row.id.desc(), Row.root.desc()))
        return {digest: (root, entry, run_id) for digest, root, entry, run_id in found}

    def _of(self, chosen: Filter, *columns: Any) -> Any:
        known = Row.root.in_(self.roots) & Row.id.is_null(False)
        return Row.select(*columns).where(known if chosen.condition is None else known & chosen.condition)

    def _tuples(self, query: Any) -> Iterator[tuple[Any, ...]]:
        """Return what a query finds as SQLite has it: many rows, quickly."""
        found: Iterator[tuple[Any, ...]] = self._database.execute(query)  # type: ignore[no-untyped-call]
        return found

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

    def _news(self, root: str) -> News:
        found, known = self._found[root], self._known(root)
        now = time.time_ns()
        changed = [
            entry for entry, seen in found.items() if self._changed(root, entry, seen, known.get(entry))
        ]
        running = [entry for entry, (*_, status) in known.items() if status == "running" and entry in found]
        return News(
            root,
            changed=[_read(root, entry, found[entry], now) for entry in changed],
            died=[entry for entry in set(running) - set(changed) if not _runs(root, entry)],
            gone=[entry for entry in known if entry not in found and _seen(root, entry) is None],
        )

    def _changed(self, root: str, entry: str, seen: Seen, known: tuple[str, int, str | None] | None) -> bool:
        if known is None or known[0] != seen.fingerprint:
            return True
        return not known[1] and (root, entry) not in self.read

    def _known(self, root: str) -> dict[str, tuple[str, int, str | None]]:
        rows = Row.select(Row.entry, Row.fingerprint, Row.settled, Row.status).where(Row.root == root)
        return {entry: (mark, settled, status) for entry, mark, settled, status in self._tuples(rows)}

    def _delete(self, condition: Any) -> None:
        Row.delete().where(condition).execute(self._database)


class Seen(NamedTuple):
    """A run's folder as it looks from outside."""

    fingerprint: str
    changed: int
    """When one of its files last did, in nanoseconds since 1970."""
    size: int | None
    """Bytes of its recording."""


class Version(NamedTuple):
    """What tells one state of the index from another."""

    file: int
    changes: int


def version() -> Version | None:
    """Return what changes with every change of the index; None if there is none that can be read."""
    try:
        with index_path().open("rb", buffering=0) as stream:
            head = stream.read(_HEAD_BYTES)
            return Version(os.fstat(stream.fileno()).st_ino, int.from_bytes(head[24:28], "big"))
    except OSError:
        return None


def look(
    roots: Sequence[Path],
    work: Callable[[Index], Found],
    tell: Tell = lambda _: None,
    anew: bool = False,
    as_known: bool = False,
) -> Found:
    """Return what some work finds in the index of these folders, brought up to date before.

    Args:
        roots: recordings folders; one that is missing has no runs.
        work: done once, or once more if the index turns out to be damaged.
        tell: told what a user is to know of the index itself.
        anew: whether to forget first what is known of these folders.
        as_known: whether to answer from what is known of them, without looking at them again.

    Raises:
        StorageError: a recordings folder cannot be read.
    """
    for _ in range(2):
        before = version()
        try:
            with contextlib.closing(_opened(tell)) as database:
                if as_known and before is not None and before.file == (version() or before).file:
                    with database.atomic("DEFERRED"):
                        return work(Index(database, roots))
                return _look(database, roots, work, anew)
        except (OperationalError, OSError) as error:
            tell(f"The index {index_path()} cannot be used ({error}); the folders are read without it.")
            break
        except DatabaseError as error:
            tell(f"The index {index_path()} is damaged ({error}); it is made anew.")
            _replace()
            as_known = False
    with contextlib.closing(_made(":memory:")) as database:
        return _look(database, roots, work, anew)


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


def index_path() -> Path:
    """Return the path of the index."""
    return cache_folder() / INDEX_FILE


def _look(
    database: SqliteDatabase, roots: Sequence[Path], work: Callable[[Index], Found], anew: bool
) -> Found:
    """Return what the work finds in the transaction in which the index was seen to agree with the folders."""
    index = Index(database, roots)
    if anew:
        index.forget()
    news = index.news()
    if not news:
        with database.atomic("DEFERRED"):
            if not index.news():
                return work(index)
    with database.atomic("IMMEDIATE"):
        index.write(news)
        index.write(index.news())  # mostly nothing: what other processes did meanwhile
        return work(index)


def _scan(root: str) -> Iterator[tuple[str, Seen]]:
    """Yield the folders that have a run's files, by name."""
    for entry in run_entries(Path(root)):
        seen = _seen(root, entry)
        if seen is not None and entry.isprintable():
            yield entry, seen


def _seen(root: str, entry: str) -> Seen | None:
    """Return how a folder looks from outside; None if it has no run's files."""
    marks, changed, size = [], 0, None
    for name in _RUN_FILES:
        try:
            facts = os.stat(f"{root}{os.sep}{entry}{os.sep}{name}")  # noqa: PTH116 - Path takes thrice as long
        except OSError:
            marks.append("")
            continue
        marks.append(f"{facts.st_mtime_ns}.{facts.st_size}.{facts.st_ino}")
        changed = max(changed, facts.st_mtime_ns)
        size = facts.st_size if name == RECORDING_FILE else None
    return Seen(" ".join(marks), changed, size) if marks[0] or marks[2] else None


def _runs(root: str, entry: str) -> bool:
    return any(run.status == "running" for run in runs_in(Path(root, entry)))


def _read(root: str, entry: str, seen: Seen, now: int) -> dict[str, Any]:
    """Return the row of a folder, read now."""
    folder = Path(root, entry)
    settled = seen.changed + _SETTLED_NS < now
    place = {"root": root, "entry": entry, "fingerprint": seen.fingerprint, "settled": settled}
    for run in runs_in(folder):
        return _EMPTY | place | row_of(run, seen.size)
    problem = f"{folder}: neither {RUN_FILE} nor {RECORDING_FILE} can be read as a run's."
    return _EMPTY | place | {"problem": problem}


_EMPTY: Final[dict[str, Any]] = dict.fromkeys(Row._meta.sorted_field_names)


def _opened(tell: Tell) -> SqliteDatabase:
    """Return the index, opened; made first if it is missing, foreign or of another version."""
    path = index_path()
    if not path.exists():
        _replace()
    for _ in range(2):
        database = _connected(os.fspath(path))
        if (database.application_id, database.user_version) == (_APPLICATION, _VERSION):
            return database
        database.close()
        tell(f"The index {path} is of another version; it is made anew.")
        _replace()
    raise OSError("it changes under our hands")


def _replace() -> None:
    """Put an empty index in place of what is there, unless another process just did."""
    from filelock import FileLock

    path = index_path()
    path.parent.mkdir(parents=True, exist_ok=True)
    before = _identity(path)
    with FileLock(path.with_suffix(".lock"), timeout=_BUSY_SECONDS):
        if _identity(path) != before:
            return
        fresh = path.with_suffix(f".{secrets.token_hex(4)}.tmp")
        _made(os.fspath(fresh)).close()
        path.with_name(f"{path.name}-journal").unlink(missing_ok=True)
        fresh.replace(path)


def _identity(path: Path) -> tuple[int, int] | None:
    with contextlib.suppress(OSError):
        facts = path.stat()
        return facts.st_ino, facts.st_ctime_ns
    return None


def _connected(path: str) -> SqliteDatabase:
    """Return the database of a path, its writers taking turns."""
    pragmas = {"busy_timeout": _BUSY_SECONDS * 1000, "synchronous": "normal"}
    database = SqliteDatabase(path, pragmas=pragmas, lock_type="IMMEDIATE", timeout=_BUSY_SECONDS)
    database.connect()
    return database


def _made(path: str) -> SqliteDatabase:
    """Return a new, empty index."""
    database = _connected(path)
    SchemaManager(Row, database).create_all()
    database.application_id, database.user_version = _APPLICATION, _VERSION
    return database
