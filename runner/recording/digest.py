"""The content digest, by which two runs are equal or not.

For each topic, BLAKE3 over its message records in order, each in canonical form: the MCAP message record with
the topic's own channel id, sequence 0, and publish time equal to log time. Then BLAKE3 over the sorted
topics that have messages: length of the name (u32), name, hash. It does not depend on where chunks were
closed, on compression, index, provenance, or topics that say how a run went: `/log`, `/clock`.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping

from blake3 import blake3

from runner.errors import RecordingError, shortened
from runner.recording.schema import Topic

_PREFIX = b"dualtaxi content 0\n"
_MAX_SHOWN = 80


class ContentHash:
    """The running digest of a recording."""

    def __init__(self) -> None:
        self._topics: dict[str, blake3] = {}

    def update(self, topic: Topic, records: bytes | memoryview) -> None:
        """Take in whole message records of a topic, in canonical form."""
        if topic.digested and len(records):
            if (running := self._topics.get(topic.name)) is None:
                running = self._topics[topic.name] = blake3()
            running.update(memoryview(records).cast("B"))

    def topics(self) -> dict[str, str]:
        """Return the hash of each topic that has messages, in hexadecimal."""
        return {name: self._topics[name].hexdigest() for name in sorted(self._topics)}


def combined_digest(topics: Mapping[str, str]) -> str:
    """Return the content digest for the hashes of the topics.

    Raises:
        RecordingError: one of them is no hash.
    """
    content = blake3(_PREFIX)
    for name in sorted(topics):
        encoded = name.encode()
        try:
            digest = bytes.fromhex(topics[name])
        except ValueError:
            text = shortened(topics[name], _MAX_SHOWN)
            raise RecordingError(
                f"the hash of {name}: found {text!r}, expected hexadecimal digits."
            ) from None
        content.update(struct.pack("<I", len(encoded)) + encoded + digest)
    return content.hexdigest()
