"""A recorded loop's environment, made again, as far as `runner.replay.trust` allows.

Its specification is parsed with checks before anything is imported.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import importlib.metadata
import importlib.util
import inspect
import itertools
import json
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeVar

from msgspec import Meta

from runner.environments.interfaces import as_parallel, class_name, creator_of, layers_of, name_of
from runner.errors import CannotRedo, RecordingError, shortened
from runner.recording import schema
from runner.recording.description import environment_count
from runner.recording.maker import EnvironmentMaker, VectorMaker
from runner.recording.reader import Recording
from runner.replay.scripts import MAIN, definition
from runner.replay.trust import (
    advice,
    is_left_out,
    packages,
    require_listed_game,
    require_listed_wrapper,
    require_registered_arguments,
    trusting,
    why_not_imported,
)
from runner.runs.trust_marks import own_mark
from runner.util.processes import (
    CallFailed,
    ChildProcess,
    TimedOut,
    end_after_call,
    raise_if_out_of_memory,
)
from runner.util.stored import stored_as

if TYPE_CHECKING:
    from gymnasium.envs.registration import EnvSpec

    from runner.environments.gym_types import Env

# --- the specification --------------------------------------------------------------------------------

_MAX_SPEC: Final = 1 << 16
"""The most characters of a specification that is not trusted."""
_WHAT: Final = "The specification of the recorded environment"
_T = TypeVar("_T")


@dataclass(frozen=True)
class WrapperSpec:
    """The parts of Gymnasium's `WrapperSpec` that a recording gives."""

    entry_point: str
    kwargs: Mapping[str, Any]


@dataclass(frozen=True)
class EnvironmentSpec:
    """The parts of Gymnasium's `EnvSpec` that a recording gives."""

    id: str
    entry_point: str | None = None
    """None for a vector with an entry point of its own."""
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    max_episode_steps: Annotated[int, Meta(ge=1, le=2**62)] | None = None
    additional_wrappers: tuple[WrapperSpec, ...] = ()
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
    wrappers: tuple[WrapperSpec, ...] = ()

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
    """Return the specification in a JSON text: an `EnvironmentSpec`, a `GameSpec` or `WrapperSpec`s.

    Raises:
        CannotRedo: it is too long, or a part is missing or of the wrong type.
    """
    if len(text) > _MAX_SPEC:
        raise CannotRedo(f"{_WHAT} has {len(text):,} characters, expected {_MAX_SPEC:,} at most.")
    try:
        return stored_as(kind, json.loads(text or "{}"), f"{_WHAT} is not possible")
    except RecordingError as error:
        raise CannotRedo(str(error)) from error


def vector_wrappers(vector: VectorMaker) -> list[WrapperSpec]:
    """Return the wrappers around a vector that change what it returns, from the innermost out."""
    wrappers = parsed(tuple[WrapperSpec, ...], vector.wrapper_specs or "[]")
    return [wrapper for wrapper in wrappers if not is_left_out(wrapper.entry_point)]


# --- the environment ----------------------------------------------------------------------------------

ALL: Final = -1
"""The number that stands for all environments of a vector."""
_OF_VECTORS: Final = frozenset({"num_envs", "vectorization_mode", "vector_kwargs", "max_episode_steps"})
"""Arguments of `make_vec` in the specification of a vector, which its environments do not take."""

MEMORY_BYTES: Final = 4 * 10**9
"""How much a child process may allocate; importing RLlib, which wraps many games, takes 2.1 GB of it."""
SECONDS: Final = 60.0
"""How long a child process may take for a block of steps, which is meant to take 0.2 s, or to begin."""
_MAX_ERROR: Final = 500
"""The most characters of an error of foreign code in a reason."""
_MAX_OPTIONS: Final = 300
"""The most characters of the options of a reset in a reason."""


def why_not_made(maker: EnvironmentMaker | None, trust: bool) -> str:
    """Return why an environment cannot be made again, as a sentence; empty if it can be tried.

    Nothing is imported or made.
    """
    if maker is None or not (maker.make or maker.spec or maker.reason):
        return "The recording does not state how its environment was made."
    if maker.make and trust:
        return why_not_imported(maker.make, trust)
    if maker.reason or not maker.spec:
        return f"The environment is made by {maker.make}. {advice()}" if maker.make else maker.reason
    try:
        return next(filter(None, (why_not_imported(module, trust) for module in modules_of(maker))), "")
    except CannotRedo as error:
        return str(error)


