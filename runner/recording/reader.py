"""The lazy reader of a recording: opens by the index, reads in blocks, keeps nothing.

    with runner.recording.open("recordings/k3v9m2xq/recording.mcap") as recording:
        for block in recording.blocks(TRAIN_STEP):      # NumPy records, some thousands at a time
            print(block["rewards"].mean())

A block is the file's own bytes seen through the dtype of `record_dtype`: no message is parsed one
by one. It is the only way in which the rest of the project reads recordings.
"""

from __future__ import annotations

import os
import stat
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from runner.errors import RecordingError, RunnerError
from runner.mdp import Mdp
from runner.recording import schema
from runner.recording.blocks import MESSAGE_HEAD, record_dtype
from runner.recording.chunks import MAX_CHUNK_BYTES
from runner.recording.contents import MAX_METADATA_BYTES, UNREADABLE, attachment_of, metadata_of
from runner.recording.facts import (
    check_facts,
    environment_of,
    holes,
    json_object,
    kind_of,
    sizes_of,
    spaces_of,
)
from runner.recording.index import ChunkEntry, read_index
from runner.recording.messages import QTable, Snapshot, decode, decode_array, decode_q_table
from runner.recording.schema import Topic
from runner.recording.spaces import decode as decode_value
from runner.recording.store import RecordStore

