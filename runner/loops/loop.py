"""The recording of a user's own loop: its folder, its file, and everything that is written into it."""

from __future__ import annotations

import contextlib
import json
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, Generic, Protocol, TypeVar

import numpy as np
from blake3 import blake3
from numpy.typing import NDArray

from runner.client.outbox import Follower, connect, is_server, outbox_folder
from runner.errors import ConfigError, RecordingError, RunnerError, StorageError, kept_message
from runner.loops import flushing
from runner.loops.options import ALL_INFO, Plan
from runner.loops.outcomes import Outcomes
from runner.loops.spaces import Described, as_json, as_mapping, can_widen, widened
from runner.loops.values import lone_number, warn_user
from runner.recording import schema
from runner.recording.chunks import MAX_CHUNK_BYTES
from runner.recording.messages import encode, encode_image, encode_log, scalar_encoder
from runner.recording.metadata import (
    Attachments,
    environment_attachments,
    run_metadata,
    sizes_of,
    write_description,
    write_result,
)
from runner.recording.recorder import FLUSH_SECONDS, Recorder
from runner.recording.schema import STEP_NANOSECONDS
from runner.recording.writer import create_recording
from runner.runs import run as runs
from runner.runs.provenance import provenance
from runner.runs.run import RECORDING_FILE, Run, new_run, recordings_folder, unless_empty
from runner.util.values import is_utf8

MAX_ARRAY_BYTES: Final = MAX_CHUNK_BYTES - (1 << 16)
MAX_INFO_BYTES: Final = 1 << 20
"""Bytes of JSON that the info of one step may take."""
_MOST_NUMBERS: Final = 1024
"""Logged numbers that wait for the recorder; they are handed over twice a second at the latest."""
_LONG_NAME: Final = 200
"""Numbers under longer names do not wait, because together they would be large."""
_UNDECIDED_SECONDS: Final = 5.0
"""The dtype of actions is left open so long while no step is taken; then it is that of their space."""


class Putting(Protocol):
    """What puts down the steps of one phase."""

    @property
    def filled(self) -> int:
        """Steps that the recorder has not taken yet."""

    @property
    def place(self) -> tuple[int, int]:
        """The steps of the phase so far, and the number of the episode that began last."""

    @property
    def off_table(self) -> int:
        """Steps so far whose reward the environment's table excludes; 0 without a table."""

    def open(self) -> None:
        """Take blocks from the recorder."""

    def commit(self) -> None:
        """Hand all steps to the recorder."""

    def reshape(self, described: Described) -> None:
        """Prepare for actions of another dtype; no step was put down yet."""


@dataclass(frozen=True)
class _Series:
    """The numbers that are logged under one name in one phase."""

    name: str
    rows: Putting
    encode: Callable[[float, int, int], bytes]
    """Returns the message for a value, step and episode."""


class Ignored:
    """Takes the steps of a forked process, and does nothing with them."""

    filled = 0
    place = (0, 0)

    def ignore(self, *_: object) -> None:
        """Do nothing."""

    open = commit = reshape = take = reset = ignore


class View(Protocol):
    """What a user holds of a loop: it is told when the process turns out to be a forked one."""

    def _detach(self) -> None: ...


R = TypeVar("R", bound=Putting)


