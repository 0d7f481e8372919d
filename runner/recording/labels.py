"""The labels that users give a run: another name, tags, a note.

    recordings/k3v9m2xq/labels.json      {"name": "patient", "tags": ["keep"], "note": "the one of figure 3"}

They are in a file of their own, because the owner of a run rewrites `run.json` while it trains. The file is
replaced atomically, under a lock.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from runner.errors import RunnerError, StorageError
from runner.util.files import read_object, storage_errors, write_object
from runner.util.values import Json, is_utf8

LABELS_FILE: Final = "labels.json"
LOCK_FILE: Final = "labels.lock"
KEEP: Final = "keep"
"""The tag of a run that must not be removed."""
MAX_LABELS_BYTES: Final = 1 << 20
MAX_NOTE: Final = 10_000
MAX_TAGS: Final = 100
LOCK_SECONDS: Final = 30.0

TAG_PATTERN: Final = r"\w[\w.=+/@-]{0,63}"
_TAG_EXPECTED: Final = "1 to 64 letters, digits or any of _ . - = + / @, the first a letter, digit or _"


@dataclass(frozen=True)
class Labels:
    """The labels of a run."""

    name: str = ""
    """The current name; empty if it is the first one."""
    tags: tuple[str, ...] = ()
    """In alphabetical order, without duplicates."""
    note: str = ""

    def as_json(self) -> Json:
        """Return the contents of the file; empty labels are left out."""
        values = {"name": self.name, "tags": list(self.tags), "note": self.note}
        return {key: value for key, value in values.items() if value}


def read_labels(folder: Path) -> Labels:
    """Return the labels of the run in a folder; invalid ones are ignored."""
    try:
        return labels_from(read_object(folder / LABELS_FILE, MAX_LABELS_BYTES))
    except (OSError, ValueError):
        return Labels()


def are_labels_readable(folder: Path) -> bool:
    """Return whether the labels of the run in a folder can be read: a damaged file may contain `keep`."""
    try:
        return isinstance(read_object(folder / LABELS_FILE, MAX_LABELS_BYTES).get("tags", []), list)
    except FileNotFoundError:
        return True
    except (OSError, ValueError):
        return False


def labels_from(values: Mapping[str, object]) -> Labels:
    """Return the labels in a JSON object; invalid ones are ignored."""
    name, tags, note = values.get("name"), values.get("tags"), values.get("note")
    valid = {tag for tag in tags if is_tag(tag)} if isinstance(tags, list) else set()
    return Labels(
        name if isinstance(name, str) and name.isprintable() and len(name) <= 100 else "",
        tuple(sorted(valid)[:MAX_TAGS]),
        note[:MAX_NOTE] if isinstance(note, str) else "",
    )


def change_labels(folder: Path, change: Callable[[Labels], Labels]) -> Labels:
    """Change the labels of the run in a folder, under a lock, and return them.

    Raises:
        RunnerError: a tag or the note is not valid.
        StorageError: the folder cannot be written.
    """
    with file_lock(folder / LABELS_FILE):
        before = read_labels(folder)
        after = change(before)
        check_tags(after.tags)
        if not is_utf8(after.note):
            raise RunnerError(f"note: found {after.note[:100]!r}, expected text in UTF-8.")
        if len(after.note) > MAX_NOTE:
            raise RunnerError(f"note: found {len(after.note):,} characters, expected at most {MAX_NOTE:,}.")
        if after != before:
            write_object(folder / LABELS_FILE, after.as_json())
        return after


@contextlib.contextmanager
def file_lock(path: Path) -> Iterator[None]:
    """Hold the lock of a file that users change.

    Raises:
        StorageError: its folder cannot be written, or another process holds the lock for too long.
    """
    from filelock import FileLock, Timeout

    lock = path.with_suffix(".lock")
    with storage_errors(path):
        try:
            with FileLock(lock, timeout=LOCK_SECONDS):
                yield
        except Timeout as error:
            raise StorageError(
                f"{lock}: another process has held it for {LOCK_SECONDS:.0f} s; try again."
            ) from error


def is_tag(text: object) -> bool:
    """Return whether a run can have this tag."""
    return isinstance(text, str) and re.fullmatch(TAG_PATTERN, text) is not None


def check_tags(tags: Collection[str]) -> None:
    """Refuse tags that a run or a mark cannot have.

    Raises:
        RunnerError: one of them is not valid, or there are too many.
    """
    for tag in tags:
        if not is_tag(tag):
            raise RunnerError(f"tag: found {tag!r}, expected {_TAG_EXPECTED}.")
    if len(tags) > MAX_TAGS:
        raise RunnerError(f"tag: found {len(tags)} tags, expected at most {MAX_TAGS}.")
