"""Wrappers and arguments of a loop's environment, as a specification from which Gymnasium makes it again."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Sequence
from pkgutil import resolve_name
from typing import Any, Final

from gymnasium.envs.registration import EnvSpec, WrapperSpec
from gymnasium.wrappers import HumanRendering, OrderEnforcing, PassiveEnvChecker, RecordVideo, TimeLimit
from gymnasium.wrappers.vector import HumanRendering as VectorHumanRendering
from gymnasium.wrappers.vector import RecordVideo as VectorRecordVideo

from runner.environments.layers import class_name, creator_of, name_of
from runner.loops.arguments import VARIABLE, CannotBeMade, arguments_of, factory_of, plain_kwargs
from runner.recording.maker import FUNCTION_NAME
from runner.replay.scripts import MAIN
from runner.replay.trust import is_left_out
from runner.util.values import MAX_TEXT, Json

_SHOWS_ONLY: Final = (RecordVideo, HumanRendering, VectorRecordVideo, VectorHumanRendering)
"""Wrappers that only show or store pictures: left out when the environment is made again."""
OBSERVERS: Final = frozenset(
    {
        "sb3_contrib.common.wrappers.action_masker:ActionMasker",
        "stable_baselines3.common.monitor:Monitor",
        "stable_baselines3.common.atari_wrappers:AtariWrapper",  # puts the other ones together
    }
)
"""Wrappers of Stable-Baselines3 that themselves change no observation, reward or end: left out, too."""


def wrappers_as_fields(wrappers: Sequence[Any], spec: object, assumed: list[str]) -> Json:
    """Return the fields of an `EnvSpec` that describe wrappers, given from the innermost out.

    Wrappers that the entry point itself puts around its environment are only counted: it does so again. The
    wrappers that `gymnasium.make` adds next are fields of their own.
    """
    left = list(wrappers)
    inner = 0
    if isinstance(spec, EnvSpec) and not isinstance(creator_of(spec), type):
        checkers = (PassiveEnvChecker, OrderEnforcing)
        firsts = [number for number, wrapper in enumerate(left) if type(wrapper) in checkers]
        inner = next(iter(firsts), 0)
        if not firsts:  # both were left out, or only an inner environment is recorded
            assumed.append(name_of(spec.entry_point))
    del left[:inner]
    checker = left.pop(0) if left and type(left[0]) is PassiveEnvChecker else None
    order = left.pop(0) if left and type(left[0]) is OrderEnforcing else None
    limit = left.pop(0) if left and type(left[0]) is TimeLimit else None
    return {
        "inner_wrappers": inner,
        "disable_env_checker": checker is None,
        "order_enforce": order is not None,
        "max_episode_steps": None if limit is None else limit._max_episode_steps,
        "additional_wrappers": [wrapper_fields(wrapper, assumed) for wrapper in left],
    }


def return_name(names: Sequence[str]) -> str:
    """Return the name under which the returns of episode statistics are logged; empty if there is no need.

    Statistics of episodes inside of a wrapper that changes rewards, such as `NormalizeReward`, have returns
    that the recorded rewards do not show.

    Args:
        names: the wrappers, `module:class`, from the outermost in.
    """
    classes = [name.rpartition(":")[2] for name in names]
    inside = next((at for at, name in enumerate(classes) if name == "RecordEpisodeStatistics"), 0)
    changing = [name for name in classes[:inside] if "Reward" in name]
    return f"return before {changing[-1]}" if changing else ""


def only_observes(wrapper: object) -> bool:
    """Return whether a wrapper changes nothing that is recorded, and can be left out."""
    return isinstance(wrapper, _SHOWS_ONLY) or class_name(wrapper) in OBSERVERS


def declared_wrapper_fields(spec: WrapperSpec, assumed: list[str]) -> Json:
    """Return the fields of a wrapper's specification, which has no arguments if it does not record them."""
    if spec.kwargs is None:
        parameters = inspect.signature(resolve_name(spec.entry_point)).parameters.values()
        others = [parameter for parameter in parameters if parameter.name != "env"]
        if any(other.default is other.empty for other in others if other.kind not in VARIABLE):
            raise CannotBeMade(f"the wrapper {spec.entry_point} does not record its arguments")
        if others:
            assumed.append(spec.entry_point)
    kwargs = plain_kwargs(spec.kwargs or {}, f"the wrapper {spec.entry_point}")
    return {"name": spec.name, "entry_point": spec.entry_point, "kwargs": kwargs}


def wrapper_fields(wrapper: object, assumed: list[str]) -> Json:
    """Return the fields of a `WrapperSpec`; add the wrapper to `assumed` if its arguments are unknown."""
    name = class_name(wrapper)
    kwargs, is_certain = arguments_of(wrapper, "env")
    if not is_certain and not is_left_out(name):
        assumed.append(name)
    kwargs = plain_kwargs(kwargs, f"the wrapper {name}")
    return {"name": type(wrapper).__name__, "entry_point": entry_point_of(type(wrapper)), "kwargs": kwargs}


def game_wrapper_fields(wrapper: object, assumed: list[str]) -> Json:
    """Return what makes a wrapper around a game: a class, or a function as SuperSuit has them."""
    name = class_name(wrapper)
    try:
        kwargs, is_certain = arguments_of(wrapper, "env")
        entry_point, kwargs = entry_point_of(type(wrapper)), plain_kwargs(kwargs, f"the wrapper {name}")
    except CannotBeMade:
        entry_point, kwargs, is_certain = factory_of(wrapper)
    assumed += [] if is_certain else [name]
    return {"entry_point": entry_point, "kwargs": kwargs}


def entry_point_of(value: object) -> str:
    """Return the `module:name` from which `gymnasium.make` gets a class or function.

    Raises:
        CannotBeMade: it cannot be imported by such a name.
    """
    text = name_of(value)
    module, _, name = text.partition(":")
    is_there = isinstance(value, str) or getattr(sys.modules.get(module), name, None) is value
    if not is_there or not FUNCTION_NAME.fullmatch(text) or "." in name:
        raise CannotBeMade(f"{text} cannot be imported by name"[:MAX_TEXT])
    if module == MAIN and not getattr(sys.modules[MAIN], "__file__", None):
        raise CannotBeMade(f"{text} is defined in no file")
    return text
