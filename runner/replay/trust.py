"""What may be imported and made from a recording: decided here, and nowhere else. See docs/trust.md.

A recording is hostile input. One that this user recorded is known by its mark (`runner.runs.trust_marks`);
all that it names may be imported, as with `--trust`. Of any other one, an environment is made only if its id
is registered here by one of `PACKAGES`, with the recorded entry point, numbers and listed words as arguments,
and wrappers of `WRAPPERS`. A server (`OWN_ONLY`) makes no environment of a loop that its user did not record.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import json
import os
import re
import string
import sys
from collections.abc import Iterator, Mapping
from multiprocessing import parent_process
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from runner.environments.interfaces import name_of, top_package
from runner.errors import CannotRedo
from runner.recording.maker import EnvironmentMaker
from runner.replay.scripts import MAIN, script_of_run, why_not_defined
from runner.runs.trust_marks import environment_of_job, own_mark
from runner.util.processes import OWN_ONLY, importing_from
from runner.util.values import JsonView

if TYPE_CHECKING:
    from gymnasium.envs.registration import EnvSpec

PACKAGES: Final = (
    "ale_py",
    "dualtaxi",
    "gymnasium",
    "gymnasium_robotics",
    "highway_env",
    "minigrid",
    "miniworld",
    "mo_gymnasium",
    "mpe2",
    "pettingzoo",
)
"""Packages: their environments are made without trust, if they are installed."""
WRAPPERS: Final[Mapping[str, frozenset[str]]] = {
    "gymnasium.wrappers.vector": frozenset(  # before the package that it is in
        [
            "ClipAction",
            "ClipReward",
            "FlattenObservation",
            "GrayscaleObservation",
            "NormalizeObservation",
            "NormalizeReward",
            "RescaleAction",
            "RescaleObservation",
            "ReshapeObservation",
            "ResizeObservation",
        ]
    ),
    "gymnasium.wrappers": frozenset(
        [
            "AtariPreprocessing",
            "Autoreset",
            "ClipAction",
            "ClipReward",
            "DelayObservation",
            "DiscretizeAction",
            "DiscretizeObservation",
            "FlattenObservation",
            "FrameStackObservation",
            "GrayscaleObservation",
            "MaxAndSkipObservation",
            "NormalizeObservation",
            "NormalizeReward",
            "OrderEnforcing",
            "PassiveEnvChecker",
            "RepeatAction",
            "RescaleAction",
            "RescaleObservation",
            "ReshapeObservation",
            "ResizeObservation",
            "StickyAction",
            "TimeAwareObservation",
            "TimeLimit",
        ]
    ),
    "minigrid.wrappers": frozenset(
        [
            "ActionBonus",
            "DictObservationSpaceWrapper",
            "DirectionObsWrapper",
            "FlatObsWrapper",
            "FullyObsWrapper",
            "ImgObsWrapper",
            "NoDeath",
            "OneHotPartialObsWrapper",
            "PositionBonus",
            "RGBImgObsWrapper",
            "RGBImgPartialObsWrapper",
            "ReseedWrapper",
            "StochasticActionWrapper",
            "SymbolicObsWrapper",
            "ViewSizeWrapper",
        ]
    ),
    "stable_baselines3.common.atari_wrappers": frozenset(
        [
            "ClipRewardEnv",
            "EpisodicLifeEnv",
            "FireResetEnv",
            "MaxAndSkipEnv",
            "NoopResetEnv",
            "StickyActionEnv",
            "WarpFrame",
        ]
    ),
}
"""The classes of wrappers that are made without trust: none writes, shows, or calls what it is given."""
_LEFT_OUT: Final = frozenset(
    ["DictInfoToList", "HumanRendering", "RecordEpisodeStatistics", "RecordVideo", "RenderCollection"]
)
"""Wrappers of Gymnasium that show or write pictures or change infos alone: they are never made."""
_WORDS: Final[Mapping[str, frozenset[str]]] = {
    "map_name": frozenset({"4x4", "8x8"}),
    "obs_type": frozenset({"rgb", "ram", "grayscale", "rgb_image", "grayscale_image"}),
    "obstacle_type": frozenset({"wall"}),
    "padding_type": frozenset({"reset", "zero"}),
    "render_mode": frozenset({"ansi", "human", "rgb_array", "rgb_array_list"}),
}
"""Arguments that may be words, and which; Gymnasium's, ALE's and MiniGrid's."""
_MAPS: Final = {"dualtaxi": ("map", string.printable), "gymnasium": ("desc", "SFHG")}
"""By package: the argument that is a map, a list of lines, and the characters of these."""
_GAMES: Final = re.compile(
    r"(pettingzoo\.(atari|butterfly|classic|mpe|sisl)|mpe2)(\.\w+)+:(parallel_env|env)"
    r"|dualtaxi\.parallel:DualTaxiParallelEnv"
)
"""What makes PettingZoo's games: by its convention, a function of one of two names in the game's module."""
_MAX_ITEMS: Final = 10_000
MORE_PACKAGES: Final = "DUALTAXI_PACKAGES"
"""The variable with further packages of environments that the user lists, separated by commas."""
SERVED: Final = (
    "The run was not recorded by the user who runs this server, so its environment is not made here. "
    "Pictures that are recorded with a run are always shown: runner.record(env, frames_every=1)."
)


