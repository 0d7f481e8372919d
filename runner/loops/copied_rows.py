"""The rows and extras of a recording that others are folded into: as recorded, with new numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import Mdp
from runner.errors import ConfigError
from runner.loops.description import Described
from runner.loops.extras import TOPICS, begin_layout
from runner.loops.shard_sources import PHASES, Source
from runner.loops.single_rows import SingleRows
from runner.recording.episode_log import Columns, Flags
from runner.recording.extras import MAX_EXTRA_BYTES, MAX_NAME_LENGTH, MAX_NAMES, ExtraLayout
from runner.recording.gym_values import Put
from runner.recording.layout import Layout
from runner.recording.recorder import BLOCK_BYTES, Recorder
from runner.util.arrays import Array

_FIELDS: Final = frozenset(
    {"state", "action", "next_state", "next_observation", "acted", "agents_terminated", "agents_truncated"}
)
"""The fields of steps that are copied as they are."""


@dataclass(frozen=True)
class Copied:
    """What rows need to know of the recording that they are copied into."""

    layout: Layout
    mdp: Mdp | None
    environments: int = 1


class CopiedRows(SingleRows):
    """Rows that are copied as they are, but for their numbers."""

    def __init__(self, recorder: Recorder, copied: Copied, phase: str) -> None:
        super().__init__(recorder, copied, phase, lambda _: None)  # type: ignore[arg-type]
        steps = recorder.dtype(self._topics.steps)
        self._fields = _FIELDS & set(steps.names or ())
        self._room = recorder.capacity(self._topics.steps)
        kept = (*sorted(self._fields), "t", "environment")
        self._copied = np.zeros(self._room, [(name, steps[name]) for name in kept])
        self._environment = 0
        """The environment that was reset last."""
        self._scratch = np.zeros(self._room, self._scratch.dtype)

    def reshape(self, described: Described) -> None:  # noqa: ARG002
        """Do nothing: values are copied."""
        self._leaves = None, None

    def _filler(self, leaves: object, column: Array) -> Put:  # noqa: ARG002
        return column[:, 0].__setitem__

    @property
    def begun(self) -> int:
        """The number of the episode that began last; -1 before any."""
        return self._begun - 1

    def put_reset(self, reset: np.void, environment: int) -> None:
        """Copy a reset."""
        self._resets["environment"][self._waiting] = self._environment = environment
        self.reset(reset["observation"], int(reset["seed"]) if reset["seeded"] else None)

    def put(self, rows: NDArray[np.void]) -> None:
        """Copy consecutive steps of the environment that was reset last."""
        while len(rows):
            part, rows = np.split(rows, [self._room - self._filled])
            at, self._filled = self._filled, self._filled + len(part)
            copied = self._copied[at : self._filled]
            copied["environment"] = self._environment
            for name in (*self._fields, "t"):
                copied[name] = part[name]
            scratch = self._scratch[at : self._filled]
            scratch["rewards"][:, 0] = part["rewards"]
            scratch["ends"][:, 0, 0], scratch["ends"][:, 1, 0] = part["terminated"], part["truncated"]
            self._begun += int(np.count_nonzero(part["t"] == 0))
            if self._are_bytes:
                self._hold(*part["action"], *part["next_observation"])
            if self._filled >= self._room or self._held > BLOCK_BYTES:
                self.commit()

    def _turns(self, was_reset: Flags) -> tuple[Flags, Flags | bool, Flags | bool]:
        # An episode begins also after a game that ended without the end of any agent.
        return was_reset | (self._copied["t"][: len(was_reset), np.newaxis] == 0), False, False

    def _values(self, rows: int, *_: object) -> Columns:
        return {name: self._copied[name][:rows, np.newaxis] for name in (*self._fields, "environment")}


class CopiedExtras:
    """The extras of all processes, with the names of all of them."""

    def __init__(self, recorder: Recorder, sources: Sequence[Source]) -> None:
        self._recorder = recorder
        self._own = {
            (source.number, phase): source.recording.phase(phase).extras
            for source in sources
            for phase in PHASES
        }
        dtypes: dict[str, np.dtype[np.generic]] = {}
        self._names: dict[tuple[int, str], str] = {}
        """The names in the run, by number of the process and its own name."""
        for (number, _), own in self._own.items():
            for name, dtype in own.items():
                new = name
                if dtypes.get(name, dtype).shape != dtype.shape:
                    new = f"{name} ({sources[number].name})"[:MAX_NAME_LENGTH]
                before = dtypes.get(new, dtype)
                dtypes[new] = np.dtype((np.promote_types(before.base, dtype.base), dtype.shape))
                self._names[number, name] = new
        self._layout = ExtraLayout(0, np.dtype(list(dtypes.items())))
        if len(dtypes) > MAX_NAMES or self._layout.values.itemsize > MAX_EXTRA_BYTES:
            raise ConfigError(
                f"extras: found {len(dtypes)} names and {self._layout.values.itemsize:,} bytes a step in all "
                f"shards, expected at most {MAX_NAMES} and {MAX_EXTRA_BYTES:,}"
            )
        self._is_described = False

    def copy(
        self, source: Source, phase: str, numbers: NDArray[np.int64], new_step: int, new_position: int
    ) -> int:
        """Copy the extras of some steps, which follow each other in the run; return how many had some.

        Args:
            numbers: of the steps, as their process counted them.
            new_step: the number of the first step in the run.
            new_position: the steps of the run before it.
        """
        own = self._own[source.number, phase]
        if not own:
            return 0
        values = {self._names[source.number, name]: each for name, each in own.at(numbers).items()}
        given = {
            name: ~np.ma.getmaskarray(each).reshape(len(numbers), -1)[:, 0] for name, each in values.items()
        }
        rows = np.flatnonzero(np.logical_or.reduce(list(given.values())))
        if not len(rows):
            return 0
        if not self._is_described:
            begin_layout(self._recorder, self._layout, new_position + int(rows[0]) + 1)
            self._is_described = True
        positions = (new_position + rows + 1).astype(np.uint64)
        for block, part in self._recorder.fill(TOPICS[phase], positions):
            block["step"] = new_step + rows[part]
            for name in self._layout.names:
                block["given"][name] = given[name][rows[part]] if name in given else False
                block["values"][name] = values[name].data[rows[part]] if name in given else 0
        return len(rows)
