"""The run of a script that logs in the shape of another tracker, and the environment that it steps.

A script with a `SummaryWriter`, or with the shape of `wandb`, does not hand over its environment. So its
values wait until it resets one: the first environment that is reset while such a run waits, at the outermost
wrapper, is recorded from then on as `runner.record` and `runner.record_vector` do, and the values go into
that recording. If the script records a loop itself, they go there. If it resets no environment, they become
a run of their own, without steps.
"""

from __future__ import annotations

import atexit
import os
import sys
import time
from collections.abc import Callable
from typing import Any, Final

from gymnasium.spaces import Discrete
from gymnasium.vector import VectorEnv

from runner.errors import ConfigError, nearest
from runner.integrations.hooks import WatchedEnvironment, hook_environments, open_runs
from runner.loops.description import Described
from runner.loops.env import record
from runner.loops.flushing import open_loops
from runner.loops.loop import Loop
from runner.loops.options import PACKING, CallbackOptions, options_of
from runner.loops.pictures import Picture
from runner.loops.recorded import ending_of
from runner.loops.values import arrays_of, warn_user
from runner.loops.vector import record_vector
from runner.recording.labels import MAX_NOTE, is_tag
from runner.recording.maker import EnvironmentMaker
from runner.runs.run import Run, label, new_run_id, recordings_folder
from runner.util.values import Json, JsonView, is_whole

STEP_NAME: Final = "global_step"
"""The name under which the script's own step is recorded, before the values that it gave with it."""
MAX_NAMES: Final = 10_000
OPTIONS: Final = CallbackOptions.__annotations__.keys() - {"config", "name", "run_id", "seed"}
"""The arguments of `runner.record` and `record_vector` that a script may add."""
_NO_ENVIRONMENT: Final = Described("step", Discrete(1), Discrete(1), env_id="none")
_NOT_MADE: Final = EnvironmentMaker("gymnasium", reason="values were logged, and no environment was recorded")
_MAX_WAITING: Final = 10_000
"""The most values that wait for an environment."""
_MAX_WAITING_BYTES: Final = 1 << 28
_WAITING_SECONDS: Final = 10.0
"""How long they do, at most; looked at when another value is logged."""


class ValueRows:
    """The place of values in a run without an environment: the script's own step."""

    off_table = 0
    is_any_over = False

    def __init__(self) -> None:
        self.place = (0, 0)
        self.filled = 0
        """The largest step so far, which orders the messages in time."""

    def move(self, step: int) -> None:
        """Let the next values have this step."""
        self.place = (step, 0)
        self.filled = max(self.filled, step)

    def open(self) -> None:
        """Do nothing: there are no steps."""

    def commit(self) -> None:
        """Do nothing: there are no steps."""

    def reshape(self, described: Described) -> None:
        """Do nothing: there are no actions."""


