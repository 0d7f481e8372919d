"""What the shapes of other trackers have in common: nothing in them ends a script."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import wraps
from typing import Any

from runner.loops.values import warn_user

_warned: set[str] = set()


def as_run_name(text: str) -> str | None:
    """Return a text as a run can have it for its name; None if nothing is left of it."""
    return re.sub(r"[^A-Za-z0-9_.+/-]", "-", text)[:100].lstrip(".-+/") or None


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


class WithoutEffect:
    """Stands for what a script expects of its tracker and a recording has no place for; it is false.

    Its attributes, items and what it returns are itself, so that any use of it goes on.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def __call__(self, *_: object, **__: object) -> WithoutEffect:  # noqa: D102
        return self

    def __getattr__(self, name: str) -> WithoutEffect:
        if name.startswith("__"):
            raise AttributeError(name)
        return self

    def __getitem__(self, key: object) -> WithoutEffect:
        return self

    def __setitem__(self, key: object, value: object) -> None: ...

    def __enter__(self) -> WithoutEffect:
        return self

    def __exit__(self, *_: object) -> None: ...

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
