"""Wrappers and arguments of a loop's environment, as a specification from which Gymnasium makes it again."""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
from gymnasium.envs.registration import WrapperSpec
from gymnasium.utils import RecordConstructorArgs
from gymnasium.wrappers import HumanRendering, OrderEnforcing, PassiveEnvChecker, RecordVideo, TimeLimit
from gymnasium.wrappers.vector import HumanRendering as VectorHumanRendering
from gymnasium.wrappers.vector import RecordVideo as VectorRecordVideo

from runner.recording.maker import FUNCTION_NAME
from runner.util.values import MAX_TEXT

_SHOWS_ONLY: Final = (RecordVideo, HumanRendering, VectorRecordVideo, VectorHumanRendering)
"""Wrappers that only show or store pictures: left out when the environment is made again."""
_SB3_ATARI: Final = "stable_baselines3.common.atari_wrappers"
OBSERVERS: Final = frozenset(
    {
        "sb3_contrib.common.wrappers.action_masker:ActionMasker",
        "stable_baselines3.common.monitor:Monitor",
        f"{_SB3_ATARI}:AtariWrapper",  # puts the other ones together
    }
)
"""Wrappers of Stable-Baselines3 that themselves change no observation, reward or end: left out, too."""


class CannotBeMade(Exception):
    """Why a part of the environment cannot be made again."""


def layers_of(env: object) -> Iterator[Any]:
    """Yield an environment's wrappers from the outermost in, and the environment inside of them."""
    innermost = getattr(env, "unwrapped", env)
    while env is not innermost and env is not None:
        yield env
        # PettingZoo's wrappers look up what they do not have inside: `env` comes first.
        env = getattr(env, "env", None) or getattr(env, "aec_env", None)
    yield innermost


def wrappers_as_fields(wrappers: Sequence[Any], assumed: list[str]) -> dict[str, object]:
    """Return the fields of an `EnvSpec` that describe wrappers, given from the innermost out.

    The innermost three are fields of their own if they are those of `gymnasium.make`.
    """
    left = list(wrappers)
    checker = left.pop(0) if left and type(left[0]) is PassiveEnvChecker else None
    order = left.pop(0) if left and type(left[0]) is OrderEnforcing else None
    limit = left.pop(0) if left and type(left[0]) is TimeLimit else None
    return {
        "disable_env_checker": checker is None,
        "order_enforce": order is not None,
        "max_episode_steps": None if limit is None else limit._max_episode_steps,
        "additional_wrappers": [wrapper_fields(wrapper, assumed) for wrapper in left],
    }


def only_observes(wrapper: object) -> bool:
    """Return whether a wrapper changes nothing that is recorded, and can be left out."""
    return isinstance(wrapper, _SHOWS_ONLY) or class_name(wrapper) in OBSERVERS


def declared_wrapper_fields(spec: WrapperSpec, assumed: list[str]) -> dict[str, object]:
    """Return the fields of a wrapper's specification, which has no arguments if it does not record them."""
    if spec.kwargs is None:
        module, _, name = spec.entry_point.partition(":")
        if default_arguments(getattr(importlib.import_module(module), name), ("env",)):
            assumed.append(spec.entry_point)
    kwargs = plain_kwargs(spec.kwargs or {}, f"the wrapper {spec.entry_point}")
    return {"name": spec.name, "entry_point": spec.entry_point, "kwargs": kwargs}


def wrapper_fields(wrapper: object, assumed: list[str]) -> dict[str, object]:
    """Return the fields of a `WrapperSpec`; add the wrapper to `assumed` if its arguments are unknown."""
    kind, name = type(wrapper), class_name(wrapper)
    parameters = inspect.signature(kind).parameters
    kwargs = getattr(wrapper, "_saved_kwargs", None) if isinstance(wrapper, RecordConstructorArgs) else None
    kwargs = None if kwargs is None else {key: value for key, value in kwargs.items() if key != "env"}
    if kind.__module__ == _SB3_ATARI:  # they keep their arguments under their names
        fields = {key: getattr(wrapper, key, getattr(wrapper, f"_{key}", None)) for key in parameters}
        kwargs = {key: value for key, value in fields.items() if key != "env" and value is not None}
    # A class that inherits from one that records its arguments may have others.
    if kwargs is None or not kwargs.keys() <= parameters.keys():
        kwargs = {}
        if default_arguments(kind, ("env",)):
            assumed.append(name)
    spec = WrapperSpec(kind.__name__, entry_point_of(kind), plain_kwargs(kwargs, f"the wrapper {name}"))
    return {"name": spec.name, "entry_point": spec.entry_point, "kwargs": spec.kwargs}


def default_arguments(kind: type, given: Sequence[str]) -> list[str]:
    """Return the parameters of a class that have default values, if all have but `given`.

    Raises:
        CannotBeMade: another one has none.
    """
    variable = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    parameters = [one for one in inspect.signature(kind).parameters.values() if one.kind not in variable]
    others = [one for one in parameters if one.name not in given]
    if len(parameters) - len(others) < len(given) or any(one.default is one.empty for one in others):
        raise CannotBeMade(f"{kind.__module__}:{kind.__qualname__} does not record its arguments")
    return [one.name for one in others]


def plain_kwargs(kwargs: Mapping[str, object], owner: str) -> dict[str, object]:
    """Return keyword arguments that JSON can hold.

    Raises:
        CannotBeMade: it cannot hold one.
    """
    for name, value in kwargs.items():
        try:
            is_plain = _is_plain(value)
        except RecursionError:
            is_plain = False
        if not is_plain:
            type_name = f"{type(value).__module__}:{type(value).__qualname__}"
            raise CannotBeMade(f"{owner} has the argument {name}, of {type_name}, which JSON cannot hold")
    return dict(kwargs)


def _is_plain(value: object) -> bool:
    if isinstance(value, list | tuple):
        return all(map(_is_plain, value))
    if isinstance(value, dict):
        return all(isinstance(key, str) and _is_plain(part) for key, part in value.items())
    return value is None or isinstance(value, str | int | float | np.number | np.bool_)


def plain_number(value: np.generic) -> object:
    """Return a number of NumPy as JSON holds it."""
    return value.item()


def top_package(module: str) -> str:
    """Return the top package of a module, or of `module:class`."""
    return module.partition(":")[0].partition(".")[0]


def class_name(instance: object) -> str:
    """Return `module:class` of an instance, cut at the length that a recording holds."""
    return f"{type(instance).__module__}:{type(instance).__qualname__}"[:MAX_TEXT]


def entry_point_of(value: object) -> str:
    """Return the `module:name` from which `gymnasium.make` gets a class or function.

    Raises:
        CannotBeMade: it cannot be imported by such a name.
    """
    text = value if isinstance(value, str) else ""
    if not text and callable(value):
        module, name = getattr(value, "__module__", None), getattr(value, "__qualname__", "?")
        if module == "__main__":
            raise CannotBeMade(f"{name} is defined in the script that was run")
        if getattr(sys.modules.get(str(module)), name, None) is value:
            text = f"{module}:{name}"
    if not FUNCTION_NAME.fullmatch(text) or "." in text.partition(":")[2]:
        raise CannotBeMade(f"{value!r} cannot be imported by name"[:MAX_TEXT])
    if text.startswith("__main__:"):
        raise CannotBeMade(f"{text} is defined in the script that was run")
    return text
