"""The run of a script that logs in the shape of another tracker, and the environment that it steps.

A script with a `SummaryWriter`, or with the shape of `wandb`, does not hand over its environment. So its
values wait until it resets one: the first environment that is reset while such a run waits, at the outermost
wrapper, is recorded from then on as `runner.record` and `runner.record_vector` do, and the values go into
that recording. If the script records a loop itself, they go there. If it resets no environment, or one that
cannot be recorded, they become a run of their own, without steps.

A script that was written for another tracker never ends because of this one: what cannot be recorded gives a
warning, unless the script asks for an error with `on_error="raise"`.

While a run waits for an environment, every class of environments of Gymnasium has a `reset` that first looks
for such a run. The outermost environment that the script resets is then stepped through its recorded twin.
The classes get their own `reset` back as soon as no run has to see which environments are reset.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import json
import os
import sys
import time
import weakref
from collections.abc import Callable
from types import FrameType, MethodType
from typing import Any, Final, Protocol

import gymnasium
from gymnasium.spaces import Discrete
from gymnasium.vector import VectorEnv

from runner.errors import ConfigError, nearest
from runner.loops.description import Described
from runner.loops.env import record
from runner.loops.loop import Loop, open_loops
from runner.loops.media import Media
from runner.loops.options import PACKING, CallbackOptions, options_of
from runner.loops.recorded import Recorded, ending_of
from runner.loops.values import warn_user
from runner.loops.vector import record_vector
from runner.recording.labels import MAX_NOTE, is_tag
from runner.recording.maker import EnvironmentMaker
from runner.recording.run_file import NO_ENVIRONMENT
from runner.runs.run import Run, label, new_run_id, recordings_folder
from runner.util.jsonable import as_json
from runner.util.values import Json, is_whole

STEP_NAME: Final = "global_step"
"""The name under which the script's own step is recorded, before the values that it gave with it."""
MAX_NAMES: Final = 10_000
OPTIONS: Final = CallbackOptions.__annotations__.keys() - {"config", "name", "run_id", "seed"}
"""The arguments of `runner.record` and `record_vector` that a script may add."""
_MAX_WAITING: Final = 10_000
"""The most values that wait for an environment."""
_MAX_WAITING_BYTES: Final = 1 << 28
_MAX_STEP: Final = 2**62
_WAITING_SECONDS: Final = 10.0
"""How long values wait at most; looked at when another value is logged."""
_NO_ENVIRONMENT: Final = Described(Discrete(1), Discrete(1), env_id=NO_ENVIRONMENT)
_NOT_MADE: Final = EnvironmentMaker("gymnasium", reason="values were logged, and no environment was recorded")
_VALUE_ARGUMENTS: Final = {*PACKING, "name", "on_error", "seed", "config", "run_id"}
"""The arguments of `record` that need no environment."""
_MAX_POSITION: Final = 2**37
"""The last step that has a time of its own; later ones are ordered as they came."""
OTHERS: Final = "other environments"
"""The subject of the warning that a run does not record further environments."""
_BASES: Final[tuple[Any, ...]] = (gymnasium.Env, VectorEnv)
_VECTORS_OF_OTHERS: Final = {
    "stable_baselines3": "runner.integrations.sb3.Recording",
    "torchrl": "runner.integrations.torchrl.record",
    "ray": "runner.integrations.rllib.Recording",
}
"""Libraries that step environments in vectors of their own, and what records these."""


class Watched(Protocol):
    """What records the environments of a script."""

    def release(self) -> None:
        """Record nothing more."""


