"""The lazy reader of a recording: opens by the index, reads in blocks, keeps nothing.

    with runner.open_recording("recordings/k3v9m2xq/recording.mcap") as recording:
        for block in recording.blocks(TRAIN_STEP):      # NumPy records, some thousands at a time
            print(block["rewards"].mean())

A block is the file's own bytes seen through the dtype of `record_dtype`: no message is parsed one
by one. It is the only way in which the rest of the project reads recordings.
"""

from __future__ import annotations

import json
import os
import stat
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property, partial
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self, TypeVar

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from runner.environments.mdp import Mdp
from runner.errors import RecordingError, RunnerError
from runner.recording import schema
from runner.recording.blocks import record_dtype
from runner.recording.chunk_cache import RecordStore
from runner.recording.chunks import MAX_CHUNK_BYTES
from runner.recording.index import read_index
from runner.recording.labels import read_labels
from runner.recording.liveness import is_owned
from runner.recording.messages import QTable, Snapshot, decode, decode_array, decode_q_table
from runner.recording.metadata import (
    check_file,
    environment_description,
    environment_of,
    json_object,
    kind_of,
    lost_ranges,
    sizes_of,
    spaces_of,
)
from runner.recording.records import MAX_METADATA_BYTES, UNREADABLE, attachment_of, metadata_of
from runner.recording.run_file import Summary, parse_summary, run_title
from runner.recording.schema import Topic
from runner.recording.spaces import decode as decode_value
from runner.recording.topic_chunks import TopicChunks, chunks_by_topic

MAX_EPISODE_BYTES: Final = 128 << 20
"""The most that `episode_steps` gives as one array: some 1.5 million steps."""
MAX_METRICS: Final = 1 << 17
"""The most that `metrics` gives as one list."""
_METRICS_BYTES: Final = 1 << 20

