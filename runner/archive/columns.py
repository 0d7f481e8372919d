"""Message records of steps, episodes and resets as columns: one table of columns for both directions."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from runner.archive import layout
from runner.archive.layout import PHASES, SCHEMAS, Column, Records, Table
from runner.archive.values import SpaceColumns, numbers
from runner.environments.mdp import Mdp
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.blocks import blank_records
from runner.recording.extras import ExtraLayout
from runner.recording.metadata import dtypes_of, kind_of, spaces_of
from runner.recording.recorder import BLOCK_BYTES
from runner.recording.schema import STEP_NANOSECONDS, MessageType, Topic
from runner.util.arrays import Array

_TICK: Final = np.uint64(STEP_NANOSECONDS)
_BLANKS: Final = 16_384
_cached_blanks = lru_cache(8)(blank_records)
_INT64, _INT32, _FLOAT, _FLAG = pa.int64(), pa.int32(), pa.float64(), pa.bool_()


@dataclass(frozen=True)
class Shape:
    """The facts of a run that determine its tables and their columns."""

    run_id: str
    kind: str
    """One of `schema.KINDS`."""
    learners: tuple[str, ...]
    agents: tuple[str, ...]
    action_counts: tuple[int, ...]
    events: tuple[str, ...]
    dtypes: Mapping[Topic, np.dtype[np.void]]
    """The dtype of each fixed-width topic's message records."""
    spaces: Mapping[str, SpaceColumns] = field(default_factory=dict)
    """The spaces of a loop by field: `action`, `next_observation`, `observation`, `extra`."""
    extras: tuple[ExtraLayout, ...] = ()
    """The names of extras, from when on."""

    @cached_property
    def tables(self) -> tuple[Table, ...]:
        """The tables of messages, without Q-tables, in the order in which they are written."""
        own = {topic.name: topic for topic in schema.KINDS[self.kind]}

        def table(name: str, *topics: str) -> Table:
            columns = SCHEMAS[name] if name in SCHEMAS else self.schema_of(own[topics[0]].message)
            return Table(name, tuple(own[topic] for topic in topics), columns)

        steps = table(layout.STEPS, "/train/step", "/eval/step")
        episodes = table(layout.EPISODES, "/train/episode", "/eval/episode")
        log = (
            table(layout.LOG, "/log"),
            table(layout.CLOCK, "/clock"),
            table(layout.HOST, "/host"),
            table(layout.CONSOLE, "/console"),
        )
        if self.kind == "job":
            return (
                steps,
                episodes,
                table(layout.TRAIN_METRICS, "/train/metrics"),
                table(layout.EVAL_METRICS, "/eval/metrics"),
                table(layout.OPTIMALITY, "/eval/optimality"),
                *log,
            )
        return (
            steps,
            episodes,
            table(layout.RESETS, "/train/reset", "/eval/reset"),
            table(layout.INFOS, "/train/info", "/eval/info"),
            table(layout.SCALARS, "/scalar"),
            table(layout.ARRAYS, "/array"),
            table(layout.FRAMES, "/train/frame", "/eval/frame", "/image"),
            *log,
            table(layout.CHECKPOINTS, "/checkpoint"),
            table(layout.EXTRA_COLUMNS, "/extra"),
            *((table(layout.EXTRAS, "/train/extra", "/eval/extra"),) if self.extras else ()),
            table(layout.RESET_STATES, "/train/reset_state", "/eval/reset_state"),
        )

    def schema_of(self, message: MessageType) -> pa.Schema:
        """Return the columns of a message whose columns differ between runs."""
        own = [(column.name, column.type) for column in self.columns_of(message)]
        return pa.schema([*layout.PLACED_IN_PHASE, *own])

    def columns_of(self, message: MessageType) -> list[Column]:
        """Return the columns of a message, without run, phase and position."""
        if message is schema.STEP:
            return self._steps
        if message is schema.TRANSITION:
            return self._transitions
        if message is schema.EXTRA:
            return self._extras
        return self._resets if message is schema.RESET else self._episodes

    @property
    def joint_actions(self) -> int:
        """The number of joint actions."""
        return math.prod(self.action_counts)

    def per_learner(self, name: str) -> list[str]:
        """Return the columns of each learner, such as `reward_taxi_1`; none if there is one learner."""
        return _names(f"{name}_", self.learners) if len(self.learners) > 1 else []

    @cached_property
    def own_actions(self) -> list[str]:
        """The columns of the agents' own actions, such as `action_taxi_1`; none if there is one agent."""
        return _names("action_", self.agents) if len(self.agents) > 1 else []

    @cached_property
    def event_columns(self) -> list[str]:
        """The columns that count events, such as `n_taxi_1_drop_off`."""
        return _names("n_", self.events)

    @cached_property
    def _steps(self) -> list[Column]:
        return [
            _plain("step", _INT64),
            _plain("episode", _INT64),
            _plain("t", _INT32),
            _plain("state", _INT32),
            _plain("action", _INT32),
            *(Column(name, _INT32, self._action_of(i)) for i, name in enumerate(self.own_actions)),
            _plain("next_state", _INT32),
            *self._summed("reward", "rewards"),
            *self._explored(),
            _plain("terminated", _FLAG),
            _plain("truncated", _FLAG),
        ]

    @cached_property
    def _transitions(self) -> list[Column]:
        return [
            _plain("step", _INT64),
            _plain("episode", _INT64),
            _plain("t", _INT32),
            *self.spaces["action"].columns,
            *self.spaces["next_observation"].columns,
            *self._summed("reward", "rewards"),
            _plain("terminated", _FLAG),
            _plain("truncated", _FLAG),
            *(_plain(name, _INT32) for name in ("acted", "agents_terminated", "agents_truncated")),
        ]

    @cached_property
    def _resets(self) -> list[Column]:
        def read_seed(records: Records) -> pa.Array:
            return pa.array(np.ascontiguousarray(records["seed"]), pa.uint64(), mask=~records["seeded"])

        def write_seed(records: Records, column: pa.Array) -> None:
            records["seed"] = numbers(column.fill_null(0))
            records["seeded"] = numbers(column.is_valid())

        return [
            *(_plain(name, _INT64) for name in ("reset", "episode", "step")),
            _plain("environment", _INT32),
            Column("seed", pa.uint64(), read_seed, write_seed),
            *self.spaces["observation"].columns,
        ]

    @cached_property
    def _extras(self) -> list[Column]:
        """Return the columns of the last layout, which has all names."""
        nullable = (
            _nullable(column, leaf.path[0])
            for leaf, columns in self.spaces["extra"].columns_by_leaf
            for column in columns
        )
        return [_plain("step", _INT64), *nullable]

    @cached_property
    def _episodes(self) -> list[Column]:
        return [
            _plain("episode", _INT64),
            _plain("last_step", _INT64),
            _plain("length", _INT32),
            _plain("penalties", _INT32),
            *self._summed("return", "returns"),
            *(_plain(name, _FLAG) for name in ("success", "terminated", "truncated")),
            *(_plain(name, _INT32, "events", i) for i, name in enumerate(self.event_columns)),
        ]

    def _action_of(self, agent: int) -> Callable[[Records], Array]:
        """Return the function that reads an agent's own action from the joint one."""
        counts, joint = self.action_counts, np.uint32(self.joint_actions)
        divisor, count = np.uint32(math.prod(counts[agent + 1 :])), np.uint32(counts[agent])
        return lambda records: (records["action"] % joint // divisor % count).astype(np.int32)

    def _summed(self, name: str, source: str) -> list[Column]:
        """Return the column of the learners' sum and, where there are several, one for each."""
        own = self.per_learner(name)
        if not own:
            return [_plain(name, _FLOAT, source, 0)]
        total = Column(name, _FLOAT, lambda records: records[source].sum(axis=1))
        return [total, *(_plain(key, _FLOAT, source, i) for i, key in enumerate(own))]

    def _explored(self) -> list[Column]:
        """Return the column for any learner's exploration and, where there are several, one for each."""

        def bit(name: str, i: int) -> Column:
            def write(records: Records, column: pa.Array) -> None:
                records["explored"] |= numbers(column).astype(np.uint32) << np.uint32(i)

            return Column(
                name, _FLAG, lambda records: records["explored"] >> np.uint32(i) & np.uint32(1) != 0, write
            )

        own = [bit(name, i) for i, name in enumerate(self.per_learner("explored"))]
        any_explored = Column("explored", _FLAG, lambda records: records["explored"] != 0)
        return [any_explored, *own] if own else [bit("explored", 0)]


def _plain(name: str, kind: pa.DataType, source: str = "", i: int | None = None) -> Column:
    """Return the column of a field, or of element `i` of the field `source`, which is an array.

    Unsigned 32-bit numbers become signed, which readers can subtract.
    """
    field, at = source or name, ... if i is None else (..., i)

    def read(records: Records) -> Array:
        values = np.ascontiguousarray(records[field][at])
        return values.view(np.int32) if kind == _INT32 else values

    def write(records: Records, column: pa.Array) -> None:
        records[field][at] = numbers(column)

    return Column(name, kind, read, write)


def _nullable(column: Column, name: str) -> Column:
    """Return the column of an extra, or of a part of it, which is null where it was not given."""
    write_values = column.write
    assert write_values is not None
    is_bytes = pa.types.is_fixed_size_binary(column.type)
    zero = pa.scalar(bytes(column.type.byte_width) if is_bytes else 0).cast(column.type)

    def read(records: Records) -> pa.Array:
        values, given = column.read(records), np.ascontiguousarray(records["given"][name])
        values = values if isinstance(values, pa.Array) else pa.array(values, column.type)
        return values if given.all() else pc.if_else(pa.array(given), values, pa.scalar(None, column.type))

    def write(records: Records, values: pa.Array) -> None:
        records["given"][name] = numbers(values.is_valid())
        write_values(records, values.fill_null(zero))

    return Column(column.name, column.type, read, write)


def _names(prefix: str, names: tuple[str, ...]) -> list[str]:
    """Return a column for each name, numbered if the names would not be unique."""
    made = [prefix + name.replace(".", "_") for name in names]
    if len(set(made)) < len(made):
        made = [f"{prefix}{number}" for number in range(1, len(made) + 1)]
    return made


def shape_of(
    run: Mapping[str, str], mdp: Mdp | None, where: str, extras: tuple[ExtraLayout, ...] = ()
) -> Shape:
    """Return the shape of a run.

    Args:
        extras: the names of its extras, from when on.

    Raises:
        RecordingError: they contradict each other.
    """
    try:
        learners = json.loads(run["agents"])
    except (ValueError, RecursionError):
        learners = None
    are_names = isinstance(learners, list) and all(isinstance(name, str) for name in learners)
    events = mdp.event_names if mdp else ()
    if not are_names or (len(learners), len(events)) != (int(run["learners"]), int(run["events"])):
        raise RecordingError(
            f"{where}: found learners {learners!r} and {len(events)} events, "
            f"expected {run['learners']} and {run['events']}."
        )
    spaces, dtypes = {}, dtypes_of(run, where)
    if extras:
        spaces["extra"] = SpaceColumns(extras[-1].description, "values", where, "extra")
        dtypes |= dict.fromkeys(schema.EXTRA_TOPICS, extras[-1].record)
    if kind_of(run) != "job":
        described = spaces_of(run, where)
        for name in ("action", "next_observation", "observation"):
            spaces[name] = SpaceColumns(described[name.removeprefix("next_")], name, where)
    return Shape(
        run_id=run["run_id"],
        kind=kind_of(run),
        learners=tuple(learners),
        agents=mdp.agents if mdp else (),
        action_counts=mdp.action_counts if mdp else (),
        events=events,
        dtypes=dtypes,
        spaces=spaces,
        extras=extras,
    )


def batch_of(topic: Topic, records: Records, shape: Shape) -> pa.RecordBatch:
    """Return the columns of message records of one fixed-width topic, [n] rows."""
    n = len(records)
    if topic.message is schema.EXTRA:
        records = _in_layout(topic, records, shape.extras[-1])
    arrays = [
        _constant(0, n, (shape.run_id,)),
        _constant(PHASES.index(topic.phase), n, PHASES),
        pa.array((records["log_time"] // _TICK).astype(np.int64)),
    ]
    for column in shape.columns_of(topic.message):
        values = column.read(records)
        arrays.append(values if isinstance(values, pa.Array) else pa.array(values, column.type))
    return pa.record_batch(arrays, schema=shape.schema_of(topic.message))


def records_of(topic: Topic, batch: pa.RecordBatch, shape: Shape) -> Records:
    """Return the message records of rows that are all of one topic."""
    records = _blanks(topic, shape.dtypes[topic], batch.num_rows)
    times = numbers(batch.column("position")).astype(np.uint64) * _TICK
    records["log_time"] = times
    records["publish_time"] = times
    for column in shape.columns_of(topic.message):
        if column.write is not None:
            column.write(records, batch.column(column.name))
    return records


def checked_batch(topic: Topic, records: Records, shape: Shape, where: str) -> pa.RecordBatch:
    """Return the columns of message records, which turn back into exactly these records.

    Raises:
        RecordingError: they do not: the records have what no recorder writes.
    """
    batch = batch_of(topic, records, shape)
    restored = records_of(topic, batch, shape)
    if topic.message is schema.EXTRA:
        parts = list(in_layouts(topic, restored, shape))
        restored = parts[0] if len(parts) == 1 and parts[0].dtype == records.dtype else np.zeros_like(records)
    found, expected = (rows.view(np.uint8).reshape(len(records), -1) for rows in (records, restored))
    if not np.array_equal(found, expected):
        differs = (found != expected).any(axis=1)
        number = int(records[int(differs.argmax())][schema.NUMBERED_BY.get(topic.message, "step")])
        raise RecordingError(
            f"{where}: message {number} of {topic.name} has what no recorder writes, so that it cannot be "
            "archived; `dualtaxi verify` names the damage."
        )
    return batch


def in_layouts(topic: Topic, records: Records, shape: Shape) -> Iterator[Records]:
    """Yield extras, which have all names, in parts with the names that there were at their time."""
    starts = np.array([layout.start_time for layout in shape.extras], np.uint64)
    chosen = np.searchsorted(starts, records["log_time"], "right") - 1
    for k in np.unique(chosen).tolist():
        yield _in_layout(topic, records[chosen == k], shape.extras[k])


def _in_layout(topic: Topic, records: Records, target: ExtraLayout) -> Records:
    """Return extras with more names, which they do not have, or with fewer."""
    moved = _blanks(topic, target.record, len(records))
    for number in ("log_time", "publish_time", "step"):
        moved[number] = records[number]
    for name in set(target.names) & set(records["values"].dtype.names or ()):
        moved["values"][name], moved["given"][name] = records["values"][name], records["given"][name]
    return moved


def record_bytes(records: Records) -> memoryview:
    """Return the bytes of contiguous message records."""
    return records.view(np.uint8).data.cast("B")


def of_phase(batch: pa.RecordBatch, phase: str, where: str) -> pa.RecordBatch:
    """Return the rows of one phase.

    Raises:
        RecordingError: there is a phase other than training and evaluation.
    """
    column = batch.column("phase")
    names = column.dictionary.to_pylist()
    codes = numbers(column.indices)
    if not {names[code] for code in np.unique(codes)} <= set(PHASES):
        raise RecordingError(f"{where}: found phases {names}, expected {list(PHASES)}.")
    chosen = codes == names.index(phase) if phase in names else np.zeros(len(codes), np.bool_)
    return batch if chosen.all() else batch.filter(pa.array(chosen))


def _blanks(topic: Topic, dtype: np.dtype[np.void], n: int) -> Records:
    """Return n blank records, which are copied from cached ones if they are small: that is quicker."""
    rounded = -(-n // _BLANKS) * _BLANKS
    if rounded * dtype.itemsize > BLOCK_BYTES:
        return blank_records(topic, dtype, n)
    return _cached_blanks(topic, dtype, rounded)[:n].copy()


def _constant(code: int, n: int, names: tuple[str, ...]) -> pa.DictionaryArray:
    return pa.DictionaryArray.from_arrays(pa.array(np.full(n, code, np.int8)), pa.array(names, pa.string()))
