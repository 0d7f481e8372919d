"""A recorded loop's environment, made again; what a recording may have imported, and what not.

A recording is hostile input. Without trust, only packages of environments that are installed here are
imported: those of `PACKAGES`, and those that register themselves with Gymnasium as plug-ins. The recorded
entry point is compared with the registered one, and never called itself. The recording's own are the keyword
arguments (plain JSON of bounded size without file names), the step limit, and wrappers of those packages.
"""

from __future__ import annotations

import dataclasses
import importlib
import importlib.metadata
import importlib.util
import inspect
import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

from runner.errors import CannotRedo
from runner.recording.maker import EnvironmentMaker, VectorMaker
from runner.util.values import is_whole

PACKAGES: Final = (
    *("ale_py", "dualtaxi", "gymnasium", "gymnasium_robotics", "highway_env"),
    *("minigrid", "miniworld", "mo_gymnasium", "mpe2", "pettingzoo"),
)
"""Packages of environments that are imported without trust, if they are installed."""
_MAX_SPEC: Final = 1 << 16
"""The most characters of a specification that is not trusted."""
_MAX_STEPS: Final = 2**62
_PARALLEL: Final = "parallel_env"
"""The name of the function that makes a PettingZoo environment, in every package of them."""
_ONLY_PICTURES: Final = frozenset({"HumanRendering", "RecordVideo", "RenderCollection"})
"""Wrappers of Gymnasium that show or write pictures and change no step: they are left out."""
_ONLY_INFOS: Final = frozenset({"DictInfoToList", "RecordEpisodeStatistics"})
"""Wrappers of vectors that change nothing but infos: left out too."""
_Wrapper = tuple[str, str, dict[str, Any]]
"""Name, entry point and keyword arguments of a wrapper."""
_TRUST: Final = "It is imported only if you trust the recording (--trust)."


@dataclass(frozen=True)
class _Spec:
    """The parts of Gymnasium's `EnvSpec` that a recording gives."""

    id: str
    entry_point: str
    kwargs: dict[str, Any]
    max_episode_steps: int | None
    wrappers: tuple[_Wrapper, ...]
    """From the innermost out."""


def why_not_made(maker: EnvironmentMaker | None, trust: bool) -> str:
    """Return why an environment cannot be made again, as a sentence; empty if it can be tried.

    Nothing is imported or made.
    """
    if maker is None:
        return "The recording does not state how its environment was made: an earlier version recorded it."
    if maker.make and trust:
        return _why_not_imported(maker.make, trust)
    if maker.make and (maker.reason or not maker.spec):
        return f"The environment is made by {maker.make}. {_TRUST}"
    if maker.reason or not maker.spec:
        return maker.reason or "The recording does not state how its environment was made."
    try:
        return next(filter(None, (_why_not_imported(module, trust) for module in _modules(maker))), "")
    except CannotRedo as error:
        return str(error)


def make_environment(maker: EnvironmentMaker, trust: bool, render: bool = False) -> Any:
    """Return an environment as a loop had it; of a vector of separate environments, one of them.

    Args:
        maker: of the recording.
        trust: whether what the recording names may be imported.
        render: whether the environment draws pictures: its `render()` returns them.

    Raises:
        CannotRedo: it cannot be made; the message is why.
    """
    if reason := why_not_made(maker, trust):
        raise CannotRedo(reason)
    if render:
        _without_display()
    try:
        if maker.make and trust:
            return _made_by_function(maker.make, render)
        if maker.kind == "pettingzoo":
            return _made_game(maker, trust, render)
        return _made(maker, trust, render)
    except CannotRedo:
        raise
    except MemoryError:
        raise
    except Exception as error:  # foreign code raises anything
        raise CannotRedo(
            f"The environment cannot be made here: {type(error).__name__}: {_short(error)}"
        ) from error


def is_whole_vector(maker: EnvironmentMaker) -> bool:
    """Return whether a vector cannot be taken apart: its environments are not independent of one another."""
    vector = maker.vector
    if vector is None:
        return False
    return vector.mode == "custom" or bool(maker.make) or bool(_vector_wrappers(vector))


