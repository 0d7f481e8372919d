"""The lazy reader of a recording: opens by the index, reads in blocks, keeps nothing.

    with runner.recording.open("recordings/k3v9m2xq/recording.mcap") as recording:
        for block in recording.blocks(TRAIN_STEP):      # NumPy records, some thousands at a time
            print(block["reward"].mean())

A block is the file's own bytes seen through the dtype of `schema.record_dtype`: no message is parsed one
by one. It is the only way in which the rest of the project reads recordings.
"""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from functools import cached_property
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Metadata
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.mdp import MAX_AGENTS, MAX_EVENTS, Mdp, from_parts
from runner.recording import schema
from runner.recording.chunks import MAX_CHUNK_BYTES, decompress
from runner.recording.index import ChunkEntry, read_index
from runner.recording.messages import QTable, decode, decode_q_table
from runner.recording.schema import BLOCK_TOPICS, Topic

MAX_ARRAY_BYTES: Final = 256 << 20
"""The largest array of environment data that is unpacked."""
_CHUNKS_KEPT: Final = 4
_FACTS: Final = {
    **dict.fromkeys(("run_id", "name", "job", "created", "agents")),
    "seed": 2**64 - 1,
    "learners": MAX_AGENTS,
    "events": MAX_EVENTS,
}
"""What every recording says of its run; of a number, the largest it can be."""
_MESSAGE_HEAD: Final = struct.Struct("<BQHIQQ")


def open_recording(path: str | os.PathLike[str]) -> Recording:
    """Open a recording, finished or not.

    Raises:
        RecordingError: it is missing, no recording of ours, of an unknown version, or damaged.
    """
    return Recording(Path(path))


