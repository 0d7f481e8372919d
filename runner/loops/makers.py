"""How a loop's environment was made: read from the environment, without changing it.

Nothing here takes the `__dict__` of an environment, for the reason in `runner.loops.generators`.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import json
import platform
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Final

import numpy as np
from gymnasium.envs.registration import EnvSpec, WrapperSpec
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorActionWrapper, VectorEnv
from gymnasium.wrappers import HumanRendering, OrderEnforcing, PassiveEnvChecker, RecordVideo, TimeLimit
from gymnasium.wrappers.vector import HumanRendering as VectorHumanRendering
from gymnasium.wrappers.vector import RecordVideo as VectorRecordVideo

from runner.errors import ConfigError
from runner.loops.actions import action_names
from runner.loops.vec_env import LIBRARY, VecEnvVector, mode_of
from runner.recording.maker import FUNCTION_NAME, MAX_SPEC, EnvironmentMaker, VectorMaker
from runner.replay.stepping_vector import spaces_of_one
from runner.replay.turns import Turns
from runner.util.values import MAX_TEXT

_NAME_MAKE: Final = 'name a function that makes it: make="module:function"'
_SHOWS_ONLY: Final = (RecordVideo, HumanRendering, VectorRecordVideo, VectorHumanRendering)
"""Wrappers that only show or store pictures: left out when the environment is made again."""
_SB3_ATARI: Final = "stable_baselines3.common.atari_wrappers"
_OBSERVERS: Final = frozenset(
    {
        "sb3_contrib.common.wrappers.action_masker:ActionMasker",
        "stable_baselines3.common.monitor:Monitor",
        f"{_SB3_ATARI}:AtariWrapper",  # puts the other ones together
    }
)
"""Wrappers of Stable-Baselines3 that themselves change no observation, reward or end: left out, too."""
_SIMULATORS: Final = ("Box2D", "ale_py", "mujoco", "pettingzoo", "supersuit")
"""Modules whose versions are recorded if they are loaded."""
_DISTRIBUTIONS: Final = {"Box2D": ("box2d", "box2d-py")}
"""The distributions of modules with other names."""


class _Unknown(Exception):
    """Why a part of the environment cannot be made again."""


def maker_of(env: Any, make: str = "") -> EnvironmentMaker:
    """Return how a Gymnasium environment was made; `make` is the function that the user named, if any."""
    layers = list(_layers(env))
    names = tuple(_class_name(layer) for layer in layers[:-1])
    actions = action_names(env, env.action_space)
    maker = EnvironmentMaker("gymnasium", make=make, wrappers=names, action_names=actions)
    wrappers = [layer for layer in reversed(layers[:-1]) if not _only_observes(layer)]
    top = _top(type(layers[-1]).__module__)
    return _with_spec(maker, getattr(layers[-1], "spec", None), partial(_wrapping, wrappers), top)


def _maker_of_spec(spec: Any) -> EnvironmentMaker:
    """Return how an environment in another process was made, whose specification has its wrappers."""
    wrappers = getattr(spec, "additional_wrappers", ())
    names = tuple(wrapper.entry_point for wrapper in reversed(wrappers))

    def wrapping(assumed: list[str]) -> dict[str, Any]:
        left = [wrapper for wrapper in wrappers if wrapper.entry_point not in _OBSERVERS]
        fields = "disable_env_checker", "order_enforce", "max_episode_steps"
        return {name: getattr(spec, name) for name in fields} | {
            "additional_wrappers": [_known_wrapper(wrapper, assumed) for wrapper in left]
        }

    return _with_spec(EnvironmentMaker("gymnasium", wrappers=names), spec, wrapping, "")


def _with_spec(
    maker: EnvironmentMaker, spec: Any, wrapping: Callable[[list[str]], dict[str, Any]], top: str
) -> EnvironmentMaker:
    """Return a maker with a specification.

    Args:
        maker: has the names of the wrappers.
        spec: Gymnasium's, of the environment inside of them.
        wrapping: returns the fields that describe the wrappers; appends those whose arguments are unknown.
        top: the top package of the environment, for versions where there is no specification.
    """
    if not isinstance(spec, EnvSpec):
        return _with_versions(maker, [top] if top else [], "it was not made by gymnasium.make")
    assumed: list[str] = []
    try:
        entry_point = _entry_point(spec.entry_point)
        fields = {
            "id": spec.id,
            "entry_point": entry_point,
            "reward_threshold": spec.reward_threshold,
            "nondeterministic": spec.nondeterministic,
            "kwargs": _checked_kwargs(spec.kwargs, spec.id),
        }
        text = json.dumps(fields | wrapping(assumed), default=_plain_number)
    except _Unknown as reason:
        return _with_versions(maker, [top] if top else [], reason)
    top = _top(entry_point)
    maker = replace(maker, spec=text, registered_by="" if top == "gymnasium" else top, assumed=tuple(assumed))
    return _with_versions(maker, [top, *(_top(name) for name in maker.wrappers if name not in _OBSERVERS)])


def vector_maker_of(
    envs: VectorEnv[Any, Any, Any], first: Any, autoreset: AutoresetMode, make: str = ""
) -> EnvironmentMaker:
    """Return how a vector environment was made.

    Args:
        envs: the vector environment.
        first: its first environment, or one made as that was; the vector itself if there is none.
        autoreset: how its environments reset themselves.
        make: the function that the user named, if any.
    """
    layers = list(_layers(envs))
    base, reason = layers[-1], ""
    mode = mode_of(base)
    if mode == "custom":
        maker = _custom_vector(base)
    elif first is base:  # its environments are in other processes
        maker = _maker_of_spec(base.spec)
    else:
        maker = maker_of(first)
        if mode == "sync" and any(maker_of(other) != maker for other in base.envs[1:]):
            reason = f"its environments were not all made in the same way; {_NAME_MAKE}"
    assumed = list(maker.assumed)
    specs = "[]"
    try:
        wrappers = [layer for layer in reversed(layers[:-1]) if not _only_observes(layer)]
        specs = json.dumps([_wrapper_spec(wrapper, assumed) for wrapper in wrappers], default=_plain_number)
    except _Unknown as unknown:
        reason = reason or f"{unknown}; {_NAME_MAKE}"
    names = tuple(_class_name(layer) for layer in layers[:-1])
    has_others = any(isinstance(layer, VectorActionWrapper) for layer in layers)
    space = spaces_of_one(envs)[1]
    return replace(
        maker,
        kind="vector",
        make=make,
        reason=maker.reason or reason,
        assumed=tuple(assumed),
        vector=VectorMaker(
            int(envs.num_envs),
            mode,
            autoreset.value,
            names,
            specs,
            LIBRARY if isinstance(base, VecEnvVector) else "",
        ),
        action_names=() if has_others else action_names(first, space),
    )


def _custom_vector(base: Any) -> EnvironmentMaker:
    """Return how a vector environment of its own class was made."""
    spec, top = getattr(base, "spec", None), _top(type(base).__module__)
    if not isinstance(spec, EnvSpec):
        reason = f"{_class_name(base)} does not state how it was made"
        return _with_versions(EnvironmentMaker("vector"), [top], reason)
    try:
        entry_point = _entry_point(spec.vector_entry_point)
        fields: dict[str, Any] = {
            "id": spec.id,
            "entry_point": _entry_point(spec.entry_point) if spec.entry_point else None,
            "vector_entry_point": entry_point,
            "max_episode_steps": spec.max_episode_steps,
            "kwargs": _checked_kwargs(spec.kwargs, spec.id),
            "additional_wrappers": [],
        }
        text = json.dumps(fields, default=_plain_number)
    except _Unknown as unknown:
        return _with_versions(EnvironmentMaker("vector"), [top], unknown)
    top = _top(entry_point.partition(":")[0])
    registered_by = "" if top == "gymnasium" else top
    return _with_versions(EnvironmentMaker("vector", spec=text, registered_by=registered_by), [top])


def game_maker_of(env: Any, make: str = "") -> EnvironmentMaker:
    """Return how a PettingZoo parallel environment was made; `make` is the function that the user named.

    By PettingZoo's convention the module of a game has a function `parallel_env`, and `env` for the game in
    turns, which also adds the wrappers that belong to the game.
    """
    is_in_turns = isinstance(env, Turns)
    function = "env" if is_in_turns else "parallel_env"
    layers = list(_layers(env.env if is_in_turns else env))
    base, outer = layers[-1], layers[0]
    module = type(base).__module__
    named = {str(agent): action_names(base, env.action_space(agent)) for agent in env.possible_agents}
    maker = EnvironmentMaker(
        "pettingzoo",
        make=make,
        wrappers=tuple(map(_class_name, layers[:-1])),
        agent_action_names={agent: names for agent, names in named.items() if names},
    )
    top, assumed = _top(module), []
    try:
        has_function = callable(getattr(sys.modules.get(module), function, None))
        foreign = [layer for layer in layers[:-1] if not type(layer).__module__.startswith("pettingzoo.")]
        is_converted = getattr(outer, "env", None) is None and hasattr(outer, "aec_env")
        if outer is not base and not (has_function and (is_converted or is_in_turns)):
            foreign.append(outer)
        if foreign:
            raise _Unknown(f"the wrapper {_class_name(foreign[0])} does not record its arguments")
        arguments = getattr(base, "_ezpickle_kwargs", None)
        if arguments is None:
            assumed = _default_arguments(type(base), ())
        elif base._ezpickle_args:
            arguments = inspect.signature(type(base)).bind(*base._ezpickle_args, **arguments).arguments
        entry_point = f"{module}:{function}" if has_function else _entry_point(type(base))
        kwargs = _checked_kwargs(arguments or {}, f"the game {_class_name(base)}")
    except _Unknown as reason:
        return _with_versions(maker, [top], reason)
    spec = json.dumps({"entry_point": entry_point, "kwargs": kwargs}, default=_plain_number)
    maker = replace(maker, spec=spec, registered_by=top, assumed=(_class_name(base),) if assumed else ())
    return _with_versions(maker, [top])


# --- wrappers and arguments ---------------------------------------------------------------------------


def _layers(env: Any) -> Iterator[Any]:
    """Yield an environment's wrappers from the outermost in, and the environment inside of them."""
    innermost = getattr(env, "unwrapped", env)
    while env is not innermost and env is not None:
        yield env
        # PettingZoo's wrappers look up what they do not have inside: `env` comes first.
        env = getattr(env, "env", None) or getattr(env, "aec_env", None)
    yield innermost


