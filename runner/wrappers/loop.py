"""The recording of somebody's own loop: its folder, its file, and whoever writes into it."""

from __future__ import annotations

import contextlib
import json
import os
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, Final, Generic, Protocol, TypeVar

import numpy as np
from blake3 import blake3

from runner import runs
from runner.errors import ConfigError, RecordingError, RunnerError, StorageError, kept_message
from runner.provenance import provenance
from runner.recording import schema
from runner.recording.chunks import MAX_CHUNK_BYTES, Packing
from runner.recording.facts import sizes_of
from runner.recording.messages import encode, encode_image, encode_log
from runner.recording.recorder import FLUSH_SECONDS, Recorder
from runner.recording.schema import STEP_NANOSECONDS
from runner.recording.telling import (
    Attachments,
    environment_attachments,
    run_facts,
    write_description,
    write_result,
)
from runner.recording.writer import create_recording
from runner.runs import RECORDING_FILE, Run, new_run, recordings_folder, unless_empty
from runner.service.outbox import Follower, connected, is_server, outbox_folder
from runner.wrappers.described import Described, as_json
from runner.wrappers.outcomes import Outcomes
from runner.wrappers.plan import Plan
from runner.wrappers.values import lone_number

MAX_ARRAY_BYTES: Final = MAX_CHUNK_BYTES - (1 << 16)


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

    def __init__(self, described: Described, plan: Plan, rows: Callable[[Recorder, str], R]) -> None:
        config = plan.mapping(described)
        client = connected(str(plan.recordings)) if is_server(plan.recordings) else None
        folder = outbox_folder() if client else recordings_folder(plan.recordings)
        self._started = time.monotonic()
        self._make_rows = rows
        self._rows: dict[str, R] = {}
        self.active: R | None = None
        """Whose steps came last; None before any, and when the loop is closed."""
        self.described = described
        self.plan = plan
        self.lock = threading.RLock()
        self.run = new_run(folder, config, plan.seed, config["name"])
        self._topics = {topic.name: topic for topic in schema.KINDS[described.kind]}
        path = self.run.folder / RECORDING_FILE
        with unless_empty(self.run):
            self._file = create_recording(path, schema.KINDS[described.kind])
        try:
            facts = self._describe(config)
        except BaseException as error:
            self._file.close()
            self._mark_failed(error)
            raise
        self._outcomes = Outcomes(described.mdp)
        self._recorder = Recorder(
            self._file,
            learners=len(described.agents),
            events=int(facts["events"]),
            packing=Packing(plan.compression, plan.level, plan.index),
            chunk_steps=plan.chunk_steps,
            beat=self.run.beat,
            sizes=sizes_of(facts, str(path)),
            watch=self._outcomes.take_records,
        )
        self._follower = Follower(client, self.run, lambda: self._file.size) if client else None
        self.closed = False
        self._process = os.getpid()
        self._stop = threading.Event()
        self._flusher = threading.Thread(target=self._keep_flushing, name="recording-flush", daemon=True)
        self._flusher.start()

    def _describe(self, config: Mapping[str, Any]) -> dict[str, str]:
        """Write what makes the recording self-contained; return what is said of the run."""
        described, mdp, run = self.described, self.described.mdp, self.run
        identity = {key: value for key, value in config.items() if key not in ("name", "seeds", "recording")}
        job = json.dumps(identity | {"seed": self.plan.seed}, sort_keys=True)
        facts = run_facts(
            run.run_id,
            run.name,
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
        made_by = provenance()
        write_description(self._file, facts, config, made_by, _environment(described))
        told = {key: made_by[key] for key in runs.MADE_BY if key in made_by}
        self.run = run.update(provenance=told)
        return facts

    # --- what is recorded -----------------------------------------------------------------------------

    def rows(self, phase: str) -> R:
        """Return what puts down the steps of a phase.

        Raises:
            ConfigError: there is no such phase.
        """
        if phase not in schema.PHASES:
            raise ConfigError(f"phase: found {phase!r}, expected one of {', '.join(schema.PHASES)}")
        if phase not in self._rows:
            with self.lock:
                self._rows[phase] = self._make_rows(self._recorder, phase)
        return self._rows[phase]

    def activate(self, rows: R) -> None:
        """Say whose steps come now; times go on in the order in which steps are taken. Holds the lock."""
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
        if not _is_text(name) or not name or (isinstance(value, str) and not _is_text(value)):
            raise ConfigError(
                f"log: found the name {name!r} for {value!r}, expected text that is valid Unicode"
            )
        with self.lock:
            position = self._moment()
            if isinstance(value, str):
                payload = encode_log(value, position * STEP_NANOSECONDS / 1e9, name=name)
                self._recorder.append(self._topics["/log"], payload, position)
                return
            number = _number(name, value)
            step, episode = self.rows(phase).place
            fields = {"name": name, "value": number, "phase": phase, "step": step, "episode": episode}
            self._recorder.append(self._topics["/scalar"], encode(schema.SCALAR, fields), position)
            self._outcomes.take_logged(name, number)

    def snapshot(self, phase: str, name: str, array: Any) -> None:
        """Record an array of numbers as it is now.

        Raises:
            ConfigError: it holds something else, or is too large.
        """
        try:
            values = np.asarray(array, order="C")
        except (TypeError, ValueError) as error:
            raise ConfigError(f"snapshot: found no array of numbers for {name!r} ({error})") from error
        if values.dtype.kind not in "biuf" or values.dtype.itemsize > 8 or not _is_text(name):
            raise ConfigError(
                f"snapshot: found {values.dtype} for {name!r}, expected an array of numbers and a name."
            )
        if values.nbytes > MAX_ARRAY_BYTES:
            raise ConfigError(
                f"snapshot: found {values.nbytes:,} bytes for {name!r}, expected at most "
                f"{MAX_ARRAY_BYTES:,}; record it in parts."
            )
        values = values.astype(values.dtype.newbyteorder("<"), copy=False)
        with self.lock:
            position = self._moment()
            step, episode = self.rows(phase).place
            fields = {"name": name, "phase": phase, "step": step, "episode": episode}
            fields |= {"shape": list(values.shape), "dtype": values.dtype.str, "data": values.tobytes()}
            self._recorder.append(self._topics["/array"], encode(schema.ARRAY, fields), position)

    def info(
        self,
        phase: str,
        info: Mapping[str, Any],
        reset: bool = False,
        beside: Mapping[str, Any] | None = None,
    ) -> None:
        """Record the chosen fields of an info, those that it has, of the step or reset just put down."""
        chosen = {key: as_json(info[key]) for key in self.plan.info if key in info}
        if not chosen and not beside:
            return
        said = {"info": chosen} | ({"reset": as_json(beside)} if beside else {})
        with self.lock:
            step, _ = self.rows(phase).place
            fields = {"step": step if reset else step - 1, "reset": reset, "json": json.dumps(said)}
            topic = self._topics[f"/{phase}/info"]
            self._recorder.append(topic, encode(schema.INFO, fields), self._moment())

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
        from runner.wrappers.frames import image_bytes

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

    def _moment(self) -> int:
        """Return the number of steps executed so far, of a loop that is not closed."""
        if self.closed:
            raise RunnerError(f"run {self.run.run_id} is closed: nothing more can be recorded in it.")
        return self.position

    # --- the end --------------------------------------------------------------------------------------

    def close(self, status: str = "finished", error: str = "") -> Run:
        """Write everything, and say how it ended; return the run as it then is. The second time, only that.

        A process that was forked from the one that records only returns the run: the file is not its own.

        Raises:
            StorageError: the disk is full or failing; what was written is kept.
        """
        if os.getpid() != self._process:
            return self.run
        self._stop.set()
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
        for rows in self._rows.values():
            rows.commit()
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

    def _keep_flushing(self) -> None:
        """Put on its way what is half a second old, also while the loop does something else."""
        while not self._stop.wait(FLUSH_SECONDS):
            with self.lock:
                if self.closed:
                    return
                try:
                    self._flush()
                except BaseException:  # the loop's own thread meets it again, with its next step
                    return

    def _flush(self) -> None:
        for rows in self._rows.values():
            rows.commit()
        self._recorder.flush()
        for rows in self._rows.values():
            rows.open()


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
        return lone_number(value, name) if np.size(value) == 1 and np.ndim(value) else float(value)
    except (TypeError, ValueError, OverflowError, RecordingError) as error:
        raise ConfigError(
            f"log: found {type(value).__name__} for {name!r}, expected a number that a float64 holds, or "
            "text; an array is recorded by snapshot()."
        ) from error


def _is_text(value: Any) -> bool:
    """Return whether a value is text that UTF-8 can hold: without lone surrogates."""
    return isinstance(value, str) and value == value.encode("utf-8", "ignore").decode()
