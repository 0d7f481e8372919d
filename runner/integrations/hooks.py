"""The environments of a script, recorded without being handed over: the first one that it resets.

While a run waits for an environment, every class of environments of Gymnasium has a `reset` that first looks
for such a run. The outermost environment that the script resets is then stepped through its recorded twin.
The classes get their own `reset` back as soon as no run has to see which environments are reset.
"""

from __future__ import annotations

import contextlib
import functools
import os
import sys
import weakref
from collections.abc import Callable
from types import FrameType, MethodType
from typing import Any, Final, Protocol

import gymnasium
from gymnasium.vector import VectorEnv

from runner.loops.recorded import Recorded

OTHERS: Final = "other environments"
"""The subject of the warning that a run does not record further environments."""
_BASES: Final[tuple[Any, ...]] = (gymnasium.Env, VectorEnv)
_VECTORS_OF_OTHERS: Final = {
    "stable_baselines3": "runner.integrations.sb3.Recording",
    "torchrl": "runner.integrations.torchrl.record",
    "ray": "runner.integrations.rllib.Recording",
}
"""Libraries that step environments in vectors of their own, and what records these."""


class WaitingRun(Protocol):
    """The run of a script that is not closed."""

    run_id: str

    @property
    def waits_for_environment(self) -> bool:
        """Whether the next environment that is reset is this run's."""

    @property
    def has_environment(self) -> bool:
        """Whether it records one that the script did not hand over."""

    @property
    def looks_at_resets(self) -> bool:
        """Whether it waits for an environment, or has to warn of others than its own."""

    def begin_with(self, env: object) -> None:
        """Begin to record an environment that is about to be reset."""

    def warn_once(self, message: str, about: str = "") -> None:
        """Warn the user of something once: of this message, or of what it is about."""

    def disown(self) -> None:
        """Leave the run to the process that this one was just forked from."""


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


open_runs: list[WaitingRun] = []
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
