"""The recording of a user's own loop: its folder, its file, its threads and its end."""

from __future__ import annotations

import contextlib
import json
import os
import threading
import time
import weakref
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

import numpy as np
from blake3 import blake3
from numpy.typing import NDArray

from runner.client.outbox import Follower, connect, is_server, outbox_folder
from runner.config.job import NOT_CONTENT
from runner.errors import ConfigError, RunnerError, StorageError, truncated_message
from runner.loops.description import Described
from runner.loops.extras import Extras
from runner.loops.folding import OWNER_WAITS, fold_if_over
from runner.loops.messages import Messages
from runner.loops.options import Options
from runner.loops.outcomes import Outcomes
from runner.loops.rows import PhaseRows
from runner.loops.values import check_phase, warn_user
from runner.recording import schema
from runner.recording.action_recorder import ActionRecorder
from runner.recording.gym_spaces import can_widen, widened
from runner.recording.maker import EnvironmentMaker
from runner.recording.metadata import run_metadata, sizes_of, write_description, write_result
from runner.recording.recorder import FLUSH_SECONDS, Recorder
from runner.recording.schema import Topic
from runner.recording.writer import create_recording
from runner.runs import run as runs
from runner.runs.code import CodeCollector
from runner.runs.provenance import provenance
from runner.runs.redaction import redacted_line
from runner.runs.run import RECORDING_FILE, Run, new_run, recordings_folder, unless_empty
from runner.runs.shards import RUN_VARIABLE, new_shard
from runner.util.values import is_whole

_UNDECIDED_SECONDS: Final = 5.0
"""The dtype of actions is left open this long while no step is taken; then it is that of their space."""

R = TypeVar("R", bound=PhaseRows)


class _IgnoredRows:
    """Ignores the steps of a forked process, and their extras."""

    filled = 0
    place = (0, 0)
    resets = 0
    is_any_over = False

    def ignore(self, *_: object) -> None:
        """Do nothing."""

    def taker(self, *_: object) -> Callable[..., None]:
        """Return a function that does nothing."""
        return self.ignore

    open = commit = finish = extend = reshape = take = take_game = reset = ignore


