"""The messages of another recording: compared with the messages of a run.

A job determines its content, so doing it again gives the recorded messages, byte for byte, and then those
that are still missing. This is how a run is resumed, and how a recording is verified.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from runner.errors import Diverged
from runner.recording import schema
from runner.recording.messages import Logged, Message, decode
from runner.recording.reader import Recording
from runner.recording.schema import BLOCK_TOPICS, Topic
from runner.util.arrays import Records
from runner.util.differences import differing_rows, first_difference


class Reference:
    """The messages of a recording, topic by topic, each compared once and in order.

    Args:
        recording: the recording; None for a new run.
        complete: whether a message that the recording does not hold is a difference, not new.
    """

    def __init__(self, recording: Recording | None = None, complete: bool = False) -> None:
        self.complete = complete
        self._remaining: dict[Topic, int] = {}
        self._blocks: dict[Topic, Iterator[Records]] = {}
        self._block: dict[Topic, Records] = {}
        self._messages: dict[Topic, Iterator[Logged]] = {}
        self._logged: set[Logged] = set()
        self._has_steps = recording is None or not recording.leaves_out_steps
        if recording is None:
            return
        for topic in BLOCK_TOPICS:
            self._remaining[topic] = recording.table(topic).count()
            self._blocks[topic] = recording.table(topic).blocks()
        for topic in set(schema.JOB_TOPICS) - set(BLOCK_TOPICS) - {schema.LOG_TOPIC}:
            self._messages[topic] = recording.table(topic).messages()
        self._logged = set(recording.table(schema.LOG_TOPIC).messages())

    def remaining(self, topic: Topic) -> int:
        """Return how many messages of a fixed-width topic are still to be compared."""
        return self._remaining.get(topic, 0)

    @property
    def exhausted(self) -> bool:
        """Whether every step and episode was compared."""
        return not any(self._remaining.values())

    def compare_block(self, topic: Topic, records: Records) -> None:
        """Compare records with the next recorded ones, as many as there are; the others are new.

        Raises:
            Diverged: they differ, the first record and field that do are named; or the recording should be
                complete and is not.
        """
        done = 0
        while done < len(records) and self.remaining(topic):
            block = self._block.get(topic)
            if block is None or not len(block):
                block = next(self._blocks[topic])
            n = min(len(block), len(records) - done)
            expected = records[done : done + n]
            if block[:n].tobytes() != expected.tobytes():
                # Constant bytes are named if nothing else differs.
                names = sorted(block.dtype.names or (), key=lambda name: name.startswith("tag_"))
                difference = first_difference(block[:n], expected, names)
                assert difference is not None  # their bytes differ
                first, name = difference
                was, should = (np.asarray(rows[first][name]).tolist() for rows in (block, expected))
                raise Diverged(topic.name, name, was, should, **_position(expected[first]))
            self._block[topic] = block[n:]
            self._remaining[topic] -= n
            done += n
        is_left_out = topic.message is schema.STEP and not self._has_steps
        if self.complete and done < len(records) and not is_left_out:
            raise Diverged(topic.name, "message", "none", "one more", **_position(records[done]))

    def compare_message(self, topic: Topic, log_time: int, payload: bytes) -> bool:
        """Compare a message with the next recorded one; return False if there is none.

        Raises:
            Diverged: they differ, or the recording should be complete and is not.
        """
        if topic is schema.LOG_TOPIC:
            return self.complete or (log_time, payload) in self._logged
        recorded = next(self._messages.get(topic, iter(())), None)
        if recorded is None:
            if self.complete:
                raise Diverged(topic.name, "message", "none", f"one at {log_time} ns")
            return False
        if recorded != (log_time, payload):
            raise _message_difference(topic, recorded, (log_time, payload))
        return True

    def check_exhausted(self) -> None:
        """Check, after the run, that the recording holds no more than the run gave.

        Raises:
            Diverged: it does.
        """
        for topic, remaining in self._remaining.items():
            if remaining:
                raise Diverged(topic.name, "messages", f"{remaining} more", "none")
        for topic, messages in self._messages.items():
            if next(messages, None) is not None:
                raise Diverged(topic.name, "messages", "more", "none")


def _message_difference(topic: Topic, found: Logged, expected: Logged) -> Diverged:
    was, should = ({"log_time": time} | decode(topic.message, payload) for time, payload in (found, expected))
    position: dict[str, int] = {key: should[key] for key in ("step", "episode") if key in should}
    for name in should:
        if repr(was[name]) != repr(should[name]):  # NaN is like NaN
            is_table = name == "data"
            field, left, right = (
                _cell_difference(was, should) if is_table else (name, was[name], should[name])
            )
            return Diverged(topic.name, field, left, right, **position)
    other = "other bytes of the same meaning"
    return Diverged(topic.name, "bytes", f"{len(found[1])} bytes", other, **position)


def _cell_difference(found: Message, expected: Message) -> tuple[str, object, object]:
    """Return the first cell in which two Q-tables differ, and its values."""
    left, right = (np.frombuffer(values["data"], "<f8") for values in (found, expected))
    if left.shape != right.shape:
        return "data", f"{len(left)} cells", f"{len(right)} cells"
    cell = int(np.argmax(differing_rows(left, right)))
    state, action = divmod(cell, int(expected["shape"][-1]))
    return f"data[{state}, {action}]", float(left[cell]), float(right[cell])


def _position(record: np.void) -> dict[str, int]:
    step = "step" if "step" in (record.dtype.names or ()) else "last_step"
    return {"episode": int(record["episode"]), "step": int(record[step])}
