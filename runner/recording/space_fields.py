"""The values of a space as fields of a message: named, typed, and readable by any Protobuf reader.

| space | field |
|---|---|
| a number of 32 or 64 bits, or a bool | of that type |
| a smaller number | of 32 bits |
| an array of numbers of 32 or 64 bits, or of bools | packed, row by row |
| an array of smaller numbers | `bytes`: the array, row by row, little-endian |
| an array of varying length | as an array of one length |
| a text | `string`; one with unpaired surrogates is in the field `NAME_raw`, as `bytes` |
| `Dict`, `Tuple`, the agents of a game | a nested message with a field for each part |

All fields are always written, in order. So values without texts have one size, and many messages are one
NumPy array. In records, values stand as `spaces` describes them: those of varying size as bytes.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any, Final

import numpy as np
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Pb

from runner.errors import RecordingError
from runner.recording.schema import Field
from runner.recording.spaces import (
    Description,
    encode_bytes,
    item_dtype,
    leaf_dtype,
    parts_of,
    varying_length,
)
from runner.util.arrays import Array

_KINDS: Final[Mapping[str, int]] = {
    "|b1": Pb.TYPE_BOOL,
    "<i4": Pb.TYPE_SFIXED32,
    "<u4": Pb.TYPE_FIXED32,
    "<f4": Pb.TYPE_FLOAT,
    "<i8": Pb.TYPE_SFIXED64,
    "<u8": Pb.TYPE_FIXED64,
    "<f8": Pb.TYPE_DOUBLE,
}
"""The types of numbers by their dtypes."""
_WIDER: Final = {"|i1": "<i4", "<i2": "<i4", "|u1": "<u4", "<u2": "<u4", "<f2": "<f4"}
"""The dtypes in which single smaller numbers are stored."""
_WIRE_TYPES: Final = {1: 0, 4: 5, 8: 1}
"""Protobuf's wire types of numbers by their bytes."""
_DELIMITED: Final = 2
_RAW: Final = 4096
"""Added to the number of a text's field if the text is no UTF-8; a message has fewer fields."""


def space_field(number: int, name: str, description: Description) -> Field:
    """Return the field of a message with the values of a space, whose description was checked."""
    return replace(_field(number, name, name, description), is_value=True)


def _field(number: int, name: str, stored_name: str, description: Description) -> Field:
    stored_as = stored_name if stored_name != name else ""
    parts = parts_of(description)
    if parts is not None:
        names = _identifiers([key for key, _ in parts])
        fields = tuple(
            _field(k, key, stored, part)
            for k, ((key, part), stored) in enumerate(zip(parts, names, strict=True), start=1)
        )
        return Field(number, name, Pb.TYPE_MESSAGE, stored_as=stored_as, parts=fields)
    dtype = leaf_dtype(description)
    if dtype is None and (item := item_dtype(description)) is not None:
        kind = _KINDS.get(item.base.str, Pb.TYPE_BYTES)
        return Field(number, name, kind, kind != Pb.TYPE_BYTES, stored_as)
    if dtype is None:
        return Field(number, name, Pb.TYPE_STRING, stored_as=stored_as)
    code = dtype.base.str
    code = code if dtype.shape else _WIDER.get(code, code)
    kind, is_repeated = _KINDS.get(code, Pb.TYPE_BYTES), bool(dtype.shape) and code in _KINDS
    return Field(number, name, kind, is_repeated, stored_as, dtype)


def _identifiers(keys: list[str]) -> list[str]:
    """Return the names of fields for the keys of parts.

    Other characters than ASCII letters, digits and `_` become `_`; a name that begins with a digit gets a `_`
    before it; and names that are equal but for case and `_` are numbered from the second on, as `NAME_2`.
    """
    names: list[str] = []
    taken: set[str] = set()
    last: dict[str, int] = {}
    for key in keys:
        base = re.sub(r"[^A-Za-z0-9_]", "_", key)
        base = f"_{base}" if base[:1].isdigit() else base
        number = last.get(_folded(base), 0) + 1
        name = base if number == 1 else f"{base}_{number}"
        while _folded(name) in taken or _folded(f"{name}_raw") in taken:
            number += 1
            name = f"{base}_{number}"
        last[_folded(base)] = number
        taken |= {_folded(name), _folded(f"{name}_raw")}
        names.append(name)
    return names


