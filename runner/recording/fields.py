"""The fields of messages: named, typed, and readable by any Protobuf reader; how their values are stored.

Values of the spaces of an environment become fields by these rules:

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
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from typing import Any, Final

import numpy as np
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Pb

from runner.errors import RecordingError
from runner.recording.spaces import (
    Description,
    encode_bytes,
    item_dtype,
    leaf_dtype,
    parts_of,
)
from runner.util.arrays import Array, DType

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


@dataclass(frozen=True)
class Field:
    """One field of a message; `repeated` means packed."""

    number: int
    name: str
    kind: int
    repeated: bool = False
    stored_as: str = ""
    """Its name in the file's schema, if that is another one."""
    dtype: DType | None = None
    """The dtype of its value, with the shape; None if that varies, or is not known without a run."""
    parts: tuple[Field, ...] | None = None
    """The fields of a nested message: the values of a `Dict` or `Tuple`."""
    is_value: bool = False
    """Whether it has values of a space of the environment."""

    @property
    def stored_name(self) -> str:
        """Its name in the file's schema."""
        return self.stored_as or self.name

    @property
    def raw(self) -> Field:
        """The second field of a text, for texts that are not valid UTF-8."""
        return Field(self.number + _RAW, f"{self.stored_name}_raw", Pb.TYPE_BYTES)

    @cached_property
    def has_one_size(self) -> bool:
        """Whether all its values have as many bytes."""
        return self.dtype is not None if self.parts is None else all(part.has_one_size for part in self.parts)

    @cached_property
    def row_dtype(self) -> DType:
        """The dtype of a value in rows: without gaps, and of varying size an object, which holds bytes."""
        if not self.has_one_size:
            return np.dtype(object)
        if self.dtype is not None:
            return self.dtype
        return np.dtype([(part.name, part.row_dtype) for part in self.parts or ()])

    @cached_property
    def stored_dtype(self) -> DType:
        """The dtype of a value of one size as it is stored, after its tag, without the tags between parts."""
        if self.dtype is not None:
            wider = None if self.dtype.shape else _WIDER.get(self.dtype.str)
            return self.dtype if wider is None else np.dtype(wider)
        parts = self.parts or ()
        offsets = []
        at = 0
        for part in parts:
            at += len(part.tag)
            offsets.append(at)
            at += part.stored_dtype.itemsize
        names, formats = [part.name for part in parts], [part.stored_dtype for part in parts]
        return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": at})

    @cached_property
    def is_widened(self) -> bool:
        """Whether it has a number that is stored in more bytes."""
        return self.stored_dtype != self.dtype

    @cached_property
    def tag(self) -> bytes:
        """The constant bytes before a value of one size: its tag, and its length if it has one."""
        size = self.stored_dtype.itemsize
        if self.parts is not None or self.repeated or self.kind == Pb.TYPE_BYTES:
            return self.head + varint(size)
        return varint(self.number << 3 | _WIRE_TYPES[size])

    @cached_property
    def head(self) -> bytes:
        """What precedes the length of a value."""
        return varint(self.number << 3 | _DELIMITED)

    @cached_property
    def raw_head(self) -> bytes:
        """The same for a text that is not valid UTF-8."""
        return self.raw.head if self.kind == Pb.TYPE_STRING else self.head

    def put_constants(self, stored: Array, at: int) -> None:
        """Set the constant bytes within a stored value, which begins at `at` in an array of bytes."""
        for part in self.parts or ():
            start = at + int(self.stored_dtype.fields[part.name][1])  # type: ignore[index]
            stored[start - len(part.tag) : start] = list(part.tag)
            part.put_constants(stored, start)

    def are_exact(self, values: Array, stored: Array) -> bool:
        """Return whether numbers that are stored in more bytes were read without loss."""
        if self.parts is not None:
            inside: tuple[Any, Any] = values, stored
            return all(part.are_exact(*(column[part.name] for column in inside)) for part in self.parts)
        return not self.is_widened or values.astype(stored.dtype).tobytes() == stored.tobytes()

    def encoded(self, value: bytes, at: int) -> tuple[bytes, int]:
        """Return this field of a message, and where its value ends.

        Args:
            value: bytes with the value at `at`, as `spaces` describes them.
        """
        if (dtype := self.dtype) is not None:
            end = at + dtype.itemsize
            data = value[at:end]
            if self.is_widened:
                data = np.frombuffer(data, dtype.base).astype(self.stored_dtype.base).tobytes()
            return self.tag + data, end
        if self.parts is None:
            end = at + 4 + int.from_bytes(value[at : at + 4], "little")
            data = value[at + 4 : end]
            return self._head_of(data) + varint(len(data)) + data, end
        pieces = []
        for part in self.parts:
            piece, at = part.encoded(value, at)
            pieces.append(piece)
        data = b"".join(pieces)
        return self.head + varint(len(data)) + data, at

    def decoded(self, message: bytes, at: int) -> tuple[bytes, int]:
        """Return the value of this field, which begins at `at` in a message, and where the field ends.

        Raises:
            RecordingError: the field is not there, or not as `encoded` returns it.
        """
        if self.dtype is not None:
            tag = self.tag
            start = at + len(tag)
            end = start + self.stored_dtype.itemsize
            if not message.startswith(tag, at) or end > len(message):
                raise self._refused()
            data = message[start:end]
            if self.is_widened:
                stored = np.frombuffer(data, self.stored_dtype.base)
                values = stored.astype(self.dtype.base)
                if not self.are_exact(values, stored):
                    raise self._refused()
                return values.tobytes(), end
            return data, end
        if self.parts is None:
            head = self.head if message.startswith(self.head, at) else self.raw_head
            start, end = self._span(message, at, head)
            data = message[start:end]
            if self._head_of(data) != head:
                raise self._refused()
            return encode_bytes(data), end
        at, end = self._span(message, at, self.head)
        pieces = []
        for part in self.parts:
            piece, at = part.decoded(message, at)
            pieces.append(piece)
        if at != end:
            raise self._refused()
        return b"".join(pieces), end

    def _head_of(self, data: bytes) -> bytes:
        try:
            data.decode()
        except UnicodeDecodeError:
            return self.raw_head
        return self.head

    def _span(self, message: bytes, at: int, head: bytes) -> tuple[int, int]:
        """Return where the bytes of a value with its length begin, and where they end."""
        length = 0
        start = at + len(head)
        for k, byte in enumerate(message[start : start + 5]):
            length |= (byte & 0x7F) << 7 * k
            if byte < 128:
                break
        size = varint(length)
        begin = start + len(size)
        if not message.startswith(head + size, at) or begin + length > len(message):
            raise self._refused()
        return begin, begin + length

    def _refused(self) -> RecordingError:
        return RecordingError(f"found no value of its space in {self.name!r}")