def packages() -> tuple[str, ...]:
    """Return the packages with environments that are made without trust."""
    listed = map(str.strip, os.environ.get(MORE_PACKAGES, "").split(","))
    return *PACKAGES, *filter(None, listed)


def advice() -> str:
    """Return what the user can do where something is not made."""
    if os.environ.get(OWN_ONLY):
        return f"A server makes nothing else for its clients; its owner can list packages in {MORE_PACKAGES}."
    return "You did not record this run on this machine, so that is made only with --trust."


@contextlib.contextmanager
def trusting(
    recording: Path, environment: EnvironmentMaker | JsonView | None, trust: bool = False
) -> Iterator[bool]:
    """Yield whether all that makes an environment may be imported; the user's modules are found meanwhile.

    In a child process they are found from then on.

    Args:
        recording: its path; the mark is next to it.
        environment: its maker, None if it is unknown, or the result of `environment_of_job`.
        trust: whether the user said so, by `--trust`.

    Raises:
        CannotRedo: this process makes nothing but what its user recorded.
    """
    mark = None if environment is None else own_mark(recording, environment)
    if isinstance(environment, EnvironmentMaker) and not (mark or trust) and os.environ.get(OWN_ONLY):
        raise CannotRedo(SERVED)
    folders = [*(mark.folders if mark else ()), *([str(Path.cwd())] if trust else [])]
    script = (mark.script, mark.script_digest) if mark else ("", "")
    with importing_from(folders, is_for_good=parent_process() is not None), script_of_run(*script):
        yield trust or mark is not None


def require_may_train(recording: Path, config: JsonView, trust: bool) -> None:
    """Refuse to make the environment of a recorded job, unless it is the user's own, or a listed one.

    Raises:
        CannotRedo: it is neither.
    """
    environment = environment_of_job(config)
    with trusting(recording, environment, trust) as is_trusted:
        if is_trusted:
            return
    require_listed(str(environment["id"]), environment["kwargs"])


def require_listed(env_id: str, kwargs: Mapping[str, object]) -> None:
    """Refuse the environment of a job that a stranger chose, unless it is a listed one.

    Raises:
        CannotRedo: it is not.
    """
    import gymnasium

    module, _, name = env_id.rpartition(":")
    if module and module not in packages():
        raise CannotRedo(
            f"The environment {env_id} is of {module}, no known package of environments. {advice()}"
        )
    if module:
        with contextlib.suppress(ImportError):  # the environment's own error says more
            importlib.import_module(module)
    for registered in list(gymnasium.registry.values()):
        if name in (registered.id, registered.id.rpartition("-v")[0]):  # without a version: its newest one
            require_registered_arguments(name, registered, kwargs)


