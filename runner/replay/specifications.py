"""The specification of a recorded environment, parsed with checks; nothing is imported or made here.

A recording is hostile input. Without trust, only packages of environments that are installed here are
imported: those of `PACKAGES` and `MODULES`, and those that register themselves with Gymnasium as plug-ins.
The recorded entry point is compared with the registered one, and never called itself. The recording's own are
the keyword arguments (plain JSON of bounded size without file names), the step limit, and wrappers of those
packages.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import os
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Final

from runner.errors import CannotRedo
from runner.recording.maker import EnvironmentMaker, VectorMaker
from runner.util.values import Json, is_whole

PACKAGES: Final = (
    *("ale_py", "dualtaxi", "gymnasium", "gymnasium_robotics", "highway_env"),
    *("minigrid", "miniworld", "mo_gymnasium", "mpe2", "pettingzoo"),
)
"""Packages of environments that are imported without trust, if they are installed."""
MODULES: Final = ("stable_baselines3.common.atari_wrappers",)
"""Modules of wrappers that are imported without trust, if they are installed: they touch no files."""
_MAX_SPEC: Final = 1 << 16
"""The most characters of a specification that is not trusted."""
_MAX_STEPS: Final = 2**62
ONLY_PICTURES: Final = frozenset({"HumanRendering", "RecordVideo", "RenderCollection"})
"""Wrappers of Gymnasium that show or write pictures and change no step: they are left out."""
_ONLY_INFOS: Final = frozenset({"DictInfoToList", "RecordEpisodeStatistics"})
"""Wrappers of vectors that change nothing but infos: left out too."""
Wrapper = tuple[str, str, dict[str, object]]
"""Name, entry point and keyword arguments of a wrapper."""
TRUST: Final = "It is imported only if you trust the recording (--trust)."


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
        return [parse_game(maker.spec)[0]]
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
        name, entry_point, kwargs = own.get("name"), own.get("entry_point"), own.get("kwargs")
        if not isinstance(name, str) or not isinstance(entry_point, str) or not isinstance(kwargs, dict):
            raise CannotRedo(f"A wrapper of {owner} does not state its class and arguments.")
        wrappers.append((name, entry_point, kwargs))
    return tuple(wrappers)


def parse_game(text: str) -> tuple[str, str, dict[str, object]]:
    """Return module, function and keyword arguments of a PettingZoo environment."""
    values = _json_of(text)
    entry_point, kwargs = values.get("entry_point"), values.get("kwargs") or {}
    module, _, function = entry_point.partition(":") if isinstance(entry_point, str) else ("", "", "")
    if not module or not function or not isinstance(kwargs, dict):
        raise CannotRedo("The specification of the recorded environment has no entry point.")
    return module, function, kwargs


def _json_of(text: str) -> dict[str, object]:
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


def check_arguments(spec: EnvironmentSpec, registered: Mapping[str, object]) -> None:
    """Refuse arguments of an environment and its wrappers that name a file, unless they are registered.

    Raises:
        CannotRedo: one does.
    """
    check_plain(f"keyword argument of {spec.id}", spec.kwargs, registered)
    for name, _, kwargs in spec.wrappers:
        if name not in ONLY_PICTURES:
            check_plain(f"argument of the wrapper {name}", kwargs, {})


def check_plain(what: str, kwargs: Mapping[str, object], registered: Mapping[str, object]) -> None:
    """Refuse arguments that name a file, unless they are the registered ones.

    Raises:
        CannotRedo: one does; the message begins with `what`.
    """
    for key, value in kwargs.items():
        if registered.get(key) != value and any("/" in text or os.sep in text for text in _texts(value)):
            raise CannotRedo(f"Found the {what} {key}={value!r}, which names a file. {TRUST}")


def _texts(value: object) -> Iterator[str]:
    """Yield the texts in a JSON value."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from _texts(part)


def vector_wrappers(vector: VectorMaker) -> list[Wrapper]:
    """Return the wrappers around a vector that change what it returns, from the innermost out."""
    return [
        wrapper
        for wrapper in _wrappers_of(json.loads(vector.wrapper_specs or "[]"), "the vector")
        if wrapper[0] not in {*ONLY_PICTURES, *_ONLY_INFOS}
    ]


def why_not_imported(module: str, trust: bool) -> str:
    """Return why a module may not or cannot be imported; empty if it can be tried."""
    path = module.partition(":")[0]
    root = path.partition(".")[0]
    if root == "__main__":
        return (
            "The environment was defined in the script that recorded it, which cannot be imported: move it "
            "to a module, and name the function that makes it: make='module:function'."
        )
    if not trust and root not in {*PACKAGES, *_plug_ins()} and path not in MODULES:
        return f"The environment needs {module}, which is not a known package of environments. {TRUST}"
    try:
        exists = root in sys.modules or importlib.util.find_spec(root) is not None
    except (ImportError, ValueError):
        exists = False
    if exists:
        return ""
    hint = (
        " If it is a file of yours, run the command in its folder, or put that into PYTHONPATH."
        if root not in PACKAGES
        else ""
    )
    return f"The package {root}, which the environment needs, is not installed here.{hint}"


@cache
def _plug_ins() -> frozenset[str]:
    """Return the installed packages that register themselves with Gymnasium, which imports them anyway."""
    entries = importlib.metadata.entry_points(group="gymnasium.envs")
    return frozenset(each.value.partition(":")[0].partition(".")[0] for each in entries)
