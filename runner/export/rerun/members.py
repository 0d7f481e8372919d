"""What a loop has several of, environments or agents, with the numbers of a step that are drawn of each."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from runner.export.values import number_names
from runner.recording.reader import Recording
from runner.recording.spaces import least_number, leaves_of

MAX_LINES: Final = 24
"""Observations or actions of more numbers are not drawn as lines."""
Part = tuple[tuple[str, ...], int, list[str]]
"""The path of a field in the record of a step, what is added to its numbers, and their names."""


class Member(NamedTuple):
    """An environment of a vector, or an agent of a game."""

    number: int
    name: str = ""
    """`env_3`, or the agent; empty if there is only one."""
    column: int = 0
    """Its column among the rewards."""
    parts: Mapping[str, list[Part]] = {}
    """`observation` and `action`, if they are drawn as lines."""


def members_of(recording: Recording, has_scene: bool) -> list[Member]:
    """Return the environments of a vector, or the agents of a game, or the only environment."""
    agents, n = recording.agents, recording.environments
    if len(agents) > 1:
        return [Member(i, entity_name(agent), i, _parts(recording, agent)) for i, agent in enumerate(agents)]
    parts = {} if has_scene else _parts(recording)
    return [Member(i, f"env_{i}" if n > 1 else "", 0, parts) for i in range(n)]


def _parts(recording: Recording, agent: str = "") -> dict[str, list[Part]]:
    """Return the numbers of a step, of one agent or of all, that are drawn as lines."""
    spaces = recording.spaces
    if recording.kind == "step":
        fields = {"observation": "state", "action": "action"}
        return {part: [((field,), least_number(spaces[part]), [field])] for part, field in fields.items()}
    by_part: dict[str, list[Part]] = {}
    for part, field in (("observation", "next_observation"), ("action", "action")):
        leaves = [
            leaf
            for leaf in leaves_of(spaces[part], f"the {part} space")
            if leaf.dtype is not None and (not agent or leaf.path[0] == agent)
        ]
        count = sum(math.prod(leaf.dtype.shape) for leaf in leaves if leaf.dtype is not None)
        if recording.kind != "variable" and 0 < count <= MAX_LINES:
            names = [list(number_names(leaf, part, skip=1 if agent else 0)) for leaf in leaves]
            by_part[part] = [((field, *leaf.path), 0, own) for leaf, own in zip(leaves, names, strict=True)]
    return by_part


def numbers_in(steps: NDArray[np.void], path: tuple[str, ...]) -> NDArray[np.float64]:
    """Return the numbers of a field, [n, numbers]."""
    column: NDArray[Any] = steps
    for name in path:
        column = column[name]
    return column.reshape(len(steps), -1).astype(np.float64)


def entity_name(name: str) -> str:
    """Return a user's name as a part of an entity's path."""
    return re.sub(r"[^\w.-]+", "_", name)[:80] or "_"