class ScriptRun:
    """A run that a script logs into; it records the environment that the script resets first.

    Args:
        recordings: the recordings folder, or the address of a server, as for `runner.record`.
        name: its name; the environment's unless given.
        tags: labels; those that a run cannot have are left out, with a warning.
        note: a note.
        has_environment: whether to wait for an environment, and to record it.
        takes_writers: whether a `SummaryWriter` made meanwhile logs into this run.
        options: further arguments of `runner.record`, such as `steps`, `frames_every` and `on_error`, by
            default "warn"; others are ignored, with a warning.
    """

    def __init__(
        self,
        recordings: str | os.PathLike[str] | None = None,
        name: str | None = None,
        tags: tuple[str, ...] = (),
        note: str = "",
        has_environment: bool = True,
        takes_writers: bool = False,
        **options: Any,
    ) -> None:
        self._warnings: set[str] = set()
        for unknown in sorted(options.keys() - OPTIONS):
            hint = nearest(unknown, {*OPTIONS, "monitor_gym", "recordings"})
            self.warn_once(f"the argument {unknown}={options.pop(unknown)!r} has no effect here.{hint}")
        self._options = {"on_error": "warn"} | options
        self.settings: Json = {}
        """The script's settings, which may be changed until the recording begins."""
        self.name = name
        self.takes_writers = takes_writers
        self.closed = False
        self.has_writer: bool | None = None
        """Whether a `SummaryWriter` writes into the run; None where none is expected."""
        self.log_last: Callable[[], None] = lambda: None
        """Logs what is known at the end only; called before the run is closed."""
        self._recordings = recordings
        self._has_environment = has_environment
        self._tags = tuple(tag for tag in tags if is_tag(tag))
        if left_out := [tag for tag in tags if not is_tag(tag)]:
            warn_user(f"tags: {', '.join(map(repr, left_out))} cannot be tags of a run, and are left out.")
        self._note = note[:MAX_NOTE]
        self.run_id = self._new_run_id()
        self.calls: int | None = None
        """The number of calls so far, where the script's tracker counts them; None where it does not."""
        self._waiting: list[tuple[str, object, int | None, int | None]] = []
        self._since = 0.0
        self._waiting_bytes = 0
        self._loop: Loop | None = None
        self._is_own = False
        """Whether this run made the loop, and closes it."""
        self._has_joined = False
        """Whether values went into a loop that is closed."""
        self._values: ValueRows | None = None
        self._watched: Watched | None = None
        self._names: dict[str, int] = {}
        """Name to the number of its values without a step."""
        self._step: int | None = None
        self._is_foreign = False
        atexit.register(self._close_at_exit)
        open_runs.append(self)
        update_hooks()

    def _new_run_id(self) -> str:
        return new_run_id(recordings_folder(local_folder(self._recordings)))

    # --- what is logged -----------------------------------------------------------------------------------

    def log(self, name: str, value: object, step: object = None) -> None:
        """Log a number, a text or a `Media`, with the script's own step.

        Raises:
            ConfigError: the name, or the content of the `Media`, cannot be recorded.
        """
        if isinstance(value, Media):
            self._waiting_bytes += value.nbytes
        if (self.closed or self._is_foreign or name not in self._names) and self._refuses(name):
            return
        whole = step if step.__class__ is int and 0 <= step < _MAX_STEP else self.step_of(step)
        if (call := self.calls) is None and whole is None:
            call = self._names[name]
            self._names[name] = call + 1
        loop = self._loop
        if loop is not None and loop.closed:
            if self._values is not None:
                return  # recording failed, and gave a warning
            self._leave_loop()
            loop = None
        if loop is not None:
            self._record(loop, name, value, whole, call)
            return
        self._waiting.append((name, value, whole, call))
        self._since = self._since or time.monotonic()
        has_room = len(self._waiting) < _MAX_WAITING and self._waiting_bytes < _MAX_WAITING_BYTES
        is_early = has_room and time.monotonic() - self._since < _WAITING_SECONDS
        if not self._join_loop() and not (is_early and self._has_environment):
            self._begin_values()

    def _refuses(self, name: str) -> bool:
        """Return whether a value is not recorded, with a warning; take note of a new name."""
        if self.closed:
            self.warn_once(f"run {self.run_id} is closed: values that are logged now are not recorded.")
        elif self._is_foreign:
            self.warn_once(f"run {self.run_id} belongs to the process that this one was forked from.")
        elif not isinstance(name, str):
            raise ConfigError(f"log: found the name {name!r}, expected text")
        elif len(self._names) == MAX_NAMES:
            self.warn_once(
                f"log: found more than {MAX_NAMES:,} names: values under further names are not recorded. "
                "Do names contain a number that should be the step?"
            )
        else:
            self._names[name] = 0
            return False
        return True

    def step_of(self, step: Any) -> int | None:
        """Return a script's own step as a whole number; None if it gave none that can be recorded."""
        if step is None:
            return None
        try:
            whole = int(step)
            if 0 <= whole < _MAX_STEP:
                return whole
        except (TypeError, ValueError, OverflowError):
            pass
        self.leave_out(
            ConfigError(f"found the step {step!r}, expected a whole number from 0."), "step", "a step"
        )
        return None

    def _leave_loop(self) -> None:
        """Let values wait for the next recording: this one failed, or was ended."""
        self._loop = None
        self._step = None
        self._has_joined = not self._is_own
        self._since = 0.0
        self._waiting_bytes = 0
        if self._is_own:
            self._release()
            self._is_own = False
            self._has_environment = False
            self.run_id, before = self._new_run_id(), self.run_id
            self.warn_once(f"run {before} has ended: further values go into run {self.run_id}.")
        update_hooks()

    def _record(self, loop: Loop, name: str, value: object, step: int | None, call: int | None) -> None:
        """Record a value in the recording, at the script's own step, or its number where it gave none."""
        try:
            if self._values is not None:
                self._values.move((call or 0) if step is None else step)
            elif step is not None and step != self._step:
                self._step = step
                loop.messages.log(loop.active_phase, STEP_NAME, step)
            loop.messages.log(loop.active_phase, name, value)
        except ConfigError as error:
            self.leave_out(error, type(value).__name__)
        except Exception as error:
            loop.fail(error)

    def leave_out(self, error: Exception, about: str, what: str = "a value") -> None:
        """Warn of what cannot be recorded, once for each kind that it is about; or raise the error.

        It is called where the error is handled.
        """
        if self._options["on_error"] == "raise":
            raise error
        self.warn_once(
            f"run {self.run_id}: {what} was left out: {error} (This warning is given once.)", about
        )

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
    def has_environment(self) -> bool:
        """Whether it records an environment that the script did not hand over."""
        return isinstance(self._watched, WatchedEnvironment)

    @property
    def waits_for_environment(self) -> bool:
        """Whether the next environment that is reset is this run's."""
        return self.is_waiting and self._has_environment

    @property
    def looks_at_resets(self) -> bool:
        """Whether it waits for an environment, or has to warn of others than its own."""
        return self.waits_for_environment or (self.has_environment and OTHERS not in self._warnings)

    def _join_loop(self) -> bool:
        """Log into the newest loop that the script records itself, if there is one."""
        ours = {id(other._loop) for other in open_runs if other._is_own}
        loops = [loop for loop in open_loops() if id(loop) not in ours]
        if not loops:
            return False
        self._begin(loops[-1])
        return True

    def _begin(self, loop: Loop) -> None:
        self._loop = loop
        update_hooks()
        waiting, self._waiting = self._waiting, []
        for values in waiting:
            self._record(loop, *values)

    def _begin_own(self, loop: Loop) -> None:
        self._is_own = True
        self.run_id = loop.run.run_id
        if self._tags or self._note:
            label(loop.run, tag=self._tags, note=self._note or None)
        atexit.unregister(self._close_at_exit)
        atexit.register(self._close_at_exit)  # before what the loop registered closes it as interrupted
        self._begin(loop)

    @property
    def arguments(self) -> dict[str, Any]:
        """The arguments of `record` that do not depend on the environment."""
        seed = self.settings.get("seed")
        settings = {}
        for key, value in self.settings.items():
            try:
                json.dumps(as_json(value), ensure_ascii=False).encode()
                settings[key] = value
            except (ValueError, RecursionError) as error:
                self.leave_out(ConfigError(f"config: {key!r}: {error}."), "config", "a setting")
        return self._options | {
            "recordings": self._recordings,
            "name": self.name,
            "seed": seed if is_whole(seed, 0, 2**64 - 1) else None,
            "config": settings,
            "run_id": self.run_id,
        }

    def _begin_values(self) -> None:
        """Begin a recording without an environment."""
        rows = ValueRows()
        try:
            arguments = {key: value for key, value in self.arguments.items() if key in _VALUE_ARGUMENTS}
            options = options_of(self._recordings, arguments | {"name": self.name or script_name()})
            loop = Loop(_NO_ENVIRONMENT, options, _NOT_MADE, make_rows=lambda *_: rows)  # type: ignore[arg-type]
            loop.activate(loop.rows("train"))
        except Exception as error:
            self.discard()
            self.leave_out(error, "run", "all that is logged")
            return
        self._values = rows
        self._begin_own(loop)

    def begin_with(self, env: Any) -> None:
        """Begin to record an environment that is about to be reset, unless the script records one itself.

        One that cannot be recorded is left out, with a warning.
        """
        if self._join_loop():
            return
        recorder: Any = record_vector if isinstance(env, VectorEnv) else record
        if missed := _elapsed_steps(env):
            self.warn_once(
                f"run {self.run_id} records {env} from this reset on. It was stepped before the run began: "
                f"{missed:,} steps of its last episode, and any earlier episodes, are not in this run."
            )
        try:
            recorded = recorder(env, **self.arguments)
        except Exception as error:
            self.record_values(error)
            return
        self.begin_recorded(recorded._loop, WatchedEnvironment(env, recorded))

    def begin_recorded(self, loop: Loop, watched: Watched) -> None:
        """Log into the recording of the script's environments, which ends with this run."""
        self._watched = watched
        self._begin_own(loop)

    def record_values(self, error: Exception) -> None:
        """Record values only, because the environment cannot be recorded; or raise the error.

        It is called where the error is handled.
        """
        self._has_environment = False
        self.leave_out(error, "environment", "the environment")

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
            self._release()
            self.discard()

    def _release(self) -> None:
        if self._watched is not None:
            self._watched.release()
            self._watched = None

    def discard(self) -> None:
        """Record nothing more."""
        if self.closed:
            return
        self.closed = True
        open_runs.remove(self)
        update_hooks()
        atexit.unregister(self._close_at_exit)
        _end_recordings()

    def _close_at_exit(self) -> None:
        self.close(*ending_of(getattr(sys, "last_value", None)))

    def disown(self) -> None:
        """Leave the run to the process that this one was just forked from."""
        self._is_foreign = True


