"""The extras of recordings that are folded into another: as recorded, with new numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from runner.errors import ConfigError
from runner.loops.extras import begin_layout, blank_extras, put_extras
from runner.loops.shard_sources import PHASES, Source
from runner.recording.extras import (
    MAX_EXTRA_BYTES,
    MAX_NAME_LENGTH,
    MAX_NAMES,
    ExtraLayout,
    encoded,
    united,
)
from runner.recording.recorder import Recorder
from runner.recording.spaces import Description, leaf_dtype
from runner.util.arrays import Ints


class CopiedExtras:
    """The extras of all processes, with the names of all of them."""

    def __init__(self, recorder: Recorder, sources: Sequence[Source]) -> None:
        self._recorder = recorder
        self._extras = {
            (source.number, phase): source.recording.phase(phase).extras
            for source in sources
            for phase in PHASES
        }
        columns: dict[str, Description] = {}
        self._names: dict[tuple[int, str], str] = {}
        """The names in the run, by number of the process and the name there."""
        for (number, _), extras in self._extras.items():
            for name, column in extras.columns.items():
                new = name
                before = columns.get(name, column)
                both = united(before, column)
                if both is None or before["type"] == column["type"] != both["type"]:
                    new = f"{name} ({sources[number].name})"[:MAX_NAME_LENGTH]
                    both = united(columns.get(new, column), column) or column
                columns[new], self._names[number, name] = both, new
        self._layout = ExtraLayout(0, 0, columns)
        if len(columns) > MAX_NAMES or self._layout.values.itemsize > MAX_EXTRA_BYTES:
            raise ConfigError(
                f"extras: found {len(columns)} names and {self._layout.values.itemsize:,} bytes a step in "
                f"all shards, expected at most {MAX_NAMES} and {MAX_EXTRA_BYTES:,}"
            )
        self._is_described = False

    def copy(self, source: Source, phase: str, numbers: Ints, new_step: int, new_position: int) -> int:
        """Copy the extras of some steps, which follow each other in the run; return how many had some.

        Args:
            numbers: of the steps, as their process counted them.
            new_step: the number of the first step in the run.
            new_position: the steps of the run before it.
        """
        extras = self._extras[source.number, phase]
        if not extras:
            return 0
        n = len(numbers)
        named = {self._names[source.number, name]: values for name, values in extras.at(numbers).items()}
        flags = {name: ~np.ma.getmaskarray(values).reshape(n, -1)[:, 0] for name, values in named.items()}
        rows = np.flatnonzero(np.logical_or.reduce(list(flags.values())))
        if not len(rows):
            return 0
        if not self._is_described:
            begin_layout(self._recorder, 0, self._layout.columns, new_position + int(rows[0]) + 1)
            self._is_described = True
        columns, given = {}, {}
        for name, column in self._layout.columns.items():
            given[name] = flags.get(name, np.zeros(n, np.bool_))[rows]
            columns[name] = blank_extras(column, len(rows))
            if name not in named:
                continue
            values = named[name].data[rows]
            if leaf_dtype(column) is not None:
                columns[name][:] = values
                continue
            for k in np.flatnonzero(given[name]).tolist():
                columns[name][k] = encoded(column, values[k])
        positions = (new_position + rows + 1).astype(np.uint64)
        put_extras(self._recorder, phase, self._layout, new_step + rows, positions, columns, given)
        return len(rows)