def make_vector(maker: EnvironmentMaker, trust: bool) -> Any:
    """Return a vector environment as a loop had it, an asynchronous one as a `SyncVectorEnv`.

    Raises:
        CannotRedo: it cannot be made; the message is why.
    """
    if reason := why_not_made(maker, trust):
        raise CannotRedo(reason)
    try:
        return _made_by_function(maker.make, False) if maker.make and trust else _made_vector(maker, trust)
    except (CannotRedo, MemoryError):
        raise
    except Exception as error:  # foreign code raises anything
        raise CannotRedo(
            f"The vector environment cannot be made here: {type(error).__name__}: {_short(error)}"
        ) from error


def _made_vector(maker: EnvironmentMaker, trust: bool) -> Any:
    import gymnasium

    assert maker.vector is not None
    if maker.vector.mode == "custom":
        spec, registered = _registered(maker, trust)
        settings = {key: value for key, value in spec.kwargs.items() if key != "vectorization_mode"}
        settings |= {"num_envs": maker.vector.number, "vectorization_mode": "vector_entry_point"}
        limit = spec.kwargs.get("max_episode_steps", spec.max_episode_steps)
        envs = gymnasium.make_vec(dataclasses.replace(registered, kwargs=settings, max_episode_steps=limit))
    else:
        envs = gymnasium.vector.SyncVectorEnv(
            [lambda: make_environment(maker, trust)] * maker.vector.number,
            autoreset_mode=gymnasium.vector.AutoresetMode(maker.vector.autoreset),
        )
    for name, entry_point, kwargs in _vector_wrappers(maker.vector):
        if not trust:
            _check_plain(f"argument of the wrapper {name}", kwargs, {})
        envs = _wrapper(entry_point, gymnasium.vector.VectorWrapper)(envs, **kwargs)
    return envs


def _made(maker: EnvironmentMaker, trust: bool, render: bool) -> Any:
    """Return an environment that is registered with Gymnasium."""
    import gymnasium

    spec, registered = _registered(maker, trust)
    kwargs = dict(spec.kwargs)
    if render:
        creator = gymnasium.envs.registration.load_env_creator(spec.entry_point)
        modes = (getattr(creator, "metadata", None) or {}).get("render_modes", ())
        if "rgb_array" not in modes:
            found = ", ".join(map(str, modes)) or "none"
            raise CannotRedo(
                f"{spec.id} draws no pictures: its render modes are {found}; rgb_array is needed."
            )
        kwargs["render_mode"] = "rgb_array"
    elif kwargs.get("render_mode") not in (None, "rgb_array"):
        kwargs["render_mode"] = None
    wrappers = tuple(
        gymnasium.envs.registration.WrapperSpec(name, entry_point, own)
        for name, entry_point, own in spec.wrappers
        if name not in _ONLY_PICTURES
    )
    for wrapper in wrappers:
        _wrapper(wrapper.entry_point, gymnasium.Wrapper)
    made: Any = gymnasium.make(
        dataclasses.replace(
            registered,
            kwargs=kwargs,
            max_episode_steps=spec.max_episode_steps,
            order_enforce=False,  # it changes nothing for a loop that was in order
            disable_env_checker=True,
            additional_wrappers=wrappers,
        )
    )
    return made


