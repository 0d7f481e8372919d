"""What a loop records besides its steps: logged values, arrays, infos, pictures; and its last results."""

from __future__ import annotations

import json
import math
import os
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np

from runner.drawing.raster import image_bytes
from runner.environments.mdp import Mdp
from runner.errors import ConfigError, RecordingError, shortened
from runner.loops.media import Picture, media_of
from runner.loops.options import ALL_INFO, Options, pillow
from runner.loops.step_buffer import StepBuffer
from runner.loops.values import numbers_of
from runner.recording import schema
from runner.recording.gym_values import only_number
from runner.recording.messages import encode, encode_image, encode_log, frame_id, scalar_encoder
from runner.recording.metrics import METRICS, RECENT_EPISODES, defined_metrics, finite_mean
from runner.recording.recorder import Recorder
from runner.recording.schema import STEP_NANOSECONDS, Topic, topics_of
from runner.runs.checkpoints import MAX_CHECKPOINTS, MAX_NAME_LENGTH, Store, is_checkpoint_name
from runner.util.arrays import Array, Floats, Records
from runner.util.extras import require
from runner.util.jsonable import as_json, as_mapping, exact_json, is_exact, is_packed, packed
from runner.util.packing import MAX_CHUNK_BYTES
from runner.util.values import Json, flatten, is_utf8

ScalarEncoder = Callable[[float, int, int], bytes]
"""Returns the message for a logged number, the step and the episode."""
MAX_ARRAY_BYTES: Final = MAX_CHUNK_BYTES - (1 << 16)
MAX_INFO_BYTES: Final = 4 << 20
"""The most bytes of JSON for the info of one step."""
_MAX_WAITING: Final = 1024
"""Logged numbers that wait for the recorder; it gets them twice a second at the latest."""
_MAX_SERIES: Final = 4096
"""The most names of logged numbers with encoders at hand."""
_LONG_NAME: Final = 200
"""Numbers under longer names do not wait, because together they would be large."""
_MAX_KEYS: Final = 1 << 20
"""The most arrays in a checkpoint."""
_MAX_SUMMARY_NAMES: Final = 64
"""The most names with their last logged value in a summary."""
_MAX_SUMMARY_TRIALS: Final = 1 << 17
"""The most trials of an evaluation that are in a summary, the last ones."""


class LoopState(Protocol):
    """The loop that messages belong to."""

    lock: threading.RLock
    is_foreign: bool
    """Whether this process was forked from the recording process."""

    @property
    def position(self) -> int:
        """The number of steps executed so far; raises `RunnerError` if the loop is closed."""

    def rows(self, phase: str) -> StepBuffer:
        """Return the steps of a phase; raises `ConfigError` if there is no such phase."""

    def records(self) -> bool:
        """Return whether this process records, and warn if it was forked from the recording process."""

    def warn_once(self, message: str) -> None:
        """Warn the user of something once."""


