"""What the shapes of other trackers have in common: how values are logged, and what has no effect.

Nothing in them ends a script.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import wraps
from typing import Any, Literal, Self

import numpy as np

from runner.errors import ConfigError
from runner.integrations.script import ScriptRun
from runner.loops.media import Media
from runner.loops.recorded import ending_of
from runner.loops.values import as_array, warn_user

_warned: set[str] = set()


def as_run_name(text: str) -> str | None:
    """Return a text as a run can have it for its name; None if nothing is left of it."""
    return re.sub(r"[^A-Za-z0-9_.+/-]", "-", text)[:100].lstrip(".-+/") or None


# --- what is logged ----------------------------------------------------------------------------------------


def as_number(name: str, value: object) -> object:
    """Return a number, also one that stands in an array or tensor of one; text is refused.

    Raises:
        ConfigError: it is something else.
    """
    if value.__class__ is float:
        return value
    try:
        return float(np.asarray(as_array(value)).astype(np.float64, casting="same_kind").item())
    except (TypeError, ValueError, RuntimeError) as error:
        raise ConfigError(
            f"add_scalar: found {type(value).__name__} for {name!r}, expected a number"
        ) from error


def forgiving(method: Callable[..., Any]) -> Callable[..., Any]:
    """Let a method of a script's tracker leave out what it cannot record: `self.script` says how."""

    @wraps(method)
    def call(self: Any, *arguments: object, **named: object) -> object:
        try:
            return method(self, *arguments, **named)
        except Exception as error:
            self.script.leave_out(error, method.__name__)
            return None

    return call


def logs(name: str, convert: Callable[..., object], arguments: str, **layout: object) -> Callable[..., None]:
    """Return a method of a tracker that logs a picture, film or array, and leaves out what is none.

        add_video = logs("add_video", film_of, "tag vid_tensor global_step fps", dataformats="NTCHW", fps=4)

    Args:
        name: of the method.
        convert: returns the content of a `Media` for the script's value, and for the layout by name.
        arguments: what the tracker calls the name, the value, the step and further arguments, in its order.
        layout: the arguments that say how to read the value, with their defaults; others are ignored.
    """
    names = arguments.split()

    def method(self: Any, *given: object, **named: object) -> None:
        by_name = dict(zip(names, given, strict=False)) | named
        tag, value, step = map(by_name.get, names[:3])
        media_arguments = {key: by_name.get(key, default) for key, default in layout.items()}
        self.script.log(tag, Media(convert, value, **media_arguments), step)

    method.__name__ = name
    method.__doc__ = f"Log a value; takes {', '.join(names)}."
    return forgiving(method)


# --- what another tracker has -------------------------------------------------------------------------------


class Tracker:
    """What a script logs into, in the shape of another tracker's; a context manager."""

    script: ScriptRun
    _shape: str
    """Its name, for warnings."""
    _end: Callable[[str, str], None]
    """Ends the run with a status and an error."""

    def __getattr__(self, name: str) -> WithoutEffect:
        return without_effect(self._shape, name)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: Any) -> Literal[False]:
        self._end(*ending_of(raised[1]))
        return False


class WithoutEffect:
    """Stands for what a script expects of its tracker and a recording has no place for; it is false.

    Its attributes, items and what it returns are itself, so that any use of it goes on.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> WithoutEffect:
        if name.startswith("__"):
            raise AttributeError(name)
        return self

    def __call__(self, *_: object, **__: object) -> WithoutEffect:
        """Return itself."""
        return self

    __enter__ = __exit__ = __getitem__ = __setitem__ = __call__

    def __iter__(self) -> Iterator[object]:
        return iter(())

    def __bool__(self) -> bool:
        return False

    def __instancecheck__(self, instance: object) -> bool:
        return False

    def __str__(self) -> str:
        return self._name


def warn_once(message: str) -> None:
    """Warn the user of something once in a process."""
    if message not in _warned:
        _warned.add(message)
        warn_user(message)


def without_effect(owner: str, name: str) -> WithoutEffect:
    """Return what stands for an attribute that another tracker's object has, with one warning of each name.

    Raises:
        AttributeError: Python looks for something of its own, such as `__deepcopy__`, or for what an object
            that is being unpickled has not yet.
    """
    if name.startswith("_") or name == "script":
        raise AttributeError(f"{owner} has no attribute {name!r}")
    warn_once(f"{owner}.{name} does nothing: a recording needs no such call, or has no place for it.")
    return WithoutEffect(f"{owner}.{name}")