class Loop(Generic[R]):
    """A loop that is being recorded; safe to use from several threads.

    Args:
        described: the environment and its spaces.
        plan: how to record it.
        rows: makes what puts down the steps of a phase, from recorder and phase.

    Raises:
        ConfigError: the plan cannot be used.
        StorageError: the recordings folder cannot be written.
    """

    def __init__(
        self,
        described: Described,
        plan: Plan,
        rows: Callable[[Recorder, Described, str, Callable[[Any], None]], R],
    ) -> None:
        self._config = plan.mapping(described)
        client = connect(str(plan.recordings)) if is_server(plan.recordings) else None
        folder = outbox_folder() if client else recordings_folder(plan.recordings)
        self._started = time.monotonic()
        self._make_rows = rows
        self._rows: dict[str, R] = {}
        self.active: R | None = None
        """Whose steps came last; None before any, and when the loop is closed."""
        self.described = described
        self.plan = plan
        self.lock = threading.RLock()
        self.closed = False
        self.is_foreign = False
        """Whether this process was forked from the one that records."""
        self.views: weakref.WeakSet[Any] = weakref.WeakSet()
        self._has_warned: set[str] = set()
        self._is_described = False
        self._is_settled = not can_widen(described.action)
        self._has_logged = False
        self._series: dict[tuple[str, str], _Series] = {}
        self._numbers: list[tuple[_Series, float, int, int, int]] = []
        """Logged numbers that the recorder has not taken yet: series, value, position, step, episode."""
        self._topics = {topic.name: topic for topic in schema.KINDS[described.kind]}
        made_by = provenance()
        known = {key: made_by[key] for key in runs.MADE_BY if key in made_by}
        self._made_by = made_by
        self.run = new_run(folder, self._config, plan.seed, self._config["name"], provenance=known)
        path = self.run.folder / RECORDING_FILE
        with unless_empty(self.run):
            self._file = create_recording(path, schema.KINDS[described.kind])
        self._said = facts = self._facts()
        """What the recording says of the run."""
        self._outcomes = Outcomes(described.mdp)
        self._recorder = Recorder(
            self._file,
            learners=len(described.agents),
            events=int(facts["events"]),
            packing=plan.packing.packing,
            beat=self.run.beat,
            sizes=sizes_of(facts, str(path)),
            watch=self._outcomes.take_records,
            before=self._describe,
        )
        if self._is_settled:
            try:
                self._describe()
            except BaseException as error:
                self._file.close()
                self._mark_failed(error)
                raise
        self._follower = Follower(client, self.run, lambda: self._file.size) if client else None
        flushing.watch(self)

    def _facts(self) -> dict[str, str]:
        """Return what the recording says of the run."""
        described, mdp, run = self.described, self.described.mdp, self.run
        left_out = ("name", "seeds", "recording")
        identity = {key: value for key, value in self._config.items() if key not in left_out}
        job = json.dumps(identity | {"seed": self.plan.seed}, sort_keys=True)
        return run_metadata(
            run.run_id,
            str(run.facts["name"]),
            self.plan.seed,
            job=blake3(job.encode()).hexdigest()[:32],
            created=run.created_text,
            agents=described.agents,
            events=len(mdp.event_names) if mdp else 0,
        ) | {
            "kind": described.kind,
            "spaces": json.dumps(described.spaces()),
            "environments": str(described.environments),
        }

    def _describe(self) -> None:
        """Write what makes the recording self-contained, once; from then on dtypes are fixed."""
        if not self._is_described:
            self._is_described = self._is_settled = True
            write_description(
                self._file, self._said, self._config, self._made_by, _environment(self.described)
            )

    def _first_action(self, action: Any) -> None:
        """Record all actions in the dtype of the first one, if the space's own cannot hold it exactly."""
        if self._is_settled:
            return
        self._is_settled = True
        wide = widened(self.described.action, action)
        if wide is self.described.action:
            return
        self.described = replace(self.described, wide_action=wide)
        self._said = self._facts()
        self._recorder.resize(sizes_of(self._said, str(self.run.recording)))
        for rows in self._rows.values():
            rows.reshape(self.described)

    # --- what is recorded -----------------------------------------------------------------------------

    def rows(self, phase: str) -> R:
        """Return what puts down the steps of a phase.

        Raises:
            ConfigError: there is no such phase.
        """
        if phase not in schema.PHASES:
            raise ConfigError(f"phase: found {phase!r}, expected one of {', '.join(schema.PHASES)}")
        with self.lock:
            if phase not in self._rows:
                self._rows[phase] = self._make_rows(self._recorder, self.described, phase, self._first_action)
            return self._rows[phase]

    def activate(self, rows: R) -> None:
        """Make these the rows whose steps come now. The caller holds the lock."""
        if self.is_foreign:
            self._warn_of_fork()
            return
        if self.closed:
            raise RunnerError(
                f"run {self.run.run_id} is closed: steps can no longer be recorded in it. "
                "Wrap the environment anew to go on."
            )
        if self.active is not None and self.active is not rows:
            self.active.commit()
            self.active.open()
        self.active = rows

    @property
    def position(self) -> int:
        """The number of steps executed so far."""
        return sum(self._recorder.steps.values()) + (self.active.filled if self.active else 0)

    def log(self, phase: str, name: str, value: Any) -> None:
        """Record a number or a text under a name, at this moment.

        Raises:
            ConfigError: it is neither, or the name is none.
        """
        series = self._series.get((phase, name))
        if value.__class__ is not float or series is None:
            if isinstance(value, str):
                self._log_text(name, value)
                return
            value = _number(name, value)
            series = series or self._new_series(phase, name, value)
        with self.lock:
            if self.is_foreign:
                self._warn_of_fork()
                return
            position = self._moment()
            step, episode = series.rows.place
            self._numbers.append((series, value, position, step, episode))
            if len(self._numbers) == _MOST_NUMBERS or len(name) > _LONG_NAME:
                self._commit_numbers()

    def _new_series(self, phase: str, name: str, value: Any) -> _Series:
        _check_name(name, value)
        self._has_logged = True
        series = self._series[phase, name] = _Series(name, self.rows(phase), scalar_encoder(name, phase))
        return series

    def _commit_numbers(self) -> None:
        """Hand the logged numbers to the recorder."""
        numbers, self._numbers = self._numbers, []
        payloads = [series.encode(value, step, episode) for series, value, _, step, episode in numbers]
        self._recorder.extend(schema.SCALAR_TOPIC, payloads, [position for _, _, position, _, _ in numbers])
        for series, value, _, _, _ in numbers:
            self._outcomes.take_logged(series.name, value)

    def _log_text(self, name: str, text: str) -> None:
        _check_name(name, text)
        if not isinstance(text, str) or not is_utf8(text):
            raise ConfigError(f"log: found {text!r} for {name!r}, expected text that is valid Unicode")
        if len(text) > MAX_ARRAY_BYTES // 4:
            raise ConfigError(
                f"log: found a text of {len(text):,} characters for {name!r}, "
                f"expected at most {MAX_ARRAY_BYTES // 4:,}"
            )
        with self._recording() as is_recorded:
            if is_recorded:
                position = self._moment()
                payload = encode_log(text, position * STEP_NANOSECONDS / 1e9, name=name)
                self._recorder.append(schema.LOG_TOPIC, payload, position)
                self._has_logged = True

    def snapshot(self, phase: str, name: str, array: Any) -> None:
        """Record an array of numbers, or all arrays of a mapping, as they are now.

        Raises:
            ConfigError: it holds something else, or is too large; nothing is recorded then.
        """
        arrays = dict(_arrays(name, array))
        with self._recording() as is_recorded:
            if not is_recorded:
                return
            position = self._moment()
            step, episode = self.rows(phase).place
            for own_name, values in arrays.items():
                fields = {"name": own_name, "phase": phase, "step": step, "episode": episode}
                fields |= {"shape": list(values.shape), "dtype": values.dtype.str, "data": values.tobytes()}
                self._recorder.append(schema.ARRAY_TOPIC, encode(schema.ARRAY, fields), position)
                self._has_logged = True

    def info(
        self,
        phase: str,
        info: Mapping[str, Any],
        reset: bool = False,
        beside: Mapping[str, Any] | None = None,
    ) -> None:
        """Record the chosen fields of an info, those that it has, of the step or reset just put down."""
        names = self.plan.info
        chosen = info if ALL_INFO in names else {key: info[key] for key in names if key in info}
        if not chosen and not beside:
            return
        text = '{"info": ' + self._json_of("info", chosen)
        text += ', "reset": ' + self._json_of("reset", beside) + "}" if beside else "}"
        with self._recording() as is_recorded:
            if not is_recorded:
                return
            step, _ = self.rows(phase).place
            fields = {"step": step if reset else step - 1, "reset": reset, "json": text}
            topic = self._topics[f"/{phase}/info"]
            self._recorder.append(topic, encode(schema.INFO, fields), self._moment())

    def _json_of(self, what: str, fields: Mapping[str, Any]) -> str:
        """Return fields as a JSON object; say in place of a field that it could not be recorded."""
        pieces, size = [], 0
        for key, value in fields.items():
            try:
                text = json.dumps(as_json(value))
                if size + len(text) > MAX_INFO_BYTES:
                    raise ValueError(f"{what} takes more than {MAX_INFO_BYTES:,} bytes of JSON")
            except (ValueError, RecursionError) as error:
                text = json.dumps(f"not recorded: {error}")
                self._warn_once(f"{what}[{key!r}] is not recorded where {error}. This is warned of once.")
            size += len(text)
            pieces.append(f"{json.dumps(str(key))}: {text}")
        return "{" + ", ".join(pieces) + "}"

    def reset_info(
        self, phase: str, info: Mapping[str, Any], options: Mapping[str, Any] | None, seed: Any
    ) -> None:
        """Record the chosen fields of a reset's info; its options, and a seed too large for `Reset`."""
        beside = {"options": options} if options else {}
        if isinstance(seed, int) and seed >= 2**64:
            beside["seed"] = {"value": str(seed)}
        if beside or self.plan.info:
            self.info(phase, info, reset=True, beside=beside)

    def frame(self, phase: str, image: Any) -> None:
        """Record a picture, [height, width, 3] of uint8; it is encoded by another thread.

        Raises:
            ConfigError: it is something else.
        """
        from runner.loops.frames import image_bytes

        if self.is_foreign:
            return
        pixels = np.array(image)
        if pixels.dtype != np.uint8 or pixels.ndim != 3 or pixels.shape[2] != 3:
            raise ConfigError(
                f"frames: found {pixels.dtype} of shape {list(pixels.shape)} from render(), expected uint8 "
                "of [height, width, 3]."
            )
        kind = self.plan.frame_format
        with self.lock:
            position = self._moment()

            def make() -> bytes:
                return encode_image(image_bytes(pixels, kind), kind, position, phase)

            self._recorder.submit(self._topics[f"/{phase}/frame"], make, position)

    @contextlib.contextmanager
    def _recording(self) -> Iterator[bool]:
        """Hold the lock; yield whether this process records: one that was forked does not."""
        with self.lock:
            if self.is_foreign:
                self._warn_of_fork()
            yield not self.is_foreign

    def _warn_of_fork(self) -> None:
        self._warn_once(
            f"run {self.run.run_id} is recorded by the process that this one was forked from: what is done "
            "here is not recorded. To record it, wrap the environment in this process."
        )

    def _warn_once(self, message: str) -> None:
        if message not in self._has_warned:
            self._has_warned.add(message)
            warn_user(message)

    def _moment(self) -> int:
        """Return the number of steps executed so far, of a loop that is not closed."""
        if self.closed:
            raise RunnerError(f"run {self.run.run_id} is closed: nothing more can be recorded in it.")
        return self.position

    # --- the end --------------------------------------------------------------------------------------

    def close(self, status: str = "finished", error: str = "") -> Run:
        """Write everything, and say how it ended; return the run as it then is. The second time, only that.

        A forked process only returns the run: the recording belongs to the process it was forked from.

        Raises:
            StorageError: the disk is full or failing; what was written is kept.
        """
        if self.is_foreign:
            return self.run
        with self.lock:
            if self.closed:
                return self.run
            try:
                summary = self._finish(status, error)
            except BaseException as failure:
                self._recorder.abandon()
                with contextlib.suppress(StorageError):
                    write_result(self._file, "failed", {"error": kept_message(failure)})
                self._mark_failed(failure)
                if self._follower:
                    self._follower.stop()
                raise
            finally:
                self.closed, self.active = True, None
                self._rows.clear()
                self._file.close()
            self.run = self.run.update(status=status, summary=summary)
        if self._follower:
            self._follower.finish(self.run)
        return self.run

    def _mark_failed(self, error: BaseException) -> None:
        with contextlib.suppress(StorageError):
            self.run = self.run.update(status="failed", summary={"error": kept_message(error)})

    def _off_table(self) -> dict[str, int]:
        """Return how many rewards the environment's table excludes, if it has a table."""
        if self.described.mdp is None:
            return {}
        return {"rewards_off_table": sum(rows.off_table for rows in self._rows.values())}

    def _finish(self, status: str, error: str) -> dict[str, Any]:
        self._commit()
        topics = self._recorder.drain()
        result = (
            self._recorder.totals(topics)
            | {
                "episodes": self._recorder.counts["/train/episode"],
                "steps_recorded": True,
            }
            | self._outcomes.summary()
            | self._off_table()
            | ({"error": kept_message(error)} if error else {})
        )
        write_result(self._file, status, result)
        seconds = round(time.monotonic() - self._started, 3)
        return result | {"seconds": seconds, "bytes": self._file.size}

    def _commit(self) -> None:
        """Hand everything to the recorder."""
        for rows in self._rows.values():
            rows.commit()
        if self._numbers:
            self._commit_numbers()

    def flush(self) -> bool:
        """Write what is half a second old, also while the loop does something else; called by a thread.

        Returns whether to call it again.
        """
        if not self.lock.acquire(timeout=0.1):
            return True
        try:
            if self.closed or self.is_foreign:
                return False
            if time.monotonic() - self._started < FLUSH_SECONDS:
                return True
            if self._is_undecided():
                self.run.beat()
                return True
            self._commit()
            self._recorder.flush()
            self._recorder.release()
            for rows in self._rows.values():
                rows.open()
        except BaseException:  # raised again in the loop's own thread, with its next step
            return False
        finally:
            self.lock.release()
        return True

    def _is_undecided(self) -> bool:
        """Return whether to wait for the first action, whose dtype the description states."""
        is_early = time.monotonic() - self._started < _UNDECIDED_SECONDS
        return not self._is_settled and not self._has_logged and is_early

    def disown(self) -> None:
        """Leave the recording to the process that this one was just forked from."""
        self.is_foreign, self.active = True, None
        self.lock = threading.RLock()  # a thread that is not here may have held the other one
        ignored: Any = Ignored()
        self._rows = dict.fromkeys(schema.PHASES, ignored)
        for view in list(self.views):
            view._detach()