_to_end: list[Recorded] = []
"""What records environments that are closed, and takes values until the runs of scripts are closed too."""


def end_with_scripts(recorded: Recorded) -> None:
    """End the recording of a closed environment, once no run of a script may log into it any more."""
    _to_end.append(recorded)
    _end_recordings()


def _end_recordings() -> None:
    while _to_end and not open_runs:
        _to_end.pop(0)._loop.close()  # processes of a run before the run


def _elapsed_steps(env: Any) -> int:
    """Return the steps since the last reset, as a `TimeLimit` counts them; 0 if none does."""
    try:
        return env.get_wrapper_attr("_elapsed_steps") or 0
    except AttributeError:
        return 0


def local_folder(recordings: str | os.PathLike[str] | None) -> str | os.PathLike[str] | None:
    """Return a recordings folder as a script gave it; None, for the usual one, where it gave a server."""
    return None if "://" in str(recordings) else recordings


def script_name() -> str:
    """Return the name of the script that was run, for runs without another name."""
    stem = os.path.splitext(os.path.basename(sys.argv[0] or ""))[0]  # noqa: PTH119, PTH122
    return stem if stem.isidentifier() else "values"


# --- a run without an environment -----------------------------------------------------------------------


class ValueRows:
    """Where values stand in a run without an environment: the script's own step."""

    off_table = 0

    def __init__(self) -> None:
        self.progress = (0, 0)
        self.pending = 0
        """The largest step so far, which orders the messages in time."""

    def move(self, step: int) -> None:
        """Let the next values have this step."""
        self.progress = (step, 0)
        self.pending = max(self.pending, min(step, _MAX_POSITION))

    def commit(self) -> None:
        """Do nothing: there are no steps."""

    def reshape(self, described: Described) -> None:
        """Do nothing: there are no actions."""


