"""A user's own loop that is being recorded: its phases, its steps, its errors and its end.

One thread flushes all open loops of this process twice a second; they also end with a fork or SIGTERM.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
import weakref
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final

from gymnasium.vector import AutoresetMode

from runner.errors import ConfigError, RunnerError, StorageError, truncated_message
from runner.loops.description import Described
from runner.loops.extras import PendingExtras
from runner.loops.loop_run import LoopRun
from runner.loops.messages import Messages
from runner.loops.options import Options
from runner.loops.step_buffer import StepBuffer
from runner.loops.values import check_phase, warn_user
from runner.recording.maker import EnvironmentMaker
from runner.recording.metadata import RECORDING_STOPPED
from runner.recording.recorder import FLUSH_SECONDS
from runner.runs.run import Run
from runner.util.values import is_whole

_UNDECIDED_SECONDS: Final = 5.0
"""The dtype of actions is left open this long while no step is taken; then their space decides it."""
_RETRY_SECONDS: Final = 0.01
"""When a signal that interrupted the recording of a step is sent again; a step takes microseconds."""


class Loop:
    """A loop that is being recorded; safe to use from several threads.

    Args:
        mode: how the environments of a vector reset themselves; None for one environment, alone.
        make_rows: returns the steps of a phase; takes the arguments of `StepBuffer`.
    """

    should_stop = False
    """Whether somebody requested that the loop stops."""

    def __init__(
        self,
        described: Described,
        options: Options,
        maker: EnvironmentMaker,
        mode: AutoresetMode | None = None,
        make_rows: Callable[..., StepBuffer] = StepBuffer,
    ) -> None:
        options = options.for_environment(maker)
        self._loop_run = LoopRun(described, options, maker)
        self.started = self._loop_run.started
        self._recorder = self._loop_run.recorder
        self._recorder.when_full = self._write
        self.mode = mode
        self._make_rows = make_rows
        self._rows: dict[str, StepBuffer] = {}
        self.active: StepBuffer | None = None
        """The rows of the last step; None before any, and when the loop is closed."""
        self.options = options
        # Reentrant: an error closes the loop while a step is recorded. It is taken before the observer's lock
        # and the syncer's, by closing.
        self.lock = threading.RLock()
        self.closed = False
        self.is_foreign = False
        """Whether this process records nothing: it was forked from the recorder, or recording failed."""
        self._failure = ""
        """Why recording stopped, if it did and `on_error` is "warn"."""
        self._warnings: set[str] = set()
        self.extras = PendingExtras(
            self._recorder, self.leave_out, () if mode is None else (described.environments,)
        )
        self.messages = Messages(
            self,
            self._recorder,
            self._loop_run.outcomes,
            options,
            (options.join or self.run).folder,
        )
        FLUSHER.add(self)

    @property
    def run(self) -> Run:
        """The run, or the shard of the run that is joined."""
        return self._loop_run.run

    @property
    def described(self) -> Described:
        """The environment and its spaces."""
        return self._loop_run.described

    def _first_action(self, action: object) -> None:
        """Record all actions in the dtype of the first one, if the space's own cannot hold it exactly."""
        if self._loop_run.settle(action):
            for rows in self._rows.values():
                rows.reshape(self.described)

    # --- what is recorded -----------------------------------------------------------------------------

    def rows(self, phase: str) -> StepBuffer:
        """Return the rows of a phase."""
        check_phase(phase)
        with self.lock:
            if phase not in self._rows:
                self._rows[phase] = self._make_rows(
                    self._recorder, self.described, phase, self._first_action, self.mode
                )
            return self._rows[phase]

    def add_maker(self, phase: str, maker: EnvironmentMaker) -> None:
        """Note how the environment of a phase was made, if it is another one than the first.

        Raises:
            ConfigError: the run records actions alone, which are too few for this environment.
        """
        # The run has begun: it cannot record whole steps instead, with a warning.
        replace(self.options, on_error="raise").for_environment(maker)
        with self.lock:
            if not self.closed:
                self._loop_run.own_makers[phase] = maker

    def activate(self, rows: StepBuffer) -> bool:
        """Record the next steps in these rows; return whether this process records.

        The caller holds the lock.
        """
        if not self.records():
            return False
        if self.closed:
            raise RunnerError(
                f"run {self.run.run_id} is closed: no more steps can be recorded in it. "
                "Wrap the environment again to record another run."
            )
        if self.active is not None and self.active is not rows:
            self.active.commit()
            self.extras.finish()
        self.active = rows
        return True

    def note(self, phase: str, rows: StepBuffer, values: Mapping[str, object]) -> None:
        """Record values with the last step of a phase.

        Raises:
            ConfigError: there is no such step any more.
            RunnerError: the loop is closed.
        """
        with self.lock:
            if not self.records():
                return
            if self.position and self.active is not rows:
                raise ConfigError(
                    "note_step: found that the last step was one of another phase, expected one of this phase"
                )
            self.extras.extend(phase, rows, values)

    @property
    def active_phase(self) -> str:
        """The phase of the last step; `train` before any."""
        for phase, rows in self._rows.items():
            if rows is self.active:
                return phase
        return "train"

    @property
    def position(self) -> int:
        """The number of steps executed so far.

        Raises:
            RunnerError: the loop is closed.
        """
        if self.closed:
            raise RunnerError(f"run {self.run.run_id} is closed: nothing more can be recorded in it.")
        return self._recorder.position + (self.active.pending if self.active else 0)

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
                self._loop_run.run = self.run.update(placed=True)
            self._recorder.advance("elsewhere", steps - before)

    def records(self) -> bool:
        """Return whether this process records, and warn if it was forked from the recording process."""
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
                    f"{RECORDING_STOPPED}{self.position:,}, and the loop went on without it: "
                    f"{type(error).__name__}: {error}"
                )
            self.close("failed", self._failure)
            self.is_foreign = True
        self.warn_once(f"run {self.run.run_id}: {self._failure}")

    # --- the end --------------------------------------------------------------------------------------

    def close(self, status: str = "finished", error: str = "") -> Run:
        """Write everything and the status, once; return the run.

        A forked process only returns the run: the recording belongs to the process it was forked from.
        """
        if self.is_foreign:
            return self.run
        with self.lock:
            if self.closed:
                return self.run
            try:
                self._recorder.raise_failure()
                self._commit()
                self.extras.finish()
                off_table = sum(rows.off_table for rows in self._rows.values())
                summary = self._loop_run.finish(status, error, off_table)
            except BaseException as failure:
                reason = truncated_message(self._failure or failure)
                self._loop_run.abandon(reason)
                if self.options.on_error == "raise" or not isinstance(failure, Exception):
                    raise
                if not self._failure:
                    self.warn_once(f"run {self.run.run_id} could not be completed: {reason}")
                return self.run
            finally:
                self.closed, self.active = True, None
                self._rows.clear()
                self._loop_run.end_joining()
                self._loop_run.file.close()
            try:
                self._loop_run.write_status(status, summary)
            except StorageError as failure:
                if self.options.on_error == "raise":
                    raise
                self.warn_once(f"run {self.run.run_id}: its status could not be written: {failure}")
        try:
            whole = self._loop_run.fold()
            if whole.summary.unfolded:
                warn_user(
                    f"run {whole.run_id}: not all that its processes recorded is in it: {whole.summary.error}"
                )
        except RunnerError as failure:
            run = self.options.join or self.run
            warn_user(
                f"run {run.run_id}: what its processes recorded was not put together: {failure} All of it is "
                f"kept in {run.folder}; `dualtaxi show {run.run_id}` tries again."
            )
        self._loop_run.finish_following()
        return self.run

    def _commit(self) -> None:
        """Hand everything to the recorder."""
        for rows in self._rows.values():
            rows.commit()
        self.extras.commit()
        self.messages.commit()
        self._loop_run.commit()

    def _write(self) -> None:
        """Write everything, and go on."""
        self._commit()
        self._recorder.flush()

    def flush(self) -> bool:
        """Write what is half a second old, also while the loop does something else.

        Returns whether to call it again.
        """
        self.should_stop = self.should_stop or (self.options.join or self.run).is_stop_requested
        if not self.lock.acquire(timeout=0.1):  # other loops wait to be flushed by this thread
            return True
        try:
            if self.closed or self.is_foreign:
                return False
            age = time.monotonic() - self.started
            if age < FLUSH_SECONDS:
                return True
            if not self._loop_run.is_settled and not self.messages.has_logged and age < _UNDECIDED_SECONDS:
                self.run.beat()  # the description waits for the dtype of the first action
                return True
            self._write()
            self._recorder.release()
        except BaseException:  # raised again in the loop's own thread, with its next step
            return False
        finally:
            self.lock.release()
        return True

    def disown(self) -> None:
        """Leave the recording to the process that this one was just forked from."""
        self.is_foreign = True
        self.active = None
        self.lock = threading.RLock()  # a thread that does not exist here may have held the other one