def _environment(described: Described) -> Attachments:
    """Return the attachments that tell of an environment, with its arrays if it is tabular."""
    if described.mdp is not None:
        return environment_attachments(described.mdp.description(), described.mdp.arrays())
    said = {
        "env_id": described.env_id,
        "kwargs": described.kwargs,
        "step_limit": described.step_limit,
        "agents": list(described.agents),
        "action_counts": [],
        "event_names": [],
        "success_events": [],
        "penalty_below": None,
        "scene": None,
    }
    return environment_attachments(said, {})


def _number(name: str, value: Any) -> float:
    """Return a number that is logged, which may stand in an array of one.

    Raises:
        ConfigError: it is none.
    """
    try:
        if callable(detach := getattr(value, "detach", None)):  # a tensor of PyTorch's
            value = detach()
        return lone_number(value, name) if np.size(value) == 1 and np.ndim(value) else float(value)
    except (TypeError, ValueError, OverflowError, RuntimeError, RecordingError) as error:
        raise ConfigError(
            f"log: found {type(value).__name__} for {name!r}, expected a number that a float64 holds, or "
            "text; an array is recorded by snapshot()."
        ) from error


def _check_name(name: Any, value: Any) -> None:
    if not isinstance(name, str) or not is_utf8(name) or not name:
        raise ConfigError(f"log: found the name {name!r} for {value!r}, expected text that is valid Unicode")


