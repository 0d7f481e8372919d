"""Archives in object storage, by boto3: uploads that go on where they were cut off, and are whole or not.

Every file goes up in parts. A part that is there already, with the same size and MD5, is not sent again;
S3 keeps the parts of an upload until it is completed, and shows none of them before. When the parts of all
files are there the uploads are completed, and then the manifest is put. Credentials, region and endpoint
(`AWS_ENDPOINT_URL`) are boto3's.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import boto3
from boto3.exceptions import Boto3Error
from botocore.exceptions import BotoCoreError, ClientError

from runner.archive import layout
from runner.archive.manifest import MAX_MANIFEST_BYTES, Entry, Manifest, read_manifest
from runner.archive.targets import S3, no_archive, temporary_folder
from runner.errors import RecordingError, RunnerError, StorageError

PART_BYTES: Final = 8 << 20
MAX_PARTS: Final = 10_000
_HASH: Final = "blake3"
_PIECE: Final = 1 << 20
_ABSENT: Final = {"404", "NoSuchKey", "NotFound"}


class S3Target:
    """A bucket, or a prefix in one, that keeps archives.

    Args:
        url: `s3://bucket/prefix`.
    """

    def __init__(self, url: str) -> None:
        bucket, _, prefix = url.removeprefix(S3).partition("/")
        if not bucket:
            raise RunnerError(f"{url}: found no bucket, expected {S3}BUCKET/PREFIX.")
        self._bucket, self._prefix = bucket, prefix.strip("/")
        with self._reaching():
            self._client: Any = boto3.client("s3")

    def place(self, run_id: str) -> str:
        """Return the URL of a run's archive."""
        return f"{S3}{self._bucket}/{self._key(run_id)}"

    def manifest(self, run_id: str) -> Manifest | None:
        """Return the manifest of a run's archive; None if there is no archive."""
        key = self._key(run_id, layout.MANIFEST)
        with self._reaching():
            try:
                body = self._client.get_object(Bucket=self._bucket, Key=key)["Body"]
            except ClientError as error:
                if _code(error) in _ABSENT:
                    return None
                raise
            data = body.read(MAX_MANIFEST_BYTES + 1)
        return read_manifest(data, f"{S3}{self._bucket}/{key}")

    @contextlib.contextmanager
    def writing(self, run_id: str) -> Iterator[Path]:  # noqa: ARG002
        """Give a temporary folder."""
        with temporary_folder() as folder:
            try:
                yield folder
            except OSError as error:
                raise StorageError(f"{folder}: cannot be written ({error.strerror}); set TMPDIR.") from error

    def commit(self, run_id: str, folder: Path) -> None:
        """Upload the parts of every file, complete all of them, and put the manifest."""
        data = (folder / layout.MANIFEST).read_bytes()
        files = read_manifest(data, str(folder)).files
        with self._reaching(" An upload that was cut off goes on when the same command is given again."):
            uploads = [
                _Upload(self._client, self._bucket, self._key(run_id, name), folder / name, entry)
                for name, entry in files.items()
            ]
            for upload in uploads:
                upload.send()
            for upload in uploads:
                upload.complete()
            self._client.put_object(Bucket=self._bucket, Key=self._key(run_id, layout.MANIFEST), Body=data)

    @contextlib.contextmanager
    def reading(self, run_id: str) -> Iterator[Path]:
        """Give a temporary folder with the archive, downloaded."""
        manifest = self.manifest(run_id)
        if manifest is None:
            raise no_archive(self.place(run_id))
        with temporary_folder() as folder:
            with self._reaching():
                for name, entry in manifest.files.items():
                    self._download(self._key(run_id, name), folder / name, entry)
            (folder / layout.MANIFEST).write_bytes(manifest.to_json())
            yield folder

    def _download(self, key: str, path: Path, entry: Entry) -> None:
        """Write an object to a file: no more of it than it should have."""
        where = f"{S3}{self._bucket}/{key}"
        try:
            found = self._client.get_object(Bucket=self._bucket, Key=key)
        except ClientError as error:
            if _code(error) in _ABSENT:
                raise RecordingError(f"{where}: is missing; the archive is damaged.") from error
            raise
        if found["ContentLength"] != entry.size:
            raise RecordingError(
                f"{where}: found {found['ContentLength']:,} bytes, expected {entry.size:,}: the archive is "
                "damaged there."
            )
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("xb") as stream:
            for piece in found["Body"].iter_chunks(_PIECE):
                stream.write(piece)

    def _key(self, *parts: str) -> str:
        return "/".join(part for part in (self._prefix, *parts) if part)

    @contextlib.contextmanager
    def _reaching(self, advice: str = "") -> Iterator[None]:
        """Tell in our words that the storage cannot be reached, or refuses; and what is to be done."""
        try:
            yield
        except (BotoCoreError, Boto3Error, ClientError, OSError, ValueError) as error:
            told = str(error).removesuffix(".")
            raise StorageError(f"{S3}{self._bucket}/{self._prefix}: {told}.{advice}") from error