# --- the environments that a script resets --------------------------------------------------------------


class WatchedEnvironment:
    """An environment of a script whose resets and steps go through its recorded twin.

    The script keeps its object. The object's `step` and `reset` call the twin, which calls the original ones.
    """

    def __init__(self, env: object, recorded: Recorded) -> None:
        self._env = env
        self.recorded: Any = recorded
        self.is_inside = False
        """Whether the twin is calling the environment."""
        _watched[id(env)] = self
        for name, method in _METHODS.items():
            object.__setattr__(env, name, MethodType(method, env))

    def release(self) -> None:
        """Record nothing more."""
        _watched.pop(id(self._env), None)
        for name in _METHODS:
            with contextlib.suppress(AttributeError):
                object.__delattr__(self._env, name)


open_runs: list[ScriptRun] = []
"""The runs of scripts that are not closed, the oldest first."""
_watched: dict[int, WatchedEnvironment] = {}
"""By the id of the environment, so that a copy of it is not watched."""
_hooked: weakref.WeakKeyDictionary[Any, tuple[Callable[..., object], bool]] = weakref.WeakKeyDictionary()
"""The classes that are hooked: the function that replaces `reset`, and whether the class had its own."""


def _own(name: str) -> Callable[..., object]:
    """Return the `step` or `reset` of a recorded environment; a copy is not recorded."""

    def call(env: Any, *arguments: object, **named: object) -> object:
        watched = _watched.get(id(env))
        if watched is None or watched.is_inside:
            return getattr(type(env), name)(env, *arguments, **named)
        watched.is_inside = True
        try:
            return getattr(watched.recorded, name)(*arguments, **named)
        finally:
            watched.is_inside = False

    call.__name__ = name  # pickle finds the method of an unpickled environment by it
    return call