class Messages:
    """Records the messages of a loop; its methods may be called from any thread."""

    def __init__(
        self,
        loop: LoopState,
        recorder: Recorder,
        outcomes: Outcomes,
        options: Options,
        run_folder: Path,
    ) -> None:
        self._run_folder = run_folder
        self._loop = loop
        self._recorder = recorder
        self._outcomes = outcomes
        self._options = options
        self.has_logged = False
        """Whether anything was logged."""
        self._series: dict[tuple[str, str], tuple[StepBuffer, ScalarEncoder]] = {}
        """The rows and the encoder of numbers, by phase and name."""
        self._numbers: list[tuple[int, str, float, ScalarEncoder, int, int]] = []
        """Position, name, value, encoder, step and episode of numbers that the recorder does not have yet."""

    def log(self, phase: str, name: str, value: object) -> None:
        """Record a number, a text, an array, a picture or a histogram under a name, at this moment."""
        series = self._series.get((phase, name))
        if value.__class__ is not float or series is None:
            if isinstance(value, str):
                self._log_text(name, value)
                return
            if not isinstance(value, int | float) and (content := media_of(value)) is not None:
                if isinstance(content, Picture):
                    self.picture(name, content)
                else:
                    _check_log_name(name, value)
                    self.snapshot(phase, name, content)
                return
            value = _logged_number(name, value)
            if series is None:
                _check_log_name(name, value)
                self.has_logged = True
                if len(self._series) == _MAX_SERIES:  # a loop with names without end
                    self._series.clear()
                series = self._loop.rows(phase), scalar_encoder(name, phase)
                self._series[phase, name] = series
        loop = self._loop
        with loop.lock:
            if loop.is_foreign and not loop.records():
                return
            rows, encode_number = series
            self._numbers.append((loop.position, name, value, encode_number, *rows.progress))
            if len(self._numbers) == _MAX_WAITING or len(name) > _LONG_NAME:
                self.commit()

    def commit(self) -> None:
        """Hand logged numbers to the recorder. The caller holds the lock."""
        numbers, self._numbers = self._numbers, []
        if numbers:
            payloads = [encode_number(value, *at) for _, _, value, encode_number, *at in numbers]
            self._recorder.extend(schema.SCALAR_TOPIC, payloads, [position for position, *_ in numbers])
            for name, value in {name: value for _, name, value, *_ in numbers}.items():
                self._outcomes.take_logged(name, value)

    def _log_text(self, name: str, text: str) -> None:
        _check_log_name(name, text)
        if not is_utf8(text):
            raise ConfigError(f"log: found {text!r} for {name!r}, expected text that is valid Unicode")
        if len(text) > MAX_ARRAY_BYTES // 4:
            raise ConfigError(
                f"log: found a text of {len(text):,} characters for {name!r}, "
                f"expected at most {MAX_ARRAY_BYTES // 4:,}"
            )
        with self._loop.lock:
            if self._loop.records():
                position = self._loop.position
                payload = encode_log(text, position * STEP_NANOSECONDS / 1e9, name=name)
                self._recorder.append(schema.LOG_TOPIC, payload, position)
                self.has_logged = True

    def snapshot(self, phase: str, name: str, array: object) -> None:
        """Record an array of numbers, or all arrays of a mapping, as they are now."""
        arrays = dict(_arrays_of(name, array))
        with self._loop.lock:
            if not self._loop.records():
                return
            position = self._loop.position
            step, episode = self._loop.rows(phase).progress
            for own_name, values in arrays.items():
                fields = {"name": own_name, "phase": phase, "step": step, "episode": episode}
                fields |= {"shape": list(values.shape), "dtype": values.dtype.str, "data": values.tobytes()}
                self._recorder.append(schema.ARRAY_TOPIC, encode(schema.ARRAY, fields), position)
                self.has_logged = True

    def checkpoint(self, phase: str, name: str, value: object, pickle: bool) -> str:
        """Store a checkpoint, and record it at this moment; return its digest.

        Raises:
            ConfigError: the name or the value cannot be recorded.
        """
        with self._loop.lock:
            if not self._loop.records():
                return ""
            step, episode = self._loop.rows(phase).progress
        content, kind = checkpoint_content(name, value, pickle)
        digest, size = Store(self._run_folder.parent).put(self._run_folder.name, content)
        fields = {"name": name, "phase": phase, "step": step, "episode": episode}
        fields |= {"digest": digest, "size": size, "format": kind}
        with self._loop.lock:
            if self._recorder.counts[schema.CHECKPOINT_TOPIC.name] == MAX_CHECKPOINTS:
                raise ConfigError(f"checkpoint: found more than {MAX_CHECKPOINTS:,} in a run")
            position = self._loop.position  # other threads may have taken steps while it was stored
            self._recorder.append(schema.CHECKPOINT_TOPIC, encode(schema.CHECKPOINT, fields), position)
            self.has_logged = True
        return digest

    def info(self, phase: str, info: Mapping[str, object], is_reset: bool = False) -> None:
        """Record the chosen fields of an info, of the step or reset that was just put down.

        Where a field cannot be recorded, the reason stands.
        """
        names = self._options.info
        fields = info if ALL_INFO in names else {key: info[key] for key in names if key in info}
        if not fields:
            return
        pieces = []
        size = 0
        for key, value in fields.items():
            try:
                text = _info_text(value, MAX_INFO_BYTES - size)
            except (ValueError, RecursionError) as error:
                text = self._reason(f"info[{key!r}] is", error)
            size += len(text)
            pieces.append(f"{json.dumps(str(key))}: {text}")
        text = "{" + ", ".join(pieces) + "}"
        with self._loop.lock:
            if not self._loop.records():
                return
            step, _ = self._loop.rows(phase).progress
            message = {"step": step if is_reset else step - 1, "reset": is_reset, "json": text}
            self._recorder.append(topics_of(phase).infos, encode(schema.INFO, message), self._loop.position)

    def options_text(self, options: Mapping[str, object] | None) -> str:
        """Return the options of a reset as JSON; empty for none. The environment may change its own."""
        if options is None:
            return ""
        try:
            if not isinstance(options, Mapping):
                raise ValueError(f"found {type(options).__name__}, expected a mapping")
            text = json.dumps(exact_json(options))
            if len(text) > MAX_INFO_BYTES:
                raise ValueError(f"they take more than {MAX_INFO_BYTES:,} bytes of JSON")
        except (ValueError, RecursionError) as error:
            return self._reason("the options of a reset are", error)
        if not is_exact(text):
            self._loop.warn_once(
                f"the options of a reset cannot be recorded exactly: {shortened(text, 200)}. Where a rerun "
                "differs, they may be the reason. This warning is given once."
            )
        return text

    def _reason(self, what: str, error: Exception) -> str:
        """Warn that something is not recorded, and return the reason as JSON."""
        self._loop.warn_once(f"{what} not recorded where {error}. This warning is given once.")
        return json.dumps(f"not recorded: {error}")

    def frame(self, phase: str, image: object, is_reset: bool, environment: int | None = None) -> None:
        """Record a picture, [height, width, 3] of uint8; another thread encodes it.

        Args:
            environment: its number in a vector; None for a single environment.

        Raises:
            ConfigError: it is something else.
        """
        with self._loop.lock:
            if not self._loop.records():
                return
            pixels = np.array(image)
            if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3 or not pixels.size:
                raise ConfigError(
                    f"frames: found {pixels.dtype} of shape {list(pixels.shape)} from render(), expected "
                    "uint8 of [height, width, 3]."
                )
            kind = self._options.frame_format
            frame = frame_id(phase, environment, is_reset)
            self._submit(topics_of(phase).frames, partial(image_bytes, pixels, kind), kind, frame)

    def picture(self, name: str, picture: Picture) -> None:
        """Record a picture or a film under a name, at this moment; another thread encodes it."""
        _check_log_name(name, "a picture")
        pillow()
        with self._loop.lock:
            if self._loop.records():
                self._submit(schema.IMAGE_TOPIC, picture.encoded, picture.format, name)
                self.has_logged = True

    def _submit(self, topic: Topic, encoded: Callable[[], bytes], kind: str, name: str) -> None:
        """Have another thread encode a picture of this moment. The caller holds the lock."""
        position = self._loop.position
        self._recorder.submit(topic, lambda: encode_image(encoded(), kind, position, name), position)