def _arrays(name: str, value: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the arrays to record for a value: the value itself, or those of a mapping by `name/key`.

    Raises:
        ConfigError: there is something else than numbers, or too many.
    """
    if not isinstance(name, str) or not is_utf8(name):
        raise ConfigError(f"snapshot: found the name {name!r}, expected an array of numbers and a name.")
    if (inside := as_mapping(value)) is not None:
        for key, part in inside.items():
            yield from _arrays(f"{name}/{key}", part)
        return
    try:
        values = _as_array(value)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ConfigError(f"snapshot: found no array of numbers for {name!r} ({error})") from error
    if values.dtype.kind not in "biuf" or values.dtype.itemsize > 8:
        raise ConfigError(
            f"snapshot: found {values.dtype} for {name!r}, expected an array of numbers and a name."
        )
    if values.nbytes > MAX_ARRAY_BYTES:
        raise ConfigError(
            f"snapshot: found {values.nbytes:,} bytes for {name!r}, expected at most "
            f"{MAX_ARRAY_BYTES:,}; record it in parts."
        )
    yield name, values.astype(values.dtype.newbyteorder("<"), copy=False)


def _as_array(value: Any) -> NDArray[Any]:
    """Return an array or tensor as NumPy's; the short floats that NumPy lacks become float32, exactly."""
    if callable(detach := getattr(value, "detach", None)):
        value = detach().cpu()
        if "bfloat16" in str(value.dtype) or "float8" in str(value.dtype):
            value = value.float()
    values = np.asarray(value, order="C")
    if values.dtype.name.startswith(("bfloat16", "float8")):
        return values.astype(np.float32)
    return values
