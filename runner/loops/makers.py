"""How a loop's environment was made: read from the environment, without changing it.

Nothing here takes the `__dict__` of an environment, for the reason in `runner.loops.generators`.
"""

from __future__ import annotations

import importlib.util
import json
import platform
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, Final

import gymnasium
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, VectorActionWrapper
from gymnasium.wrappers import OrderEnforcing

from runner.environments.gym_types import AnyVectorEnv
from runner.environments.interfaces import (
    MultiAgent,
    Turns,
    class_name,
    layers_of,
    name_of,
    spaces_of_one,
    top_package,
)
from runner.errors import ConfigError
from runner.loops.actions import action_names
from runner.loops.arguments import (
    OBSERVERS,
    CannotBeMade,
    arguments_of,
    declared_wrapper_fields,
    entry_point_of,
    game_wrapper_fields,
    is_plain,
    only_observes,
    plain_kwargs,
    plain_number,
    wrapper_fields,
    wrappers_as_fields,
)
from runner.loops.vec_env import LIBRARY, VecEnvVector, mode_of
from runner.recording.maker import FUNCTION_NAME, MAX_SPEC, EnvironmentMaker, Registered, VectorMaker
from runner.replay.scripts import MAIN
from runner.util.values import MAX_TEXT, Json

NAME_MAKE: Final = 'name a function that makes it: make="module:function"'
_SIMULATORS: Final = ("Box2D", "ale_py", "mujoco", "pettingzoo", "supersuit")
"""Modules: their versions are recorded if they are loaded."""
_DISTRIBUTIONS: Final = {"Box2D": ("box2d", "box2d-py")}
"""The distributions of modules with other names."""


def maker_of(env: Any, make: str = "") -> EnvironmentMaker:
    """Return how a Gymnasium environment was made; `make` is the function that the user named, if any."""
    layers = list(layers_of(env))
    names = tuple(class_name(layer) for layer in layers[:-1])
    actions = action_names(env, env.action_space)
    maker = EnvironmentMaker("gymnasium", make=make, wrappers=names, action_names=actions)
    wrappers = [layer for layer in reversed(layers[:-1]) if not only_observes(layer)]
    spec = getattr(layers[-1], "spec", None)
    return _with_spec(maker, spec, partial(wrappers_as_fields, wrappers, spec), layers[-1])


def _maker_of_spec(spec: object) -> EnvironmentMaker:
    """Return how an environment in another process was made, by its specification, which has its wrappers."""
    wrappers = getattr(spec, "additional_wrappers", ())
    names = tuple(wrapper.entry_point for wrapper in reversed(wrappers))

    def wrapping(assumed: list[str]) -> Json:
        left = [wrapper for wrapper in wrappers if wrapper.entry_point not in OBSERVERS]
        fields = "disable_env_checker", "order_enforce", "max_episode_steps"
        return {name: getattr(spec, name) for name in fields} | {
            "additional_wrappers": [declared_wrapper_fields(wrapper, assumed) for wrapper in left]
        }

    return _with_spec(EnvironmentMaker("gymnasium", wrappers=names), spec, wrapping)


def _with_spec(
    maker: EnvironmentMaker,
    spec: object,
    wrapping: Callable[[list[str]], Json],
    base: object = None,
) -> EnvironmentMaker:
    """Return a maker with a specification.

    Args:
        spec: of Gymnasium; None if the environment's class was called.
        wrapping: returns the fields that describe the wrappers; appends wrappers with unknown arguments.
        base: the environment inside of all wrappers; None if it is in another process.
    """
    assumed: list[str] = []
    try:
        fields, registered_by = (
            _spec_fields(spec) if isinstance(spec, EnvSpec) else _own_fields(base, assumed)
        )
        fields |= wrapping(assumed)
        inner: Any = fields.pop("inner_wrappers", 0)
        text = json.dumps(fields, default=plain_number)
    except CannotBeMade as reason:
        tops = [] if base is None else [top_package(type(base).__module__)]
        return _with_versions(maker, tops, reason)
    top = top_package(str(fields["entry_point"]))
    maker = replace(
        maker,
        spec=text,
        registered_by="" if top in ("gymnasium", MAIN) else registered_by,
        assumed=tuple(assumed),
        inner_wrappers=inner,
        registered=_registered(spec),
    )
    return _with_versions(
        maker, [top, *(top_package(name) for name in maker.wrappers if name not in OBSERVERS)]
    )