# --- all loops of this process ------------------------------------------------------------------------


class Flusher:
    """The open loops of this process, and one thread that flushes them twice a second."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Forget all loops and the thread, and replace the lock."""
        self._loops: weakref.WeakSet[Loop] = weakref.WeakSet()
        self._to_flush: weakref.WeakSet[Loop] = weakref.WeakSet()
        self._thread: threading.Thread | None = None
        # For all of these: loops are added and listed by any thread, and the thread ends. Reentrant: a signal
        # may interrupt the thread that holds it, and lists the loops.
        self._lock = threading.RLock()

    def loops(self) -> list[Loop]:
        """Return the loops that still exist, also closed ones."""
        with self._lock:
            return list(self._loops)

    def add(self, loop: Loop) -> None:
        """Flush a loop from now on, as long as its `flush` returns True; close it before SIGTERM ends it."""
        is_main = threading.current_thread() is threading.main_thread()
        if is_main and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:  # else the user has a handler
            with contextlib.suppress(ValueError):  # not the main interpreter
                signal.signal(signal.SIGTERM, _end_by_signal)
        with self._lock:
            self._loops.add(loop)
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
                if not loop.flush():  # without the lock: a loop that begins does not wait for slow disks
                    with self._lock:
                        self._to_flush.discard(loop)
            del loop, loops  # nothing is kept alive while the thread sleeps