def _folded(name: str) -> str:
    """Return what two fields of a message must not have in common: Protobuf compares their JSON names."""
    return name.replace("_", "").lower()


def raw_field(field: Field) -> Field:
    """Return the second field of a text, for texts that are not valid UTF-8."""
    name = f"{field.stored_name}_raw"
    return Field(field.number + _RAW, name, Pb.TYPE_BYTES)


def is_text(field: Field) -> bool:
    """Return whether a field has texts of a space."""
    return field.kind == Pb.TYPE_STRING and field.parts is None


def has_one_size(field: Field) -> bool:
    """Return whether all values of a field have as many bytes."""
    return field.dtype is not None if field.parts is None else all(map(has_one_size, field.parts))


@lru_cache(256)
def stored_dtype(field: Field) -> np.dtype[Any]:
    """Return the dtype of a value as it is stored, after its tag; what stands between parts is left out."""
    if field.parts is None:
        assert field.dtype is not None
        wider = None if field.dtype.shape else _WIDER.get(field.dtype.str)
        return field.dtype if wider is None else np.dtype(wider)
    offsets, at = [], 0
    for part in field.parts:
        at += len(tag(part))
        offsets.append(at)
        at += stored_dtype(part).itemsize
    names, formats = [part.name for part in field.parts], [*map(stored_dtype, field.parts)]
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": at})


def are_exact(field: Field, values: Array, stored: Array) -> bool:
    """Return whether numbers, read from those that are stored in more bytes, are the stored ones."""
    if field.parts is not None:
        inside: tuple[Any, Any] = values, stored
        return all(are_exact(part, *(own[part.name] for own in inside)) for part in field.parts)
    if stored_dtype(field) == field.dtype:
        return True
    return values.astype(stored.dtype).tobytes() == stored.tobytes()


@lru_cache(256)
def row_dtype(field: Field) -> np.dtype[Any]:
    """Return the dtype of a value in rows: without gaps, and of varying size an object, which holds bytes."""
    if not has_one_size(field):
        return np.dtype(object)
    if field.parts is None:
        assert field.dtype is not None
        return field.dtype
    return np.dtype([(part.name, row_dtype(part)) for part in field.parts])


def tag(field: Field) -> bytes:
    """Return the constant bytes before a value of one size: its tag, and its length if it has one."""
    size = stored_dtype(field).itemsize
    if field.parts is not None or field.repeated or field.kind == Pb.TYPE_BYTES:
        return _head(field.number) + varint(size)
    return varint(field.number << 3 | _WIRE_TYPES[size])


def put_constants(field: Field, stored: Array, at: int = 0) -> None:
    """Set the constant bytes within a stored value, which begins at `at` in an array of bytes."""
    dtype = stored_dtype(field)
    for part in field.parts or ():
        start = at + int(dtype.fields[part.name][1])  # type: ignore[index]
        constant = tag(part)
        stored[start - len(constant) : start] = list(constant)
        put_constants(part, stored, start)


def varint(number: int) -> bytes:
    """Return a number as Protobuf writes lengths: seven bits a byte, the lowest first."""
    low = []
    while number >= 128:
        low.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*low, number])


# --- values of varying size ---------------------------------------------------------------------------


Encoder = Callable[[bytes, int], tuple[bytes, int]]
"""Takes bytes with a value that `spaces` describes, and where it begins; returns the field of a message, and
where the value ends."""
Decoder = Callable[[bytes, int], tuple[bytes, int]]
"""Takes a message, and where a field begins; returns the field's value, and where the field ends.

Raises a `RecordingError` if the field is not there, or is not as an encoder writes it."""


