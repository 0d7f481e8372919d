"""The steps of a phase, whole or by their actions alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runner.recording.actions import kept_dtype, unpacked
from runner.recording.topic_chunks import FOREVER, TopicChunks


@dataclass(eq=False, kw_only=True)
class Steps(TopicChunks):
    """The steps of a phase: numbered from 0, in a vector over all its environments."""

    actions: TopicChunks
    """The messages of steps of which only the actions were recorded."""

    @property
    def are_actions(self) -> bool:
        """Whether only the actions of the steps were recorded."""
        return bool(self.actions)

    @property
    def are_known(self) -> bool:
        """Whether any step was recorded, whole or by its action."""
        return bool(self or self.actions)

    def total(self) -> int:
        """Return how many steps were recorded, whole or by their actions alone."""
        if not self.are_actions:
            return self.count()
        last = self.actions.decoded(chunks=range(len(self.actions) - 1, len(self.actions)))
        return max(int(fields["step"] + fields["count"]) for fields in last)

    @property
    def row_dtype(self) -> np.dtype[np.void]:
        """The dtype of `rows`; of actions alone, `kept_dtype`."""
        return kept_dtype(super().row_dtype) if self.are_actions else super().row_dtype

    def rows(self, times: range | None = None) -> Iterator[NDArray[np.void]]:
        """Yield the steps in blocks, in any layout; those of actions alone have the fields of `kept_dtype`.

        Args:
            times: their `log_time` in ns, from the first to before the last; None for all.

        Raises:
            RecordingError: they are damaged.
        """
        if not self.are_actions:
            yield from super().rows(times)
            return
        # A message has the time of its last step.
        for fields in self.actions.decoded(times=times and range(times.start, FOREVER)):
            where = f"{self.file.path}: {self.actions.topic.name}"
            block = unpacked(fields, self.row_dtype, self.file.environments, where)
            if times is not None:
                if block["log_time"][0] >= times.stop:
                    return
                block = block[(block["log_time"] >= times.start) & (block["log_time"] < times.stop)]
            yield block

    def _blocks_from(self, start: int, stop: int) -> Iterator[NDArray[np.void]]:
        return self.rows() if self.are_actions else super()._blocks_from(start, stop)