def _wrapping(wrappers: Sequence[Any], assumed: list[str]) -> dict[str, Any]:
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
        "additional_wrappers": [_wrapper_spec(wrapper, assumed) for wrapper in left],
    }


def _only_observes(wrapper: Any) -> bool:
    return isinstance(wrapper, _SHOWS_ONLY) or _class_name(wrapper) in _OBSERVERS


def _known_wrapper(spec: WrapperSpec, assumed: list[str]) -> dict[str, Any]:
    """Return the fields of a wrapper's specification, which has no arguments if it does not record them."""
    if spec.kwargs is None:
        module, _, name = spec.entry_point.partition(":")
        if _default_arguments(getattr(importlib.import_module(module), name), ("env",)):
            assumed.append(spec.entry_point)
    kwargs = _checked_kwargs(spec.kwargs or {}, f"the wrapper {spec.entry_point}")
    return {"name": spec.name, "entry_point": spec.entry_point, "kwargs": kwargs}


def _wrapper_spec(wrapper: Any, assumed: list[str]) -> dict[str, Any]:
    """Return the fields of a `WrapperSpec`; add the wrapper to `assumed` if its arguments are unknown."""
    kind, name = type(wrapper), _class_name(wrapper)
    parameters = inspect.signature(kind).parameters
    kwargs = getattr(wrapper, "_saved_kwargs", None) if isinstance(wrapper, RecordConstructorArgs) else None
    kwargs = None if kwargs is None else {key: value for key, value in kwargs.items() if key != "env"}
    if kind.__module__ == _SB3_ATARI:  # they keep their arguments under their names
        kept = {key: getattr(wrapper, key, getattr(wrapper, f"_{key}", None)) for key in parameters}
        kwargs = {key: value for key, value in kept.items() if key != "env" and value is not None}
    # A class that inherits from one that records its arguments may have others.
    if kwargs is None or not kwargs.keys() <= parameters.keys():
        kwargs = {}
        if _default_arguments(kind, ("env",)):
            assumed.append(name)
    spec = WrapperSpec(kind.__name__, _entry_point(kind), _checked_kwargs(kwargs, f"the wrapper {name}"))
    return {"name": spec.name, "entry_point": spec.entry_point, "kwargs": spec.kwargs}