def _spec_fields(spec: EnvSpec) -> tuple[Json, str]:
    """Return what is recorded of a specification without wrappers, and the module that registers it."""
    registered = gymnasium.registry.get(spec.id)
    try:
        entry_point = entry_point_of(spec.entry_point)
        registered_by = top_package(entry_point)
    except CannotBeMade:  # a function without a name of its own, which its module registers under the id
        entry_point = name_of(spec.entry_point)
        registered_by = entry_point.partition(":")[0]
        if registered is None or name_of(registered.entry_point) != entry_point or registered_by == MAIN:
            raise
    fields: Json = {
        "id": spec.id,
        "entry_point": entry_point,
        "reward_threshold": spec.reward_threshold,
        "nondeterministic": spec.nondeterministic,
        "kwargs": plain_kwargs(spec.kwargs, spec.id),
    }
    return fields, registered_by


def _registered(spec: object) -> Registered:
    """Return the arguments and the step limit that are registered for the id of a specification."""
    known = gymnasium.registry.get(spec.id) if isinstance(spec, EnvSpec) else None
    if known is None:
        return {}
    kwargs = {name: value for name, value in known.kwargs.items() if is_plain(value)}
    plain = json.loads(json.dumps(kwargs, default=plain_number))
    return {"kwargs": plain, "max_episode_steps": known.max_episode_steps}


def _own_fields(base: object, assumed: list[str]) -> tuple[Json, str]:
    """Return the same as `_spec_fields`, of an environment that was made by calling its class."""
    if base is None:
        raise CannotBeMade("it was not made by gymnasium.make, and is in another process")
    kwargs, is_certain = arguments_of(base)
    if not is_certain:
        assumed.append(class_name(base))
    entry_point = entry_point_of(type(base))
    fields: Json = {
        "id": type(base).__name__,
        "entry_point": entry_point,
        "kwargs": plain_kwargs(kwargs, class_name(base)),
    }
    return fields, top_package(entry_point)


def vector_maker_of(envs: AnyVectorEnv, first: Any, autoreset: AutoresetMode, make: str) -> EnvironmentMaker:
    """Return how a vector environment was made.

    Args:
        first: its first environment, or one made as that was; the vector itself if there is none.
    """
    layers = list(layers_of(envs))
    base = layers[-1]
    reason = ""
    mode = mode_of(base)
    if mode == "custom":
        maker = _custom_vector(base)
    elif first is base:  # its environments are in other processes
        maker = _maker_of_spec(base.spec)
    else:
        maker = maker_of(first)
        if mode == "sync" and any(maker_of(other) != maker for other in base.envs[1:]):
            reason = f"its environments were not all made in the same way; {NAME_MAKE}"
    assumed = list(maker.assumed)
    specs = "[]"
    try:
        wrappers = [layer for layer in reversed(layers[:-1]) if not only_observes(layer)]
        specs = json.dumps([wrapper_fields(wrapper, assumed) for wrapper in wrappers], default=plain_number)
    except CannotBeMade as unknown:
        reason = reason or f"{unknown}; {NAME_MAKE}"
    names = tuple(class_name(layer) for layer in layers[:-1])
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


def _custom_vector(base: object) -> EnvironmentMaker:
    """Return how a vector environment of its own class was made."""
    spec = getattr(base, "spec", None)
    top = top_package(type(base).__module__)
    try:
        if not isinstance(spec, EnvSpec):
            raise CannotBeMade(f"{class_name(base)} does not state how it was made")
        entry_point = entry_point_of(spec.vector_entry_point)
        fields: Json = {
            "id": spec.id,
            "entry_point": entry_point_of(spec.entry_point) if spec.entry_point else None,
            "vector_entry_point": entry_point,
            "max_episode_steps": spec.max_episode_steps,
            "kwargs": plain_kwargs(spec.kwargs, spec.id),
            "additional_wrappers": [],
        }
        text = json.dumps(fields, default=plain_number)
    except CannotBeMade as unknown:
        return _with_versions(EnvironmentMaker("vector"), [top], unknown)
    top = top_package(entry_point.partition(":")[0])
    registered_by = "" if top == "gymnasium" else top
    return _with_versions(EnvironmentMaker("vector", spec=text, registered_by=registered_by), [top])


