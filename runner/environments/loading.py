"""Make a tabular Gymnasium environment, and read it into arrays.

The environment offers them as documented attributes of `env.unwrapped` (`transitions`, `agents`,
`agent_action_counts`, `event_names`, `success_events`, `penalty_below`, `scene`, `scene_cells`,
`scene_carriers`), or only Gymnasium's customary `P` and `initial_state_distrib`. For Gymnasium's own grid
worlds a `GridWorld` adds the rest, computed from the environment as made, so that maps, rewards and
slipperiness given as arguments are respected. An attribute that is missing stays unknown.
"""

from __future__ import annotations

import contextlib
import difflib
import functools
import importlib
import json
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runner.environments.mdp import Mdp, Transitions, check_mdp
from runner.errors import EnvironmentNotUsable
from runner.util.arrays import Flags
from runner.util.values import JsonView


def load_mdp(env_id: str, kwargs: JsonView, rewards: str = "team") -> Mdp:
    """Make the environment and return its arrays.

    Args:
        env_id: a Gymnasium id; the part before a colon is a module to import first.
        kwargs: arguments of the environment.
        rewards: `team`, or `individual` for a reward of each agent (the environment's `competitive=True`).

    Raises:
        EnvironmentNotUsable: it is unknown, cannot be made, or has no transition table.
    """
    env = _make(env_id, dict(kwargs) | ({"competitive": True} if rewards == "individual" else {}))
    try:
        with contextlib.closing(env):
            mdp = _read(env_id, kwargs, env, rewards)
    except EnvironmentNotUsable:
        raise
    except Exception as error:  # its attributes may raise anything
        raise EnvironmentNotUsable(
            f"environment {env_id!r}: its attributes cannot be read "
            f"({type(error).__name__}: {error}); docs/architecture.md lists what is expected."
        ) from error
    check_mdp(mdp)
    if rewards == "individual" and mdp.rewards.shape[-1] != len(mdp.agents):
        raise _one_reward_only(env_id)
    return mdp


def load_once(env_id: str, kwargs: JsonView, rewards: str) -> Mdp:
    """Return what `load_mdp` does; a process that needs the same environment again does not make it again."""
    return _loaded(env_id, json.dumps(dict(kwargs), sort_keys=True, default=dict), rewards)


@functools.lru_cache(maxsize=16)
def _loaded(env_id: str, kwargs: str, rewards: str) -> Mdp:
    return load_mdp(env_id, json.loads(kwargs), rewards)


def mdp_of(env: Any, kwargs: JsonView) -> Mdp:
    """Return the arrays of an environment made with `kwargs`, whose agents share the reward.

    Raises:
        EnvironmentNotUsable: it has no transition table, or one that is invalid.
    """
    spec = env.spec
    env_id = spec.id if spec is not None else type(env.unwrapped).__qualname__
    try:
        mdp = _read(env_id, kwargs, env, "team")
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise EnvironmentNotUsable(
            f"environment {env_id!r}: its attributes contradict each other."
        ) from error
    check_mdp(mdp)
    return mdp


def _read(env_id: str, kwargs: JsonView, env: Any, rewards: str) -> Mdp:
    """Return the attributes of an environment, not yet checked; a team shares the summed reward."""
    from runner.config.sections import plain  # reading a recording needs none of it

    base = env.unwrapped
    limit = env.spec.max_episode_steps if env.spec is not None else None
    transitions = _transitions(env_id, base)
    joint = transitions["next_state"].shape[1]
    source = base
    if adapt := _ADAPTERS.get(f"{type(base).__module__}.{type(base).__qualname__}"):
        source = adapt(env_id, base, transitions)
        transitions["events"] = source.events
    if rewards == "team":
        transitions["rewards"] = transitions["rewards"].sum(axis=-1, keepdims=True)
    return Mdp(
        env_id=env_id,
        kwargs=plain(kwargs),
        **transitions,
        start=np.ascontiguousarray(base.initial_state_distrib, dtype=np.float64),
        step_limit=int(limit or 0),
        agents=tuple(getattr(source, "agents", ("agent",))),
        action_counts=tuple(int(n) for n in getattr(base, "agent_action_counts", (joint,))),
        event_names=tuple(getattr(source, "event_names", ())),
        success_events=tuple(getattr(source, "success_events", ())),
        penalty_below=float(getattr(source, "penalty_below", -np.inf)),
        scene=getattr(source, "scene", None),
        scene_cells=getattr(source, "scene_cells", None),
        scene_carriers=getattr(source, "scene_carriers", None),
    )


