"""Where archives are kept: a folder, or object storage.

Both give an archive whole or not at all. In a folder it is written aside, on the same disk, and renamed
when it is complete; in object storage its files come into being when all of their parts are there, and
the manifest last.
"""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final, Protocol

from runner.archive import layout
from runner.archive.manifest import MAX_MANIFEST_BYTES, Manifest, read_manifest
from runner.errors import RecordingError, StorageError
from runner.util.files import sync
from runner.util.opening import open_regular

ASIDE: Final = ".partial"
"""The folder of archives that are being written; one level down, where `*/steps.parquet` does not reach."""
S3: Final = "s3://"


class Target(Protocol):
    """Where archives are kept, each under its run's id."""

    def place(self, run_id: str) -> str:
        """Return the path or URL of a run's archive."""

    def manifest(self, run_id: str) -> Manifest | None:
        """Return the manifest of a run's archive; None if there is no archive.

        Raises:
            RecordingError: it is none of ours.
            StorageError: the target cannot be read.
        """

    def writing(self, run_id: str) -> contextlib.AbstractContextManager[Path]:
        """Give an empty local folder to write a run's archive in; it is gone afterwards."""

    def commit(self, run_id: str, folder: Path) -> None:
        """Make what stands in that folder the run's archive, whole.

        Raises:
            StorageError: the target cannot be written; there is no archive then.
        """

    def reading(self, run_id: str) -> contextlib.AbstractContextManager[Path]:
        """Give a local folder with the run's archive, not to be changed.

        Raises:
            RecordingError: there is no archive of it.
            StorageError: the target cannot be read.
        """


def split_place(place: str) -> tuple[str, str]:
    """Return the target of an archive's path or URL, and the id of its run."""
    target, _, run_id = place.rstrip("/").rpartition("/")
    return target or "/" if place.startswith("/") else target or ".", run_id


class FolderTarget:
    """A folder of archives."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def place(self, run_id: str) -> str:
        """Return the path of a run's archive."""
        return str(self._root / run_id)

    def manifest(self, run_id: str) -> Manifest | None:
        """Return the manifest of a run's archive; None if there is no archive."""
        path = self._root / run_id / layout.MANIFEST
        try:
            with open_regular(path) as stream:
                return read_manifest(stream.read(MAX_MANIFEST_BYTES + 1), str(path))
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            raise StorageError(f"{path}: cannot be read ({error.strerror}).") from error

    @contextlib.contextmanager
    def writing(self, run_id: str) -> Iterator[Path]:
        """Give an empty folder on the target's own disk."""
        aside = self._root / ASIDE / run_id
        with self._writable():
            shutil.rmtree(aside, ignore_errors=True)
            aside.mkdir(parents=True)
        try:
            with self._writable():
                yield aside
        finally:
            shutil.rmtree(aside, ignore_errors=True)
            with contextlib.suppress(OSError):
                aside.parent.rmdir()

    def commit(self, run_id: str, folder: Path) -> None:
        """Rename the folder; what is left of an archive without a manifest gives way."""
        with self._writable():
            for path in folder.rglob("*"):
                if path.is_file():
                    sync(path)
            if self.manifest(run_id) is None:
                shutil.rmtree(self._root / run_id, ignore_errors=True)
            folder.rename(self._root / run_id)

    @contextlib.contextmanager
    def reading(self, run_id: str) -> Iterator[Path]:
        """Give the archive's own folder."""
        if self.manifest(run_id) is None:
            raise no_archive(self.place(run_id))
        yield self._root / run_id

    @contextlib.contextmanager
    def _writable(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise StorageError(
                f"{self._root}: cannot be written ({error.strerror or error}); no archive was made. "
                "Free some disk, or choose another folder by --to."
            ) from error


def no_archive(place: str) -> RecordingError:
    """Return the error that there is none."""
    return RecordingError(f"{place}: found no archive there (no {layout.MANIFEST}), expected one.")


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """Give a folder that is gone afterwards."""
    with tempfile.TemporaryDirectory(prefix="dualtaxi-archive-", ignore_cleanup_errors=True) as folder:
        yield Path(folder)