M = TypeVar("M")


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
            check_file(self.run, self._index, str(path))
        except OSError as error:
            self.close()
            raise RecordingError(f"{path}: cannot be read ({error.strerror}).") from error
        except BaseException:
            self.close()
            raise
        self._known_chunks: dict[Topic, TopicChunks] = {}

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
        """The metadata record `run`: id, name, seed, job, creation, agents and more, as texts."""
        return self.metadata("run")

    @property
    def run_id(self) -> str:
        """The id of the run."""
        return self.run["run_id"]

    @property
    def job(self) -> str:
        """The identity of the run's job."""
        return self.run["job"]

    @property
    def created(self) -> str:
        """When the run began, in ISO format."""
        return self.run["created"]

    @property
    def seed(self) -> int | None:
        """The seed of the run's job; None for a loop without one."""
        return None if self.run.get("seeded") == "false" else int(self.run["seed"])

    @cached_property
    def agents(self) -> tuple[str, ...]:
        """The names of the learners: one table and one reward each."""
        return tuple(map(str, json.loads(self.run["agents"])))

    @property
    def event_names(self) -> tuple[str, ...]:
        """The names of the environment's events, which episodes count."""
        return tuple(self.environment["event_names"])

    @property
    def title(self) -> str:
        """What the run is called now, and its seed if it has one: `patient, seed 3`."""
        return run_title(self.name, self.seed)

    @cached_property
    def lost(self) -> dict[str, list[list[int]]]:
        """Messages that a repair could not save: topic to [first, behind the last] numbers; mostly none."""
        if "repair" not in self._index.metadata:
            return {}
        return lost_ranges(self._json("repair"), str(self.path))

    @cached_property
    def config(self) -> dict[str, Any]:
        """The resolved configuration, as `runner.config.from_mapping` takes it."""
        return self._json("config")

    @cached_property
    def provenance(self) -> dict[str, str]:
        """Where and by what it was made."""
        return self.metadata("provenance")

    @cached_property
    def raw_result(self) -> dict[str, Any]:
        """The result as it was written, unchecked; empty if the recorder never came to that.

        Raises:
            RecordingError: it is no JSON object.
        """
        if "result" not in self._index.metadata:
            return {}
        return self._json("result")

    @cached_property
    def result(self) -> Summary:
        """What the recorder wrote at the end: status, digest, counts; empty if it never came to that.

        Raises:
            RecordingError: it holds what cannot be.
        """
        problems: list[str] = []
        found = parse_summary(self.raw_result, "", problems)
        if problems:
            raise RecordingError(f"{self.path}: its result is damaged: {'; '.join(problems)}.")
        return found

    @property
    def status(self) -> str:
        """How the run stands: `finished`, `failed`, `running`, or else `interrupted`."""
        if self.result.status is None and self._is_in_run_folder and is_owned(self.path.parent):
            return "running"
        return self.result.status or "interrupted"

    @property
    def name(self) -> str:
        """What the run is called now: the name in its labels if it was renamed, else the first one."""
        renamed = read_labels(self.path.parent).name if self._is_in_run_folder else ""
        return renamed or self.run["name"]

    @property
    def _is_in_run_folder(self) -> bool:
        return self.path.name == "recording.mcap"

    def run_facts(self) -> dict[str, Any]:
        """Return what `run.json` says, from the recording alone; the result in it is unchecked."""
        result = self.raw_result
        return {
            "run_id": self.run["run_id"],
            "name": self.run["name"],
            "seed": int(self.run["seed"]),
            **({"seeded": False} if self.run.get("seeded") == "false" else {}),
            "created": self.run["created"],
            "status": result.get("status", "interrupted"),
            "config": self.config,
            "summary": {key: value for key, value in result.items() if key != "status"},
        }

    def done(self) -> dict[str, int]:
        """Return how many training episodes and steps of each phase were done: as written, else counted."""
        result = self.result
        return {
            "episodes": self.count(schema.TRAIN_EPISODE) if result.episodes is None else result.episodes,
            "train_steps": self.count(schema.TRAIN_STEP)
            if result.train_steps is None
            else result.train_steps,
            "eval_steps": self.count(schema.EVAL_STEP) if result.eval_steps is None else result.eval_steps,
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

    @cached_property
    def environment(self) -> dict[str, Any]:
        """What is said of the environment beside its arrays: agents, events, scene; not to be changed."""
        return environment_description(self.attachment("environment.json"), str(self.path))

    @property
    def tabular(self) -> bool:
        """Whether the environment's arrays are there, so that it has an `mdp`."""
        return self.kind in ("job", "step") and bool(self.environment["arrays"])

    @property
    def has_steps(self) -> bool:
        """Whether any step was recorded."""
        return any(len(self._chunks(self.topic(f"/{phase}/step"))) for phase in schema.PHASES)

    @property
    def leaves_out_steps(self) -> bool:
        """Whether the configuration leaves the steps out of the recording (`recording.steps: none`)."""
        plan = self.config.get("recording")
        return isinstance(plan, Mapping) and plan.get("steps") == "none"

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
    def is_job(self) -> bool:
        """Whether the runner itself learned it, from a configuration; else it was recorded from a loop."""
        return self.kind == "job"

    @property
    def topics(self) -> tuple[Topic, ...]:
        """The topics that a recording of its kind has."""
        return schema.KINDS[self.kind]

    def require_job(self, purpose: str, instead: str) -> None:
        """Refuse a recording of somebody's own loop.

        Raises:
            RunnerError: it is one; `purpose` says what it cannot be used for, `instead` what can be done.
        """
        if not self.is_job:
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
        if name not in self._own:
            raise RecordingError(f"{self.path}: has no topic {name!r}: it is of the kind {self.kind!r}.")
        return self._own[name]

    def count(self, topic: Topic) -> int:
        """Return the number behind a topic's last message: how many there are, if none was lost.

        For a topic of variable size it reads them.
        """
        return self._chunks(topic).count()

    def blocks(self, topic: Topic, start: int = 0, stop: int | None = None) -> Iterator[NDArray[np.void]]:
        """Yield the messages number `start` up to `stop` of a fixed-width topic, a chunk at a time.

        Each block is a read-only structured array with the fields of the message, and those of the MCAP
        record (`log_time` in nanoseconds, ...).
        """
        return self._chunks(topic).blocks(start, stop)

    def blocks_between(self, topic: Topic, start_time: int, stop_time: int) -> Iterator[NDArray[np.void]]:
        """Yield the messages of a fixed-width topic logged from `start_time` up to `stop_time`, in ns."""
        return self._chunks(topic).blocks_between(start_time, stop_time)

    def blocks_of_episodes(self, phase: str, start: int, stop: int | None) -> Iterator[NDArray[np.void]]:
        """Yield the steps of the episodes number `start` up to `stop`; None for the very end."""
        steps = self._chunks(self.topic(f"/{phase}/step"))
        behind = None if stop is None else steps.first_from("episode", stop)
        return steps.blocks(steps.first_from("episode", start), behind)

    def messages(self, topic: Topic, first_chunk: int = 0) -> Iterator[tuple[int, bytes]]:
        """Yield (log time in nanoseconds, payload) of a topic's messages, in order."""
        return self._chunks(topic).messages(first_chunk)

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
                f"{self.path}: {phased} episode {episode} has {stop - start:,} steps, too many to be given "
                f"at once; read them in blocks, from {start}."
            )
        blocks = list(self.blocks(topic, start, stop))
        if not blocks:
            raise RecordingError(f"{self.path}: the steps of {phased} episode {episode} were lost.")
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

    def decoded(self, topic: Topic, most: int = MAX_CHUNK_BYTES) -> Iterator[dict[str, Any]]:
        """Yield the messages of a topic of variable size: `log_time` and the fields, by name.

        Raises:
            RecordingError: one cannot be read, or has more bytes than `most`.
        """
        for time, fields in self._parsed(topic, partial(decode, topic.message), most=most):
            yield {"log_time": time} | fields

    def arrays(self) -> Iterator[Snapshot]:
        """Yield the arrays that a loop recorded by `snapshot`, in order."""
        for _, array in self._parsed(schema.ARRAY_TOPIC, decode_array):
            yield array

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
        topic = schema.TRAIN_METRICS_TOPIC if phase == "train" else schema.EVAL_METRICS_TOPIC
        yield from self.decoded(topic, _METRICS_BYTES)

    def optimality(self) -> Iterator[dict[str, Any]]:
        """Yield the exact measures of the evaluations, in order; none unless `evaluation.exact` was set."""
        yield from self.decoded(schema.OPTIMALITY_TOPIC, _METRICS_BYTES)

    def snapshots(self, step: int = 0, tables: int = 0) -> Iterator[QTable]:
        """Yield the snapshots in order; those are left out that are older than needed for `step`.

        Of the last moment at or before `step` all are given, and of the moment before it.

        Args:
            step: a training step.
            tables: how many tables there are of a moment; by default the learners' Q-tables are given, and
                what else their algorithm keeps is left out.
        """
        learners = len(self.agents)
        for snapshot in self._since(step, tables or learners):
            if tables or snapshot.table < learners:
                yield snapshot

    def _since(self, step: int, tables: int) -> Iterator[QTable]:
        chunks = range(len(self._chunks(schema.Q_TABLE_TOPIC)))
        behind = bisect_right(chunks, step, key=lambda k: next(self._snapshots(k)).step) if step else 0
        yield from self._snapshots(max(0, behind - 2 * tables))

    def _snapshots(self, first_chunk: int) -> Iterator[QTable]:
        for _, table in self._parsed(schema.Q_TABLE_TOPIC, decode_q_table, first_chunk):
            yield table

    # --- inside ------------------------------------------------------------------------------------

    def _parsed(
        self,
        topic: Topic,
        parse: Callable[[bytes], M],
        first_chunk: int = 0,
        most: int = MAX_CHUNK_BYTES,
    ) -> Iterator[tuple[int, M]]:
        """Yield (log time in nanoseconds, what `parse` makes of it) of a topic's messages, in order.

        Raises:
            RecordingError: it makes nothing of one, which is named, or one has more bytes than `most`.
        """
        for time, payload in self.messages(topic, first_chunk):
            try:
                if len(payload) > most:
                    raise RecordingError(f"found {len(payload):,} bytes; too many to be ours.")
                message = parse(payload)
            except RecordingError as error:
                raise RecordingError(f"{self.path}: {topic.name} at {time} ns: {error}") from error
            yield time, message

    def _chunks(self, topic: Topic) -> TopicChunks:
        """Return the chunks of a topic, or of this recording's own of that name: the kinds differ."""
        own = self._own.get(topic.name, topic)
        if own not in self._known_chunks:
            self._known_chunks[own] = TopicChunks(
                own,
                self._places[own],
                self._index.chunks,
                self._store,
                self.dtypes.get(own),
                self.lost.get(own.name, []),
                str(self.path),
            )
        return self._known_chunks[own]

    @cached_property
    def _places(self) -> Mapping[Topic, NDArray[np.intp]]:
        """Which chunks of the file are each topic's."""
        return chunks_by_topic(self._index, self._store, self.dtypes, str(self.path))

    @cached_property
    def _own(self) -> Mapping[str, Topic]:
        """The topics that a recording of its kind has, by name."""
        return {topic.name: topic for topic in self.topics}

    def _json(self, name: str) -> dict[str, Any]:
        return json_object(self.metadata(name).get("json"), f"{self.path}: the metadata {name!r}")

    def _record(self, opcode: int, offset: int, length: int, most: int = MAX_CHUNK_BYTES) -> bytes:
        """Return the body of a record of this kind."""
        record = self._store.record(offset, length, most)
        if record[0] != opcode or int.from_bytes(record[1:9], "little") != length - 9:
            raise RecordingError(f"{self.path}: found another record at {offset} than the index says.")
        return record[9:]