FLUSHER = Flusher()


def open_loops() -> list[Loop]:
    """Return the loops that this process records, the oldest first."""
    loops = [loop for loop in FLUSHER.loops() if not loop.closed and not loop.is_foreign]
    return sorted(loops, key=lambda loop: loop.started)


def _end_by_signal(number: int, _frame: object) -> None:
    """Close the recordings of this process as interrupted, then let the signal end it as it would have."""
    loops = open_loops()
    if any(loop.lock._is_owned() for loop in loops):  # type: ignore[attr-defined]
        # This thread is recording: it must complete that first.
        threading.Timer(_RETRY_SECONDS, os.kill, (os.getpid(), number)).start()
        return
    signal.signal(number, signal.SIG_DFL)  # a second signal ends it at once
    for loop in loops:
        with contextlib.suppress(Exception):  # the run then has the status failed, with the reason
            loop.close("interrupted")
    os.kill(os.getpid(), number)


_fork = threading.local()
"""`blocked`: the signals that a thread had blocked before its fork."""


def _before_fork() -> None:
    """Keep SIGTERM waiting for a forked process until it has no handler: before, it would be lost."""
    _fork.blocked = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])


def _unblock() -> None:
    signal.pthread_sigmask(signal.SIG_SETMASK, _fork.blocked)


def _after_fork() -> None:
    """In a forked process: it has no such thread, and the recordings belong to the other process."""
    loops = list(FLUSHER._loops)  # without the lock, which another thread may have held
    FLUSHER.clear()
    if signal.getsignal(signal.SIGTERM) is _end_by_signal:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
    _unblock()
    for loop in loops:
        loop.disown()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_before_fork, after_in_parent=_unblock, after_in_child=_after_fork)
