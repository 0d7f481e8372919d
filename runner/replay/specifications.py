"""The specification of a recorded environment, parsed with checks; nothing is imported or made here.

What of it may be made is decided in `runner.replay.trust`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from runner.errors import CannotRedo
from runner.recording.maker import EnvironmentMaker, VectorMaker
from runner.replay.trust import is_left_out
from runner.util.values import Json, is_whole

_MAX_SPEC: Final = 1 << 16
"""The most characters of a specification that is not trusted."""
_MAX_STEPS: Final = 2**62
Wrapper = tuple[str, str, dict[str, object]]
"""Name, entry point and keyword arguments of a wrapper."""


@dataclass(frozen=True)
class EnvironmentSpec:
    """The parts of Gymnasium's `EnvSpec` that a recording gives."""

    id: str
    entry_point: str
    kwargs: Json
    max_episode_steps: int | None
    wrappers: tuple[Wrapper, ...]
    """From the innermost out."""


def modules_of(maker: EnvironmentMaker) -> list[str]:
    """Return the modules that an environment's specification has imported.

    Raises:
        CannotRedo: it is no specification.
    """
    if maker.kind == "pettingzoo":
        module, _, _, around = parse_game(maker.spec)
        return [module, *(entry_point.partition(":")[0] for _, entry_point, _ in around)]
    spec = parse_spec(maker.spec)
    wrappers = [*spec.wrappers, *(vector_wrappers(maker.vector) if maker.vector else ())]
    names = [maker.registered_by, spec.entry_point, *(entry_point for _, entry_point, _ in wrappers)]
    return [name.partition(":")[0] for name in dict.fromkeys(names) if name]


def parse_spec(text: str) -> EnvironmentSpec:
    """Return the specification in the JSON of an `EnvSpec`.

    Raises:
        CannotRedo: a part is missing or of the wrong type.
    """
    values = _json_of(text)
    wrappers = values.get("additional_wrappers") or []
    limit = values.get("max_episode_steps")
    name, entry_point, kwargs = values.get("id"), values.get("entry_point"), values.get("kwargs") or {}
    if not isinstance(name, str) or ":" in name or not isinstance(entry_point, str | None):
        raise CannotRedo("The specification of the recorded environment has no id or entry point.")
    if not isinstance(kwargs, dict) or not (limit is None or is_whole(limit, 1, _MAX_STEPS)):
        raise CannotRedo(f"The specification of {name} has arguments or a step limit that are not possible.")
    return EnvironmentSpec(name, entry_point or "", kwargs, limit, _wrappers_of(wrappers, name))


def _wrappers_of(values: object, owner: str) -> tuple[Wrapper, ...]:
    """Return the wrappers in the JSON of `WrapperSpec`s.

    Raises:
        CannotRedo: one lacks its name, entry point or arguments.
    """
    wrappers = []
    for value in values if isinstance(values, list) else [None]:
        own = value if isinstance(value, Mapping) else {}
        entry_point, kwargs = own.get("entry_point"), own.get("kwargs")
        name = own.get("name", entry_point)
        if not isinstance(name, str) or not isinstance(entry_point, str) or not isinstance(kwargs, dict):
            raise CannotRedo(f"A wrapper of {owner} does not state its class and arguments.")
        wrappers.append((name, entry_point, kwargs))
    return tuple(wrappers)


def parse_game(text: str) -> tuple[str, str, dict[str, object], tuple[Wrapper, ...]]:
    """Return module, function, keyword arguments and wrappers of a PettingZoo environment."""
    values = _json_of(text)
    entry_point, kwargs = values.get("entry_point"), values.get("kwargs") or {}
    module, _, function = entry_point.partition(":") if isinstance(entry_point, str) else ("", "", "")
    if not module or not function or not isinstance(kwargs, dict):
        raise CannotRedo("The specification of the recorded environment has no entry point.")
    return module, function, kwargs, _wrappers_of(values.get("wrappers") or [], "the game")


def _json_of(text: str) -> dict[str, object]:
    if len(text) > _MAX_SPEC:
        raise CannotRedo(
            f"The specification of the recorded environment has {len(text):,} characters, expected "
            f"{_MAX_SPEC:,} at most."
        )
    values: dict[str, object] = json.loads(text or "{}")  # `parse_maker` checked it
    return values


def vector_wrappers(vector: VectorMaker) -> list[Wrapper]:
    """Return the wrappers around a vector that change what it returns, from the innermost out."""
    return [
        wrapper
        for wrapper in _wrappers_of(json.loads(vector.wrapper_specs or "[]"), "the vector")
        if not is_left_out(wrapper[1])
    ]