def encoder(field: Field) -> Encoder:
    """Return the function that encodes the values of a field."""
    if field.parts is not None:
        encoders = [*map(encoder, field.parts)]

        def nested(value: bytes, at: int) -> tuple[bytes, int]:
            pieces = []
            for encode in encoders:
                piece, at = encode(value, at)
                pieces.append(piece)
            return _delimited(head, b"".join(pieces)), at

        head = _head(field.number)
        return nested
    if not has_one_size(field):
        heads = _heads(field)

        def varying(value: bytes, at: int) -> tuple[bytes, int]:
            end = at + 4 + varying_length(value, at)
            data = value[at + 4 : end]
            return _delimited(heads[_is_utf8(data)], data), end

        return varying
    dtype, stored, constant = _number_dtypes(field)

    def number(value: bytes, at: int) -> tuple[bytes, int]:
        data = value[at : at + size]
        if stored != dtype:
            data = np.frombuffer(data, dtype).astype(stored).tobytes()
        return constant + data, at + size

    size = field.dtype.itemsize if field.dtype is not None else 0
    return number


def decoder(field: Field) -> Decoder:
    """Return the function that decodes the values of a field."""
    if field.parts is not None:
        decoders = [*map(decoder, field.parts)]

        def nested(message: bytes, at: int) -> tuple[bytes, int]:
            at, end = _span(field, message, at, head)
            pieces = []
            for decode in decoders:
                piece, at = decode(message, at)
                pieces.append(piece)
            if at != end:
                raise _refused(field)
            return b"".join(pieces), end

        head = _head(field.number)
        return nested
    if not has_one_size(field):
        heads = _heads(field)

        def varying(message: bytes, at: int) -> tuple[bytes, int]:
            is_utf8 = message.startswith(heads[True], at)
            start, end = _span(field, message, at, heads[is_utf8])
            data = message[start:end]
            if heads[_is_utf8(data)] != heads[is_utf8]:
                raise _refused(field)
            return encode_bytes(data), end

        return varying
    dtype, stored, constant = _number_dtypes(field)

    def number(message: bytes, at: int) -> tuple[bytes, int]:
        start = at + len(constant)
        end = start + size
        if not message.startswith(constant, at) or end > len(message):
            raise _refused(field)
        data = message[start:end]
        if stored != dtype:
            values = np.frombuffer(data, stored).astype(dtype)
            if values.astype(stored).tobytes() != data:
                raise _refused(field)
            data = values.tobytes()
        return data, end

    size = stored_dtype(field).itemsize
    return number


def _number_dtypes(field: Field) -> tuple[np.dtype[Any], np.dtype[Any], bytes]:
    """Return the dtypes of the numbers of a field, in rows and as they are stored, and its constant bytes."""
    assert field.dtype is not None
    return field.dtype.base, stored_dtype(field).base, tag(field)


def _heads(field: Field) -> tuple[bytes, bytes]:
    """Return what a value of varying size begins with: if it is no UTF-8, and if it is."""
    head = _head(field.number)
    return (_head(field.number + _RAW) if is_text(field) else head), head


def _head(number: int) -> bytes:
    return varint(number << 3 | _DELIMITED)


def _delimited(head: bytes, data: bytes) -> bytes:
    return head + varint(len(data)) + data


def _span(field: Field, message: bytes, at: int, head: bytes) -> tuple[int, int]:
    """Return where the bytes of a delimited field begin, and where they end."""
    length, start = 0, at + len(head)
    for k, byte in enumerate(message[start : start + 5]):
        length |= (byte & 0x7F) << 7 * k
        if byte < 128:
            break
    begin = start + len(size := varint(length))
    if not message.startswith(head + size, at) or begin + length > len(message):
        raise _refused(field)
    return begin, begin + length


def _is_utf8(text: bytes) -> bool:
    try:
        text.decode()
    except UnicodeDecodeError:
        return False
    return True


def _refused(field: Field) -> RecordingError:
    return RecordingError(f"found no value of its space in {field.name!r}")