def require_registered_arguments(
    name: str, registered: EnvSpec, kwargs: Mapping[str, object], vector: bool = False
) -> None:
    """Refuse an environment that no listed package registered, or with arguments that are not plain.

    Raises:
        CannotRedo: it is such a one.
    """
    entry_point = name_of(registered.vector_entry_point if vector else registered.entry_point)
    package = top_package(entry_point)
    if package not in packages():
        raise CannotRedo(
            f"The environment {name} is {entry_point}, of no known package of environments. {advice()}"
        )
    require_plain(f"keyword argument of {name}", kwargs, registered.kwargs, package)


def require_plain(
    what: str, kwargs: Mapping[str, object], registered: Mapping[str, object], package: str = ""
) -> None:
    """Refuse arguments that are not numbers or listed words, unless they are the registered ones.

    Names in values can be anything to the code that gets them: files, modules, classes.

    Raises:
        CannotRedo: one is such a value; the message begins with `what`.
    """
    for key, value in kwargs.items():
        is_registered = key in registered and _text(registered[key]) == _text(value) != ""
        is_word = isinstance(value, str) and value in _WORDS.get(key, ())
        if isinstance(value, Mapping) and (package, key) == ("dualtaxi", "rewards"):
            value = list(value.values())  # noqa: PLW2901 - their names are checked there
        if not (is_registered or is_word or _is_map(package, key, value) or _is_plain(value)):
            raise CannotRedo(
                f"Found the {what} {key}={str(value)[:200]!r}, expected numbers or a known word. {advice()}"
            )


def _is_plain(value: object) -> bool:
    """Return whether a value is a number, a truth value, null, an array of numbers, or a list of such."""
    if isinstance(value, np.ndarray | np.generic):
        return value.size <= _MAX_ITEMS and value.dtype.kind in "biuf"
    if isinstance(value, list | tuple):
        return len(value) <= _MAX_ITEMS and all(map(_is_plain, value))
    return value is None or isinstance(value, int | float) or value == {}


def _is_map(package: str, key: str, value: object) -> bool:
    name, characters = _MAPS.get(package, ("", ""))
    if key != name or not isinstance(value, list | tuple) or len(value) > _MAX_ITEMS:
        return False
    return all(isinstance(line, str) and set(line) <= set(characters) for line in value)


def _text(value: object) -> str:
    """Return a value as JSON; empty if that cannot hold it."""
    try:
        return json.dumps(value, sort_keys=True)
    except (TypeError, ValueError):
        return ""


def require_listed_game(entry_point: str, kwargs: Mapping[str, object]) -> None:
    """Refuse a game of several agents that is not one of PettingZoo's, MPE2's or `dualtaxi`'s.

    Raises:
        CannotRedo: it is another one, or its arguments are not plain.
    """
    if not _GAMES.fullmatch(entry_point):
        raise CannotRedo(f"The environment is made by {entry_point}, which is not a known game. {advice()}")
    require_plain("keyword argument", kwargs, {}, top_package(entry_point))


def require_listed_wrapper(entry_point: str, kwargs: Mapping[str, object]) -> None:
    """Refuse a wrapper that is not one of `WRAPPERS`, by the class that its entry point gives.

    Raises:
        CannotRedo: it is another one, or its arguments are not plain.
    """
    module, _, name = entry_point.partition(":")
    home = next((listed for listed in WRAPPERS if f"{module}.".startswith(f"{listed}.")), "")
    if name in WRAPPERS.get(home, ()):
        listed = getattr(importlib.import_module(home), name)
        if getattr(importlib.import_module(module), name, None) is listed:
            require_plain(f"argument of the wrapper {name}", kwargs, {})
            return
    raise CannotRedo(f"The environment needs the wrapper {entry_point}, which is not a known one. {advice()}")


def is_left_out(entry_point: str) -> bool:
    """Return whether a wrapper is never made: Gymnasium's that show or write pictures, or add infos."""
    module, _, name = entry_point.partition(":")
    return f"{module}.".startswith("gymnasium.wrappers.") and name in _LEFT_OUT


def why_not_imported(module: str, trust: bool) -> str:
    """Return why a module may not or cannot be imported; empty if it can be tried."""
    path = module.partition(":")[0]
    root = top_package(module)
    if root == MAIN:
        return why_not_defined()
    if not trust and root not in packages() and path not in WRAPPERS:
        return f"The environment needs {module}, which is not a known package of environments. {advice()}"
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