def make_environment(maker: EnvironmentMaker, trust: bool, render: bool = False) -> Any:
    """Return an environment as a loop had it; of a vector of separate environments, one of them.

    Args:
        render: whether the environment draws pictures: its `render()` returns them.

    Raises:
        CannotRedo: it cannot be made; the message is why.
    """
    with _making("environment", maker, trust, render):
        if maker.make and trust:
            env = _made_by_function(maker.make, render)
        else:
            make = _made_game if maker.kind == "pettingzoo" else _made
            env = make(maker, trust, render)
        return as_parallel(env)


@contextlib.contextmanager
def _making(what: str, maker: EnvironmentMaker, trust: bool, render: bool) -> Iterator[None]:
    """Refuse what cannot be made, and raise what foreign code raises in the block as `CannotRedo`."""
    if reason := why_not_made(maker, trust):
        raise CannotRedo(reason)
    if render:
        _without_display()
    with using(f"The {what} cannot be made here"):
        yield


@contextlib.contextmanager
def using(failure: str) -> Iterator[None]:
    """Raise what foreign code raises in the block as `CannotRedo`, which begins with `failure`."""
    try:
        yield
    except (CannotRedo, MemoryError):
        raise
    except Exception as error:  # foreign code raises anything
        raise_if_out_of_memory()
        text = " ".join(str(error).split())[:_MAX_ERROR]
        raise CannotRedo(f"{failure}: {type(error).__name__}: {text}") from error


def is_whole_vector(maker: EnvironmentMaker) -> bool:
    """Return whether a vector cannot be taken apart: its environments are not independent of one another."""
    vector = maker.vector
    if vector is None or vector.is_vec_env:
        return False
    return vector.mode == "custom" or bool(maker.make) or bool(vector_wrappers(vector))


def environments_of(recording: Recording) -> Sequence[int]:
    """Return the environments that can be stepped alone; `ALL` where only the whole vector can be."""
    makers = (recording.phase(phase).maker_of() for phase in schema.PHASES)
    if not recording.shards and any(maker is not None and is_whole_vector(maker) for maker in makers):
        return [ALL]
    return range(environment_count(recording))


def why_not_alone(maker: EnvironmentMaker) -> str:
    """Return why one environment of a vector cannot be made; empty if it can be tried."""
    reason = "The environments of this vector cannot be made one by one, and one is needed here."
    vector = maker.vector
    if vector is None or not is_whole_vector(maker):
        return ""
    is_made_whole = maker.make or vector_wrappers(vector)
    return reason if is_made_whole or not parsed(EnvironmentSpec, maker.spec).entry_point else ""


def make_vector(maker: EnvironmentMaker, trust: bool, render: bool = False) -> object:
    """Return a vector environment as a loop had it, an asynchronous one as a `SyncVectorEnv`.

    Args:
        render: whether its `render()` returns pictures, one of each environment.

    Raises:
        CannotRedo: it cannot be made; the message is why.
    """
    import gymnasium

    with _making("vector environment", maker, trust, render):
        if maker.make and trust:
            return _made_by_function(maker.make, render)
        vector = maker.vector
        assert vector is not None
        if vector.mode == "custom":
            spec, registered = _registered(maker, trust)
            kwargs = {**spec.kwargs, "num_envs": vector.number, "vectorization_mode": "vector_entry_point"}
            kwargs |= {"render_mode": "rgb_array"} if render else {}
            limit = spec.kwargs.get("max_episode_steps", spec.max_episode_steps)
            envs = gymnasium.make_vec(dataclasses.replace(registered, kwargs=kwargs, max_episode_steps=limit))
        else:
            envs = gymnasium.vector.SyncVectorEnv(
                [lambda: make_environment(maker, trust, render)] * vector.number,
                autoreset_mode=gymnasium.vector.AutoresetMode(vector.autoreset),
            )
        for wrapper in vector_wrappers(vector):
            envs = _wrapper(wrapper, gymnasium.vector.VectorWrapper, trust)(envs, **wrapper.kwargs)
        return envs


def _made(maker: EnvironmentMaker, trust: bool, render: bool) -> Env:
    import gymnasium

    spec, registered = _registered(maker, trust)
    kwargs = {key: value for key, value in spec.kwargs.items() if key not in _OF_VECTORS}
    if render:
        modes = (getattr(creator_of(registered), "metadata", None) or {}).get("render_modes", ())
        if "rgb_array" not in modes:
            names = ", ".join(map(str, modes)) or "none"
            raise CannotRedo(
                f"{spec.id} draws no pictures: its render modes are {names}; rgb_array is needed."
            )
        kwargs["render_mode"] = "rgb_array"
    elif kwargs.get("render_mode") not in (None, "rgb_array"):
        kwargs["render_mode"] = None
    wrappers = [
        (_wrapper(wrapper, gymnasium.Wrapper, trust), wrapper.kwargs)
        for wrapper in spec.additional_wrappers
        if not is_left_out(wrapper.entry_point)
    ]
    made: Env = gymnasium.make(
        dataclasses.replace(
            registered,
            kwargs=kwargs,
            max_episode_steps=spec.max_episode_steps,
            order_enforce=False,  # it changes nothing for a loop that was in order
            disable_env_checker=True,
            additional_wrappers=(),
        )
    )
    # Without their number, wrappers that the entry point adds are the first of the recorded ones.
    inside = () if maker.inner_wrappers or made.spec is None else made.spec.additional_wrappers
    for make, arguments in wrappers[len(inside) :]:
        made = make(env=made, **arguments)
    return made