def _registered(maker: EnvironmentMaker, trust: bool) -> tuple[_Spec, Any]:
    """Return the recorded specification, and Gymnasium's own `EnvSpec` of that environment.

    Raises:
        CannotRedo: it is not registered here, or with another entry point, unless that is trusted.
    """
    import gymnasium

    spec = _spec_of(maker.spec)
    if maker.registered_by:
        importlib.import_module(maker.registered_by)
    registered = gymnasium.registry.get(spec.id)
    if registered is None and trust and spec.entry_point:
        registered = gymnasium.envs.registration.EnvSpec(spec.id, entry_point=spec.entry_point)
    if registered is None:
        raise CannotRedo(
            f"{spec.id} is not registered with Gymnasium {gymnasium.__version__} here, by "
            f"{maker.registered_by or 'Gymnasium itself'}."
        )
    if _name_of(registered.entry_point) != spec.entry_point:
        if not trust:
            raise CannotRedo(
                f"{spec.id} is {spec.entry_point} in the recording, and "
                f"{_name_of(registered.entry_point)} here: it is another environment, or another version."
            )
        registered = dataclasses.replace(registered, entry_point=spec.entry_point)
    if not trust:
        _check_arguments(spec, registered.kwargs)
    return spec, registered


def _made_game(maker: EnvironmentMaker, trust: bool, render: bool) -> Any:
    """Return a PettingZoo parallel environment."""
    module, function, kwargs = _game_of(maker.spec)
    if not trust:
        _check_plain("keyword argument", kwargs, {})
        if function != _PARALLEL:
            raise CannotRedo(f"The environment is made by {module}:{function}. {_TRUST}")
    make = _attribute(f"{module}:{function}")
    kwargs = {key: value for key, value in kwargs.items() if key != "render_mode"}
    return make(**kwargs, **({"render_mode": "rgb_array"} if render else {}))


def _made_by_function(name: str, render: bool) -> Any:
    """Return what the function `module:function` of the user returns."""
    make = _attribute(name)
    if not render:
        return make()
    parameters = inspect.signature(make).parameters.values()
    if not any(each.name == "render_mode" or each.kind is each.VAR_KEYWORD for each in parameters):
        raise CannotRedo(
            f"{name} makes environments that draw no pictures: let it take an argument render_mode, and "
            "hand it to gymnasium.make."
        )
    return make(render_mode="rgb_array")


# --- checks -------------------------------------------------------------------------------------------


def _modules(maker: EnvironmentMaker) -> list[str]:
    """Return the modules that an environment's specification has imported.

    Raises:
        CannotRedo: it is no specification.
    """
    if maker.kind == "pettingzoo":
        return [_game_of(maker.spec)[0]]
    spec = _spec_of(maker.spec)
    wrappers = [*spec.wrappers, *(_vector_wrappers(maker.vector) if maker.vector else ())]
    names = [maker.registered_by, spec.entry_point, *(entry_point for _, entry_point, _ in wrappers)]
    return [name.partition(":")[0] for name in dict.fromkeys(names) if name]


def _spec_of(text: str) -> _Spec:
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
    return _Spec(name, entry_point or "", kwargs, limit, _wrappers_of(wrappers, name))


def _wrappers_of(values: Any, owner: str) -> tuple[_Wrapper, ...]:
    """Return the wrappers in the JSON of `WrapperSpec`s.

    Raises:
        CannotRedo: one lacks its name, entry point or arguments.
    """
    found = []
    for value in values if isinstance(values, list) else [None]:
        own = value if isinstance(value, Mapping) else {}
        name, entry_point, kwargs = own.get("name"), own.get("entry_point"), own.get("kwargs")
        if not isinstance(name, str) or not isinstance(entry_point, str) or not isinstance(kwargs, dict):
            raise CannotRedo(f"A wrapper of {owner} does not state its class and arguments.")
        found.append((name, entry_point, kwargs))
    return tuple(found)


def _game_of(text: str) -> tuple[str, str, dict[str, Any]]:
    """Return module, function and keyword arguments of a PettingZoo environment."""
    values = _json_of(text)
    entry_point, kwargs = values.get("entry_point"), values.get("kwargs") or {}
    module, _, function = entry_point.partition(":") if isinstance(entry_point, str) else ("", "", "")
    if not module or not function or not isinstance(kwargs, dict):
        raise CannotRedo("The specification of the recorded environment has no entry point.")
    return module, function, kwargs