MAX_EPISODE_BYTES: Final = 128 << 20
"""The most that `episode_steps` gives as one array: some 1.5 million steps."""
MAX_METRICS: Final = 1 << 17
"""The most that `metrics` gives as one list."""
_METRICS_BYTES: Final = 1 << 20


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
            if not stat.S_ISREG(path.stat().st_mode):  # to open a pipe would wait for its writer
                raise RecordingError(f"{path}: cannot be read: it is no file.")
            self._stream = path.open("rb")
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise RecordingError(f"{path}: cannot be read ({reason}).") from error
        self._store = RecordStore(self._stream, str(path))
        try:
            self._index = read_index(self._stream, str(path))
            check_facts(self.run, self._index, str(path))
        except OSError as error:
            self.close()
            raise RecordingError(f"{path}: cannot be read ({error.strerror}).") from error
        except BaseException:
            self.close()
            raise
        self._known_numbers: dict[Topic, tuple[NDArray[np.int64], NDArray[np.int64]]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._store.close()

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
        return holes(self._json("repair"), str(self.path))

    @cached_property
    def config(self) -> dict[str, Any]:
        """The resolved configuration, as `runner.config.from_mapping` takes it."""
        return self._json("config")

    @cached_property
    def provenance(self) -> dict[str, str]:
        """Where and by what it was made."""
        return self.metadata("provenance")

    @cached_property
    def result(self) -> dict[str, Any]:
        """What the recorder said at the end: status, digest, counts; empty if it never came to that."""
        if "result" not in self._index.metadata:
            return {}
        return self._json("result")

    @property
    def status(self) -> str:
        """How the run ended: `finished`, `failed`, or `interrupted`, also if it could not say so."""
        return str(self.result.get("status", "interrupted"))

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

    def done(self) -> dict[str, int]:
        """Return how many training episodes and steps of each phase were done: as told, else as counted."""
        counted = {
            "episodes": schema.TRAIN_EPISODE,
            "train_steps": schema.TRAIN_STEP,
            "eval_steps": schema.EVAL_STEP,
        }
        told = self.result
        return {key: told[key] if key in told else self.count(topic) for key, topic in counted.items()}

    def metadata(self, name: str) -> dict[str, str]:
        """Return a metadata record's entries.

        Raises:
            RecordingError: there is none of that name, or it cannot be read.
        """
        if name not in self._index.metadata:
            raise RecordingError(f"{self.path}: has no metadata {name!r}; it was cut off, or is not ours.")
        offset, length = self._index.metadata[name]
        try:
            found, entries = metadata_of(self._record(Opcode.METADATA, offset, length, MAX_METADATA_BYTES))
        except UNREADABLE as error:
            raise RecordingError(f"{self.path}: the metadata {name!r} at {offset} cannot be read.") from error
        if found != name:
            raise RecordingError(f"{self.path}: found metadata {found!r} at {offset}, expected {name!r}.")
        return entries

    @property
    def metadata_names(self) -> list[str]:
        """The names of the metadata records, in the order of the file."""
        return sorted(self._index.metadata, key=lambda name: self._index.metadata[name][0])

    def attachments(self) -> Iterator[tuple[str, str, bytes]]:
        """Yield name, media type and data of each attachment, in the order of the file."""
        for name in sorted(self._index.attachments, key=lambda name: self._index.attachments[name][0]):
            yield name, *self._attachment(name)

    def attachment(self, name: str) -> bytes:
        """Return an attachment's data, after comparing its checksum.

        Raises:
            RecordingError: there is none of that name, or it is damaged.
        """
        return self._attachment(name)[1]

    def _attachment(self, name: str) -> tuple[str, bytes]:
        """Return an attachment's media type and data."""
        if name not in self._index.attachments:
            raise RecordingError(f"{self.path}: has no attachment {name!r}; it was cut off, or is not ours.")
        offset, length = self._index.attachments[name]
        try:
            found, media_type, data = attachment_of(self._record(Opcode.ATTACHMENT, offset, length), offset)
        except UNREADABLE as error:
            raise RecordingError(f"{self.path}: the attachment at {offset} cannot be read.") from error
        except RecordingError as error:
            raise RecordingError(f"{self.path}: {error}.") from error
        if found != name:
            raise RecordingError(f"{self.path}: found attachment {found!r} at {offset}, expected {name!r}.")
        return media_type, data

    @cached_property
    def mdp(self) -> Mdp:
        """The environment: arrays, agents, events, scene."""
        return environment_of(self.environment, self.attachment, str(self.path))

    @property
    def environment(self) -> dict[str, Any]:
        """What is said of the environment beside its arrays: agents, events, scene."""
        return json_object(self.attachment("environment.json"), f"{self.path}: environment.json")

    @property
    def tabular(self) -> bool:
        """Whether the environment's arrays are there, so that it has an `mdp`."""
        return self.kind in ("job", "step") and self.environment.get("arrays") != []

    # --- blocks ------------------------------------------------------------------------------------

    @cached_property
    def dtypes(self) -> dict[Topic, np.dtype[np.void]]:
        """The dtype of each fixed-width topic's message records in this recording."""
        return {
            topic: record_dtype(topic.message, sizes)
            for topic, sizes in sizes_of(self.run, str(self.path)).items()
        }

    @property
    def kind(self) -> str:
        """`job` if the runner learned it; else what the spaces of somebody's own loop ask for.

        `step`: both are `Discrete`; `transition`: all values have one size; `variable`: they have not.
        """
        return kind_of(self.run)

    @property
    def topics(self) -> tuple[Topic, ...]:
        """The topics that a recording of its kind has."""
        return schema.KINDS[self.kind]

    def require_job(self, purpose: str, instead: str) -> None:
        """Refuse a recording of somebody's own loop.

        Raises:
            RunnerError: it is one; `purpose` says what it cannot be used for, `instead` what can be done.
        """
        if self.kind != "job":
            raise RunnerError(
                f"{self.path}: was recorded from somebody's own loop, by {self.config.get('made_by')}; "
                f"{purpose} is for runs that were trained here. {instead}"
            )

    @cached_property
    def spaces(self) -> dict[str, Any]:
        """The descriptions of the `observation` and the `action` space of a loop's recording."""
        return spaces_of(self.run, str(self.path))

    @property
    def environments(self) -> int:
        """How many environments took turns: step number n was taken in number n modulo this."""
        return int(self.run.get("environments", "1"))

    def topic(self, name: str) -> Topic:
        """Return the topic of that name, such as `/train/step`.

        Raises:
            RecordingError: a recording of its kind has none.
        """
        for topic in self.topics:
            if topic.name == name:
                return topic
        raise RecordingError(f"{self.path}: has no topic {name!r}: it is of the kind {self.kind!r}.")

    def count(self, topic: Topic) -> int:
        """Return the number behind a topic's last message: how many there are, if none was lost.

        For a topic of variable size it reads them.
        """
        topic = self._own(topic)
        if topic in self.dtypes:
            ends = self._numbers(topic)[1]
            return int(ends[-1]) if len(ends) else 0
        return sum(1 for _ in self.messages(topic))

    def blocks(self, topic: Topic, start: int = 0, stop: int | None = None) -> Iterator[NDArray[np.void]]:
        """Yield the messages number `start` up to `stop` of a fixed-width topic, a chunk at a time.

        Each block is a read-only structured array with the fields of the message, and those of the MCAP
        record (`log_time` in nanoseconds, ...).
        """
        topic = self._own(topic)
        if topic not in self.dtypes:
            raise RecordingError(
                f"{self.path}: the messages of {topic.name} vary in size; read them one by one."
            )
        firsts, ends = self._numbers(topic)
        stop = int(ends[-1]) if stop is None and len(ends) else (stop or 0)
        chunks = range(
            int(np.searchsorted(ends, start, side="right")), int(np.searchsorted(firsts, stop, side="left"))
        )
        entries = (self._entry(topic, k) for k in chunks)
        for k, data in zip(chunks, self._store.chunks(entries), strict=True):
            first = int(firsts[k])
            yield self._block(topic, k, data)[max(start - first, 0) : stop - first]

    def blocks_between(self, topic: Topic, start_time: int, stop_time: int) -> Iterator[NDArray[np.void]]:
        """Yield the messages of a fixed-width topic logged from `start_time` up to `stop_time`, in ns."""
        firsts, ends = self._numbers(topic)
        if not len(firsts):
            return
        start, stop = np.uint64(max(start_time, 0)), np.uint64(max(stop_time, 0))
        times = self._index.chunks.columns[self._chunks_of[topic.channel]]
        first, behind = np.searchsorted(times["end_time"], start), np.searchsorted(times["start_time"], stop)
        for block in self.blocks(topic, int(firsts[first]), int(ends[behind - 1])) if first < behind else ():
            low, high = (int(np.searchsorted(block["log_time"], time)) for time in (start, stop))
            if low < high:
                yield block[low:high]

    def blocks_of_episodes(self, phase: str, start: int, stop: int | None) -> Iterator[NDArray[np.void]]:
        """Yield the steps of the episodes number `start` up to `stop`; None for the very end."""
        behind = None if stop is None else self._first_step(phase, stop)
        return self.blocks(self.topic(f"/{phase}/step"), self._first_step(phase, start), behind)

    def _first_step(self, phase: str, episode: int) -> int:
        """Return the first step of an episode or a later one, found in the steps themselves."""
        topic = self.topic(f"/{phase}/step")
        firsts, ends = (numbers.tolist() for numbers in self._numbers(topic))
        k = bisect_left(ends, episode, key=lambda end: next(self.blocks(topic, end - 1, end))["episode"][0])
        if k == len(ends):
            return self.count(topic)
        block = next(self.blocks(topic, firsts[k], ends[k]))
        return int(firsts[k]) + int(np.searchsorted(block["episode"], episode))

    def messages(self, topic: Topic, first_chunk: int = 0) -> Iterator[tuple[int, bytes]]:
        """Yield (log time in nanoseconds, payload) of a topic's messages, in order."""
        for k in range(first_chunk, len(self._chunks_of[topic.channel])):
            entry = self._entry(topic, k)
            data = self._store.chunk(entry)
            at = 0
            while at < len(data):
                if at + MESSAGE_HEAD.size > len(data):
                    raise self._damaged(entry, f"stray bytes at {at}")
                opcode, length, channel, _, log_time, _ = MESSAGE_HEAD.unpack_from(data, at)
                if opcode != 5 or length < 22 or at + 9 + length > len(data) or channel != topic.channel:
                    raise self._damaged(entry, f"no message of {topic.name} at {at}")
                yield log_time, data[at + MESSAGE_HEAD.size : at + 9 + length]
                at += 9 + length

    def episodes(self, phase: str, start: int = 0, stop: int | None = None) -> NDArray[np.void]:
        """Return the episode records of a phase (`train` or `eval`) as one array."""
        topic = self.topic(f"/{phase}/episode")
        blocks = list(self.blocks(topic, start, stop))
        return np.concatenate(blocks) if blocks else np.empty(0, self.dtypes[topic])

    def episode_steps(self, phase: str, episode: int) -> NDArray[np.void]:
        """Return the steps of one episode, also of one that never ended.

        Where several environments take turns, episodes are numbered as they ended, and only those are given.

        Raises:
            RecordingError: the recording has no such episode, or no steps.
        """
        topic, episodes = self.topic(f"/{phase}/step"), self.topic(f"/{phase}/episode")
        stride = self.environments
        total, ended = self.count(topic), self.count(episodes)
        phased = {"train": "training", "eval": "evaluation"}[phase]
        if not total:
            raise RecordingError(f"{self.path}: has no {phased} steps.")
        start = stop = 0
        if 0 <= episode < ended and len(records := self.episodes(phase, episode, episode + 1)):
            stop = int(records[0]["last_step"]) + 1
            start = stop - (int(records[0]["length"]) - 1) * stride - 1
        elif episode == ended and stride == 1:
            last = self.episodes(phase, ended - 1, ended)
            start, stop = int(last[0]["last_step"]) + 1 if len(last) else 0, total
        if not 0 <= start < stop <= total:
            raise RecordingError(
                f"{self.path}: has no {phased} episode {episode}; there are {ended}, from 0."
            )
        if (stop - start) * self.dtypes[topic].itemsize > MAX_EPISODE_BYTES:
            raise RecordingError(
                f"{self.path}: {phase} episode {episode} has {stop - start:,} steps, too many to be given "
                f"at once; read them in blocks, from {start}."
            )
        blocks = list(self.blocks(topic, start, stop))
        if not blocks:
            raise RecordingError(f"{self.path}: the steps of {phase} episode {episode} were lost.")
        return np.concatenate(blocks)[::stride]

    # --- of somebody's own loop ---------------------------------------------------------------------

    def transitions(self, phase: str) -> Iterator[Any]:
        """Yield the steps of a phase one by one, with `action` and `next_observation` as values.

        Of the kind `step` they have `state`, `action` and `next_state`, counted from 0.

        Records of NumPy where values have one size (`blocks` gives many at once), else dictionaries.
        """
        yield from self._values(self.topic(f"/{phase}/step"), action="action", next_observation="observation")

    def resets(self, phase: str) -> Iterator[Any]:
        """Yield the resets of a phase one by one, as `transitions` yields steps."""
        yield from self._values(self.topic(f"/{phase}/reset"), observation="observation")

    def decoded(self, topic: Topic) -> Iterator[dict[str, Any]]:
        """Yield the messages of a topic of variable size: `log_time` and the fields, by name."""
        for time, payload in self.messages(topic):
            try:
                yield {"log_time": time} | decode(topic.message, payload)
            except RecordingError as error:
                raise RecordingError(f"{self.path}: {topic.name} at {time} ns: {error}") from error

    def arrays(self) -> Iterator[Snapshot]:
        """Yield the arrays that a loop recorded by `snapshot`, in order."""
        for time, payload in self.messages(schema.ARRAY_TOPIC):
            try:
                yield decode_array(payload)
            except RecordingError as error:
                raise RecordingError(f"{self.path}: the array at {time} ns: {error}") from error

    def _values(self, topic: Topic, **spaces: str) -> Iterator[Any]:
        """Yield a topic's messages one by one; `spaces` names the space of each field that is a value."""
        if topic in self.dtypes:
            for block in self.blocks(topic):
                yield from block
            return
        for fields in self.decoded(topic):
            where = f"{self.path}: {topic.name} at {fields['log_time']} ns"
            for name, space in spaces.items():
                fields[name] = decode_value(self.spaces[space], fields[name], where)
            if "rewards" in fields:
                fields["rewards"] = np.array(fields["rewards"])
            yield fields

    def metrics(self, phase: str) -> list[dict[str, Any]]:
        """Return the metrics of a phase, in order.

        Raises:
            RecordingError: they are damaged, or more than 131,072; `iter_metrics` gives them one by one.
            ValueError: there is no such phase.
        """
        found: list[dict[str, Any]] = []
        for metrics in self.iter_metrics(phase):
            if len(found) == MAX_METRICS:
                raise RecordingError(f"{self.path}: has more than {MAX_METRICS:,} {phase} metrics.")
            found.append(metrics)
        return found

    def iter_metrics(self, phase: str) -> Iterator[dict[str, Any]]:
        """Yield the metrics of a phase (`train` or `eval`), in order.

        Raises:
            RecordingError: they are damaged.
            ValueError: there is no such phase.
        """
        if phase not in schema.PHASES:
            raise ValueError(f"found phase {phase!r}, expected one of: {', '.join(schema.PHASES)}.")
        yield from self._decoded(
            schema.TRAIN_METRICS_TOPIC if phase == "train" else schema.EVAL_METRICS_TOPIC
        )

    def optimality(self) -> Iterator[dict[str, Any]]:
        """Yield the exact measures of the evaluations, in order; none unless `evaluation.exact` was set."""
        yield from self._decoded(schema.OPTIMALITY_TOPIC)

    def _decoded(self, topic: schema.Topic) -> Iterator[dict[str, Any]]:
        for time, payload in self.messages(topic):
            where = f"{self.path}: {topic.name} at {time} ns"
            if len(payload) > _METRICS_BYTES:
                raise RecordingError(f"{where}: found {len(payload):,} bytes; too many to be ours.")
            try:
                yield {"log_time": time} | decode(topic.message, payload)
            except RecordingError as error:
                raise RecordingError(f"{where}: {error}") from error

    def snapshots(self, step: int = 0, tables: int = 0) -> Iterator[QTable]:
        """Yield the snapshots in order; those are left out that are older than needed for `step`.

        Of the last moment at or before `step` all are given, and of the moment before it.

        Args:
            step: a training step.
            tables: how many tables there are of a moment; by default the learners' Q-tables are given, and
                what else their algorithm keeps is left out.
        """
        learners = int(self.run["learners"])
        for snapshot in self._since(step, tables or learners):
            if tables or snapshot.table < learners:
                yield snapshot

    def _since(self, step: int, tables: int) -> Iterator[QTable]:
        topic = schema.Q_TABLE_TOPIC
        chunks = range(len(self._chunks_of[topic.channel]))
        behind = bisect_right(chunks, step, key=lambda k: next(self._snapshots(k)).step) if step else 0
        yield from self._snapshots(max(0, behind - 2 * tables))

    def _snapshots(self, first_chunk: int) -> Iterator[QTable]:
        for time, payload in self.messages(schema.Q_TABLE_TOPIC, first_chunk):
            try:
                yield decode_q_table(payload)
            except RecordingError as error:
                raise RecordingError(f"{self.path}: the Q-table at {time} ns: {error}") from error

    # --- inside ------------------------------------------------------------------------------------

    def _json(self, name: str) -> dict[str, Any]:
        return json_object(self.metadata(name).get("json"), f"{self.path}: the metadata {name!r}")

    @cached_property
    def _chunks_of(self) -> Mapping[int, NDArray[np.intp]]:
        """Which chunks each channel has, in order."""
        table = self._index.chunks
        channels = table.columns["channel"].copy() if table else np.empty(0, np.uint16)
        for k in np.flatnonzero(channels == 0).tolist():
            channel = self._store.first_channel(table[k])
            channels[k] = channel
        for k in np.flatnonzero(~np.isin(channels, list(self._index.channels))).tolist():
            raise self._damaged(table[k], f"messages of channel {channels[k]}, expected one of ours")
        return {topic.channel: np.flatnonzero(channels == topic.channel) for topic in schema.ALL_TOPICS}

    def _entry(self, topic: Topic, k: int) -> ChunkEntry:
        """Return the entry of a topic's chunk number k."""
        return self._index.chunks[int(self._chunks_of[topic.channel][k])]

    def _own(self, topic: Topic) -> Topic:
        """Return this recording's topic of that name, if it has one: `/train/step` differs by its kind."""
        return next((own for own in self.topics if own.name == topic.name), topic)

    def _numbers(self, topic: Topic) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return, for each chunk of a fixed-width topic, the number of its first message and behind its last.

        Messages are numbered as recorded; where a repair lost some, the numbers go on behind the gap.
        """
        if topic not in self._known_numbers:
            size, chunks = self.dtypes[topic].itemsize, self._chunks_of[topic.channel]
            sizes = np.empty(0, np.int64)
            if len(chunks):
                sizes = self._index.chunks.columns["uncompressed_size"][chunks].astype(np.int64)
            if (odd := np.flatnonzero(sizes % size)).size:
                entry = self._entry(topic, int(odd[0]))
                raise self._damaged(entry, f"{entry.uncompressed_size} bytes, not a multiple of {size}")
            ends = np.cumsum(sizes // size)
            firsts = ends - sizes // size
            for start, stop in self.lost.get(topic.name, []):
                behind = firsts >= start
                firsts[behind] += stop - start
                ends[behind] += stop - start
            self._known_numbers[topic] = firsts, ends
        return self._known_numbers[topic]

    def _block(self, topic: Topic, k: int, data: bytes) -> NDArray[np.void]:
        """Return a chunk of a fixed-width topic as an array, after looking at its constant bytes."""
        dtype = self.dtypes[topic]
        block = np.frombuffer(data, dtype=dtype)
        if (block["channel_id"] != topic.channel).any() or (
            block["record_length"] != dtype.itemsize - 9
        ).any():
            raise self._damaged(self._entry(topic, k), f"other messages than of {topic.name}")
        return block

    def _record(self, opcode: int, offset: int, length: int, most: int = MAX_CHUNK_BYTES) -> bytes:
        """Return the body of a record of this kind."""
        record = self._store.record(offset, length, most)
        if record[0] != opcode or int.from_bytes(record[1:9], "little") != length - 9:
            raise RecordingError(f"{self.path}: found another record at {offset} than the index says.")
        return record[9:]

    def _damaged(self, entry: ChunkEntry, found: str) -> RecordingError:
        return RecordingError(f"{self.path}: chunk at {entry.offset}: found {found}.")
