"""Messages as protobuf: descriptors and classes; messages of variable size, encoded and decoded."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Pb
from google.protobuf.message import DecodeError

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.fields import Field
from runner.recording.layout import HEADER_BYTES, blank_records, constant_bytes, row_dtype
from runner.recording.schema import LOG_LEVELS, STEP_NANOSECONDS, MessageType
from runner.recording.spaces import RECORDED_DTYPE
from runner.util.arrays import Array, Floats, Records
from runner.util.jsonable import is_exact, restored
from runner.util.values import Json, JsonView

Message = dict[str, Any]
"""The fields of a decoded message by name."""
Logged = tuple[int, bytes]
"""The log time of a message, in nanoseconds, and its payload."""


@lru_cache(256)
def file_descriptor_set(message: MessageType) -> bytes:
    """Return the schema of a message as MCAP wants it: a serialized FileDescriptorSet with its imports."""
    return descriptor_pb2.FileDescriptorSet(file=_files(message)).SerializeToString(deterministic=True)


@lru_cache(256)
def message_class(message: MessageType) -> Any:
    """Return the protobuf class of a message."""
    pool = descriptor_pool.DescriptorPool()
    for file in _files(message):
        pool.AddSerializedFile(file.SerializeToString())
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(message.full_name))


def _files(message: MessageType) -> list[descriptor_pb2.FileDescriptorProto]:
    """Return the file that describes a message, after the files it imports."""
    file = descriptor_pb2.FileDescriptorProto(
        name=f"{message.package}/{message.name}.proto", package=message.package, syntax="proto3"
    )
    described = file.message_type.add(name=message.name)
    imports = []
    for field in message.fields:
        added = _add_field(file, described, field, field.stored_name)
        if field.kind == Pb.TYPE_MESSAGE and field.parts is None:
            added.type_name = ".google.protobuf.Timestamp"
            timestamp = descriptor_pb2.FileDescriptorProto()
            timestamp_pb2.DESCRIPTOR.CopyToProto(timestamp)
            imports.append(timestamp)
            file.dependency.append(timestamp.name)
        elif field.kind == Pb.TYPE_ENUM:
            added.type_name = f".{message.full_name}.Level"
            levels = described.enum_type.add(name="Level")
            for number, name in enumerate(LOG_LEVELS):
                levels.value.add(name=name, number=number)
    return [*imports, file]


def _add_field(
    file: descriptor_pb2.FileDescriptorProto,
    described: descriptor_pb2.DescriptorProto,
    field: Field,
    nested_name: str,
    is_value: bool = False,
) -> Pb:
    """Add a field to a message, and the type of a nested message to the file, named after its parent."""
    added: Pb = described.field.add(
        name=field.stored_name,
        number=field.number,
        type=field.kind,
        label=Pb.LABEL_REPEATED if field.repeated else Pb.LABEL_OPTIONAL,
    )
    if field.kind == Pb.TYPE_STRING and (is_value or field.is_value):
        _add_field(file, described, field.raw, "")
    if field.parts is not None:
        nested = file.message_type.add(name=f"{described.name}_{nested_name}")
        added.type_name = f".{file.package}.{nested.name}"
        for part in field.parts:
            _add_field(file, nested, part, str(part.number), is_value=True)
    return added


@dataclass(frozen=True, eq=False)
class QTable:
    """A snapshot: the table of one agent after `step` training steps, in which `episode` episodes ended."""

    step: int
    episode: int
    agent: str
    table: int
    values: Floats
    """[states, actions]."""


def encode(message: MessageType, values: Mapping[str, object]) -> bytes:
    """Return the message with these field values; a missing field is protobuf's zero.

    Values of spaces are bytes as `spaces` describes them; of such a message no field may be missing.
    """
    if message.values:
        row = np.zeros(1, row_dtype(message))
        for field in message.fields:
            row[field.name][0] = values[field.name]
        return encode_rows(message, row)[0]
    return bytes(message_class(message)(**values).SerializeToString(deterministic=True))


@lru_cache(64)
def _numbers_of(message: MessageType) -> MessageType:
    """Return the message type without its values of varying size, which come last."""
    fields = tuple(field for field in message.fields if not field.is_value)
    return replace(message, fields=fields, varies=False)


def encode_rows(message: MessageType, rows: Records) -> list[bytes]:
    """Return the payload of each row, for messages of varying size."""
    numbers = _numbers_of(message)
    records = blank_records(schema.LOG_TOPIC, numbers, len(rows))
    for field in numbers.fields:
        records[field.name] = rows[field.name]
    payloads = [record[HEADER_BYTES:] for record in records.view(f"V{records.itemsize}").tolist()]
    for field in message.values:
        parts = (field.encoded(value, 0)[0] for value in rows[field.name].tolist())
        payloads = [payload + part for payload, part in zip(payloads, parts, strict=True)]
    return payloads


def decode_rows(message: MessageType, messages: Sequence[Logged]) -> Records:
    """Return messages of varying size, given as log times and payloads, as rows.

    Raises:
        RecordingError: one is not as `encode_rows` writes them.
    """
    numbers = _numbers_of(message)
    dtype = blank_records(schema.LOG_TOPIC, numbers, 0).dtype
    size = dtype.itemsize - HEADER_BYTES
    head = bytes(HEADER_BYTES)
    joined = b"".join([head + payload[:size].ljust(size, b"\0") for _, payload in messages])
    records = np.frombuffer(joined, dtype)
    rows = np.zeros(len(messages), row_dtype(message))
    rows["log_time"] = rows["publish_time"] = [time for time, _ in messages]
    expected, is_constant = constant_bytes(schema.LOG_TOPIC, numbers)
    found = records.view(np.uint8).reshape(len(messages), -1)
    is_message = bool((found[:, is_constant] == expected[is_constant]).all())
    for field in numbers.fields:
        rows[field.name] = records[field.name]
        is_message &= field.are_exact(rows[field.name], records[field.name])
    if not is_message:
        raise RecordingError(f"found a payload that is no {message.full_name}")
    for k, (_, payload) in enumerate(messages):
        end = size
        for field in message.values:
            rows[field.name][k], end = field.decoded(payload, end)
        if end != len(payload):
            raise RecordingError(f"found {len(payload)} bytes, expected {end} in a {message.full_name}")
    return rows


def scalar_encoder(name: str, phase: str) -> Callable[[float, int, int], bytes]:
    """Return a function that encodes `dualtaxi.Scalar` messages, from value, step and episode.

    It gives the same bytes as `encode`, in a quarter of the time, because only three numbers change.
    """
    before_value, before_step = encode(schema.SCALAR, {"name": name}), encode(schema.SCALAR, {"phase": phase})
    pack_value, pack_number = struct.Struct("<cd").pack, struct.Struct("<cq").pack

    def encode_scalar(value: float, step: int, episode: int) -> bytes:
        # Protobuf leaves zeros out, but not a negative one.
        has_value = value or math.copysign(1.0, value) < 0
        return (
            before_value
            + (pack_value(b"\x11", value) if has_value else b"")
            + before_step
            + (pack_number(b"!", step) if step else b"")
            + (pack_number(b")", episode) if episode else b"")
        )

    return encode_scalar


class Scalars(NamedTuple):
    """Logged values, in the order in which they were logged."""

    series: list[tuple[str, str]]
    """Name and phase of each series, in the order of their first values."""
    rows: Records
    """A `SCALAR_ROW` for each value."""


SCALAR_ROW: Final = np.dtype(
    [("series", "<i8"), ("log_time", "<u8"), ("step", "<i8"), ("episode", "<i8"), ("value", "<f8")]
)
"""A logged value: the number of its series in `Scalars.series`, and the fields of its message."""


def decode_scalars(messages: Sequence[Logged]) -> Scalars:
    """Return `dualtaxi.Scalar` messages, given as log times and payloads.

    Raises:
        RecordingError: a payload is not such a message.
    """
    numbers: dict[tuple[str, str], int] = {}
    rows = []
    for time, payload in messages:
        scalar = _parsed(schema.SCALAR, payload)
        number = numbers.setdefault((scalar.name, scalar.phase), len(numbers))
        rows.append((number, time, scalar.step, scalar.episode, scalar.value))
    return Scalars(list(numbers), np.array(rows, SCALAR_ROW))


def decode(message: MessageType, payload: bytes) -> Message:
    """Return the values of a message's fields; repeated ones as lists, those of spaces as bytes.

    Raises:
        RecordingError: the payload is not such a message.
    """
    if message.values:
        row = decode_rows(message, [(0, payload)])[0]
        return {
            field.name: value if isinstance(value, bytes) else value.tolist()
            for field in message.fields
            for value in (row[field.name],)
        }
    parsed = _parsed(message, payload)
    return {
        field.name: list(value) if field.repeated else value
        for field in message.fields
        for value in (getattr(parsed, field.stored_name),)
    }


def _parsed(message: MessageType, payload: bytes) -> Any:
    try:
        return message_class(message).FromString(payload)
    except DecodeError as error:
        raise RecordingError(f"found a payload that is no {message.full_name} ({error})") from error


def unknown_measures(message: MessageType, schema_data: bytes) -> list[str]:
    """Return the single doubles of a message that a recorded schema does not have: they were added later.

    Protobuf reads such a field as 0, as if that had been measured.

    Args:
        schema_data: the schema in the recording, a serialized FileDescriptorSet.
    """
    try:
        files = descriptor_pb2.FileDescriptorSet.FromString(schema_data).file
    except DecodeError:
        return []
    described = [kind for file in files for kind in file.message_type if kind.name == message.name]
    numbers = {field.number for kind in described for field in kind.field}
    return [
        field.name
        for field in message.fields
        if described and field.kind == Pb.TYPE_DOUBLE and not field.repeated and field.number not in numbers
    ]


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
    shape = tuple(fields["shape"])
    data = fields["data"]
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
    values: Array


def decode_array(payload: bytes) -> Snapshot:
    """Return the array in a `dualtaxi.Array`.

    Raises:
        RecordingError: shape, dtype and data do not fit together.
    """
    fields = decode(schema.ARRAY, payload)
    shape = tuple(fields["shape"])
    kind = fields["dtype"]
    data = fields["data"]
    try:
        if not RECORDED_DTYPE.fullmatch(kind):  # `np.dtype` takes more than names of numbers
            raise ValueError
        values = np.frombuffer(data, kind).reshape(shape)
    except ValueError as error:  # also of shapes that no array can have
        found = f"shape {shape}, dtype {kind!r} and {len(data)} bytes"
        raise RecordingError(f"found an array of {found}") from error
    return Snapshot(fields["name"], fields["phase"], fields["step"], fields["episode"], values)


def encode_log(text: str, seconds: float, level: str = "INFO", name: str = "dualtaxi") -> bytes:
    """Return a `foxglove.Log` at a logical time."""
    whole = int(seconds)
    return encode(
        schema.LOG,
        {
            "timestamp": {"seconds": whole, "nanos": round((seconds - whole) * 1e9)},
            "level": LOG_LEVELS.index(level),
            "message": text,
            "name": name,
        },
    )


def log_level(number: int) -> str:
    """Return the name of a level of `foxglove.Log`; UNKNOWN for a number that it does not have."""
    return LOG_LEVELS[number] if number in range(len(LOG_LEVELS)) else LOG_LEVELS[0]


def media_type(data: bytes) -> str | None:
    """Return the media type of a picture; None if it is neither PNG, JPEG nor WebP."""
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return "image/png"
    if data.startswith(b"\xff\xd8\xff"):
        return "image/jpeg"
    return "image/webp" if data[:4] == b"RIFF" and data[8:12] == b"WEBP" else None


def encode_image(data: bytes, kind: str, position: int, frame_id: str) -> bytes:
    """Return a `foxglove.CompressedImage` logged after `position` steps; `kind` is `png` or `jpeg`."""
    seconds, nanos = divmod(position * STEP_NANOSECONDS, 10**9)
    stamp = {"seconds": seconds, "nanos": nanos}
    return encode(schema.IMAGE, {"timestamp": stamp, "data": data, "format": kind, "frame_id": frame_id})


def frame_id(phase: str, environment: int | None, is_reset: bool) -> str:
    """Return the place of a frame: `train`, `train/reset`, or of a vector environment `train/3/reset`."""
    parts = [phase, *([] if environment is None else [str(environment)]), *(["reset"] if is_reset else [])]
    return "/".join(parts)


def frame_place(frame: Message) -> tuple[int, bool]:
    """Return the environment of a decoded frame, and whether it shows the state after a reset."""
    _, *parts = frame["frame_id"].split("/", 2)
    environment = int(parts[0]) if parts and parts[0].isdecimal() and len(parts[0]) < 10 else 0
    return environment, parts[-1:] == ["reset"]


# --- what resets depend on ----------------------------------------------------------------------------

MAX_DIGITS: Final = 4000
MAX_LARGE_SEED: Final = 10**MAX_DIGITS - 1
"""The largest seed that is recorded."""


class ResetOptions(NamedTuple):
    """The options of a reset, and a seed that is too large for its record."""

    reset: int = -1
    """The number of the reset in its phase, as in `dualtaxi.Reset`."""
    json: str = ""
    """The options as `exact_json` writes them, or as text the reason why they are not recorded; empty for
    none."""
    large_seed: int | None = None
    """The seed, if it has more than 64 bits."""
    resets: int = 1
    """How many consecutive resets have the options: one call may reset several environments."""

    @property
    def options(self) -> dict[str, object] | None:
        """The options; None if there are none, or none that could be recorded."""
        options = restored(json.loads(self.json)) if self.json else None
        return options if isinstance(options, dict) else None

    @property
    def is_exact(self) -> bool:
        """Whether the environment got exactly these options."""
        return is_exact(self.json) and (not self.json or self.options is not None)

    def to_payload(self) -> bytes:
        """Return the message."""
        seed = "" if self.large_seed is None else str(self.large_seed)
        return encode(schema.RESET_OPTIONS, self._asdict() | {"large_seed": seed})


def decode_reset_options(payload: bytes) -> ResetOptions:
    """Return the options in a `dualtaxi.ResetOptions`.

    Raises:
        RecordingError: they are no JSON, or the seed is no number.
    """
    fields = decode(schema.RESET_OPTIONS, payload)
    seed = fields["large_seed"]
    if seed and not (seed.isascii() and seed.isdecimal() and len(seed) <= MAX_DIGITS):
        raise RecordingError(f"found the seed {seed[:40]!r} of a reset, expected at most {MAX_DIGITS} digits")
    large_seed = int(seed) if seed else None
    given = ResetOptions(fields["reset"], fields["json"], large_seed, fields["resets"])
    try:
        given.options  # noqa: B018 - read once, to refuse what is no JSON
    except (ValueError, RecursionError) as error:
        raise RecordingError(f"found options of a reset that are no JSON ({error})") from error
    return given


STEPS_BETWEEN: Final = 1_000
"""The least steps of an environment from one recorded state to the next, so that states cost a step nearly
nothing."""
SEED_BYTES: Final = 16
MAX_ALE_STATE: Final = 1 << 20
"""The most bytes of an emulator's state."""
_PCG64: Final = struct.Struct("<16s16sII")
"""State, increment, `uinteger`, `has_uint32`."""