def _default_arguments(kind: type, given: Sequence[str]) -> list[str]:
    """Return the parameters of a class that have default values, if all have but `given`.

    Raises:
        _Unknown: another one has none.
    """
    variable = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    parameters = [one for one in inspect.signature(kind).parameters.values() if one.kind not in variable]
    others = [one for one in parameters if one.name not in given]
    if len(parameters) - len(others) < len(given) or any(one.default is one.empty for one in others):
        raise _Unknown(f"{kind.__module__}:{kind.__qualname__} does not record its arguments")
    return [one.name for one in others]


def _checked_kwargs(kwargs: Mapping[str, Any], owner: str) -> dict[str, Any]:
    """Return keyword arguments that JSON can hold.

    Raises:
        _Unknown: it cannot hold one.
    """
    for name, value in kwargs.items():
        try:
            is_plain = _is_plain(value)
        except RecursionError:
            is_plain = False
        if not is_plain:
            found = f"{type(value).__module__}:{type(value).__qualname__}"
            raise _Unknown(f"{owner} has the argument {name}, of {found}, which JSON cannot hold")
    return dict(kwargs)


def _is_plain(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return all(map(_is_plain, value))
    if isinstance(value, dict):
        return all(isinstance(key, str) and _is_plain(part) for key, part in value.items())
    return value is None or isinstance(value, str | int | float | np.number | np.bool_)


def _plain_number(value: Any) -> Any:
    """Return a number of NumPy as JSON holds it."""
    return value.item()


# --- names and versions -------------------------------------------------------------------------------


def _top(module: str) -> str:
    """Return the top package of a module, or of `module:class`."""
    return module.partition(":")[0].partition(".")[0]


def _class_name(instance: Any) -> str:
    return f"{type(instance).__module__}:{type(instance).__qualname__}"[:MAX_TEXT]


def _entry_point(value: Any) -> str:
    """Return the `module:name` from which `gymnasium.make` gets a class or function.

    Raises:
        _Unknown: it cannot be imported by such a name.
    """
    text = value if isinstance(value, str) else ""
    if not text and callable(value):
        module, name = getattr(value, "__module__", None), getattr(value, "__qualname__", "?")
        if module == "__main__":
            raise _Unknown(f"{name} is defined in the script that was run")
        if getattr(sys.modules.get(str(module)), name, None) is value:
            text = f"{module}:{name}"
    if not FUNCTION_NAME.fullmatch(text) or "." in text.partition(":")[2]:
        raise _Unknown(f"{value!r} cannot be imported by name"[:MAX_TEXT])
    if text.startswith("__main__:"):
        raise _Unknown(f"{text} is defined in the script that was run")
    return text


def checked_make(make: object) -> str:
    """Return the `module:function` of the argument `make` of `record`, a function or its name; "" for None.

    Raises:
        ConfigError: it is something else, or cannot be imported by that name.
    """
    if make is None:
        return ""
    text = make if isinstance(make, str) else f"{_module_of(make)}:{getattr(make, '__qualname__', '?')}"
    if not FUNCTION_NAME.fullmatch(text) or len(text) > MAX_TEXT:
        raise ConfigError(
            f"make: found {make!r}, expected a function at the top of a module, or its name, such as "
            '"train:make_env".'
        )
    module, _, path = text.partition(":")
    try:
        found = sys.modules["__main__"] if module == _main_name() else importlib.import_module(module)
        for name in path.split("."):
            found = getattr(found, name)
    except Exception as error:  # importing a module runs any code
        raise ConfigError(f"make: {text!r} cannot be imported ({error}).") from error
    if not callable(found) or not (isinstance(make, str) or found is make):
        raise ConfigError(
            f"make: found {found!r} as {text!r}, expected the function that makes environments."
        )
    return text


def _module_of(function: object) -> str:
    """Return the name by which another process can import a function's module."""
    module = str(getattr(function, "__module__", "?"))
    return _main_name() or "?" if module == "__main__" else module


def _main_name() -> str | None:
    """Return the name by which another process can import the script that was run; None if there is none."""
    main = sys.modules["__main__"]
    if (spec := getattr(main, "__spec__", None)) is not None:
        return str(spec.name)
    path = getattr(main, "__file__", None)
    if path is None:
        return None
    name = Path(path).stem
    found = importlib.util.find_spec(name) if name.isidentifier() else None
    is_same = found is not None and found.origin and Path(found.origin).resolve() == Path(path).resolve()
    return name if is_same else None


def _with_versions(maker: EnvironmentMaker, tops: Sequence[str], reason: object = "") -> EnvironmentMaker:
    """Return a maker with the versions of the packages, the platform, and why it is incomplete."""
    if reason:
        maker = replace(maker, reason=f"{reason}; {_NAME_MAKE}")
    if len(maker.spec) > MAX_SPEC:
        maker = replace(maker, spec="", reason=f"its arguments take {len(maker.spec):,} bytes; {_NAME_MAKE}")
    return replace(maker, packages=package_versions(tops), platform=_platform(), machine=platform.machine())


def package_versions(tops: Sequence[str] = ()) -> dict[str, str]:
    """Return the versions of Gymnasium, NumPy, simulators that are loaded, and the distributions of modules.

    Args:
        tops: names of further modules, without dots; those that no distribution is named after have no entry.
    """
    names = {"gymnasium", "numpy", *tops, *(name for name in _SIMULATORS if name in sys.modules)}
    found = (_installed(name) for name in sorted(names))
    return dict(one for one in found if one is not None)


@cache
def _installed(module: str) -> tuple[str, str] | None:
    """Return name and version of the distribution that is named after a module; None if there is none."""
    for name in _DISTRIBUTIONS.get(module, (module.replace("_", "-"),)):
        try:
            return name, version(name)
        except (PackageNotFoundError, ValueError):
            continue
    return None


@cache
def _platform() -> str:
    return platform.platform()[:MAX_TEXT]