class Loop(Generic[R]):
    """A loop that is being recorded; safe to use from several threads.

    Args:
        described: the environment and its spaces.
        options: how to record it.
        maker: how it was made.
        make_rows: returns the rows of a phase for recorder, description, phase and what to call with the
            first action.
        batch: (N,) for N environments that step at once, else ().

    Raises:
        ConfigError: the steps of this environment, or of a shard, cannot be left out.
        StorageError: the recordings folder cannot be written.
    """

    should_stop = False
    """Whether somebody requested that the loop stops."""

    def __init__(
        self,
        described: Described,
        options: Options,
        maker: EnvironmentMaker,
        make_rows: Callable[[Recorder, Described, str, Callable[[Any], None]], R],
        batch: tuple[int, ...] = (),
    ) -> None:
        is_shard = options.join is not None
        client = connect(str(options.recordings)) if is_server(options.recordings) and not is_shard else None
        self.started = time.monotonic()
        self._config = options.config(described)
        self._maker = maker
        self._own_makers: dict[str, EnvironmentMaker] = {}
        """How the environments of phases were made, where another one is recorded into the run."""
        self._make_rows = make_rows
        self._rows: dict[str, R] = {}
        self.active: R | None = None
        """The rows of the last step; None before any, and when the loop is closed."""
        self.described, self.options = described, options
        self.lock = threading.RLock()
        self.closed = False
        self.is_foreign = False
        """Whether this process records nothing: it was forked from the one that does, or recording failed."""
        self._failure = ""
        """Why recording stopped, if it did and `on_error` is "warn"."""
        self.views: weakref.WeakSet[Any] = weakref.WeakSet()
        """The recorded environments; `_detach` of each is called in a forked process."""
        self._warnings: set[str] = set()
        self._is_described = False
        self._is_settled = not can_widen(described.action)
        self._made_by = provenance(with_command=options.packing.code)
        made_by = {key: self._made_by[key] for key in runs.MADE_BY if key in self._made_by}
        facts = {"provenance": made_by, "spaces": described.common}
        self.run = self._new_run(outbox_folder() if client else None, facts)
        self._code = CodeCollector(self.run.folder.parent, options.packing.code and not is_shard)
        path = self.run.folder / RECORDING_FILE
        topics = schema.KINDS[described.kind]
        with unless_empty(self.run):
            self._file = create_recording(path, topics)
        self._facts = self._run_facts()
        self._outcomes = Outcomes(described.mdp)
        self._recorder = Recorder(
            self._file,
            learners=len(described.agents),
            events=int(self._facts["events"]),
            packing=options.packing.packing,
            record_steps=options.steps == "all",
            beat=self._code.beat(self.run, self._file),
            sizes=sizes_of(self._facts, str(path)),
            watch=self._watch,
            before=self._describe,
            system=options.packing.system and not is_shard,
            console=redacted_line if options.packing.console and not is_shard else None,
        )
        self._actions = (
            ActionRecorder(self._recorder, described.environments, options.packing.chunk_steps)
            if options.steps == "actions"
            else None
        )
        self.extras = Extras(self._recorder, batch)
        self.messages = Messages(
            self,
            self._recorder,
            self._outcomes,
            options,
            {topic.name: topic for topic in topics},
            options.join.folder if options.join else self.run.folder,
        )
        if self._is_settled:
            try:
                self._describe()
            except BaseException as error:
                self._file.close()
                self._mark_failed(truncated_message(error))
                raise
        self._follower = Follower(client, self.run, lambda: self._file.size) if client else None
        if not is_shard:
            os.environ[RUN_VARIABLE] = os.path.abspath(self.run.folder)  # noqa: PTH100 - links stay what they are
        _flusher.add(self)

    def _new_run(self, folder: Path | None, facts: Mapping[str, Any]) -> Run:
        """Create the folder of the run, or of the shard of the run that is joined.

        Raises:
            ConfigError: the spaces are others than those of the run that is joined.
            RunnerError: that run is over.
        """
        options, config = self.options, self._config
        if options.join is None:
            folder = folder or recordings_folder(options.recordings)
            return new_run(folder, config, options.seed, config["name"], options.run_id, **facts)
        expected = options.join.facts.get("spaces")
        if facts["spaces"] != expected:
            raise ConfigError(
                f"join: found an environment with {facts['spaces'][:500]}, expected the spaces and agents of "
                f"run {options.join.run_id}: {str(expected)[:500]}"
            )
        return new_shard(options.join, options.shard, config, options.seed, **facts)

    def _watch(self, topic: Topic, records: NDArray[np.void]) -> None:
        self._outcomes.take_records(topic, records)
        if self._actions is not None:
            self._actions.take_records(topic, records)

    def _run_facts(self) -> dict[str, str]:
        described, mdp, run = self.described, self.described.mdp, self.run
        content = {key: value for key, value in self._config.items() if key not in NOT_CONTENT}
        job = json.dumps(content | {"seed": self.options.seed}, sort_keys=True)
        return run_metadata(
            run.run_id,
            str(run.facts["name"]),
            self.options.seed,
            job=blake3(job.encode()).hexdigest()[:32],
            created=run.created_text,
            agents=described.agents,
            events=len(mdp.event_names) if mdp else 0,
        ) | {
            "kind": described.kind,
            "spaces": described.spaces_json,
            "environments": str(described.environments),
        }

    def _describe(self) -> None:
        """Write what makes the recording self-contained, once; from then on dtypes are fixed."""
        if not self._is_described:
            self._is_described = self._is_settled = True
            environment = self.described.attachments(), self._maker
            write_description(self._file, self._facts, self._config, self._made_by, *environment)

    def _first_action(self, action: Any) -> None:
        """Record all actions in the dtype of the first one, if the space's own cannot hold it exactly."""
        if self._is_settled:
            return
        self._is_settled = True
        wide = widened(self.described.action, action)
        if wide is not self.described.action:
            self.described = replace(self.described, wide_action=wide)
            self._facts = self._run_facts()
            self._recorder.resize(sizes_of(self._facts, str(self.run.recording)))
            for rows in self._rows.values():
                rows.reshape(self.described)

    # --- what is recorded -----------------------------------------------------------------------------

    def rows(self, phase: str) -> R:
        """Return the rows of a phase.

        Raises:
            ConfigError: there is no such phase.
        """
        check_phase(phase)
        with self.lock:
            if phase not in self._rows:
                self._rows[phase] = self._make_rows(self._recorder, self.described, phase, self._first_action)
            return self._rows[phase]

    def add_maker(self, phase: str, maker: EnvironmentMaker) -> None:
        """Note how the environment of a phase was made, if it is another one than the first."""
        with self.lock:
            if not self.closed:
                self._own_makers[phase] = maker

    def activate(self, rows: R) -> None:
        """Record the next steps in these rows. The caller holds the lock."""
        if not self.records():
            return
        if self.closed:
            raise RunnerError(
                f"run {self.run.run_id} is closed: no more steps can be recorded in it. "
                "Wrap the environment again to record another run."
            )
        if self.active is not None and self.active is not rows:
            self.active.commit()
            self.extras.finish()
            self.active.open()
        self.active = rows

    def note(self, phase: str, rows: R, values: Mapping[str, Any]) -> None:
        """Record values with the last step of a phase.

        Raises:
            ConfigError: a name or a value cannot be recorded.
            RunnerError: there is no such step any more, or the loop is closed.
        """
        with self.lock:
            if self.records() and self.position and self.active is not rows:
                raise RunnerError(
                    "note_step: found that the last step was one of another phase, expected one of this phase"
                )
            self.extras.extend(phase, rows, values)

    @property
    def active_phase(self) -> str:
        """The phase of the last step; `train` before any."""
        return next((phase for phase, rows in self._rows.items() if rows is self.active), "train")

    @property
    def position(self) -> int:
        """The number of steps executed so far.

        Raises:
            RunnerError: the loop is closed.
        """
        if self.closed:
            raise RunnerError(f"run {self.run.run_id} is closed: nothing more can be recorded in it.")
        return sum(self._recorder.steps.values()) + (self.active.filled if self.active else 0)

    def moment(self, rows: PhaseRows) -> tuple[int, int, int]:
        """Return `position`, and the steps and the episode of a phase.

        Raises:
            RunnerError: the loop is closed.
        """
        step, episode = rows.place
        if (active := self.active) is None:
            return self.position, step, episode
        counts = self._recorder.steps
        return counts["train"] + counts["eval"] + counts["elsewhere"] + active.filled, step, episode

    def at_step(self, steps: int) -> None:
        """State how many training steps the whole run had when what is recorded from now on happened.

        Raises:
            ConfigError: it is no number of steps, or lower than before.
            RunnerError: this process takes training steps itself, or the loop is closed.
        """
        with self.lock:
            if not self.records():
                return
            taken = self._recorder.steps
            before = taken["elsewhere"]
            if not is_whole(steps := getattr(steps, "item", lambda: steps)(), before, 2**53):
                raise ConfigError(f"at_step: found {steps!r}, expected a whole number from {before:,} up")
            self.position  # noqa: B018 - it raises an error if the loop is closed
            self._commit()
            self.extras.finish()
            if taken["train"]:
                raise RunnerError(
                    "at_step: found training steps of this process, which have their place by themselves; "
                    "expected a process that only evaluates or logs."
                )
            if "placed" not in self.run.facts:
                self.run = self.run.update(placed=True)
            taken["elsewhere"] = steps

    def records(self) -> bool:
        """Return whether this process records, and warn if it was forked from the one that does."""
        if self.is_foreign and not self._failure:
            self.warn_once(
                f"run {self.run.run_id} is recorded by the process that this one was forked from, and not "
                "here. To record what this process does into the same run, join it here: "
                "runner.record(env, join=True), with the environment as it was before it was recorded."
            )
        return not self.is_foreign

    def warn_once(self, message: str) -> None:
        """Warn the user of something once."""
        if message not in self._warnings:
            self._warnings.add(message)
            warn_user(message)

    def leave_out(self, error: Exception) -> None:
        """Raise the error of a value that cannot be recorded; with `on_error="warn"`, warn of it instead.

        It is called where the error is handled.
        """
        if self.options.on_error == "raise" or not isinstance(error, ConfigError):
            self.fail(error)
        else:
            self.warn_once(f"run {self.run.run_id}: a value was left out: {error}")

    def fail(self, error: Exception) -> None:
        """Raise an error of the recorder; with `on_error="warn"`, warn of it and stop recording instead.

        It is called where the error is handled. The run then has the status `failed`, with the reason.
        """
        try:
            self._recorder.raise_failure()  # of another thread, from which this error may follow
        except Exception as first:
            error = first
        if self.options.on_error == "raise":
            raise error
        with self.lock:
            if self.is_foreign:
                return
            if self.closed:
                self._failure = str(error)
            else:
                self._failure = (
                    f"recording stopped at step {self.position:,}, and the loop went on without it: "
                    f"{type(error).__name__}: {error}"
                )
            self.close("failed", self._failure)
            self.disown()
        self.warn_once(f"run {self.run.run_id}: {self._failure}")

    # --- the end --------------------------------------------------------------------------------------

    def close(self, status: str = "finished", error: str = "") -> Run:
        """Write everything and the status, once; return the run.

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
                reason = truncated_message(self._failure or failure)
                self._abandon(reason)
                if self.options.on_error == "raise" or not isinstance(failure, Exception):
                    raise
                if not self._failure:
                    self.warn_once(f"run {self.run.run_id} could not be completed: {reason}")
                return self.run
            finally:
                self.closed, self.active = True, None
                self._rows.clear()
                self._file.close()
            made_by = self._code.made_by(self.run)
            try:
                self.run = self.run.update(status=status, summary=summary, provenance=made_by)
            except StorageError as failure:
                if self.options.on_error == "raise":
                    raise
                self.warn_once(f"run {self.run.run_id}: its status could not be written: {failure}")
        if os.environ.get(RUN_VARIABLE) == os.path.abspath(self.run.folder):  # noqa: PTH100
            del os.environ[RUN_VARIABLE]
        joined = self.options.join
        try:
            whole = fold_if_over(joined or self.run, 0 if joined else OWNER_WAITS)
            self.run = self.run if joined else whole
        except RunnerError as failure:
            run = joined or self.run
            warn_user(
                f"run {run.run_id}: what its processes recorded was not put together: {failure} All of it is "
                f"kept in {run.folder}; `dualtaxi show {run.run_id}` tries again."
            )
        if self._follower:
            self._follower.finish(self.run)
        return self.run

    def _abandon(self, reason: str) -> None:
        """Close what could not be finished, with as much as can be written."""
        with contextlib.suppress(Exception):  # the first error is the one that matters
            self._recorder.abandon()
        with contextlib.suppress(StorageError):
            write_result(self._file, "failed", {"error": reason})
        self._mark_failed(reason)
        if self._follower:
            self._follower.stop()

    def _mark_failed(self, reason: str) -> None:
        with contextlib.suppress(StorageError):
            self.run = self.run.update(status="failed", summary={"error": reason})

    def _finish(self, status: str, error: str) -> dict[str, Any]:
        self._recorder.raise_failure()
        self._commit()
        self.extras.finish()
        result = self._recorder.totals(self._recorder.drain()) | self._outcomes.summary()
        result |= {
            "episodes": self._recorder.counts["/train/episode"],
            "steps_recorded": self.options.steps == "all",
        }
        if self.described.mdp is not None:
            result["rewards_off_table"] = sum(rows.off_table for rows in self._rows.values())
        if error:
            result["error"] = truncated_message(error)
        self._code.write(self._file, wait=True)
        write_result(self._file, status, result, self._own_makers)
        seconds = round(time.monotonic() - self.started, 3)
        return result | {"seconds": seconds, "bytes": self._file.size}

    def _commit(self) -> None:
        """Hand everything to the recorder."""
        for rows in self._rows.values():
            rows.commit()
        self.extras.commit()
        self.messages.commit()
        if self._actions is not None:
            self._actions.commit()

    def flush(self) -> bool:
        """Write what is half a second old, also while the loop does something else.

        Returns whether to call it again.
        """
        self.should_stop = self.should_stop or (self.options.join or self.run).is_stop_requested
        if not self.lock.acquire(timeout=0.1):
            return True
        try:
            if self.closed or self.is_foreign:
                return False
            age = time.monotonic() - self.started
            if age < FLUSH_SECONDS:
                return True
            if not self._is_settled and not self.messages.has_logged and age < _UNDECIDED_SECONDS:
                self.run.beat()  # the description waits for the dtype of the first action
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

    def disown(self) -> None:
        """Leave the recording to the process that this one was just forked from."""
        self.is_foreign, self.active = True, None
        self.lock = threading.RLock()  # a thread that does not exist here may have held the other one
        ignored: Any = _IgnoredRows()
        self._rows, self.extras = dict.fromkeys(schema.PHASES, ignored), ignored
        for view in list(self.views):
            view._detach()


class _Flusher:
    """The open loops of this process, and one thread that flushes them twice a second."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all loops and the thread, and replace the lock."""
        self.loops: weakref.WeakSet[Loop[Any]] = weakref.WeakSet()
        self._to_flush: weakref.WeakSet[Loop[Any]] = weakref.WeakSet()
        self._thread: threading.Thread | None = None
        self._lock = threading.Lock()

    def add(self, loop: Loop[Any]) -> None:
        """Flush a loop from now on, as long as its `flush` returns True."""
        with self._lock:
            self.loops.add(loop)
            self._to_flush.add(loop)
            if self._thread is None:
                self._thread = threading.Thread(target=self._flush_all, name="recording-flush", daemon=True)
                self._thread.start()

    def _flush_all(self) -> None:
        while True:
            time.sleep(FLUSH_SECONDS)
            with self._lock:
                loops = list(self._to_flush)
                if not loops:
                    self._thread = None
                    return
            for loop in loops:
                if not loop.flush():
                    with self._lock:
                        self._to_flush.discard(loop)
            del loop, loops  # nothing is kept alive while the thread sleeps


_flusher = _Flusher()


def open_loops() -> list[Loop[Any]]:
    """Return the loops that this process records, the oldest first."""
    loops = [loop for loop in _flusher.loops if not loop.closed and not loop.is_foreign]
    return sorted(loops, key=lambda loop: loop.started)


def _after_fork() -> None:
    """In a forked process: it has no such thread, and the recordings belong to the other process."""
    loops = list(_flusher.loops)
    _flusher.clear()
    for loop in loops:
        loop.disown()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