class ScriptRun:
    """A run that a script logs into; it records the environment that the script resets first.

    Args:
        recordings: the recordings folder, or the address of a server, as for `runner.record`.
        name: its name; that of the environment unless given.
        settings: the script's settings, which may be changed until the recording begins.
        tags: labels; those that a run cannot have are left out, with a warning.
        note: a note.
        has_environment: whether to wait for an environment, and to record it.
        takes_writers: whether a `SummaryWriter` made meanwhile logs into this run.
        options: further arguments of `runner.record`, such as `steps`, `frames_every` and `on_error`.

    Raises:
        ConfigError: `runner.record` has no such argument.
    """

    def __init__(
        self,
        recordings: str | os.PathLike[str] | None = None,
        name: str | None = None,
        settings: JsonView | None = None,
        tags: tuple[str, ...] = (),
        note: str = "",
        has_environment: bool = True,
        takes_writers: bool = False,
        **options: Any,
    ) -> None:
        if unknown := sorted(options.keys() - OPTIONS):
            expected = ", ".join(sorted(OPTIONS))
            hint = nearest(unknown[0], {*OPTIONS, "monitor_gym", "recordings"})
            raise ConfigError(f"found the argument {unknown[0]!r}, expected one of {expected}.{hint}")
        self._options = options
        self.settings: Json = dict(settings or {})
        self.name, self.takes_writers = name, takes_writers
        self.closed = self.has_writer = False
        self.log_last: Callable[[], None] = lambda: None
        """Logs what is known at the end only; called before the run is closed."""
        self._recordings, self._has_environment = recordings, has_environment
        self._tags = tuple(tag for tag in tags if is_tag(tag))
        if left_out := [tag for tag in tags if not is_tag(tag)]:
            warn_user(f"tags: {', '.join(map(repr, left_out))} cannot be tags of a run, and are left out.")
        self._note = note[:MAX_NOTE]
        is_folder = "://" not in str(recordings or "")
        self.run_id = new_run_id(recordings_folder(recordings if is_folder else None))
        self._waiting: list[tuple[str, tuple[object, ...], int | None]] = []
        self._since, self._waiting_bytes = 0.0, 0
        self._loop: Loop[Any] | None = None
        self._is_own = False
        """Whether this run made the loop, and closes it."""
        self._has_joined = False
        """Whether values went into a loop that is closed."""
        self._values: ValueRows | None = None
        self._watched: WatchedEnvironment | None = None
        self._names: set[str] = set()
        self._step: int | None = None
        self._warnings: set[str] = set()
        self._is_foreign = False
        hook_environments()
        atexit.register(self._close_at_exit)
        open_runs.append(self)

    # --- what is logged -----------------------------------------------------------------------------------

    def log(self, name: str, value: object, step: int | None = None) -> None:
        """Log a number or a text, with the script's own step."""
        if name not in self._names:
            if not isinstance(name, str):
                raise ConfigError(f"log: found the name {name!r}, expected text")
            if len(self._names) == MAX_NAMES:
                self.warn_once(
                    f"log: found more than {MAX_NAMES:,} names: values under further names are not recorded. "
                    "Do names contain a number that should be the step?"
                )
                return
            self._names.add(name)
        self._do("log", (name, value), step)

    def snapshot(self, name: str, array: object, step: int | None = None) -> None:
        """Record an array of numbers, or each of a mapping of arrays."""
        for own_name, values in arrays_of(name, array):
            self._waiting_bytes += values.nbytes
            self._do("snapshot", (own_name, values.copy() if self._loop is None else values), step)

    def picture(self, name: str, picture: Picture, step: int | None = None) -> None:
        """Record a picture or a film under a name."""
        self._waiting_bytes += picture.frames.nbytes
        self._do("picture", (name, picture), step)

    def _do(self, method: str, arguments: tuple[object, ...], step: int | None) -> None:
        """Call a method of the recording's `Messages`, now or when there is a recording."""
        if self.closed:
            self.warn_once(f"run {self.run_id} is closed: values that are logged now are not recorded.")
            return
        if self._is_foreign:
            self.warn_once(f"run {self.run_id} belongs to the process that this one was forked from.")
            return
        if self._loop is not None and self._loop.closed and not self._is_own:
            self._loop = self._step = None  # what the script recorded is over; there may be more
            self._has_joined, self._since, self._waiting_bytes = True, 0.0, 0
        if self._loop is None:
            self._waiting.append((method, arguments, step))
            self._since = self._since or time.monotonic()
            has_room = len(self._waiting) < _MAX_WAITING and self._waiting_bytes < _MAX_WAITING_BYTES
            is_early = has_room and time.monotonic() - self._since < _WAITING_SECONDS
            if not self._join_loop() and not (is_early and self._has_environment):
                self._begin_values()
            return
        try:
            self._move(self._loop, step)
            phase = () if method == "picture" else (self._loop.active_phase,)
            getattr(self._loop.messages, method)(*phase, *arguments)
        except Exception as error:
            self._loop.leave_out(error)

    def _move(self, loop: Loop[Any], step: int | None) -> None:
        """Record the script's own step, if it is another than before."""
        if step is None or step == self._step:
            return
        self._step = step
        if self._values is not None:
            self._values.move(step)
        else:
            loop.messages.log(loop.active_phase, STEP_NAME, step)

    def warn_once(self, message: str, about: str = "") -> None:
        """Warn the user of something once: of this message, or of what it is about."""
        if (about or message) not in self._warnings:
            self._warnings.add(about or message)
            warn_user(message)

    # --- the recording ------------------------------------------------------------------------------------

    @property
    def run(self) -> Run | None:
        """The run, as soon as it is recorded."""
        return self._loop.run if self._loop else None

    @property
    def is_waiting(self) -> bool:
        """Whether no recording was begun yet."""
        return self._loop is None and not self.closed and not self._is_foreign

    @property
    def has_steps(self) -> bool:
        """Whether values go into a recording of steps, or wait for one."""
        return self._has_environment if self._loop is None else self._values is None

    @property
    def has_environment(self) -> bool:
        """Whether it records an environment that the script did not hand over."""
        return self._watched is not None

    @property
    def waits_for_environment(self) -> bool:
        """Whether the next environment that is reset is this run's."""
        return self.is_waiting and self._has_environment

    def _join_loop(self) -> bool:
        """Log into the newest loop that the script records itself, if there is one."""
        own = {id(other._loop) for other in open_runs if isinstance(other, ScriptRun) and other._is_own}
        loops = [loop for loop in open_loops() if id(loop) not in own]
        if not loops:
            return False
        self._begin(loops[-1])
        return True

    def _begin(self, loop: Loop[Any]) -> None:
        self._loop = loop
        waiting, self._waiting = self._waiting, []
        for method, arguments, step in waiting:
            self._do(method, arguments, step)

    def _begin_own(self, loop: Loop[Any]) -> None:
        self._is_own = True
        self.run_id = loop.run.run_id
        if self._tags or self._note:
            label(loop.run, tag=self._tags, note=self._note or None)
        atexit.unregister(self._close_at_exit)
        atexit.register(self._close_at_exit)  # before what the loop registered closes it as interrupted
        self._begin(loop)

    def _arguments(self) -> dict[str, Any]:
        """Return the arguments of `record` that do not depend on the environment."""
        seed = self.settings.get("seed")
        return {
            "name": self.name,
            "seed": seed if is_whole(seed, 0, 2**64 - 1) else None,
            "config": self.settings,
        }

    def _begin_values(self) -> None:
        """Begin a recording without an environment."""
        packing: Any = {key: self._options[key] for key in (*PACKING, "on_error") if key in self._options}
        given = self._arguments() | {"name": self.name or script_name(), "run_id": self.run_id}
        options = options_of(self._recordings, given | packing)
        self._values = rows = ValueRows()
        loop: Loop[Any] = Loop(_NO_ENVIRONMENT, options, _NOT_MADE, lambda *_: rows)
        loop.activate(loop.rows("train"))
        self._begin_own(loop)

    def begin_with(self, env: Any) -> None:
        """Begin to record an environment that is about to be reset, unless the script records one itself.

        Raises:
            EnvironmentNotUsable: it cannot be recorded.
        """
        if self._join_loop():
            return
        recorder: Any = record_vector if isinstance(env, VectorEnv) else record
        given = self._arguments()
        missed = 0 if isinstance(env, VectorEnv) else _elapsed_steps(env)
        if missed:
            self.warn_once(
                f"run {self.run_id} records {env} from this reset on. It was stepped before the run began: "
                f"{missed:,} steps of its last episode, and any earlier episodes, are not in this run."
            )
        recorded = recorder(env, self._recordings, run_id=self.run_id, **given, **self._options)
        self._watched = WatchedEnvironment(env, recorded)
        self._begin_own(recorded._loop)

    # --- the end ------------------------------------------------------------------------------------------

    def close(self, status: str = "finished", error: str = "") -> Run | None:
        """End the run, and return it; None if nothing was recorded."""
        if self.closed or self._is_foreign:
            return self.run
        try:
            self.log_last()
            if self.is_waiting:
                if not self._waiting and (self._has_joined or not self.settings):
                    return None  # there is nothing to record
                if not self._join_loop():
                    self._begin_values()
            if self._is_own and self._loop is not None:
                return self._loop.close(status, error)
            return self.run
        finally:
            if self._watched is not None:
                self._watched.release()
            self.discard()

    def discard(self) -> None:
        """Record nothing more."""
        self.closed = True
        open_runs.remove(self)
        atexit.unregister(self._close_at_exit)

    def _close_at_exit(self) -> None:
        self.close(*ending_of(getattr(sys, "last_value", None)))

    def disown(self) -> None:
        """Leave the run to the process that this one was just forked from."""
        self._is_foreign = True


def _elapsed_steps(env: Any) -> int:
    """Return the steps since the last reset, as a `TimeLimit` counts them; 0 if none does."""
    try:
        return env.get_wrapper_attr("_elapsed_steps") or 0
    except AttributeError:
        return 0


def script_name() -> str:
    """Return the name of the script that was run, for runs without another name."""
    stem = os.path.splitext(os.path.basename(sys.argv[0] or ""))[0]  # noqa: PTH119, PTH122
    return stem if stem.isidentifier() else "values"
