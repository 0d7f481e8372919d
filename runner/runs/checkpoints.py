"""The checkpoints of a run: an agent's parameters at a step, recorded by `rec.checkpoint`.

    run = runner.find_run("cartpole")
    for checkpoint in run.checkpoints():
        print(checkpoint.name, checkpoint.step, checkpoint.format)
    weights = run.checkpoints()[-1].load()         # name -> array, of a safetensors file

The recording has the digest; the content is in the store next to the runs.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from blake3 import blake3

from runner.errors import RecordingError, RunnerError, RunNotFound
from runner.recording import schema
from runner.recording.reader import Recording
from runner.runs.store import DIGEST, Store
from runner.util.arrays import Array
from runner.util.extras import require
from runner.util.files import hash_of, open_regular
from runner.util.values import Json

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
