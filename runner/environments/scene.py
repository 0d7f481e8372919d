"""Checks of a scene, so that code that draws or describes it need not check again.

An environment, or the recording of one, includes the scene as plain data (see `runner.environments.mdp`);
neither can be trusted.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Annotated, Final, NotRequired, TypedDict

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from runner.util.stored import mistake_in_words
from runner.util.values import MAX_TEXT

MAX_CELLS: Final = 2**15 - 1
"""Cells are numbered in int16."""
_Count = Annotated[int, Meta(ge=1, le=MAX_CELLS)]
_Cell = Annotated[Sequence[Annotated[int, Meta(ge=0)]], Meta(min_length=2, max_length=2)]
"""Row and column."""
_Label = Annotated[str, Meta(min_length=1, max_length=MAX_TEXT)]


class Landmark(TypedDict):
    """A cell that is marked."""

    name: _Label
    cell: _Cell
    colour: Annotated[str, Meta(pattern=r"^#[0-9A-Fa-f]{6}\Z")]
    """Such as `#009E73`."""
    label: NotRequired[_Label | None]
    kind: NotRequired[_Label | None]
    """`hazard` or `goal`, or any other word."""


class Thing(TypedDict):
    """What is somewhere in every state."""

    name: _Label
    label: _Label
    kind: _Label
    """`mover`, `goal`, or any other word."""
    agent: NotRequired[_Label | None]
    """The agent that moves it."""
    colour: NotRequired[_Label | None]


class SceneAction(TypedDict):
    """An action of each agent."""

    name: _Label
    move: NotRequired[
        Annotated[
            Sequence[Annotated[int, Meta(ge=-MAX_CELLS, le=MAX_CELLS)]], Meta(min_length=2, max_length=2)
        ]
        | None
    ]
    """Rows and columns; None for an action that is no move."""


class SceneDescription(TypedDict):
    """How the states of an environment are drawn, as it describes them and as recordings store it."""

    rows: _Count
    columns: _Count
    walls: Sequence[Annotated[Sequence[_Cell], Meta(min_length=2, max_length=2)]]
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
    try:  # as it is recorded: JSON has no sets, whose order may change
        checked = msgspec.convert(json.loads(json.dumps(dict(scene))), SceneDescription)
    except (msgspec.ValidationError, TypeError, ValueError, RecursionError) as error:
        return f"the scene: {mistake_in_words(error, scene)}"
    things = len(checked["things"])
    last_cell = checked["rows"] * checked["columns"] - 1
    return (
        _content_mistake(checked)
        or _array_mistake("cells", cells, np.int16, (states, things), (0, last_cell))
        or _array_mistake("carriers", carriers, np.int8, (states, things), (-1, things - 1))
    )


def _content_mistake(scene: SceneDescription) -> str | None:
    """Return the first mistake of a scene with values of the right types."""
    rows, columns = scene["rows"], scene["columns"]
    if rows * columns > MAX_CELLS:
        return f"a scene has at most {MAX_CELLS:,} cells; found {rows:,} rows and {columns:,} columns"
    for cell in (*chain(*scene["walls"]), *(mark["cell"] for mark in scene["landmarks"])):
        if cell[0] >= rows or cell[1] >= columns:
            return f"each of the scene's cells is within {rows} rows and {columns} columns; found {cell}"
    for part in (*scene["landmarks"], *scene["things"], *scene["actions"]):
        for text in part.values():
            if isinstance(text, str) and not text.isprintable():
                return f"each of the scene's texts must be printable; found {text!r}"
    return None


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