def _one_reward_only(env_id: str) -> EnvironmentNotUsable:
    return EnvironmentNotUsable(
        f"environment {env_id!r} does not reward its agents individually: set `rewards: team` "
        "(`mode: competitive` means individual rewards)."
    )


def _make(env_id: str, kwargs: JsonView) -> Any:
    """Return the environment, without the wrappers that only check or render."""
    import gymnasium

    module, _, name = env_id.rpartition(":")
    if module:
        try:
            importlib.import_module(module)
        except ModuleNotFoundError as error:
            raise EnvironmentNotUsable(
                f"environment {env_id!r}: there is no module {error.name!r}; "
                "install its package, set PYTHONPATH to its folder, or correct `env.id`."
            ) from error
        except Exception as error:  # a module may raise anything
            raise EnvironmentNotUsable(
                f"environment {env_id!r}: the module {module!r} cannot be imported ({_raised(error)})."
            ) from error
    if name not in gymnasium.registry:
        raise EnvironmentNotUsable(
            f"environment {env_id!r}: Gymnasium knows no such id.{_nearest_id(module, name)}"
        )
    try:
        return gymnasium.make(name, disable_env_checker=True, **kwargs)
    except Exception as error:  # an environment may raise anything
        if "competitive" in kwargs and "keyword argument 'competitive'" in str(error):
            raise _one_reward_only(env_id) from error
        given = ", ".join(f"{key}={value!r}" for key, value in kwargs.items()) or "no arguments"
        is_clear = isinstance(error, TypeError | ValueError | ImportError | gymnasium.error.Error)
        raise EnvironmentNotUsable(
            f"environment {env_id!r} cannot be made with {given}: {error if is_clear else _raised(error)}"
        ) from error


def _nearest_id(module: str, name: str) -> str:
    """Return a hint at the registered id that was probably meant, without regard to versions."""
    import gymnasium

    stem = name.rpartition("-v")[0]
    newest = {env_name.rpartition("-v")[0]: env_name for env_name in gymnasium.registry}
    near = difflib.get_close_matches(stem, newest, n=1, cutoff=0.6)
    if not near:
        return ""
    meant = newest[near[0]]
    is_of_module = module and meant.startswith(stem)
    return f" Did you mean '{module}:{meant}'?" if is_of_module else f" Did you mean '{meant}'?"


def _raised(error: Exception) -> str:
    """Return the error and its place in other code: `KeyError: 'goal' (corridor.py, line 12)`."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    at = "" if isinstance(error, SyntaxError) else f" ({Path(frame.filename).name}, line {frame.lineno})"
    return f"{type(error).__name__}: {error}{at}"


_OutcomesOfPairs = Mapping[int, Mapping[int, list[tuple[float, int, ArrayLike, bool]]]]
"""Gymnasium's `P[state][action] = [(probability, next state, reward, terminated), ...]`."""


def _transitions(env_id: str, base: object) -> Transitions:
    """Return the transition arrays, from the environment's own or from its `P`."""
    if hasattr(base, "transitions"):
        transitions = base.transitions
        return {
            "next_state": np.ascontiguousarray(transitions.next_state, dtype=np.int32),
            "probability": np.ascontiguousarray(transitions.probability, dtype=np.float64),
            "rewards": np.ascontiguousarray(transitions.rewards, dtype=np.float64),
            "terminated": np.ascontiguousarray(transitions.terminated, dtype=np.bool_),
            "events": np.ascontiguousarray(transitions.events, dtype=np.uint32),
        }
    if not hasattr(base, "P") or not hasattr(base, "initial_state_distrib"):
        raise EnvironmentNotUsable(
            f"environment {env_id!r} offers no transition table (`P` and `initial_state_distrib`), which "
            "tabular learning here needs. DualTaxi-v1, Taxi-v4, FrozenLake-v1 and CliffWalking-v1 have one."
        )
    p: _OutcomesOfPairs = base.P
    states = len(p)
    actions = len(p[0])
    most = max(len(outcomes) for row in p.values() for outcomes in row.values())
    shape = (states, actions, most)
    next_state = np.zeros(shape, np.int32)
    probability = np.zeros(shape)
    rewards = np.zeros((*shape, 1))
    terminated = np.zeros(shape, np.bool_)
    for s, row in p.items():
        for a, outcomes in row.items():
            for k, (chance, successor, reward, over) in enumerate(outcomes):
                next_state[s, a, k], probability[s, a, k] = successor, chance
                rewards[s, a, k, 0] = float(np.sum(reward))
                terminated[s, a, k] = over
    return {
        "next_state": next_state,
        "probability": probability,
        "rewards": rewards,
        "terminated": terminated,
        "events": np.zeros(shape, np.uint32),
    }