class _Upload:
    """A file on its way into an object."""

    def __init__(self, client: Any, bucket: str, key: str, path: Path, entry: Entry) -> None:
        self._client = client
        self._object = {"Bucket": bucket, "Key": key}
        self._path = path
        self._entry = entry
        self._upload: str | None = None
        self._parts: list[dict[str, Any]] = []

    def send(self) -> None:
        """Send the parts that are not there."""
        if self._is_there():
            return
        self._upload, there = self._begun()
        for number, data in enumerate(self._pieces(), start=1):
            if number in there:
                tag = there[number][1]
            else:
                place = {"UploadId": self._upload, "PartNumber": number}
                tag = self._client.upload_part(**self._object, **place, Body=data)["ETag"]
            self._parts.append({"PartNumber": number, "ETag": tag})

    def _pieces(self) -> Iterator[bytes]:
        """Yield the parts of the file; an empty file has one, too."""
        size = max(PART_BYTES, -(-self._entry.size // (MAX_PARTS - 1)))
        with self._path.open("rb") as stream:
            yield stream.read(size)
            while data := stream.read(size):
                yield data

    def complete(self) -> None:
        """Make the object of its parts."""
        if self._upload is not None:
            self._client.complete_multipart_upload(
                **self._object, UploadId=self._upload, MultipartUpload={"Parts": self._parts}
            )

    def _is_there(self) -> bool:
        try:
            found = self._client.head_object(**self._object)
        except ClientError as error:
            if _code(error) in _ABSENT:
                return False
            raise
        said = found["Metadata"].get(_HASH)
        return bool(found["ContentLength"] == self._entry.size and said == self._entry.blake3)

    def _begun(self) -> tuple[str, dict[int, tuple[int, str]]]:
        """Return the upload that was begun of this very file, or a new one, and the parts that it has.

        A part: its size and MD5, by number.
        """
        found = self._client.list_multipart_uploads(Bucket=self._object["Bucket"], Prefix=self._object["Key"])
        for upload in found.get("Uploads", []):
            if upload["Key"] == self._object["Key"]:
                there = dict(self._sent_before(upload["UploadId"]))
                if there and self._begins_with(there):
                    return upload["UploadId"], there
                self._client.abort_multipart_upload(**self._object, UploadId=upload["UploadId"])
        begun = self._client.create_multipart_upload(**self._object, Metadata={_HASH: self._entry.blake3})
        return str(begun["UploadId"]), {}

    def _begins_with(self, there: Mapping[int, tuple[int, str]]) -> bool:
        """Return whether these are parts of the file as it is now."""
        mine = enumerate(self._pieces(), start=1)
        told = {number: (len(data), _tag(data)) for number, data in mine if number in there}
        return told == there

    def _sent_before(self, upload: str) -> Iterator[tuple[int, tuple[int, str]]]:
        pages = self._client.get_paginator("list_parts").paginate(**self._object, UploadId=upload)
        for page in pages:
            for part in page.get("Parts", []):
                yield part["PartNumber"], (part["Size"], part["ETag"])


def _tag(data: bytes) -> str:
    """Return what S3 calls a part: the MD5 of its bytes, quoted."""
    return f'"{hashlib.md5(data, usedforsecurity=False).hexdigest()}"'


def _code(error: ClientError) -> str:
    return str(error.response.get("Error", {}).get("Code", ""))
