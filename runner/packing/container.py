"""The file that a packed run is: a plain tar of known members, the first of which says what they are.

    manifest.json     run, content digest; name, size and BLAKE3 of each other member
    run.json          what the run is
    labels.json       what people said of it, if they did
    recording.mcap    the truth

Every tar program reads it. This reader takes nothing but what the writer writes: each header is compared
byte by byte with the one that its name and size give, so that there is no room for links, devices, paths
or a member twice; and all is read in pieces, so that no declared size is believed.
"""

from __future__ import annotations

import contextlib
import json
import tarfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, BinaryIO, Final, Literal

from blake3 import blake3
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from runner.errors import RunnerError
from runner.runs.labels import LABELS_FILE, MAX_LABELS_BYTES
from runner.runs.run import RECORDING_FILE, RUN_FILE
from runner.util.hashing import hash_of
from runner.util.opening import open_regular

VERSION: Final = 0
MANIFEST_FILE: Final = "manifest.json"
MEMBERS: Final = (RUN_FILE, LABELS_FILE, RECORDING_FILE)
"""The members behind the manifest, in their order; labels may be missing."""
MOST_BYTES: Final = {
    MANIFEST_FILE: 1 << 16,
    RUN_FILE: 4 << 20,
    LABELS_FILE: MAX_LABELS_BYTES,
    RECORDING_FILE: 1 << 62,
}

_BLOCK: Final = tarfile.BLOCKSIZE
_PIECE: Final = 1 << 20
_END: Final = bytes(2 * _BLOCK)

_Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
_Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}$")]
_STRICT: Final = ConfigDict(frozen=True, extra="forbid", strict=True)


class PackError(RunnerError):
    """A file is no packed run, is damaged, or was made to do harm; nothing of it was written."""


class Member(BaseModel):
    """A file in the pack."""

    model_config = _STRICT

    name: Literal["run.json", "labels.json", "recording.mcap"]
    size: Annotated[int, Field(ge=0, le=1 << 62)]
    blake3: _Digest


class Manifest(BaseModel):
    """What a pack says of itself."""

    model_config = _STRICT

    dualtaxi_pack: Literal[0]
    run_id: _Name
    name: _Name
    seed: Annotated[int, Field(ge=0, lt=1 << 64)]
    status: Literal["finished", "interrupted", "failed"]
    content_digest: _Digest
    anonymous: bool
    members: tuple[Member, ...]

    def to_bytes(self) -> bytes:
        """Return it as it stands in the file."""
        return json.dumps(self.model_dump(mode="json"), indent=1).encode() + b"\n"


def member_of(path: Path, name: str) -> Member:
    """Return what the manifest says of a file.

    Raises:
        PackError: it is larger than such a file can be.
        OSError: it cannot be read.
    """
    size, digest = hash_of(path)
    if size > MOST_BYTES[name]:
        raise PackError(f"{path}: found {size:,} bytes, expected {MOST_BYTES[name]:,} at most.")
    return Member.model_validate({"name": name, "size": size, "blake3": digest})


def write_pack(target: BinaryIO, manifest: Manifest, sources: Mapping[str, Path]) -> None:
    """Write a pack of these files; the same files give the same bytes.

    Raises:
        PackError: a file is not any more what the manifest says.
        OSError: a file cannot be read, or the pack cannot be written.
    """
    said = manifest.to_bytes()
    target.write(_header(MANIFEST_FILE, len(said)) + said + _padding(len(said)))
    for member in manifest.members:
        target.write(_header(member.name, member.size))
        with sources[member.name].open("rb") as source:
            _copy(source, member, target, str(sources[member.name]))
        target.write(_padding(member.size))
    target.write(_END)


