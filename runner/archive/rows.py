"""Messages of variable size to rows and back: metrics, log lines, snapshots of Q-tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from blake3 import blake3

from runner.recording import schema
from runner.recording.messages import QTable, decode, encode, encode_log
from runner.recording.schema import STEP_NANOSECONDS, Topic


@dataclass(frozen=True, eq=False)
class PlacedTable:
    """A snapshot and its position: environment steps executed before it."""

    position: int
    table: QTable

    @property
    def step(self) -> int:
        """Training steps taken."""
        return self.table.step


def message_row(topic: Topic, payload: bytes) -> dict[str, Any]:
    """Return a message of metrics or of the log as the values of its columns.

    Raises:
        RecordingError: the payload is no such message.
    """
    values = decode(topic.message, payload)
    if topic is schema.LOG_TOPIC:
        level = values["level"]
        known = 0 <= level < len(schema.LOG_LEVELS)
        return {"level": schema.LOG_LEVELS[level if known else 0], "message": values["message"]}
    return values


def message_payload(topic: Topic, position: int, row: Mapping[str, Any]) -> bytes:
    """Return the message that a row came from."""
    if topic is schema.LOG_TOPIC:
        return encode_log(row["message"], position * STEP_NANOSECONDS / 1e9, row["level"])
    return encode(topic.message, {field.name: row[field.name] for field in topic.message.fields})


def snapshot_row(run_id: str, snapshot: PlacedTable, with_values: bool) -> dict[str, Any]:
    """Return the row of a snapshot; without its values, their hash says whether they were made again."""
    table = snapshot.table
    data = table.values.tobytes()
    return {
        "run_id": run_id,
        "position": snapshot.position,
        "step": table.step,
        "episode": table.episode,
        "agent": table.agent,
        "table": table.table,
        "states": table.values.shape[0],
        "actions": table.values.shape[1],
        "blake3": blake3(data).hexdigest(),
        "data": data if with_values else None,
    }
