"""Messages of variable size, to and from protobuf: metrics, tables, arrays, log lines, pictures."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.blocks import varint
from runner.recording.protobuf import message_class
from runner.recording.schema import STEP_NANOSECONDS, MessageType
from runner.recording.spaces import NUMBERS


@dataclass(frozen=True, eq=False)
class QTable:
    """A snapshot: the table of one agent after `step` training steps, in which `episode` episodes ended."""

    step: int
    episode: int
    agent: str
    table: int
    values: NDArray[np.float64]
    """[states, actions]."""


def encode(message: MessageType, values: Mapping[str, Any]) -> bytes:
    """Return the message with these field values; a field that is missing is protobuf's zero."""
    stored = {field.name: field.stored_as for field in message.fields if field.stored_as}
    values = {stored.get(name, name): value for name, value in values.items()}
    return bytes(message_class(message)(**values).SerializeToString(deterministic=True))


def scalar_encoder(name: str, phase: str) -> Callable[[float, int, int], bytes]:
    """Return a function that encodes `dualtaxi.Scalar` messages, from value, step and episode.

    It returns the bytes that `encode` returns, in a tenth of the time, because only three numbers change.
    Neither name nor phase may be empty.
    """
    named, phased = name.encode(), phase.encode()
    head = b"\n" + varint(len(named)) + named
    middle = b"\x1a" + varint(len(phased)) + phased
    before_value, before_step = head + b"\x11", middle + b"!"
    pack = struct.Struct(f"<{len(before_value)}sd{len(before_step)}sqcq").pack
    pack_value, pack_number = struct.Struct("<cd").pack, struct.Struct("<cq").pack

    def encode_scalar(value: float, step: int, episode: int) -> bytes:
        if value and step and episode:
            return pack(before_value, value, before_step, step, b")", episode)
        # Protobuf leaves zeros out, but not a negative one.
        is_zero = not value and math.copysign(1.0, value) > 0
        return (
            (head if is_zero else head + pack_value(b"\x11", value))
            + (middle + pack_number(b"!", step) if step else middle)
            + (pack_number(b")", episode) if episode else b"")
        )

    return encode_scalar


def decode(message: MessageType, payload: bytes) -> dict[str, Any]:
    """Return the values of a message's fields; repeated ones as lists.

    Raises:
        RecordingError: the payload is no such message.
    """
    try:
        parsed = message_class(message).FromString(payload)
    except DecodeError as error:
        raise RecordingError(f"found a payload that is no {message.full_name} ({error})") from error
    return {
        field.name: list(value) if field.repeated else value
        for field in message.fields
        for value in (getattr(parsed, field.stored_name),)
    }


def encode_q_table(table: QTable) -> bytes:
    """Return a `dualtaxi.QTable`; values as little-endian float64, row-major."""
    return encode(
        schema.Q_TABLE,
        {
            "step": table.step,
            "episode": table.episode,
            "agent": table.agent,
            "table": table.table,
            "shape": list(table.values.shape),
            "dtype": "<f8",
            "data": np.ascontiguousarray(table.values, dtype="<f8").tobytes(),
        },
    )


def decode_q_table(payload: bytes) -> QTable:
    """Return the snapshot in a `dualtaxi.QTable`.

    Raises:
        RecordingError: shape, dtype and data do not fit together.
    """
    fields = decode(schema.Q_TABLE, payload)
    shape, data = tuple(fields["shape"]), fields["data"]
    if fields["dtype"] != "<f8" or len(shape) != 2 or shape[0] * shape[1] * 8 != len(data):
        raise RecordingError(
            f"found a Q-table of shape {shape}, dtype {fields['dtype']!r} and {len(data)} bytes; "
            "expected two axes of little-endian float64"
        )
    values = np.frombuffer(data, dtype="<f8").reshape(shape)
    return QTable(fields["step"], fields["episode"], fields["agent"], fields["table"], values)


@dataclass(frozen=True, eq=False)
class Snapshot:
    """An array that a loop recorded, after `step` steps of its phase."""

    name: str
    phase: str
    step: int
    episode: int
    values: NDArray[Any]


def decode_array(payload: bytes) -> Snapshot:
    """Return the array in a `dualtaxi.Array`.

    Raises:
        RecordingError: shape, dtype and data do not fit together.
    """
    fields = decode(schema.ARRAY, payload)
    shape, kind, data = tuple(fields["shape"]), fields["dtype"], fields["data"]
    if not NUMBERS.fullmatch(kind) or math.prod(shape) * np.dtype(kind).itemsize != len(data):
        raise RecordingError(f"found an array of shape {shape}, dtype {kind!r} and {len(data)} bytes")
    values = np.frombuffer(data, kind).reshape(shape)
    return Snapshot(fields["name"], fields["phase"], fields["step"], fields["episode"], values)


def encode_log(text: str, seconds: float, level: str = "INFO", name: str = "dualtaxi") -> bytes:
    """Return a `foxglove.Log` at a logical time."""
    whole = int(seconds)
    return encode(
        schema.LOG,
        {
            "timestamp": {"seconds": whole, "nanos": round((seconds - whole) * 1e9)},
            "level": schema.LOG_LEVELS.index(level),
            "message": text,
            "name": name,
        },
    )


def encode_image(data: bytes, kind: str, position: int, phase: str) -> bytes:
    """Return a `foxglove.CompressedImage` after so many steps; `kind` is `png` or `jpeg`."""
    seconds, nanos = divmod(position * STEP_NANOSECONDS, 10**9)
    stamp = {"seconds": seconds, "nanos": nanos}
    return encode(schema.IMAGE, {"timestamp": stamp, "data": data, "format": kind, "frame_id": phase})