def _logged_number(name: str, value: Any) -> float:
    """Return a logged number, which may stand in an array of one.

    Raises:
        ConfigError: it is not a number.
    """
    try:
        if callable(detach := getattr(value, "detach", None)):  # a tensor of PyTorch
            value = detach()
        is_array = np.size(value) == 1 and np.ndim(value)
        return float(only_number(value, name) if is_array else value)
    except (TypeError, ValueError, OverflowError, RuntimeError, RecordingError) as error:
        raise ConfigError(
            f"log: found {type(value).__name__} for {name!r}, expected a number that a float64 holds, "
            "text, an array of numbers or a picture."
        ) from error


def _check_log_name(name: object, value: object) -> None:
    """Refuse a name that a logged value cannot have.

    Raises:
        ConfigError: it is empty, or not text.
    """
    if name == "":
        raise ConfigError(f"log: found an empty name for {value!r}, expected a name that is not empty")
    if not isinstance(name, str) or not is_utf8(name):
        raise ConfigError(f"log: found the name {name!r} for {value!r}, expected text that is valid Unicode")


def _arrays_of(name: str, value: object) -> Iterator[tuple[str, Array]]:
    """Yield the arrays of a snapshot: the value itself, or the arrays of a mapping as `name/key`.

    Raises:
        ConfigError: a value holds something else than numbers, or too many.
    """
    if not isinstance(name, str) or not is_utf8(name):
        raise ConfigError(f"snapshot: found the name {name!r}, expected an array of numbers and a name.")
    if (inside := as_mapping(value)) is not None:
        for key, part in inside.items():
            yield from _arrays_of(f"{name}/{key}", part)
        return
    values = numbers_of(value, "snapshot", f"for {name!r}", "an array of numbers")
    if values.nbytes > MAX_ARRAY_BYTES:
        raise ConfigError(
            f"snapshot: found {values.nbytes:,} bytes for {name!r}, expected at most "
            f"{MAX_ARRAY_BYTES:,}; record it in parts."
        )
    yield name, values.astype(values.dtype.newbyteorder("<"), copy=False)


def _info_text(value: Any, limit: int) -> str:
    """Return a field of an info as JSON of at most `limit` bytes."""
    text = ""
    is_array = is_packed(value)
    if is_array and value.nbytes <= limit:
        array = packed(value)
        data = array.pop("base64")  # has nothing to escape, so the encoder need not look at it
        text = f'{json.dumps(array)[:-1]}, "base64": "{data}"' + "}"
    elif not is_array:
        text = json.dumps(as_json(value, packs=True))
    if not 0 < len(text) <= limit:
        raise ValueError(f"it takes more than {MAX_INFO_BYTES:,} bytes of JSON")
    return text