@lru_cache(4096)
def varint(number: int) -> bytes:
    """Return a number as Protobuf writes lengths: seven bits a byte, the lowest first."""
    low = []
    while number >= 128:
        low.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*low, number])


def space_field(
    number: int, name: str, description: Description, stored_as: str = "", is_value: bool = True
) -> Field:
    """Return the field of a message with the values of a space, whose description was checked.

    Args:
        stored_as: its name in the file's schema, if that is another one.
        is_value: False for a part of a space.
    """
    field = partial(Field, number, name, stored_as=stored_as, is_value=is_value)
    if (parts := parts_of(description)) is not None:
        names = _identifiers([key for key, _ in parts])
        fields = tuple(
            space_field(k, key, part, stored if stored != key else "", is_value=False)
            for k, ((key, part), stored) in enumerate(zip(parts, names, strict=True), start=1)
        )
        return field(Pb.TYPE_MESSAGE, parts=fields)
    dtype = leaf_dtype(description)
    number_type = item_dtype(description) if dtype is None else dtype
    if number_type is None:
        return field(Pb.TYPE_STRING)
    is_array = dtype is None or bool(dtype.shape)
    code = number_type.base.str
    code = code if is_array else _WIDER.get(code, code)
    return field(_KINDS.get(code, Pb.TYPE_BYTES), is_array and code in _KINDS, dtype=dtype)


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