def _registered(maker: EnvironmentMaker, trust: bool) -> tuple[EnvironmentSpec, EnvSpec]:
    """Return the recorded specification, and Gymnasium's own `EnvSpec` of that environment.

    Raises:
        CannotRedo: it is not registered here, or with another entry point, unless that is trusted.
    """
    import gymnasium

    spec = parsed(EnvironmentSpec, maker.spec)
    entry_point = spec.entry_point or ""
    if not trust and maker.registered_by not in ("", *packages()):
        raise CannotRedo(f"{spec.id} is registered by {maker.registered_by}. {advice()}")
    if maker.registered_by:
        importlib.import_module(maker.registered_by)
    registered = gymnasium.registry.get(spec.id)
    if registered is None and trust and entry_point:
        registered = gymnasium.envs.registration.EnvSpec(spec.id, entry_point=_creator(entry_point))
    if registered is None and spec.id == entry_point.partition(":")[2]:
        raise CannotRedo(f"The environment is made by {entry_point}. {advice()}")
    if registered is None:
        raise CannotRedo(
            f"{spec.id} is not registered with Gymnasium {gymnasium.__version__} here, by "
            f"{maker.registered_by or 'Gymnasium itself'}."
        )
    if name_of(registered.entry_point) != entry_point:
        if not trust:
            raise CannotRedo(
                f"{spec.id} is {entry_point} in the recording, and "
                f"{name_of(registered.entry_point)} here: it is another environment, or another version."
            )
        registered = dataclasses.replace(registered, entry_point=_creator(entry_point))
    if not trust:
        is_whole = maker.vector is not None and maker.vector.mode == "custom"
        kwargs = {key: value for key, value in spec.kwargs.items() if key not in _OF_VECTORS}
        require_registered_arguments(spec.id, registered, kwargs, is_whole)
    return spec, registered


def _made_game(maker: EnvironmentMaker, trust: bool, render: bool) -> Any:
    spec = parsed(GameSpec, maker.spec)
    if not trust:
        if spec.wrappers:
            raise CannotRedo(f"The environment is wrapped by {spec.wrappers[0].entry_point}. {advice()}")
        require_listed_game(spec.entry_point, spec.kwargs)
    make = _attribute(spec.entry_point)
    kwargs = {key: value for key, value in spec.kwargs.items() if key != "render_mode"}
    game = make(**kwargs, **({"render_mode": "rgb_array"} if render else {}))
    for wrapper in spec.wrappers:
        game = _attribute(wrapper.entry_point)(game, **wrapper.kwargs)
    names = tuple(map(class_name, layers_of(game)))[:-1]
    if spec.wrappers and names != maker.wrappers:
        raise CannotRedo(f"The environment has the wrappers {names} here, recorded {maker.wrappers}.")
    return game


def _made_by_function(name: str, render: bool) -> Any:
    """Return what the function `module:function` of the user returns."""
    make = _attribute(name)
    if not render:
        return make()
    parameters = inspect.signature(make).parameters.values()
    if any(part.name == "render_mode" or part.kind is part.VAR_KEYWORD for part in parameters):
        return make(render_mode="rgb_array")
    env = make()
    if getattr(env, "render_mode", None) != "rgb_array":
        env.close()
        raise CannotRedo(
            f"{name} makes environments that draw no pictures: give it an argument render_mode, and "
            "pass it to gymnasium.make."
        )
    return env


def _wrapper(spec: WrapperSpec, base: type, trust: bool) -> Any:
    """Return the class of a wrapper.

    Raises:
        CannotRedo: it is something else, or may not be made.
    """
    if not trust:
        require_listed_wrapper(spec.entry_point, spec.kwargs)
    wrapper = _attribute(spec.entry_point)
    if not (isinstance(wrapper, type) and issubclass(wrapper, base)):
        raise CannotRedo(f"{spec.entry_point} is not a wrapper of Gymnasium.")
    return wrapper


# --- whether a recording can be rerun -----------------------------------------------------------------