def game_maker_of(env: Any, make: str) -> EnvironmentMaker:
    """Return how a game with PettingZoo's parallel interface was made; `make` is the user's own function.

    By PettingZoo's convention the module of a game has a function `parallel_env`, and `env` for the game in
    turns, which also adds the wrappers that belong to the game.
    """
    is_in_turns, is_of_rllib = isinstance(env, Turns), isinstance(env, MultiAgent)
    function = "env" if is_in_turns else "parallel_env"
    layers = list(layers_of(env.env if is_in_turns or is_of_rllib else env))
    if is_of_rllib:  # by `gymnasium.make`, around every environment
        layers = [layer for layer in layers if type(layer) is not OrderEnforcing]
    base, outer = layers[-1], layers[0]
    module = type(base).__module__
    named = {str(agent): action_names(base, env.action_space(agent)) for agent in env.possible_agents}
    maker = EnvironmentMaker(
        "pettingzoo",
        make=make,
        wrappers=tuple(map(class_name, layers[:-1])),
        agent_action_names={agent: names for agent, names in named.items() if names},
    )
    top = top_package(module)
    assumed = []
    has_function = callable(getattr(sys.modules.get(module), function, None))
    wrappers = [
        layer for layer in reversed(layers[:-1]) if not type(layer).__module__.startswith("pettingzoo.")
    ]
    try:
        if is_of_rllib:
            if env.creator is None:
                raise CannotBeMade("it is not known what made it")
            entry_point = entry_point_of(env.creator)
            arguments = env.arguments
            wrappers = []
            top = top_package(entry_point)
        else:
            is_converted = getattr(outer, "env", None) is None and hasattr(outer, "aec_env")
            if outer not in (base, *wrappers) and not (has_function and (is_converted or is_in_turns)):
                raise CannotBeMade(f"the wrapper {class_name(outer)} does not record its arguments")
            entry_point = f"{module}:{function}" if has_function else entry_point_of(type(base))
            arguments, is_certain = arguments_of(base)
            if not is_certain:
                assumed.append(class_name(base))
        fields: Json = {
            "entry_point": entry_point,
            "kwargs": plain_kwargs(arguments, f"the game {class_name(base)}"),
        }
        if wrappers:
            fields["wrappers"] = [game_wrapper_fields(wrapper, assumed) for wrapper in wrappers]
    except CannotBeMade as reason:
        return _with_versions(maker, [top], reason)
    spec = json.dumps(fields, default=plain_number)
    return _with_versions(replace(maker, spec=spec, registered_by=top, assumed=tuple(assumed)), [top])


def why_not_certain(maker: EnvironmentMaker) -> str:
    """Return why an environment cannot be made again for certain, with what to do; empty if it can."""
    if maker.make:
        return ""
    if maker.assumed:
        return f"the arguments of {', '.join(maker.assumed)} could not be recorded; {NAME_MAKE}"
    specs = maker.spec + (maker.vector.wrapper_specs if maker.vector else "")
    if f'"{MAIN}:' in specs:
        return f"it is defined in the script that is run, which may change; {NAME_MAKE}"
    return maker.reason


def checked_make(make: object) -> str:
    """Return the `module:function` of the argument `make` of `record`; empty for None.

    Raises:
        ConfigError: it is something else, or cannot be imported by that name.
    """
    if make is None:
        return ""
    module = str(getattr(make, "__module__", "?"))
    module = _main_name() or "?" if module == "__main__" else module  # as another process can import it
    text = make if isinstance(make, str) else f"{module}:{getattr(make, '__qualname__', '?')}"
    if not FUNCTION_NAME.fullmatch(text) or len(text) > MAX_TEXT:
        raise ConfigError(
            f"make: found {make!r}, expected a function at the top of a module, or its name, such as "
            '"train:make_env".'
        )
    module, _, path = text.partition(":")
    try:
        target = resolve_name(f"{MAIN}:{path}" if module == _main_name() else text)
    except Exception as error:  # importing a module runs any code
        raise ConfigError(f"make: {text!r} cannot be imported ({error}).") from error
    if not callable(target) or not (isinstance(make, str) or target is make):
        raise ConfigError(
            f"make: found {target!r} as {text!r}, expected the function that makes environments."
        )
    return text


def _main_name() -> str | None:
    """Return the name by which another process can import the script that was run; None if there is none."""
    main = sys.modules["__main__"]
    if (spec := getattr(main, "__spec__", None)) is not None:
        return str(spec.name)
    path = Path(getattr(main, "__file__", None) or "")
    spec = importlib.util.find_spec(path.stem) if path.stem.isidentifier() else None
    is_same = spec is not None and spec.origin and Path(spec.origin).resolve() == path.resolve()
    return path.stem if is_same else None


def _with_versions(maker: EnvironmentMaker, tops: Sequence[str], reason: object = "") -> EnvironmentMaker:
    """Return a maker with the versions of the packages, the platform, and why it is incomplete."""
    if reason:
        maker = replace(maker, reason=f"{reason}; {NAME_MAKE}")
    if len(maker.spec) > MAX_SPEC:
        maker = replace(maker, spec="", reason=f"its arguments take {len(maker.spec):,} bytes; {NAME_MAKE}")
    return replace(maker, packages=package_versions(tops), platform=_platform(), machine=platform.machine())


def package_versions(tops: Sequence[str] = ()) -> dict[str, str]:
    """Return the versions of Gymnasium, NumPy, simulators that are loaded, and the distributions of modules.

    Args:
        tops: names of further modules, without dots; a module without a distribution of its name is left out.
    """
    names = {"gymnasium", "numpy", *tops, *(name for name in _SIMULATORS if name in sys.modules)}
    packages = (_installed(name) for name in sorted(names))
    return dict(package for package in packages if package is not None)


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
