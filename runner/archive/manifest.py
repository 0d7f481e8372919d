"""The manifest of an archive: written last, with size and hash of every file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path, PurePosixPath
from typing import Annotated, Final

from blake3 import blake3
from msgspec import Meta

from runner.archive.layout import FORMAT, MANIFEST, VERSION
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.digest import combined_digest
from runner.util.files import hash_of
from runner.util.stored import stored_as
from runner.util.values import JsonView

MAX_MANIFEST_BYTES: Final = 1 << 20


@dataclass(frozen=True)
class Entry:
    """A file of an archive, or the messages of a topic: size or number, and BLAKE3."""

    size: Annotated[int, Meta(ge=0, le=2**53)]
    blake3: Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]


@dataclass(frozen=True)
class Manifest:
    """The description of an archive."""

    run: JsonView
    """Id, name, seed, creation and status of the run, and the content digest that its result states."""
    topics: Mapping[str, Entry]
    """The messages in the archive, by topic."""
    files: Mapping[str, Entry] = field(default_factory=dict)
    """Every other file, by its path in the archive's folder."""
    format: str = FORMAT
    version: int = VERSION

    @property
    def run_id(self) -> str:
        """The run's id."""
        return str(self.run["run_id"])

    @property
    def digest(self) -> str:
        """The content digest of the messages in the archive; without steps, it is not that of the run."""
        digested = self.topics.keys() & schema.DIGESTED
        return combined_digest({name: self.topics[name].blake3 for name in digested})

    @property
    def size(self) -> int:
        """Bytes of all files but this one."""
        return sum(entry.size for entry in self.files.values())

    def to_json(self) -> bytes:
        """Return the manifest as a file: JSON with a seal, the BLAKE3 of the rest."""
        values = asdict(self)
        return _json(values | {"seal": blake3(_json(values)).hexdigest()})


def _json(values: Mapping[str, object]) -> bytes:
    return json.dumps(values, indent=1, sort_keys=True).encode() + b"\n"


def read_manifest(data: bytes, where: str) -> Manifest:
    """Return the manifest in a file's bytes.

    Raises:
        RecordingError: they are not a manifest of a dualtaxi archive.
    """
    try:
        values = json.loads(data[:MAX_MANIFEST_BYTES])
        if values["format"] != FORMAT:
            raise ValueError(f"found format {values['format']!r}")
        if values["version"] != VERSION:
            raise RecordingError(
                f"{where}: found an archive of version {values['version']!r}, expected {VERSION}: it takes "
                "another version of dualtaxi to restore it; its tables can be read all the same."
            )
        manifest = stored_as(Manifest, values, f"{where}: is not the manifest of an archive")
        _check(manifest)
    except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise RecordingError(f"{where}: is not the manifest of an archive ({error}).") from error
    if manifest.to_json() != data:
        raise RecordingError(f"{where}: does not match its seal: it was changed, and the archive is damaged.")
    return manifest


def _check(manifest: Manifest) -> None:
    if strange := [name for name in manifest.files if not is_inside(name)]:
        raise ValueError(f"the file {strange[0]!r} would leave the archive")
    for name in ("run_id", "name", "created", "status"):
        if not isinstance(manifest.run[name], str):
            raise ValueError(f"the {name} of its run is {manifest.run[name]!r}")
    if unknown := set(manifest.topics) - {topic.name for topic in schema.ALL_TOPICS}:
        raise ValueError(f"it has topics {sorted(unknown)}")


def is_inside(name: str) -> bool:
    """Return whether a name is a plain path that stays in the folder it is looked up in, on any system."""
    path = PurePosixPath(name)
    plain = bool(name) and name.isprintable() and not set(name) & set('\\:*?"<>|') and len(name) < 200
    return plain and str(path) == name and not path.is_absolute() and ".." not in path.parts and name != "."


def entry_of(path: Path) -> Entry:
    """Return size and hash of a file.

    Raises:
        OSError: it cannot be read.
    """
    return Entry(*hash_of(path))


def entries_of(folder: Path) -> dict[str, Entry]:
    """Return size and hash of every file of an archive but its manifest, by name."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path != folder / MANIFEST)
    return {path.relative_to(folder).as_posix(): entry_of(path) for path in files}