def _json_of(text: str) -> dict[str, Any]:
    if len(text) > _MAX_SPEC:
        raise CannotRedo(
            f"The specification of the recorded environment has {len(text):,} characters, expected "
            f"{_MAX_SPEC:,} at most."
        )
    try:
        values = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise CannotRedo(f"The specification of the recorded environment is no JSON ({error}).") from error
    if not isinstance(values, dict):
        raise CannotRedo("The specification of the recorded environment is no JSON object.")
    return values


def _check_arguments(spec: _Spec, registered: Mapping[str, Any]) -> None:
    _check_plain(f"keyword argument of {spec.id}", spec.kwargs, registered)
    for name, _, kwargs in spec.wrappers:
        if name not in _ONLY_PICTURES:
            _check_plain(f"argument of the wrapper {name}", kwargs, {})


def _check_plain(what: str, kwargs: Mapping[str, Any], registered: Mapping[str, Any]) -> None:
    """Refuse arguments that name a file, unless they are the registered ones."""
    for key, value in kwargs.items():
        if registered.get(key) != value and any("/" in text or os.sep in text for text in _texts(value)):
            raise CannotRedo(f"Found the {what} {key}={value!r}, which names a file. {_TRUST}")


def _texts(value: Any) -> Iterator[str]:
    """Yield the texts in a JSON value."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _texts(part)


def _wrapper(entry_point: str, base: type) -> Any:
    """Return a wrapper.

    Raises:
        CannotRedo: it is something else.
    """
    wrapper = _attribute(entry_point)
    if not (isinstance(wrapper, type) and issubclass(wrapper, base)):
        raise CannotRedo(f"{entry_point} is not a wrapper of Gymnasium.")
    return wrapper


def _vector_wrappers(vector: VectorMaker) -> list[_Wrapper]:
    """Return the wrappers around a vector that change what it returns, from the innermost out."""
    return [
        wrapper
        for wrapper in _wrappers_of(json.loads(vector.wrapper_specs or "[]"), "the vector")
        if wrapper[0] not in {*_ONLY_PICTURES, *_ONLY_INFOS}
    ]


def _why_not_imported(module: str, trust: bool) -> str:
    """Return why a module may not or cannot be imported; empty if it can be tried."""
    root = module.partition(":")[0].partition(".")[0]
    if root == "__main__":
        return (
            "The environment was defined in the script that recorded it, which cannot be imported: move it "
            "to a module, and name the function that makes it: make='module:function'."
        )
    if not trust and root not in {*PACKAGES, *_plug_ins()}:
        return f"The environment needs {module}, which is not a known package of environments. {_TRUST}"
    try:
        found = root in sys.modules or importlib.util.find_spec(root) is not None
    except (ImportError, ValueError):
        found = False
    return "" if found else f"The package {root}, which the environment needs, is not installed here."


@cache
def _plug_ins() -> frozenset[str]:
    """Return the installed packages that register themselves with Gymnasium, which imports them anyway."""
    found = importlib.metadata.entry_points(group="gymnasium.envs")
    return frozenset(each.value.partition(":")[0].partition(".")[0] for each in found)


# --- help ---------------------------------------------------------------------------------------------


def _attribute(name: str) -> Any:
    """Return the object that `module:attribute` names; the module is imported."""
    module, _, path = name.partition(":")
    found: Any = importlib.import_module(module)
    for part in path.split("."):
        found = getattr(found, part)
    return found


def _name_of(entry_point: str | Callable[..., Any] | None) -> str:
    """Return an entry point as `module:attribute`."""
    if entry_point is None or isinstance(entry_point, str):
        return entry_point or ""
    return f"{entry_point.__module__}:{getattr(entry_point, '__qualname__', '')}"


def _without_display() -> None:
    """Make libraries draw without a display, where there is none."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        os.environ.setdefault("MUJOCO_GL", "egl")
        os.environ.setdefault("PYOPENGL_PLATFORM", os.environ["MUJOCO_GL"])
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    os.environ.setdefault("SDL_AUDIODRIVER", "dummy")


def _short(error: BaseException) -> str:
    return " ".join(str(error).split())[:500]