class Pack:
    """A pack opened for reading, from its beginning to its end, once.

    Args:
        stream: the file.
        path: its path, for errors.

    Raises:
        PackError: it does not begin as a pack does.
    """

    def __init__(self, stream: BinaryIO, path: Path) -> None:
        self._stream = stream
        self._path = path
        size = self._read_header(MANIFEST_FILE)
        self.manifest = _manifest(self._exactly(size), path)
        self._skip_padding(size)

    def take(self, member: Member, target: BinaryIO | None) -> None:
        """Read the next member, compare its checksum, and write it to a file if there is one.

        Raises:
            PackError: another member is there, or it is damaged.
        """
        size = self._read_header(member.name)
        if size != member.size:
            raise PackError(
                f"{self._path}: found {member.name} of {size:,} bytes, expected the {member.size:,} that the "
                "manifest says."
            )
        _copy(self._stream, member, target, f"{self._path}: {member.name}")
        self._skip_padding(size)

    def check_end(self) -> None:
        """Refuse anything behind the last member.

        Raises:
            PackError: there is something.
        """
        if self._exactly(len(_END)) != _END or self._stream.read(1):
            raise PackError(f"{self._path}: found something behind the last member, expected the end.")

    def _read_header(self, expected: str) -> int:
        """Return the size of the next member, which must be the expected one."""
        block = self._exactly(_BLOCK)
        try:
            found = tarfile.TarInfo.frombuf(block, "ascii", "strict")
        except (tarfile.HeaderError, ValueError) as error:
            raise PackError(f"{self._path}: found no member {expected}; it is no packed run.") from error
        if found.name != expected:
            raise PackError(f"{self._path}: found a member {found.name!r}, expected {expected}.")
        if not 0 <= found.size <= MOST_BYTES[expected]:
            raise PackError(f"{self._path}: {expected} declares {found.size:,} bytes; too many to be ours.")
        if block != _header(expected, found.size):
            raise PackError(
                f"{self._path}: {expected} has another kind, owner or mode than `dualtaxi pack` writes."
            )
        return found.size

    def _skip_padding(self, size: int) -> None:
        if any(self._exactly(len(_padding(size)))):
            raise PackError(f"{self._path}: found something between its members.")

    def _exactly(self, size: int) -> bytes:
        data = self._stream.read(size)
        if len(data) != size:
            raise PackError(f"{self._path}: is cut off; ask for it again.")
        return data


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Pack]:
    """Give a pack, opened for reading.

    Raises:
        PackError: there is none, it cannot be read, or it is no pack.
    """
    try:
        if path.is_dir():
            raise PackError(f"{path}: found a folder, expected the file that `dualtaxi pack` writes.")
        if not path.is_file():  # to open a pipe would wait for its writer
            raise PackError(f"{path}: found no such file, expected a packed run.")
        with open_regular(path) as stream:
            yield Pack(stream, path)
    except OSError as error:
        if error.filename is None or Path(error.filename) == path:
            raise PackError(f"{path}: cannot be read ({error.strerror}).") from error
        raise


def _manifest(data: bytes, path: Path) -> Manifest:
    try:
        found = json.loads(data)
        version = found.get("dualtaxi_pack") if isinstance(found, dict) else None
        if isinstance(version, int) and version != VERSION:
            raise PackError(
                f"{path}: found a pack of version {version}, expected {VERSION}: "
                "it takes another version of dualtaxi to unpack it."
            )
        manifest = Manifest.model_validate_json(data)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise PackError(f"{path}: its manifest is not ours: {place}: {first['msg']}.") from error
    except (ValueError, RecursionError) as error:
        raise PackError(f"{path}: its manifest is no JSON.") from error
    names = [member.name for member in manifest.members]
    if names not in ([*MEMBERS], [name for name in MEMBERS if name != LABELS_FILE]):
        raise PackError(f"{path}: found the members {', '.join(names)}, expected {', '.join(MEMBERS)}.")
    return manifest


def _copy(source: BinaryIO, member: Member, target: BinaryIO | None, where: str) -> None:
    """Copy a member's bytes in pieces, and compare their checksum."""
    digest, left = blake3(), member.size
    while left and (piece := source.read(min(_PIECE, left))):
        digest.update(piece)
        left -= len(piece)
        if target is not None:
            target.write(piece)
    if left:
        raise PackError(f"{where}: ends {left:,} bytes too early.")
    if digest.hexdigest() != member.blake3:
        raise PackError(f"{where}: found another checksum than the manifest says; its bytes were changed.")


def _header(name: str, size: int) -> bytes:
    """Return the one tar header that a member of this name and size has."""
    member = tarfile.TarInfo(name)
    member.size = size
    return member.tobuf(tarfile.GNU_FORMAT)


def _padding(size: int) -> bytes:
    return bytes(-size % _BLOCK)
