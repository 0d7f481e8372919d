"""Checks of a scene, so that code that draws or describes it need not check again.

An environment, or the recording of one, includes the scene as plain data (see `runner.environments.mdp`);
neither can be trusted.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Final, NotRequired, TypedDict, TypeGuard

import numpy as np
from numpy.typing import NDArray

from runner.util.values import JsonView, is_text, is_whole

MAX_CELLS: Final = 2**15 - 1
"""Cells are numbered in int16."""
_COLOUR: Final = re.compile(r"#[0-9A-Fa-f]{6}")


class Landmark(TypedDict):
    """A cell that is marked."""

    name: str
    cell: Sequence[int]
    """Row and column."""
    colour: str
    """Such as `#009E73`."""
    label: NotRequired[str | None]
    kind: NotRequired[str | None]
    """`hazard` or `goal`, or any other word."""


class Thing(TypedDict):
    """What is somewhere in every state."""

    name: str
    label: str
    kind: str
    """`mover`, `goal`, or any other word."""
    agent: NotRequired[str | None]
    """The agent that moves it."""
    colour: NotRequired[str | None]


class SceneAction(TypedDict):
    """An action of each agent."""

    name: str
    move: NotRequired[Sequence[int] | None]
    """Rows and columns; None for an action that is no move."""


class SceneDescription(TypedDict):
    """How the states of an environment are drawn, as it describes them and as recordings store it."""

    rows: int
    columns: int
    walls: Sequence[Sequence[Sequence[int]]]
    """Pairs of cells with a wall between them."""
    landmarks: Sequence[Landmark]
    things: Sequence[Thing]
    actions: Sequence[SceneAction]


_KEYS: Final = SceneDescription.__required_keys__


def scene_mistake(
    scene: object, cells: NDArray[np.int16] | None, carriers: NDArray[np.int8] | None, states: int
) -> str | None:
    """Return the first mistake of a scene and its arrays; None if there is none.

    Args:
        cells: the cell of each thing in each state, [S, things].
        carriers: which thing carries it, or -1, [S, things].
    """
    if scene is None:
        return None if cells is None and carriers is None else "the scene's arrays need a scene; found none"
    if not isinstance(scene, Mapping) or not set(scene) >= _KEYS:
        keys = ", ".join(sorted(map(str, scene))) if isinstance(scene, Mapping) else f"{scene!r}"
        return f"a scene must have {', '.join(sorted(_KEYS))}; found {keys:.100}"
    rows, columns = scene["rows"], scene["columns"]
    if not is_whole(rows, 1, MAX_CELLS) or not is_whole(columns, 1, MAX_CELLS) or rows * columns > MAX_CELLS:
        return (
            f"a scene has rows and columns, and at most {MAX_CELLS:,} cells; "
            f"found {rows!r:.40} rows and {columns!r:.40} columns"
        )

    def is_cell(value: object) -> bool:
        return _is_pair(value) and is_whole(value[0], 0, rows - 1) and is_whole(value[1], 0, columns - 1)

    expected: dict[str, tuple[Callable[[object], bool], str]] = {
        "walls": (lambda wall: _is_pair(wall) and all(map(is_cell, wall)), "two cells"),
        "landmarks": (lambda mark: _is_landmark(mark, is_cell), "a name, a cell and a colour"),
        "things": (_is_thing, "a name, a label and a kind"),
        "actions": (_is_action, "a name, and a move or none"),
    }
    for key, (is_one, what) in expected.items():
        if not isinstance(scene[key], list | tuple):
            return f"the scene's {key} must be a list; found {scene[key]!r:.100}"
        for one in scene[key]:
            if not is_one(one):
                return f"each of the scene's {key} needs {what}; found {one!r:.100}"
    things = len(scene["things"])
    return _array_mistake("cells", cells, np.int16, (states, things), (0, rows * columns - 1)) or (
        _array_mistake("carriers", carriers, np.int8, (states, things), (-1, things - 1))
    )


def _array_mistake(
    name: str,
    array: NDArray[np.int16 | np.int8] | None,
    kind: type[np.int16 | np.int8],
    shape: tuple[int, int],
    bounds: tuple[int, int],
) -> str | None:
    if array is None:
        return None
    if array.dtype != kind or array.shape != shape:
        return f"scene_{name} must be {np.dtype(kind)} {shape}; found {array.dtype} {array.shape}"
    if array.size and not bounds[0] <= int(array.min()) <= int(array.max()) <= bounds[1]:
        return f"scene_{name} must be from {bounds[0]} to {bounds[1]}; found {array.min()} to {array.max()}"
    return None


def _is_pair(value: object) -> TypeGuard[Sequence[object]]:
    return isinstance(value, list | tuple) and len(value) == 2


def _has_texts(value: object, *keys: str) -> TypeGuard[JsonView]:
    return isinstance(value, Mapping) and all(is_text(value.get(key)) for key in keys)


def _is_landmark(value: object, is_cell: Callable[[object], bool]) -> bool:
    return (
        _has_texts(value, "name", "colour")
        and is_cell(value.get("cell"))
        and _COLOUR.fullmatch(value["colour"]) is not None
        and _is_optional(value, "label", "kind")
    )


def _is_thing(value: object) -> bool:
    return _has_texts(value, "name", "label", "kind") and _is_optional(value, "agent", "colour")


def _is_optional(value: JsonView, *keys: str) -> bool:
    return all(value.get(key) is None or is_text(value[key]) for key in keys)


def _is_action(value: object) -> bool:
    if not _has_texts(value, "name"):
        return False
    move = value.get("move")
    return move is None or (_is_pair(move) and all(is_whole(part, -MAX_CELLS, MAX_CELLS) for part in move))
