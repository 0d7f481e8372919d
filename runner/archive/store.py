"""Store archives in a folder, or under a prefix in object storage with the S3 protocol.

An archive is complete or absent. In a folder it is written to `.partial/` on the same disk, and renamed when
it is complete. In object storage its files are uploaded first and the manifest last: without a manifest there
is no archive, and the next upload overwrites the files of an interrupted one.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Container, Iterator
from pathlib import Path
from typing import Any, Final

from runner.archive import layout
from runner.archive.layout import MAX_MANIFEST_BYTES, Entry, Manifest, is_inside, read_manifest
from runner.errors import RecordingError, RunnerError, StorageError
from runner.util.extras import require
from runner.util.files import sync

PARTIAL: Final = ".partial"
"""The folder of archives that are being written, which the pattern `*/steps.parquet` does not match."""
S3: Final = "s3://"
_PIECE: Final = 1 << 20


class ArchiveStore:
    """A folder or an object storage prefix that has one archive per run, named by the run's id.

    Args:
        location: a folder, or `s3://bucket/prefix`. Credentials, region and endpoint of object storage come
            from the usual AWS variables and files.
    """

    def __init__(self, location: str) -> None:
        fs = require("pyarrow.fs", extra="archive", purpose="archives")
        self._file_type = fs.FileType.File
        self._missing = fs.FileType.NotFound
        self._folder: Path | None = None
        if location.startswith(S3):
            self._root = location.removeprefix(S3).strip("/")
            self._url = f"{S3}{self._root}"
            with self._reaching(self._url):
                self._files: Any = _s3(fs, self._root.partition("/")[0])
        elif "://" in location:
            raise RunnerError(f"{location}: found a URL, expected a folder or {S3}BUCKET/PREFIX.")
        else:
            self._folder = Path(location).expanduser().absolute()
            self._url = str(self._folder)
            self._root = self._url
            self._files = fs.LocalFileSystem()

    def place(self, run_id: str) -> str:
        """Return the path or URL of a run's archive."""
        return str(self._folder / run_id) if self._folder else f"{self._url}/{run_id}"

    def manifest(self, run_id: str) -> Manifest | None:
        """Return the manifest of a run's archive; None if there is no archive.

        Raises:
            StorageError: it cannot be read.
        """
        where = f"{self.place(run_id)}/{layout.MANIFEST}"
        with self._reaching(where):
            path = self._path(run_id, layout.MANIFEST)
            info = self._files.get_file_info(path)
            if info.type == self._missing:
                return None
            if info.type != self._file_type:  # opening a pipe would block
                raise StorageError(f"{where}: cannot be read (it is not a regular file).")
            with self._files.open_input_stream(path, compression=None) as stream:
                data = stream.read(MAX_MANIFEST_BYTES + 1)
        return read_manifest(data, where)

    @contextlib.contextmanager
    def writing(self, run_id: str) -> Iterator[Path]:
        """Yield an empty local folder to write an archive in; store it when the block ends without an error.

        Raises:
            RunnerError: another process is writing an archive of this run here.
            StorageError: the store cannot be written; there is no archive then.
        """
        if self._folder is None:
            with temporary_folder() as folder:
                try:
                    yield folder
                except OSError as error:
                    raise StorageError(
                        f"{folder}: cannot be written ({error.strerror or error}); set TMPDIR."
                    ) from error
                self._upload(run_id, folder)
            return
        from filelock import FileLock, Timeout

        final = Path(self._path(run_id))
        partial = Path(self._path(PARTIAL, run_id))
        lock = partial.with_name(f"{run_id}.lock")
        try:
            partial.parent.mkdir(parents=True, exist_ok=True)
            with FileLock(lock, timeout=0):
                try:
                    shutil.rmtree(partial, ignore_errors=True)
                    partial.mkdir()
                    yield partial
                    for path in filter(Path.is_file, partial.rglob("*")):
                        sync(path)
                    if self.manifest(run_id) is None:
                        shutil.rmtree(final, ignore_errors=True)
                    partial.rename(final)
                finally:
                    shutil.rmtree(partial, ignore_errors=True)
                    with contextlib.suppress(OSError):
                        lock.unlink()
        except Timeout as error:
            raise RunnerError(
                f"{final}: another process is writing this archive; try again when it has finished."
            ) from error
        except OSError as error:
            raise StorageError(
                f"{self._folder}: cannot be written ({error.strerror or error}); no archive was made. "
                "Free some disk, or choose another folder by --to."
            ) from error
        finally:
            with contextlib.suppress(OSError):
                partial.parent.rmdir()

    @contextlib.contextmanager
    def reading(self, run_id: str, without: Container[str] = ()) -> Iterator[Path]:
        """Yield a local folder with a run's archive, read-only: its own folder, or a downloaded copy.

        A copy is `without` files of these names, and their folders.
        """
        manifest = self.manifest(run_id)
        if manifest is None:
            raise no_archive(self.place(run_id))
        if self._folder is not None:
            yield Path(self._path(run_id))
            return
        with temporary_folder() as folder:
            for name, entry in manifest.files.items():
                if name not in without and f"{name.partition('/')[0]}/" not in without:
                    self._download(run_id, name, entry, folder / name)
            (folder / layout.MANIFEST).write_bytes(manifest.to_json())
            yield folder

    @contextlib.contextmanager
    def opened(self, run_id: str, name: str) -> Iterator[Any]:
        """Yield a file of a run's archive, as pyarrow reads it."""
        where = f"{self.place(run_id)}/{name}"
        with self._reaching(where):
            path = self._path(run_id, name)
            if self._files.get_file_info(path).type != self._file_type:  # opening a pipe would block
                raise RecordingError(f"{where}: is missing; the archive is damaged.")
            with self._files.open_input_file(path) as file:
                yield file

    def _upload(self, run_id: str, folder: Path) -> None:
        names = list(read_manifest((folder / layout.MANIFEST).read_bytes(), str(folder)).files)
        for name in (*names, layout.MANIFEST):
            where = f"{self.place(run_id)}/{name}"
            advice = " No archive was made; the same command uploads all of it again."
            with (
                self._reaching(where, advice),
                (folder / name).open("rb") as source,
                self._files.open_output_stream(self._path(run_id, name), compression=None) as target,
            ):
                shutil.copyfileobj(source, target, _PIECE)

    def _download(self, run_id: str, name: str, entry: Entry, path: Path) -> None:
        """Copy a file of an archive to a local one: never more bytes than the manifest says."""
        with self.opened(run_id, name) as source:
            if (size := source.size()) != entry.size:
                raise RecordingError(
                    f"{self.place(run_id)}/{name}: found {size:,} bytes, expected {entry.size:,}: "
                    "the archive is damaged."
                )
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("xb") as target:
                shutil.copyfileobj(source, target, _PIECE)

    def _path(self, *parts: str) -> str:
        """Return the path of a file in the store's file system.

        Raises:
            RecordingError: it would lead out of the store.
        """
        if not is_inside(path := "/".join(parts)):
            raise RecordingError(f"{self._url}: {path!r} is not the name of an archive's file.")
        return f"{self._root}/{path}"

    @contextlib.contextmanager
    def _reaching(self, where: str, advice: str = "") -> Iterator[None]:
        """Raise a `StorageError` for what pyarrow raises if the storage cannot be reached or refuses."""
        try:
            yield
        except (OSError, ValueError) as error:
            reason = error.strerror if self._folder and isinstance(error, OSError) else None
            message = str(reason or error).partition(" Detail: ")[0].strip().removesuffix(".")
            raise StorageError(f"{where}: cannot be accessed ({message}).{advice}") from error


def split_place(place: str) -> tuple[str, str]:
    """Return the store of an archive's path or URL, and the id of its run."""
    store, _, run_id = place.rstrip("/").rpartition("/")
    return store or "/" if place.startswith("/") else store or ".", run_id


def no_archive(place: str) -> RecordingError:
    """Return the error for a place without an archive."""
    return RecordingError(f"{place}: found no archive there (no {layout.MANIFEST}), expected one.")


@contextlib.contextmanager
def temporary_folder() -> Iterator[Path]:
    """Yield a folder that is removed afterwards."""
    with tempfile.TemporaryDirectory(prefix="dualtaxi-archive-", ignore_cleanup_errors=True) as folder:
        yield Path(folder)


def _s3(fs: Any, bucket: str) -> Any:
    """Return the file system of object storage, at the endpoint and in the region of the usual variables."""
    if not bucket:
        raise RunnerError(f"{S3}: found no bucket, expected {S3}BUCKET/PREFIX.")
    if endpoint := os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL"):
        return fs.S3FileSystem(endpoint_override=endpoint)
    region = os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION")
    return fs.S3FileSystem(region=region or fs.resolve_s3_region(bucket))
