"""Steps that were done again, as `runner.replay.environment.redo` yields them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from runner.errors import CannotRedo
from runner.recording.spaces import Value
from runner.replay.differences import Difference
from runner.util.arrays import Array

Frame = NDArray[np.uint8]
"""A picture, [height, width, 3]."""


@dataclass(frozen=True, eq=False)
class Values:
    """Values of steps: arrays [rows]."""

    observations: Array
    """After each step, as recorded: [rows, ...] in the dtype of the space, structured for `Dict` and `Tuple`.

    States from 0 if both spaces are `Discrete`; bytes, for `runner.recording.spaces.decode`, where values
    vary in size."""
    rewards: NDArray[np.float64]
    """[rows, agents]."""
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]

    def part(self, rows: slice) -> Values:
        """Return the values of some rows."""
        return Values(
            self.observations[rows], self.rewards[rows], self.terminated[rows], self.truncated[rows]
        )


class RedoneStart(NamedTuple):
    """The beginning of an episode that was done again."""

    row: int
    """The row of the block that comes after the reset."""
    episode: int
    seed: int | None
    recorded: Value
    """The first observation, as in `Values`, but a state as the environment returned it."""
    got: Value
    frame: Frame | None = None
    """The picture after the reset, if pictures are drawn."""


@dataclass(frozen=True, eq=False)
class RedoneSteps:
    """Consecutive steps of one environment, done again; of one or more episodes."""

    phase: str
    environment: int
    """Which environment of a vector; 0 for a single one."""
    step: NDArray[np.int64]
    """The number of each step in its phase."""
    episode: NDArray[np.int64]
    """The number of its episode; counted in each environment by itself where several take turns and all
    episodes are done again."""
    t: NDArray[np.int64]
    """The number of each step in its episode."""
    actions: Array
    """As recorded."""
    recorded: Values
    got: Values
    starts: tuple[RedoneStart, ...] = ()
    """The episodes that begin in the block, in order."""
    frames: Sequence[Frame] = ()
    """The picture after each step, uint8 [height, width, 3], if pictures are drawn."""
    difference: Difference | None = None
    """The first difference, in the last row, or at the reset after it; the last block has it, if any has."""

    def __len__(self) -> int:
        return len(self.step)

    def require_equal(self) -> Self:
        """Return these steps.

        Raises:
            CannotRedo: they differ from the recorded ones.
        """
        if self.difference is not None:
            raise CannotRedo(f"The environment is not the recorded one: {self.difference}.")
        return self

    def since(self, step: int) -> RedoneSteps:
        """Return what came from a step of the phase on."""
        at = int(np.searchsorted(self.step, step))
        rest = {name: getattr(self, name)[at:] for name in ("step", "episode", "t", "actions", "frames")}
        starts = tuple(start._replace(row=start.row - at) for start in self.starts if start.row >= at)
        recorded, got = (values.part(slice(at, None)) for values in (self.recorded, self.got))
        return replace(self, **rest, recorded=recorded, got=got, starts=starts)

    def without_rows(self) -> RedoneSteps:
        """Return the difference alone: it is in an episode before the requested one."""
        empty = {name: getattr(self, name)[:0] for name in ("step", "episode", "t", "actions")}
        recorded, got = (values.part(slice(0)) for values in (self.recorded, self.got))
        return replace(self, **empty, recorded=recorded, got=got, starts=(), frames=())