def checkpoint_content(name: str, value: object, pickle: bool) -> tuple[bytes | memoryview | Path, str]:
    """Return the content of a checkpoint, and its format.

    Args:
        value: bytes, the path of a file, or a mapping of arrays or tensors.

    Raises:
        ConfigError: name or value cannot be recorded.
    """
    if not is_checkpoint_name(name):
        raise ConfigError(
            f"checkpoint: found the name {str(name)[:80]!r}, expected printable text of 1 to "
            f"{MAX_NAME_LENGTH} letters without @"
        )
    if pickle:
        import pickle as pickling

        try:
            return pickling.dumps(value), "pickle"
        except Exception as error:  # whatever the object raises
            raise ConfigError(f"checkpoint: {name!r} cannot be pickled ({error})") from error
    if isinstance(value, bytes | bytearray | memoryview):
        return memoryview(value).cast("B"), "bytes"
    if isinstance(value, str | os.PathLike):
        path = Path(os.fspath(value))
        if not path.is_file():
            raise ConfigError(
                f"checkpoint: found the path {str(path)!r} for {name!r}, expected that of a file"
            )
        return path, "safetensors" if path.suffix == ".safetensors" else "file"
    if isinstance(value, Mapping):
        return _safetensors(name, flatten(value, separator="/")), "safetensors"
    raise ConfigError(
        f"checkpoint: found {type(value).__name__} for {name!r}, expected bytes, a path, or a mapping of "
        "arrays or tensors, such as model.state_dict(); pickle=True records any other object"
    )


def _safetensors(name: str, values: Mapping[str, Any]) -> bytes:
    if not 0 < len(values) <= _MAX_KEYS:
        raise ConfigError(
            f"checkpoint: found {len(values):,} arrays for {name!r}, expected at least one, and at most "
            f"{_MAX_KEYS:,}"
        )
    torch = sys.modules.get("torch")
    is_torch = torch is not None and all(isinstance(value, torch.Tensor) for value in values.values())
    module = "safetensors.torch" if is_torch else "safetensors.numpy"
    save = require(module, extra="safetensors", purpose="a checkpoint of arrays or tensors").save
    if is_torch:  # a copy of each: tensors that share memory are refused
        return bytes(save({key: value.detach().cpu().contiguous().clone() for key, value in values.items()}))
    expected = "an array of numbers; pickle=True records any object"
    arrays = {
        key: np.array(numbers_of(value, "checkpoint", f"at {key!r} of {name!r}", expected), order="C")
        for key, value in values.items()
    }
    return bytes(save(arrays))


class Outcomes:
    """Returns and lengths of the last training episodes and of the last evaluation, and logged values.

    `summary` returns what `runner.analysis.evaluations.loop_summary` computes from a whole recording.
    """

    def __init__(self, mdp: Mdp | None) -> None:
        has_success = mdp is not None and bool(mdp.success_events)
        has_penalties = mdp is not None and math.isfinite(mdp.penalty_below)
        self._defined = defined_metrics(has_success, has_penalties)
        self._trained = 0
        self._recent = np.empty((0, 2))
        """[episodes, 2]: returns and lengths of the last training episodes."""
        self._evaluated_after = -1
        self._trials = 0
        """Number of trials of the last evaluation."""
        self._values: dict[str, Floats] = {}
        """Values of those trials, summed over agents, by metric."""
        self._logged: dict[str, float | None] = {}

    def take_episodes(self, topic: Topic, records: Records) -> None:
        """Add episodes that the recorder gets."""
        if topic.phase == "train":
            self._trained += len(records)
            last = records[-RECENT_EPISODES:]
            results = np.column_stack([last["returns"].sum(axis=1), last["length"]])
            self._recent = np.concatenate([self._recent, results])[-RECENT_EPISODES:]
        else:
            if self._evaluated_after != self._trained:
                self._evaluated_after = self._trained
                self._trials = 0
                self._values = {}
            self._trials += len(records)
            for metric in self._defined:
                values = metric.of_trials(records).astype(np.float64)
                values = values.sum(axis=1) if metric.per_agent else values
                before = self._values.get(metric.name, np.empty(0))
                self._values[metric.name] = np.concatenate([before, values])[-_MAX_SUMMARY_TRIALS:]

    def take_logged(self, name: str, value: float) -> None:
        """Add a logged value."""
        if name in self._logged or len(self._logged) < _MAX_SUMMARY_NAMES:
            self._logged[name] = value if math.isfinite(value) else None

    def summary(self) -> Json:
        """Return `last_evaluation`, `recent_training` and `logged`, as JSON can hold them."""
        returns, lengths = self._recent.T
        evaluation = None
        if self._trials:
            unknown = np.empty(0)
            values = {
                metric.name: metric.of_usable(self._values.get(metric.name, unknown)) for metric in METRICS
            }
            evaluation = {"episode": self._evaluated_after, "trials": self._trials, **values}
        return {
            "last_evaluation": evaluation,
            "recent_training": {
                "episodes": len(self._recent),
                "mean_length": finite_mean(lengths),
                "mean_return": finite_mean(returns),
            },
            "logged": self._logged,
        }