# Okabe and Ito (2008): distinguishable with any common colour blindness.
_VERMILLION, _GREEN, _YELLOW, _BLUE = "#D55E00", "#009E73", "#F0E442", "#0072B2"
_GREY = "#777777"

_MOVES: Final = {
    "south": [1, 0], "north": [-1, 0], "east": [0, 1], "west": [0, -1],
    "down": [1, 0], "up": [-1, 0], "right": [0, 1], "left": [0, -1],
}  # fmt: skip
_TAXI_COLOURS: Final = (_VERMILLION, _GREEN, _YELLOW, _BLUE)
_FALL: Final = -100.0
_START: Final = {"name": "S", "label": "start", "kind": "start", "colour": _GREY}
_GOAL: Final = {"name": "G", "label": "goal", "kind": "goal", "colour": _GREEN}
_LAKE: Final = {
    b"S": _START,
    b"G": _GOAL,
    b"H": {"name": "H", "label": "hole", "kind": "hazard", "colour": _BLUE},
}
_CLIFF: Final = {
    b"S": _START,
    b"G": _GOAL,
    b"C": {"name": "C", "label": "cliff", "kind": "hazard", "colour": _VERMILLION},
}


@dataclass(frozen=True, eq=False)
class GridWorld:
    """What an adapter adds to an environment's transition table."""

    scene: Mapping[str, object]
    scene_cells: NDArray[np.int16]
    """[S, things]."""
    scene_carriers: NDArray[np.int8]
    """[S, things]."""
    happens: Mapping[str, Flags]
    """Event to the outcomes [S, J, K] in which it happens."""
    success_events: tuple[str, ...]
    agents: tuple[str, ...]
    penalty_below: float

    @property
    def event_names(self) -> tuple[str, ...]:
        """The events, in the order of their bits."""
        return tuple(self.happens)

    @property
    def events(self) -> NDArray[np.uint32]:
        """[S, J, K]: bit i is `event_names[i]`."""
        bits = (outcomes.astype(np.uint32) << bit for bit, outcomes in enumerate(self.happens.values()))
        return np.asarray(np.bitwise_or.reduce(list(bits)), np.uint32)


def _taxi(env_id: str, base: Any, arrays: Transitions) -> GridWorld:
    if base.fickle_passenger:
        raise EnvironmentNotUsable(
            f"environment {env_id!r} with fickle_passenger=True: found a passenger who changes the "
            "destination outside of the transition table `P`, from which everything is learned and recorded "
            "here; expected fickle_passenger=False. (is_rainy=True is in the table and can be used.)"
        )
    rows, columns = base.max_row + 1, base.max_col + 1
    row, column, passenger, goal = np.array([base.decode(s) for s in range(len(arrays["next_state"]))]).T
    taxi = row * columns + column
    stands = np.array([r * columns + c for r, c in base.locs])
    aboard = passenger == len(base.locs)
    waits = np.append(stands, 0)[passenger]  # the zero is never chosen
    cells = np.stack((taxi, np.where(aboard, taxi, waits), stands[goal]), axis=1)
    carriers = np.full(cells.shape, -1, np.int8)
    carriers[aboard, 1] = 0
    after = passenger[arrays["next_state"]]
    before = passenger[:, None, None]
    pickup = _action(arrays, 4)
    drop_off = _action(arrays, 5)
    stayed = after == before
    return GridWorld(
        scene=_scene(
            (rows, columns),
            walls=[
                [[r, c], [r, c + 1]]
                for r in range(rows)
                for c in range(columns - 1)
                if base.desc[1 + r, 2 * c + 2] == b"|"
            ],
            landmarks=[
                {"name": name, "cell": list(cell), "colour": colour}
                for name, cell, colour in zip("RGYB", base.locs, _TAXI_COLOURS, strict=True)
            ],
            things=[
                {"name": "taxi", "label": "taxi", "kind": "mover", "agent": "taxi"},
                {"name": "passenger", "label": "passenger", "kind": "passenger"},
                {"name": "destination", "label": "destination", "kind": "goal"},
            ],
            actions=("south", "north", "east", "west", "pickup", "drop_off"),
        ),
        scene_cells=cells.astype(np.int16),
        scene_carriers=carriers,
        happens={
            "pickup": pickup & ~stayed,
            "drop_off": drop_off & arrays["terminated"],
            "wrong_stop": drop_off & ~stayed & ~arrays["terminated"],
            "illegal_pickup": pickup & stayed,
            "illegal_drop_off": drop_off & stayed,
        },
        success_events=("drop_off",),
        penalty_below=-1.0,
        agents=("taxi",),
    )


