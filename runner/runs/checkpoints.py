"""The checkpoints of a run: an agent's parameters at a step, recorded by `rec.checkpoint`.

    run = runner.find_run("cartpole")
    for checkpoint in run.checkpoints():
        print(checkpoint.name, checkpoint.step, checkpoint.format)
    weights = run.checkpoints()[-1].load()         # name -> array, of a safetensors file

The recording has the digest; the content is in a store next to the runs of its folder:

    recordings/.store/objects/3f/3f9a...    a content, named by its BLAKE3 in hexadecimal, and written once
    recordings/.store/runs/k3v9m2xq         the digests that a run refers to, a line each

Runs with the same content share it. It is removed with the last run that refers to it.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from blake3 import blake3
from filelock import FileLock

from runner.errors import RecordingError, RunnerError, RunNotFound, StorageError
from runner.util.extras import require
from runner.util.files import hash_of, open_regular, storage_errors
from runner.util.values import Json

if TYPE_CHECKING:
    from runner.recording.reader import Recording
    from runner.util.arrays import Array

_STORE_FOLDER: Final = ".store"
DIGEST: Final = re.compile(r"[0-9a-f]{64}")
_PIECE: Final = 1 << 20
_LEFT_OVER_SECONDS: Final = 3600
"""What changed later may belong to an import, or to a process that is storing a content."""
_ADVICE: Final = "free some disk"


class Store:
    """The store of a recordings folder; it need not exist."""

    def __init__(self, recordings: Path) -> None:
        self._folder = recordings / _STORE_FOLDER

    def path(self, digest: str) -> Path:
        """Return the path of a content, whether or not it is there.

        Raises:
            RecordingError: it is not a digest; anything else could lead out of the store.
        """
        if not DIGEST.fullmatch(digest):
            raise RecordingError(f"found the digest {digest[:80]!r}, expected 64 hexadecimal digits.")
        return self._folder / "objects" / digest[:2] / digest

    def has(self, digest: str, size: int) -> bool:
        """Return whether a content of this size is there."""
        try:
            return self.path(digest).stat().st_size == size
        except OSError:
            return False

    def put(self, run: str, content: bytes | memoryview | Path, expected: str = "") -> tuple[str, int]:
        """Store a content that a run refers to; return its digest and its number of bytes.

        Args:
            content: the bytes, or a file with them.
            expected: its digest, if it is known.

        Raises:
            StorageError: the file cannot be read, or the store cannot be written.
        """
        if not isinstance(content, Path):
            return self._put(run, [content], expected)
        try:
            stream = open_regular(content)
        except OSError as error:
            raise StorageError(f"{content}: cannot be read ({error.strerror}).") from error
        with stream:
            return self._put(run, iter(partial(stream.read, _PIECE), b""), expected)

    def _put(self, run: str, pieces: Iterable[bytes | memoryview], expected: str) -> tuple[str, int]:
        with storage_errors(self._folder, _ADVICE):
            (self._folder / "objects").mkdir(parents=True, exist_ok=True)
            fresh = self._folder / "objects" / f".{secrets.token_hex(8)}"
            try:
                digest, size = _write(fresh, pieces)
                if expected and digest != expected:
                    raise RecordingError(
                        f"checkpoint {expected[:16]}…: found content {digest[:16]}…: it was changed."
                    )
                path = self.path(digest)
                with self._locked():
                    self._refer(run, [digest])
                    path.parent.mkdir(exist_ok=True)
                    fresh.replace(path)  # also where it is there already: that file may be damaged
            finally:
                fresh.unlink(missing_ok=True)
        return digest, size

    def refer(self, run: str, digests: Iterable[str]) -> None:
        """Note that a run refers to contents, which then stay."""
        if digests := [digest for digest in digests if self.path(digest)]:
            with storage_errors(self._folder, _ADVICE):
                self._folder.mkdir(exist_ok=True)
                with self._locked():
                    self._refer(run, digests)

    def _refer(self, run: str, digests: Iterable[str]) -> None:
        referred = set(self.of_run(run))
        if fresh := [digest for digest in dict.fromkeys(digests) if digest not in referred]:
            path = self._folder / "runs" / run
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("a", encoding="ascii") as stream:
                # The empty line ends one that was cut off when the machine failed.
                stream.write("\n".join(["", *fresh, ""]))

    def of_run(self, run: str) -> list[str]:
        """Return the digests that a run refers to."""
        try:
            with open_regular(self._folder / "runs" / run) as stream:
                lines = stream.read().decode("ascii", "replace").split()
        except OSError:
            return []
        return [line for line in lines if DIGEST.fullmatch(line)]

    def runs(self) -> list[str]:
        """Return the names of the folders of runs that refer to something."""
        with contextlib.suppress(OSError):
            return sorted(path.name for path in (self._folder / "runs").iterdir())
        return []

    def sizes(self) -> dict[str, int]:
        """Return the bytes of the contents by run; what several runs share counts for the first of them."""
        seen: set[str] = set()
        by_run = {}
        for run in self.runs():
            unseen = [digest for digest in self.of_run(run) if digest not in seen]
            seen.update(unseen)
            by_run[run] = sum(map(self._size, unseen))
        return by_run

    def only_of(self, runs: Iterable[str]) -> dict[str, int]:
        """Return the contents that only these runs refer to, with their bytes."""
        leaving = set(runs)
        known = set(self.runs())
        staying = {digest for run in known - leaving for digest in self.of_run(run)}
        left_by = {digest for run in known & leaving for digest in self.of_run(run)}
        return {digest: self._size(digest) for digest in sorted(left_by - staying)}

    def drop(self, run: str) -> int:
        """Forget a run, and remove the contents that no other run refers to; return the bytes freed."""
        if run not in self.runs():
            return 0
        with storage_errors(self._folder), self._locked():
            unused = self.only_of([run])
            for digest in unused:
                self.path(digest).unlink(missing_ok=True)
            (self._folder / "runs" / run).unlink(missing_ok=True)
        return sum(unused.values())

    def clean(self) -> None:
        """Forget runs that are gone, and remove what killed processes left, both after an hour."""
        for run in self.runs():
            if not (self._folder.parent / run).exists() and _is_old(self._folder / "runs" / run):
                self.drop(run)
        for path in (self._folder / "objects").glob(".*"):
            if _is_old(path):
                path.unlink(missing_ok=True)

    def _size(self, digest: str) -> int:
        with contextlib.suppress(OSError):
            return self.path(digest).stat().st_size
        return 0

    def _locked(self) -> FileLock:
        """Return the lock, with which no other process changes what runs refer to."""
        return FileLock(self._folder / "lock")


def _is_old(path: Path) -> bool:
    with contextlib.suppress(OSError):
        return time.time() - path.stat().st_mtime > _LEFT_OVER_SECONDS
    return False


def _write(path: Path, pieces: Iterable[bytes | memoryview]) -> tuple[str, int]:
    """Write a new file, and sync it; return its digest and size."""
    digest = blake3()
    size = 0
    with path.open("xb") as stream:
        for piece in pieces:
            stream.write(piece)
            digest.update(piece)
            size += len(piece)
        stream.flush()
        os.fsync(stream.fileno())
    return digest.hexdigest(), size


MAX_NAME_LENGTH: Final = 200
FORMATS: Final = ("bytes", "file", "safetensors", "pickle")
MAX_CHECKPOINTS: Final = 1 << 17
"""The most checkpoints that are read of a recording."""
MAX_LOADED: Final = 16 << 30
"""The largest content that is read into memory."""
_MAX_MESSAGE: Final = 4096
_DTYPES: Final = {
    "BOOL": "|b1",
    **{f"I{8 * n}": f"<i{n}" for n in (1, 2, 4, 8)},
    **{f"U{8 * n}": f"<u{n}" for n in (1, 2, 4, 8)},
    **{f"F{8 * n}": f"<f{n}" for n in (2, 4, 8)},
    "BF16": "<u2",
}
"""The dtypes of safetensors as NumPy's; bfloat16 is the upper half of a float32."""


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint, taken after `step` steps of its phase."""

    name: str
    phase: str
    step: int
    episode: int
    digest: str
    size: int
    """Number of bytes."""
    format: str
    """One of `FORMATS`."""
    path: Path
    """Where its content is, if it is here."""

    @property
    def is_here(self) -> bool:
        """Whether its content is in the store."""
        try:
            return self.path.stat().st_size == self.size
        except OSError:
            return False

    @property
    def reference(self) -> str:
        """The text that names it in commands."""
        return f"{self.name}@{self.step}"

    def check(self) -> None:
        """Compare the digest of its content.

        Raises:
            RecordingError: it is not here, or was changed.
        """
        try:
            found = hash_of(self.path)
        except OSError as error:
            raise self._missing(error) from error
        if found != (self.size, self.digest):
            raise self._changed()

    def _missing(self, error: OSError) -> RecordingError:
        return RecordingError(
            f"checkpoint {self.reference}: its content is not here ({self.path}: {error.strerror}); pull the "
            "run, or restore it from its archive."
        )

    def _changed(self) -> RecordingError:
        return RecordingError(f"checkpoint {self.reference}: {self.path} was changed: its digest differs.")

    def read(self) -> bytes:
        """Return its content, after comparing its digest.

        Raises:
            RecordingError: it is not here, was changed, or is too large for memory.
        """
        if self.size > MAX_LOADED:
            raise RecordingError(
                f"checkpoint {self.reference}: has {self.size:,} bytes, too many for memory."
            )
        try:
            with open_regular(self.path) as stream:
                # Reserves no more memory than the file has bytes, whatever the recording claims.
                data = stream.read(min(self.size, os.fstat(stream.fileno()).st_size) + 1)
        except OSError as error:
            raise self._missing(error) from error
        if len(data) != self.size or blake3(data).hexdigest() != self.digest:
            raise self._changed()
        return data

    def load(self, trust: bool = False) -> Any:
        """Return its content: arrays by name of safetensors, the object of a pickle, else bytes.

        Args:
            trust: unpickle a pickle, which can run any program: only one of your own.

        Raises:
            RecordingError: it is not here, or was changed.
            RunnerError: it is a pickle, and `trust` is not set.
        """
        if self.format == "safetensors":
            return arrays_in(self.read(), f"checkpoint {self.reference}")
        if self.format != "pickle":
            return self.read()
        if not trust:
            raise RunnerError(
                f"checkpoint {self.reference}: is a pickle, which can run any program when it is loaded; if "
                "it is from you, load it with trust=True, or --trust."
            )
        import pickle

        return pickle.loads(self.read())

    def as_json(self) -> Json:
        """Return it as JSON can hold it."""
        keys = ("name", "phase", "step", "episode", "format", "size", "digest")
        return {key: getattr(self, key) for key in keys} | {"here": self.is_here, "path": str(self.path)}


def is_checkpoint_name(name: object) -> bool:
    """Return whether a checkpoint may have this name: printable text without `@`."""
    is_text = isinstance(name, str) and name.isprintable() and "@" not in name
    return is_text and 0 < len(str(name)) <= MAX_NAME_LENGTH


def read_checkpoints(recording: Recording, recordings: Path) -> list[Checkpoint]:
    """Return the checkpoints in a recording, in order; their contents are in a recordings folder's store.

    Raises:
        RecordingError: one is invalid.
    """
    from runner.recording import schema

    if schema.CHECKPOINT_TOPIC not in recording.topics:
        return []
    store = Store(recordings)
    checkpoints: list[Checkpoint] = []
    for fields in recording.table(schema.CHECKPOINT_TOPIC).decoded(_MAX_MESSAGE):
        if not (
            DIGEST.fullmatch(fields["digest"])
            and is_checkpoint_name(fields["name"])
            and min(fields["size"], fields["step"], fields["episode"]) >= 0
            and fields["phase"] in schema.PHASES
            and fields["format"] in FORMATS
        ):
            raise RecordingError(f"{recording.path}: found an invalid checkpoint at {fields['log_time']} ns.")
        if len(checkpoints) == MAX_CHECKPOINTS:
            raise RecordingError(f"{recording.path}: has more than {MAX_CHECKPOINTS:,} checkpoints.")
        values = {key: value for key, value in fields.items() if key != "log_time"}
        checkpoints.append(Checkpoint(**values, path=store.path(fields["digest"])))
    return checkpoints


def find_checkpoint(every: Sequence[Checkpoint], reference: str, where: str) -> Checkpoint:
    """Return the checkpoint that a text names.

    `@STEP` is the last one at or before a step, `NAME@STEP` the last one of a name; without a step, the last.
    Steps are those of training, unless all checkpoints are of the evaluation phase.

    Raises:
        RunNotFound: there is none.
    """
    name, at, step = reference.rpartition("@") if "@" in reference else (reference, "", "")
    if at and step != "latest" and not (step.isdecimal() and len(step) < 19):
        raise RunNotFound(
            f"checkpoint {reference!r}: found the step {step!r}, expected a number: {name}@20000."
        )
    candidates = [checkpoint for checkpoint in every if checkpoint.phase == "train"] or every
    candidates = [checkpoint for checkpoint in candidates if not name or checkpoint.name == name]
    if step and step != "latest":
        candidates = [checkpoint for checkpoint in candidates if checkpoint.step <= int(step)]
    if candidates:
        return candidates[-1]
    if not every:
        raise RunNotFound(f"{where} has no checkpoints; a loop records one by rec.checkpoint(name, value).")
    available = ", ".join(checkpoint.reference for checkpoint in every[:20])
    raise RunNotFound(f"{where} has no checkpoint {reference!r}; it has: {available}.")


def arrays_in(data: bytes, where: str) -> dict[str, Array]:
    """Return the arrays in a safetensors file, by name; those of bfloat16 become float32, exactly.

    Raises:
        RecordingError: it is not such a file, or has a dtype that NumPy lacks; `where` is named.
    """
    import numpy as np

    safetensors = require("safetensors", extra="safetensors", purpose="reading a safetensors file")
    try:
        entries = safetensors.deserialize(data)
    except (safetensors.SafetensorError, ValueError) as error:
        raise RecordingError(f"{where}: found no safetensors file ({error}).") from error
    arrays = {}
    for name, entry in entries:
        if entry["dtype"] not in _DTYPES:
            raise RecordingError(f"{where}: {name}: found the dtype {entry['dtype']}, which NumPy lacks.")
        values = np.frombuffer(entry["data"], _DTYPES[entry["dtype"]]).reshape(entry["shape"])
        arrays[name] = (values.astype("<u4") << 16).view("<f4") if entry["dtype"] == "BF16" else values
    return arrays