_METHODS: Final = {"step": _own("step"), "reset": _own("reset")}


def _find_run(env: object) -> None:
    """Give an environment that is about to be reset to the run that waits for one, if any."""
    waiting = [run for run in open_runs if run.waits_for_environment]
    library = _library_that_resets() if waiting and not isinstance(env, Recorded) else None
    if library is not None:
        for run in waiting:
            run.warn_once(
                f"environments that {library} steps are not recorded by this run, but by "
                f"{_VECTORS_OF_OTHERS[library]}, into whose recording its values go then."
            )
    elif waiting:
        waiting[0].begin_with(env)
    elif not isinstance(env, Recorded):
        for run in open_runs:
            if run.has_environment:
                run.warn_once(
                    f"run {run.run_id} records the environment that was reset first, and no other: "
                    f"{env} is not recorded. runner.record(env) records it in a run of its own.",
                    about=OTHERS,
                )
        update_hooks()


def _library_that_resets() -> str | None:
    """Return the library that resets the environment, if it steps vectors of its own."""
    frame: FrameType | None = sys._getframe(2)
    while frame is not None:
        top = str(frame.f_globals.get("__name__")).partition(".")[0]
        if top in _VECTORS_OF_OTHERS:
            return top
        frame = frame.f_back
    return None


def update_hooks() -> None:
    """Let every class of environments look for a run when one is reset, as long as a run needs it."""
    is_needed = any(run.looks_at_resets for run in open_runs)
    if is_needed and not _hooked:
        for base in _BASES:
            _hook_with_subclasses(base)
    elif _hooked and not is_needed:
        _take_hooks_off()


def _hook_with_subclasses(base: Any) -> None:
    """Hook a class of environments, its subclasses, and those that are defined from now on."""
    classes = [base]
    while classes:
        cls = classes.pop()
        _hook(cls)
        classes += cls.__subclasses__()

    def hook_subclass(cls: Any, /, **named: object) -> None:
        super(base, cls).__init_subclass__(**named)
        _hook(cls)

    base.__init_subclass__ = classmethod(hook_subclass)


def _hook(cls: Any) -> None:
    """Replace the `reset` of a class, wherever it inherits it: EnvPool's is not of a class of Gymnasium's."""
    owner = next((base for base in cls.__mro__ if "reset" in vars(base)), None)
    if owner is None or owner in _hooked:
        return
    original = vars(owner)["reset"]

    @functools.wraps(original)
    def reset(self: Any, *arguments: object, **named: object) -> object:
        if id(self) not in _watched and not any(watched.is_inside for watched in _watched.values()):
            _find_run(self)
            if id(self) in _watched:
                return self.reset(*arguments, **named)
        return original(self, *arguments, **named)

    _hooked[cls] = reset, owner is cls
    cls.reset = reset


def _take_hooks_off() -> None:
    """Give all classes their own `reset` back, unless somebody else replaced it meanwhile."""
    for base in _BASES:
        del base.__init_subclass__
    for cls, (reset, has_own) in _hooked.items():
        if vars(cls).get("reset") is reset:
            del cls.reset
            if has_own:
                cls.reset = reset.__wrapped__
    _hooked.clear()


def _after_fork() -> None:
    """In a forked process: the runs belong to the other process."""
    for run in open_runs:
        run.disown()
    open_runs.clear()
    _watched.clear()
    update_hooks()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