def _frozen_lake(_: str, base: Any, arrays: Transitions) -> GridWorld:
    tiles = base.desc.ravel()
    happens = {"goal": _arrives(arrays, tiles == b"G"), "hole": _arrives(arrays, tiles == b"H")}
    return _one_player(base.desc, _LAKE, ("left", "down", "right", "up"), happens)


def _cliff(_: str, base: Any, arrays: Transitions) -> GridWorld:
    tiles = np.where(base._cliff, b"C", b"F")
    tiles.ravel()[base.start_state_index], tiles.ravel()[-1] = b"S", b"G"
    falls = arrays["rewards"][..., 0] <= _FALL
    happens = {"goal": _arrives(arrays, tiles.ravel() == b"G"), "fall": falls}
    return _one_player(tiles, _CLIFF, ("up", "right", "down", "left"), happens, penalty_below=-1.0)


_ADAPTERS: Final[Mapping[str, Callable[[str, object, Transitions], GridWorld]]] = {
    "gymnasium.envs.toy_text.taxi.TaxiEnv": _taxi,
    "gymnasium.envs.toy_text.frozen_lake.FrozenLakeEnv": _frozen_lake,
    "gymnasium.envs.toy_text.cliffwalking.CliffWalkingEnv": _cliff,
}


def _scene(
    shape: tuple[int, ...],
    things: list[dict[str, str]],
    actions: tuple[str, ...],
    landmarks: list[dict[str, object]],
    walls: list[list[list[int]]] | None = None,
) -> dict[str, object]:
    """Return a scene with the keys that every environment's has."""
    return {
        "rows": int(shape[0]),
        "columns": int(shape[1]),
        "walls": walls or [],
        "landmarks": landmarks,
        "things": things,
        "actions": [{"name": name, "move": _MOVES.get(name)} for name in actions],
    }


def _one_player(
    tiles: NDArray[np.bytes_],
    kinds: Mapping[bytes, dict[str, str]],
    actions: tuple[str, ...],
    happens: Mapping[str, Flags],
    penalty_below: float = -np.inf,
) -> GridWorld:
    """Return a world whose state is the player's cell, with a landmark for each tile of these kinds."""
    landmarks: list[dict[str, object]] = [
        kinds[bytes(tile)] | {"cell": [int(row), int(column)]}
        for (row, column), tile in np.ndenumerate(tiles)
        if bytes(tile) in kinds
    ]
    player = {"name": "player", "label": "player", "kind": "mover", "agent": "player"}
    return GridWorld(
        scene=_scene(tiles.shape, [player], actions, landmarks),
        scene_cells=np.arange(tiles.size, dtype=np.int16)[:, np.newaxis],
        scene_carriers=np.full((tiles.size, 1), -1, np.int8),
        happens=happens,
        success_events=("goal",),
        agents=("player",),
        penalty_below=penalty_below,
    )


def _action(arrays: Transitions, action: int) -> Flags:
    """Return the real outcomes [S, J, K] of an action."""
    taken = np.zeros(arrays["next_state"].shape, np.bool_)
    taken[:, action] = True
    return np.asarray(taken & (arrays["probability"] > 0))


def _arrives(arrays: Transitions, where: Flags) -> Flags:
    """Return the outcomes [S, J, K] that enter one of these states from another."""
    entered = where[arrays["next_state"]] & ~where[:, np.newaxis, np.newaxis]
    return np.asarray(entered & (arrays["probability"] > 0))
