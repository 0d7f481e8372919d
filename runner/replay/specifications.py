"""The specification of a recorded environment, parsed with checks; nothing is imported or made here.

What of it may be made is decided in `runner.replay.trust`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Final, TypeVar

from msgspec import Meta

from runner.errors import CannotRedo, RecordingError
from runner.recording.maker import EnvironmentMaker, VectorMaker
from runner.replay.trust import is_left_out
from runner.util.stored import stored_as

_MAX_SPEC: Final = 1 << 16
"""The most characters of a specification that is not trusted."""
_WHAT: Final = "The specification of the recorded environment"
_T = TypeVar("_T")


@dataclass(frozen=True)
class Wrapper:
    """The parts of Gymnasium's `WrapperSpec` that a recording gives."""

    entry_point: str
    kwargs: Mapping[str, Any]


@dataclass(frozen=True)
class EnvironmentSpec:
    """The parts of Gymnasium's `EnvSpec` that a recording gives."""

    id: str
    entry_point: str | None = None
    """None of a vector that has an entry point of its own."""
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    max_episode_steps: Annotated[int, Meta(ge=1, le=2**62)] | None = None
    additional_wrappers: tuple[Wrapper, ...] = ()
    """From the innermost out."""

    def __post_init__(self) -> None:
        """Refuse an id for which Gymnasium would import a module."""
        if ":" in self.id:
            raise ValueError(f"found {self.id!r} as id, expected an id without a module")


@dataclass(frozen=True)
class GameSpec:
    """What makes a game: `module:function`, its arguments, and the wrappers around the result."""

    entry_point: str
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    wrappers: tuple[Wrapper, ...] = ()

    def __post_init__(self) -> None:
        """Refuse what names no function."""
        module, _, function = self.entry_point.partition(":")
        if not module or not function:
            raise ValueError(f"found {self.entry_point!r} as entry_point, expected module:function")


def modules_of(maker: EnvironmentMaker) -> list[str]:
    """Return the modules that an environment's specification has imported.

    Raises:
        CannotRedo: it is no specification.
    """
    if maker.kind == "pettingzoo":
        game = parsed(GameSpec, maker.spec)
        names = [game.entry_point, *(wrapper.entry_point for wrapper in game.wrappers)]
        return [name.partition(":")[0] for name in names]
    spec = parsed(EnvironmentSpec, maker.spec)
    wrappers = [*spec.additional_wrappers, *(vector_wrappers(maker.vector) if maker.vector else ())]
    entry_points = [maker.registered_by, spec.entry_point, *(wrapper.entry_point for wrapper in wrappers)]
    return [name.partition(":")[0] for name in dict.fromkeys(entry_points) if name]


def parsed(kind: type[_T], text: str) -> _T:
    """Return the specification in a JSON text: an `EnvironmentSpec`, a `GameSpec` or a tuple of `Wrapper`s.

    Raises:
        CannotRedo: it is too long, or a part is missing or of the wrong type.
    """
    if len(text) > _MAX_SPEC:
        raise CannotRedo(f"{_WHAT} has {len(text):,} characters, expected {_MAX_SPEC:,} at most.")
    try:
        return stored_as(kind, json.loads(text or "{}"), f"{_WHAT} is not possible")
    except RecordingError as error:
        raise CannotRedo(str(error)) from error


def vector_wrappers(vector: VectorMaker) -> list[Wrapper]:
    """Return the wrappers around a vector that change what it returns, from the innermost out."""
    wrappers = parsed(tuple[Wrapper, ...], vector.wrapper_specs or "[]")
    return [wrapper for wrapper in wrappers if not is_left_out(wrapper.entry_point)]
