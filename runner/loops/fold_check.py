"""Whether a fold lost anything: what it left out, and the new recording compared with what was copied."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from blake3 import blake3

from runner.errors import RecordingError
from runner.loops.shard_sources import Source
from runner.recording import schema
from runner.recording.layout import Layout
from runner.recording.reader import open_recording
from runner.recording.rewriting import content_of
from runner.recording.schema import Topic

_NEW: Final = frozenset({"step", "episode", "t", "environment", "taken", "reset", "log_time", "publish_time"})
"""The fields to which a fold gives new numbers, and which only steps have that were taken."""
_NOT_COPIED: Final = (*schema.MACHINE_TOPICS, schema.EXTRA_COLUMNS_TOPIC)
"""What is of one process only, or written again; so are episodes, which follow from the steps."""


class Content:
    """Digests of the values in steps and resets, by topic and field: a fold must not change them.

    Args:
        layout: the messages of the folded recording, in the dtypes of which values are compared.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self.digests: dict[tuple[str, str], Any] = defaultdict(blake3)

    def take(self, topic: Topic, rows: Any) -> None:
        """Take the next steps or resets: records, or a record."""
        for name in {field.name for field in self._layout.message(topic).fields} - _NEW:
            values = np.atleast_1d(rows)[name]
            if values.dtype.hasobject:
                parts = [len(value).to_bytes(4, "little") + value for value in values.tolist()]
                data = b"".join(parts)
            else:
                dtype = self._layout.rows(topic)[name]
                data = np.ascontiguousarray(values, dtype.base).tobytes()
            self.digests[topic.name, name].update(data)

    def check(self, path: Path) -> None:
        """Compare a folded recording with what was copied into it, after checking every byte of it.

        Raises:
            RecordingError: it is damaged, or holds other values.
        """
        content_of(path)
        found = Content(self._layout)
        with open_recording(path) as recording:
            for topic in recording.topics:
                if topic.name.endswith(("/step", "/reset")):
                    for rows in recording.table(topic).rows():
                        found.take(topic, rows)
        for (topic_name, name), digest in self.digests.items():
            if found.digests[topic_name, name].digest() != digest.digest():
                raise RecordingError(
                    f"{path}: {topic_name}: {name}: found other values than its processes recorded; "
                    "their recordings are kept as they are."
                )


def left_out(source: Source, read: Mapping[str, int]) -> str:
    """Return how much of what a process recorded is in the run, if not all of it is.

    Args:
        read: the number of messages by topic that the fold read.
    """
    steps, others = [], []
    for topic in source.recording.topics:
        if topic.name.endswith("/episode") or topic in _NOT_COPIED:
            continue
        found, there = read.get(topic.name, 0), source.stated.get(topic.name, 0)
        there = max([there, *(stop for _, stop in source.recording.lost.get(topic.name, []))])
        if topic.message is schema.STEP:
            found = source.stops[topic.phase]
            there = max(there, source.recording.phase(topic.phase).steps.total())
            if found < there:
                steps.append(f"{found:,} of {there:,} {schema.PHASE_NAMES[topic.phase]} steps")
        elif found < there:
            others.append(f"{found:,} of {there:,} messages of {topic.name}")
    return ", ".join(steps or others)