class ResetState(NamedTuple):
    """What one reset without a seed depends on: the random generators of its environment.

    It is recorded at the first reset without a seed, and then at the first one after `STEPS_BETWEEN` more
    steps. Any episode can be repeated from the last recorded state, or the last reset with a seed, at or
    before its own reset.

    To repeat the episode that begins with it, call `reset(seed=np_random_seed)` if that is there; otherwise
    set `bit_generator` and `ale_state`, as far as they are there, and call `reset()`.
    """

    reset: int = -1
    """The number of the reset in its phase, as in `dualtaxi.Reset`."""
    environment: int = 0
    """Which environment of a vector; 0 for a generator that all environments share."""
    np_random_seed: int | None = None
    """The seed of the generator that the reset made, drawn by NumPy; None if it made none."""
    bit_generator: Mapping[str, object] | None = None
    """The state of `unwrapped.np_random` before the reset, as `numpy.random.PCG64.state` takes it."""
    ale_state: bytes = b""
    """The state of an Atari environment's emulator before the reset, as `ale_py.ALEState` takes it, with its
    generator; empty for other environments."""

    @property
    def resets(self) -> int:
        """How many consecutive resets it belongs to: one."""
        return 1

    def to_payload(self) -> bytes:
        """Return the message."""
        seed = self.np_random_seed
        generator = b""
        if self.bit_generator is not None:
            state: JsonView = self.bit_generator
            inner = state["state"]
            numbers = (inner[name].to_bytes(16, "little") for name in ("state", "inc"))
            generator = _PCG64.pack(*numbers, state["uinteger"], state["has_uint32"])
        return encode(
            schema.RESET_STATE,
            {
                "reset": self.reset,
                "environment": self.environment,
                "np_random_seed": b"" if seed is None else seed.to_bytes(SEED_BYTES, "little"),
                "bit_generator": generator,
                "ale_state": self.ale_state,
            },
        )