def why_not_rerun(recording: Recording, trust: bool = False) -> str:
    """Return why the recorded actions cannot be repeated in the environment; empty if it can be tried."""
    if not recording.has_actions:
        return "No steps were recorded."
    if recording.lost:
        return "A part of the recording was lost, and what follows depends on it."
    first, reason = 0, ""
    for shard in recording.shards:
        phases = [
            phase for phase, n in zip(schema.PHASES, (shard.train_steps, shard.eval_steps), strict=True) if n
        ]
        for maker in (recording.phase(phase).maker_of(first) for phase in phases):
            if maker is not None and is_whole_vector(maker):
                return (
                    "A process stepped a vector that cannot be taken apart. As several processes recorded "
                    "the run, its environments are recorded one by one."
                )
            reason = reason or _why_not_made_of(recording, maker, trust)
        first += shard.environments
    return reason or _why_not_made_of(recording, recording.maker, trust)


def _why_not_made_of(recording: Recording, maker: EnvironmentMaker | None, trust: bool) -> str:
    try:
        with trusting(recording.path, maker, trust) as is_trusted:
            return why_not_made(maker, is_trusted)
    except CannotRedo as error:
        return str(error)


def why_uncertain(recording: Recording, trust: bool) -> str:
    """Return why a difference shows nothing, as some arguments are not known; empty if all are."""
    for phase in recording.phases:
        for given in phase.reset_options():
            if not given.is_exact:
                return (
                    f"The options of {phase.title} reset {given.reset:,} could not be recorded exactly; with "
                    f"{shortened(given.json, _MAX_OPTIONS)} the environment begins in another way."
                )
    firsts = itertools.accumulate((shard.environments for shard in recording.shards), initial=0)
    makers = [recording.phase(phase).maker_of(first) for first in firsts for phase in schema.PHASES]
    known = [maker for maker in makers if maker is not None and maker.assumed]
    made = [maker for maker in known if not (maker.make and (trust or own_mark(recording.path, maker)))]
    names = ", ".join(dict.fromkeys(name for maker in made for name in maker.assumed))
    return names and (
        f"The arguments of {names} could not be recorded, and with those that were assumed it is another "
        'environment. Runs recorded with a function that makes it, make="module:function", can be verified.'
    )


# --- in a child process -------------------------------------------------------------------------------


def stream_from_child(
    function: Callable[..., None],
    path: Path,
    *arguments: object,
    hash_seed: int | None = None,
    **keywords: object,
) -> Iterator[Any]:
    """Yield what a function that runs foreign code passes to `report_progress` in a child process.

    Args:
        function: of a module; called with the path and the other arguments.
        hash_seed: runs in a fresh interpreter with this hash seed.

    Raises:
        CannotRedo: the process hangs, crashes or needs more memory.
    """
    with ChildProcess(MEMORY_BYTES, hash_seed=hash_seed) as child:
        try:
            yield from child.stream(_quietly, SECONDS, function, path, *arguments, **keywords)
        except TimedOut:
            raise CannotRedo(
                f"The environment took longer than {SECONDS:g} s to be made or stepped, and was stopped."
            ) from None
        except CallFailed as error:
            raise CannotRedo(f"The environment ended its process: {error}") from error


def _quietly(function: Callable[..., None], *arguments: object, **keywords: object) -> None:
    """Call a function in a child process, without what environments print: it would be mixed with results."""
    silence()
    function(*arguments, **keywords)


def silence() -> None:
    """Leave out what environments print, in a child process, which therefore ends after its call."""
    end_after_call()
    warnings.simplefilter("ignore")
    with open(os.devnull, "wb") as nothing:  # noqa: PTH123 - a device
        for stream in (1, 2):
            os.dup2(nothing.fileno(), stream)


# --- help ---------------------------------------------------------------------------------------------


def _attribute(name: str) -> Any:
    """Return the object that `module:attribute` names; the module is imported."""
    module, _, path = name.partition(":")
    if module == MAIN:
        return definition(path)
    value: Any = importlib.import_module(module)
    for part in path.split("."):
        value = getattr(value, part)
    return value


def _creator(entry_point: str) -> Any:
    """Return what Gymnasium takes as an entry point: a definition of the script itself, else its name."""
    return _attribute(entry_point) if entry_point.startswith(f"{MAIN}:") else entry_point


def _without_display() -> None:
    """Make libraries draw without a display, where there is none."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        os.environ.setdefault("MUJOCO_GL", "egl")
        os.environ.setdefault("PYOPENGL_PLATFORM", os.environ["MUJOCO_GL"])
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    os.environ.setdefault("SDL_AUDIODRIVER", "dummy")
