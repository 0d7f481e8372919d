"""The messages as protobuf's own descriptors and classes."""

from __future__ import annotations

from functools import cache
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Pb

from runner.recording.schema import LOG_LEVELS, MessageType


@cache
def file_descriptor_set(message: MessageType) -> bytes:
    """Return the schema of a message as MCAP wants it: a serialized FileDescriptorSet with its imports."""
    return descriptor_pb2.FileDescriptorSet(file=_files(message)).SerializeToString(deterministic=True)


@cache
def message_class(message: MessageType) -> Any:
    """Return the protobuf class of a message."""
    pool = descriptor_pool.DescriptorPool()
    for file in _files(message):
        pool.AddSerializedFile(file.SerializeToString())
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(message.full_name))


def _files(message: MessageType) -> list[descriptor_pb2.FileDescriptorProto]:
    """Return the file that describes the message, after the files it imports."""
    file = descriptor_pb2.FileDescriptorProto(
        name=f"{message.package}/{message.name}.proto", package=message.package, syntax="proto3"
    )
    described = file.message_type.add(name=message.name)
    imports = []
    for field in message.fields:
        added = described.field.add(
            name=field.stored_name,
            number=field.number,
            type=field.kind,
            label=Pb.LABEL_REPEATED if field.repeated else Pb.LABEL_OPTIONAL,
        )
        if field.kind == Pb.TYPE_MESSAGE:
            added.type_name = ".google.protobuf.Timestamp"
            imports.append(_timestamp_file())
            file.dependency.append(imports[-1].name)
        elif field.kind == Pb.TYPE_ENUM:
            added.type_name = f".{message.full_name}.Level"
            levels = described.enum_type.add(name="Level")
            for number, name in enumerate(LOG_LEVELS):
                levels.value.add(name=name, number=number)
    return [*imports, file]


def _timestamp_file() -> descriptor_pb2.FileDescriptorProto:
    file = descriptor_pb2.FileDescriptorProto()
    timestamp_pb2.DESCRIPTOR.CopyToProto(file)
    return file