def decode_reset_state(payload: bytes) -> ResetState:
    """Return the state in a `dualtaxi.ResetState`.

    Raises:
        RecordingError: a value has another size than expected.
    """
    fields = decode(schema.RESET_STATE, payload)
    seed, packed, ale = fields["np_random_seed"], fields["bit_generator"], fields["ale_state"]
    if len(seed) not in (0, SEED_BYTES) or len(packed) not in (0, _PCG64.size) or len(ale) > MAX_ALE_STATE:
        raise RecordingError(
            f"found a reset state with a seed of {len(seed)} bytes, a generator of {len(packed)} and an "
            f"emulator of {len(ale):,}; expected {SEED_BYTES}, {_PCG64.size}, at most {MAX_ALE_STATE:,}"
        )
    generator: Json | None = None
    if packed:
        state, increment, uinteger, has_uint32 = _PCG64.unpack(packed)
        inner = {"state": int.from_bytes(state, "little"), "inc": int.from_bytes(increment, "little")}
        if not inner["inc"] % 2 or has_uint32 > 1:
            raise RecordingError("found the state of a random generator that no PCG64 has")
        generator = {"bit_generator": "PCG64", "state": inner, "has_uint32": has_uint32, "uinteger": uinteger}
    return ResetState(
        reset=fields["reset"],
        environment=fields["environment"],
        np_random_seed=int.from_bytes(seed, "little") if seed else None,
        bit_generator=generator,
        ale_state=ale,
    )
