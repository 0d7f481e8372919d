"""Scene, events and success of Gymnasium's own grid worlds, which do not define them.

Taxi-v4, FrozenLake-v1 and CliffWalking-v1 offer a transition table and no more. A `GridWorld` here adds
the attributes that an environment of this project offers itself (see `runner.environments.loading`): the
cells, the place of each thing in each state, and which outcomes are events. They are computed from the
environment as made, so maps, rewards and slipperiness given as arguments are respected.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import Transitions
from runner.errors import EnvironmentNotUsable
from runner.util.arrays import Flags

# Okabe and Ito (2008): distinguishable with any common colour blindness.
_VERMILLION, _GREEN, _YELLOW, _BLUE = "#D55E00", "#009E73", "#F0E442", "#0072B2"
_GREY, _SKY_BLUE = "#777777", "#56B4E9"

Events = Mapping[str, Flags]


@dataclass(frozen=True, eq=False)
class GridWorld:
    """What an adapter adds to an environment's transition table."""

    scene: Mapping[str, object]
    scene_cells: NDArray[np.int16]
    """[S, things]."""
    scene_carriers: NDArray[np.int8]
    """[S, things]."""
    happens: Events
    """Event to the outcomes [S, J, K] in which it happens."""
    success_events: tuple[str, ...]
    penalty_below: float = -np.inf
    agents: tuple[str, ...] = field(default=("agent",))

    @property
    def event_names(self) -> tuple[str, ...]:
        """The events, in the order of their bits."""
        return tuple(self.happens)

    @property
    def events(self) -> NDArray[np.uint32]:
        """[S, J, K]: bit i is `event_names[i]`."""
        bits = (outcomes.astype(np.uint32) << bit for bit, outcomes in enumerate(self.happens.values()))
        return np.asarray(np.bitwise_or.reduce(list(bits)), np.uint32)


def grid_world(env_id: str, base: object, arrays: Transitions) -> GridWorld | None:
    """Return the additions to one of Gymnasium's grid worlds; None for any other environment.

    Args:
        arrays: its transition arrays, as `runner.environments.mdp` has them.
    """
    adapt = _ADAPTERS.get(f"{type(base).__module__}.{type(base).__qualname__}")
    return None if adapt is None else adapt(env_id, base, arrays)


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
    return GridWorld(
        scene=_scene(
            base.desc.shape,
            landmarks=_tiles(base.desc, _LAKE),
            things=[_PLAYER],
            actions=("left", "down", "right", "up"),
        ),
        **_one_player(len(tiles)),
        happens={"goal": _arrives(arrays, tiles == b"G"), "hole": _arrives(arrays, tiles == b"H")},
        success_events=("goal",),
        agents=("player",),
    )


def _cliff(_: str, base: Any, arrays: Transitions) -> GridWorld:
    tiles = np.where(base._cliff, b"C", b"F")
    tiles.ravel()[base.start_state_index], tiles.ravel()[-1] = b"S", b"G"
    return GridWorld(
        scene=_scene(
            base.shape,
            landmarks=_tiles(tiles, _CLIFF),
            things=[_PLAYER],
            actions=("up", "right", "down", "left"),
        ),
        **_one_player(tiles.size),
        happens={"goal": _arrives(arrays, tiles.ravel() == b"G"), "fall": arrays["rewards"][..., 0] <= _FALL},
        success_events=("goal",),
        penalty_below=-1.0,
        agents=("player",),
    )


_ADAPTERS: Final[Mapping[str, Callable[[str, object, Transitions], GridWorld]]] = {
    "gymnasium.envs.toy_text.taxi.TaxiEnv": _taxi,
    "gymnasium.envs.toy_text.frozen_lake.FrozenLakeEnv": _frozen_lake,
    "gymnasium.envs.toy_text.cliffwalking.CliffWalkingEnv": _cliff,
}

_MOVES: Final = {
    "south": [1, 0], "north": [-1, 0], "east": [0, 1], "west": [0, -1],
    "down": [1, 0], "up": [-1, 0], "right": [0, 1], "left": [0, -1],
}  # fmt: skip
_TAXI_COLOURS: Final = (_VERMILLION, _GREEN, _YELLOW, _BLUE)
_PLAYER: Final = {"name": "player", "label": "player", "kind": "mover", "agent": "player"}
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


def _scene(
    shape: tuple[int, int],
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


def _tiles(tiles: NDArray[np.bytes_], kinds: Mapping[bytes, dict[str, str]]) -> list[dict[str, object]]:
    """Return a landmark for each tile that has a meaning."""
    return [
        kinds[bytes(tile)] | {"cell": [int(row), int(column)]}
        for (row, column), tile in np.ndenumerate(tiles)
        if bytes(tile) in kinds
    ]


def _one_player(cells: int) -> dict[str, Any]:
    """Return the scene's arrays where the state is the player's cell."""
    return {
        "scene_cells": np.arange(cells, dtype=np.int16)[:, np.newaxis],
        "scene_carriers": np.full((cells, 1), -1, np.int8),
    }


def _action(arrays: Transitions, action: int) -> Flags:
    """Return the real outcomes [S, J, K] of an action."""
    taken = np.zeros(arrays["next_state"].shape, np.bool_)
    taken[:, action] = True
    return np.asarray(taken & (arrays["probability"] > 0))


def _arrives(arrays: Transitions, where: Flags) -> Flags:
    """Return the outcomes [S, J, K] that enter one of these states from another."""
    entered = where[arrays["next_state"]] & ~where[:, np.newaxis, np.newaxis]
    return np.asarray(entered & (arrays["probability"] > 0))