class Recording:
    """A recording, opened; a context manager."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._stream = path.open("rb")
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read ({error.strerror}).") from error
        try:
            self._index = read_index(self._stream, str(path))
            self._check_version()
        except BaseException:
            self._stream.close()
            raise
        self._kept: OrderedDict[int, bytes] = OrderedDict()
        self._known_numbers: dict[Topic, tuple[NDArray[np.int64], NDArray[np.int64]]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    # --- what the recording says of itself ------------------------------------------------------------

    @property
    def finished(self) -> bool:
        """Whether the file was closed properly: it has its index and summary."""
        return self._index.finished

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return os.fstat(self._stream.fileno()).st_size

    @cached_property
    def run(self) -> dict[str, str]:
        """Id, name, seed, job and creation of the run."""
        return self.metadata("run")

    @cached_property
    def lost(self) -> dict[str, list[list[int]]]:
        """Messages that a repair could not save: topic to [first, behind the last] numbers; mostly none."""
        if "repair" not in self._index.metadata:
            return {}
        return dict(_json(self.metadata("repair"), "repair", self.path)["lost"])

    @cached_property
    def config(self) -> dict[str, Any]:
        """The resolved configuration, as `runner.config.from_mapping` takes it."""
        return _json(self.metadata("config"), "config", self.path)

    @cached_property
    def provenance(self) -> dict[str, str]:
        """Where and by what it was made."""
        return self.metadata("provenance")

    @cached_property
    def result(self) -> dict[str, Any]:
        """What the recorder said at the end: status, digest, counts; empty if it never came to that."""
        if "result" not in self._index.metadata:
            return {}
        return _json(self.metadata("result"), "result", self.path)

    def run_facts(self) -> dict[str, Any]:
        """Return what `run.json` says, from the recording alone."""
        result = self.result
        return {
            "run_id": self.run["run_id"],
            "name": self.run["name"],
            "seed": int(self.run["seed"]),
            "created": self.run["created"],
            "status": result.get("status", "interrupted"),
            "config": self.config,
            "summary": {key: value for key, value in result.items() if key != "status"},
        }

    def metadata(self, name: str) -> dict[str, str]:
        """Return a metadata record's entries.

        Raises:
            RecordingError: there is none of that name, or it cannot be read.
        """
        if name not in self._index.metadata:
            raise RecordingError(f"{self.path}: has no metadata {name!r}; it was cut off, or is not ours.")
        offset, length = self._index.metadata[name]
        try:
            record = Metadata.read(ReadDataStream(BytesIO(self._read(offset, length)[9:])))
        except (McapError, struct.error, UnicodeDecodeError) as error:
            raise RecordingError(f"{self.path}: the metadata {name!r} at {offset} cannot be read.") from error
        return dict(record.metadata)

    def attachment(self, name: str) -> bytes:
        """Return an attachment's data, after comparing its checksum.

        Raises:
            RecordingError: there is none of that name, or it is damaged.
        """
        if name not in self._index.attachments:
            raise RecordingError(f"{self.path}: has no attachment {name!r}; it was cut off, or is not ours.")
        offset, length = self._index.attachments[name]
        body = memoryview(self._read(offset, length))[9:]
        at = 16
        try:
            for _ in range(2):  # name, media type
                at += 4 + struct.unpack_from("<I", body, at)[0]
            (size,) = struct.unpack_from("<Q", body, at)
            (crc,) = struct.unpack_from("<I", body, len(body) - 4)
        except struct.error as error:
            raise RecordingError(f"{self.path}: the attachment at {offset} cannot be read.") from error
        data = body[at + 8 : -4]
        if len(data) != size or zlib.crc32(body[:-4]) != crc:
            raise RecordingError(
                f"{self.path}: the attachment {name!r} at {offset} does not match its checksum."
            )
        return bytes(data)

    @cached_property
    def mdp(self) -> Mdp:
        """The environment: arrays, agents, events, scene."""
        description = json.loads(self.attachment("environment.json"))
        arrays = {
            name: _array(self.attachment(f"environment/{name}.npy.zst"), f"{self.path}: environment/{name}")
            for name in description.pop("arrays")
        }
        return from_parts(description, arrays)

    # --- blocks ------------------------------------------------------------------------------------

    @cached_property
    def dtypes(self) -> dict[Topic, np.dtype[np.void]]:
        """The dtype of each fixed-width topic's message records in this recording."""
        learners, events = int(self.run["learners"]), int(self.run["events"])
        return {
            topic: schema.record_dtype(topic.message, schema.block_counts(topic, learners, events))
            for topic in BLOCK_TOPICS
        }

    def count(self, topic: Topic) -> int:
        """Return the number behind a topic's last message: how many there are, if none was lost.

        For a topic of variable size it reads them.
        """
        if topic in BLOCK_TOPICS:
            ends = self._numbers(topic)[1]
            return int(ends[-1]) if len(ends) else 0
        return sum(1 for _ in self.messages(topic))

    def blocks(self, topic: Topic, start: int = 0, stop: int | None = None) -> Iterator[NDArray[np.void]]:
        """Yield the messages number `start` up to `stop` of a fixed-width topic, a chunk at a time.

        Each block is a read-only structured array with the fields of the message, and those of the MCAP
        record (`log_time` in nanoseconds, ...).
        """
        firsts, ends = self._numbers(topic)
        stop = int(ends[-1]) if stop is None and len(ends) else (stop or 0)
        chunks = self._chunks_of[topic.channel]
        for k in range(int(np.searchsorted(ends, start, side="right")), len(chunks)):
            first = int(firsts[k])
            if first >= stop:
                return
            block = self._block(topic, chunks[k])
            yield block[max(start - first, 0) : stop - first]

    def messages(self, topic: Topic) -> Iterator[tuple[int, bytes]]:
        """Yield (log time in nanoseconds, payload) of a topic's messages, in order."""
        for entry in self._chunks_of[topic.channel]:
            data = self._chunk(entry)
            at = 0
            while at < len(data):
                if at + _MESSAGE_HEAD.size > len(data):
                    raise self._damaged(entry, f"stray bytes at {at}")
                opcode, length, channel, _, log_time, _ = _MESSAGE_HEAD.unpack_from(data, at)
                if opcode != 5 or length < 22 or at + 9 + length > len(data) or channel != topic.channel:
                    raise self._damaged(entry, f"no message of {topic.name} at {at}")
                yield log_time, data[at + _MESSAGE_HEAD.size : at + 9 + length]
                at += 9 + length

    def episodes(self, phase: str, start: int = 0, stop: int | None = None) -> NDArray[np.void]:
        """Return the episode records of a phase (`train` or `eval`) as one array."""
        topic = schema.PHASES[phase][1]
        blocks = list(self.blocks(topic, start, stop))
        return np.concatenate(blocks) if blocks else np.empty(0, self.dtypes[topic])

    def episode_steps(self, phase: str, episode: int) -> NDArray[np.void]:
        """Return the steps of one episode, also of one that never ended.

        Raises:
            RecordingError: the recording has no such episode, or no steps.
        """
        topic = schema.TRAIN_STEP if phase == "train" else schema.EVAL_STEP
        total, ended = (
            self.count(topic),
            self.count(schema.TRAIN_EPISODE if phase == "train" else schema.EVAL_EPISODE),
        )
        if not total:
            raise RecordingError(f"{self.path}: has no {phase} steps.")
        if 0 <= episode < ended:
            record = self.episodes(phase, episode, episode + 1)[0]
            start, stop = int(record["last_step"]) + 1 - int(record["length"]), int(record["last_step"]) + 1
        elif episode == ended:
            start = int(self.episodes(phase, ended - 1, ended)[0]["last_step"]) + 1 if ended else 0
            stop = total
        else:
            start = stop = 0
        blocks = list(self.blocks(topic, start, stop)) if start < stop else []
        if not blocks:
            raise RecordingError(f"{self.path}: has no {phase} episode {episode}; there are {ended}, from 0.")
        return np.concatenate(blocks)

    def metrics(self, phase: str) -> list[dict[str, Any]]:
        """Return the metrics of a phase, in order."""
        topic = schema.TRAIN_METRICS_TOPIC if phase == "train" else schema.EVAL_METRICS_TOPIC
        return [{"log_time": time} | decode(topic.message, payload) for time, payload in self.messages(topic)]

    def snapshots(self) -> Iterator[QTable]:
        """Yield the Q-table snapshots, in order."""
        for _, payload in self.messages(schema.Q_TABLE_TOPIC):
            yield decode_q_table(payload)

    # --- inside ------------------------------------------------------------------------------------

    def _check_version(self) -> None:
        topics = {topic.channel: topic.name for topic in schema.TOPICS}
        for number, channel in self._index.channels.items():
            if topics.get(number) != channel.topic:
                raise RecordingError(
                    f"{self.path}: found channel {number} for {channel.topic!r}, "
                    f"expected {topics.get(number)!r}: not written by dualtaxi."
                )
        version = self.run.get("format_version", "?")
        if version != str(schema.FORMAT_VERSION):
            raise RecordingError(
                f"{self.path}: found a recording of version {version}, expected {schema.FORMAT_VERSION}: "
                "it takes another version of dualtaxi to read it."
            )
        for name, most in _FACTS.items():
            said = self.run.get(name, "")
            if not said or (most and not (said.isdecimal() and len(said) <= 20 and int(said) <= most)):
                raise RecordingError(f"{self.path}: is damaged: of its run it says that {name} is {said!r}.")

    @cached_property
    def _chunks_of(self) -> Mapping[int, list[ChunkEntry]]:
        """The chunks of each channel, in order."""
        chunks: dict[int, list[ChunkEntry]] = {topic.channel: [] for topic in schema.TOPICS}
        for entry in self._index.chunks:
            channels = entry.channels or (self._first_channel(entry),)
            if len(channels) != 1 or channels[0] not in chunks:
                raise self._damaged(entry, f"messages of channels {channels}, expected one of ours")
            chunks[channels[0]].append(entry)
        return chunks

    def _first_channel(self, entry: ChunkEntry) -> int:
        """Return the channel of a chunk's first message, where no index says it."""
        data = self._chunk(entry)
        if len(data) < _MESSAGE_HEAD.size:
            raise self._damaged(entry, "no whole message")
        return int(_MESSAGE_HEAD.unpack_from(data)[2])

    def _numbers(self, topic: Topic) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return, for each chunk of a fixed-width topic, the number of its first message and behind its last.

        Messages are numbered as recorded; where a repair lost some, the numbers go on behind the gap.
        """
        if topic not in self._known_numbers:
            size = self.dtypes[topic].itemsize
            for entry in self._chunks_of[topic.channel]:
                if entry.uncompressed_size % size:
                    raise self._damaged(entry, f"{entry.uncompressed_size} bytes, not a multiple of {size}")
            counts = [entry.uncompressed_size // size for entry in self._chunks_of[topic.channel]]
            ends = np.cumsum(counts, dtype=np.int64)
            firsts = ends - np.array(counts, dtype=np.int64)
            for start, stop in self.lost.get(topic.name, []):
                behind = firsts >= start
                firsts[behind] += stop - start
                ends[behind] += stop - start
            self._known_numbers[topic] = firsts, ends
        return self._known_numbers[topic]

    def _block(self, topic: Topic, entry: ChunkEntry) -> NDArray[np.void]:
        """Return a chunk of a fixed-width topic as an array, after looking at its constant bytes."""
        data = self._chunk(entry)
        dtype = self.dtypes[topic]
        if len(data) % dtype.itemsize:
            raise self._damaged(entry, f"{len(data)} bytes, not a multiple of {dtype.itemsize}")
        block = np.frombuffer(data, dtype=dtype)
        if (block["channel_id"] != topic.channel).any() or (
            block["record_length"] != dtype.itemsize - 9
        ).any():
            raise self._damaged(entry, f"other messages than of {topic.name}")
        return block

    def _chunk(self, entry: ChunkEntry) -> bytes:
        """Return a chunk's message records, after comparing its checksum; keeps the last few."""
        if entry.offset in self._kept:
            self._kept.move_to_end(entry.offset)
            return self._kept[entry.offset]
        record = self._read(entry.offset, entry.length)
        where = f"{self.path}: chunk at {entry.offset}"
        try:
            size, crc, name_length = struct.unpack_from("<QII", record, 25)
            name = record[41 : 41 + name_length].decode("ascii")
            (packed,) = struct.unpack_from("<Q", record, 41 + name_length)
        except (struct.error, UnicodeDecodeError) as error:
            raise RecordingError(f"{where}: the record cannot be read.") from error
        body = memoryview(record)[49 + name_length :]
        if record[0] != 6 or packed != len(body) or size > MAX_CHUNK_BYTES or size != entry.uncompressed_size:
            raise RecordingError(f"{where}: the record contradicts itself or its index entry.")
        data = decompress(body, name, size, where)
        if zlib.crc32(data) != crc:
            raise RecordingError(f"{where}: its content does not match its checksum.")
        self._kept[entry.offset] = data
        if len(self._kept) > _CHUNKS_KEPT:
            self._kept.popitem(last=False)
        return data

    def _read(self, offset: int, length: int) -> bytes:
        if length > MAX_CHUNK_BYTES:
            raise RecordingError(
                f"{self.path}: the record at {offset} declares {length:,} bytes; too large to be ours."
            )
        self._stream.seek(offset)
        data = self._stream.read(length)
        if len(data) != length:
            raise RecordingError(f"{self.path}: the record at {offset} is cut off.")
        return data

    def _damaged(self, entry: ChunkEntry, found: str) -> RecordingError:
        return RecordingError(f"{self.path}: chunk at {entry.offset}: found {found}.")


def _json(entries: Mapping[str, str], name: str, path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(entries["json"]))
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise RecordingError(f"{path}: the metadata {name!r} holds no JSON object.") from error


def pack_array(array: NDArray[Any]) -> bytes:
    """Return an array as a `.npy` file, compressed with zstd."""
    buffer = BytesIO()
    np.lib.format.write_array(buffer, np.ascontiguousarray(array), allow_pickle=False)
    return zstandard.ZstdCompressor(level=9).compress(buffer.getvalue())


def _array(data: bytes, where: str) -> NDArray[Any]:
    """Return the array in a compressed `.npy` file; never unpickles, never unpacks without bound."""
    try:
        with zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(data) as stream:
            unpacked = stream.read(MAX_ARRAY_BYTES)
        return np.asarray(
            np.lib.format.read_array(BytesIO(unpacked), allow_pickle=False, max_header_size=4096)
        )
    except (zstandard.ZstdError, ValueError, EOFError) as error:
        raise RecordingError(f"{where}: holds no array ({error}).") from error
