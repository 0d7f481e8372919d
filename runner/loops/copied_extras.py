"""The extras of recordings that are folded into another: as recorded, with new numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from runner.errors import ConfigError
from runner.loops.extras import TOPICS, begin_layout
from runner.loops.shard_sources import PHASES, Source
from runner.recording.extras import MAX_EXTRA_BYTES, MAX_NAME_LENGTH, MAX_NAMES, ExtraLayout
from runner.recording.recorder import Recorder


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
