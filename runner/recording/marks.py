"""The marks that users set at steps of a run: a text and tags at `812:57`.

    recordings/k3v9m2xq/marks.json      {"marks": [{"at": "812:57", "episode": 812, "text": "both stuck",
                                         "tags": ["stuck"], "created": "2026-11-27T08:00:00.123Z"}],
                                         "removed": ["3f2a9c01b7de"]}

A mark is identified by a hash of its content. Marks of two people are merged: the union of both, without
what either of them removed. The file is replaced atomically, under a lock.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Annotated, Final

from blake3 import blake3
from msgspec import Meta

from runner.errors import RecordingError, RunnerError
from runner.recording.labels import MAX_TAGS, TAG_PATTERN, file_lock
from runner.util.files import read_object, write_object
from runner.util.stored import Count, stored_as
from runner.util.values import Json

MARKS_FILE: Final = "marks.json"
MARKS_LOCK: Final = "marks.lock"
MAX_MARKS: Final = 1000
"""The most marks of a run."""
MAX_MARK_TEXT: Final = 1000
_ID_LENGTH: Final = 12
_MAX_REMOVED: Final = 10_000
_MAX_BYTES: Final = 8 << 20


@dataclass(frozen=True)
class Mark:
    """A mark at a step of a run."""

    at: Annotated[str, Meta(pattern=r"^(eval:\d{1,15}:)?\d{1,15}:\d{1,15}\Z")]
    """The step, as `EpisodeRef` writes it."""
    episode: Count
    """The number of its episode, counted over the phase."""
    text: Annotated[str, Meta(max_length=MAX_MARK_TEXT)]
    tags: Annotated[tuple[Annotated[str, Meta(pattern=rf"^{TAG_PATTERN}\Z")], ...], Meta(max_length=MAX_TAGS)]
    """In alphabetical order."""
    created: Annotated[str, Meta(pattern=r"^\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z\Z")]
    """When it was set, in UTC."""

    @cached_property
    def id(self) -> str:
        """The mark's id."""
        content = [self.at, self.episode, self.text, *self.tags, self.created]
        return blake3(json.dumps(content).encode()).hexdigest()[:_ID_LENGTH]

    @property
    def phase(self) -> str:
        """The phase of the step."""
        return "eval" if self.at.startswith("eval") else "train"

    @property
    def t(self) -> int:
        """The number of the step in its episode."""
        return int(self.at.rpartition(":")[2])

    def as_row(self) -> Json:
        """Return the mark with what follows from it, for tables and JSON."""
        return {"mark": self.id, "phase": self.phase, "t": self.t} | asdict(self) | {"tags": list(self.tags)}


@dataclass(frozen=True)
class Marks:
    """The marks of a run, and the ids of removed marks."""

    marks: tuple[Mark, ...] = ()
    """In the order of their steps."""
    removed: frozenset[str] = frozenset()

    def merged(self, more: Iterable[Mark], removed: Iterable[str] = ()) -> Marks:
        """Return these marks and more, without the marks that either side removed."""
        gone = self.removed.union(removed)
        by_id = {mark.id: mark for mark in (*self.marks, *more) if mark.id not in gone}
        order = sorted(by_id.values(), key=lambda mark: (mark.phase, mark.episode, mark.t, mark.created))
        return Marks(tuple(order), gone)

    def as_json(self) -> Json:
        """Return the contents of the file."""
        return {"marks": list(map(asdict, self.marks)), "removed": sorted(self.removed)}


def marks_from(values: object) -> Marks:
    """Return the marks in a JSON object that anyone may have written; invalid ones are ignored."""
    valid = []
    for value in _items(values, "marks", MAX_MARKS):
        with contextlib.suppress(RecordingError, ValueError):
            mark = stored_as(Mark, value, MARKS_FILE)
            datetime.fromisoformat(mark.created)
            valid.append(mark)
    ids = (item for item in _items(values, "removed", _MAX_REMOVED) if isinstance(item, str))
    return Marks().merged(valid, (item for item in ids if len(item) == _ID_LENGTH))


def _items(values: object, key: str, most: int) -> list[object]:
    items = values.get(key) if isinstance(values, Mapping) else None
    return items[:most] if isinstance(items, list) else []


def read_marks(folder: Path) -> Marks:
    """Return the marks of the run in a folder; invalid ones are ignored."""
    with contextlib.suppress(OSError, ValueError):
        return marks_from(read_object(folder / MARKS_FILE, _MAX_BYTES))
    return Marks()


def change_marks(folder: Path, change: Callable[[Marks], Marks]) -> Marks:
    """Change the marks of the run in a folder, under a lock, and return them.

    Raises:
        RunnerError: there would be too many.
        StorageError: the folder cannot be written.
    """
    with file_lock(folder / MARKS_FILE):
        before = read_marks(folder)
        after = change(before)
        if len(after.marks) > MAX_MARKS or len(after.removed) > _MAX_REMOVED:
            raise RunnerError(
                f"{folder / MARKS_FILE}: found {len(after.marks):,} marks, expected at most {MAX_MARKS:,}."
            )
        if after != before:
            write_object(folder / MARKS_FILE, after.as_json())
        return after
