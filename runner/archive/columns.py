"""Message records of steps and episodes to columns and back: the two directions of one mapping."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from runner.archive.layout import PHASES, Shape
from runner.archive.values import SpaceColumns
from runner.environments.mdp import Mdp
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.blocks import Sizes, blank_records, record_dtype
from runner.recording.metadata import kind_of, sizes_of, spaces_of
from runner.recording.reader import Recording
from runner.recording.recorder import BLOCK_BYTES
from runner.recording.schema import STEP_NANOSECONDS, Topic

Records = NDArray[np.void]
Columns = Mapping[str, pa.Array]
_TICK: Final = np.uint64(STEP_NANOSECONDS)
_BLANKS: Final = 16_384
_WHOLE_OF_STEPS: Final = ("t", "state", "action", "next_state")
_SAME_OF_STEPS: Final = ("step", "episode", "terminated", "truncated")
_WHOLE_OF_EPISODES: Final = ("length", "penalties")
_SAME_OF_TRANSITIONS: Final = ("step", "episode", "terminated", "truncated")
_WHOLE_OF_TRANSITIONS: Final = ("t", "acted", "agents_terminated", "agents_truncated")
_SAME_OF_RESETS: Final = ("reset", "episode", "step")
_SAME_OF_EPISODES: Final = ("episode", "last_step", "success", "terminated", "truncated")


def shape_of(run: Mapping[str, str], mdp: Mdp | None, where: str) -> Shape:
    """Return what fixes the tables of a run and their columns.

    Args:
        run: the recording's metadata record of that name.
        mdp: its environment, if that is tabular.
        where: named in errors.

    Raises:
        RecordingError: they contradict each other.
    """
    try:
        learners = json.loads(run["agents"])
    except (ValueError, RecursionError):
        learners = None
    known = isinstance(learners, list) and all(isinstance(name, str) for name in learners)
    events = mdp.event_names if mdp else ()
    if not known or (len(learners), len(events)) != (int(run["learners"]), int(run["events"])):
        raise RecordingError(
            f"{where}: found learners {learners!r} and {len(events)} events, "
            f"expected {run['learners']} and {run['events']}."
        )
    return Shape(
        run_id=run["run_id"],
        kind=kind_of(run),
        learners=tuple(learners),
        agents=mdp.agents if mdp else (),
        action_counts=mdp.action_counts if mdp else (),
        events=events,
        sizes=sizes_of(run, where),
        spaces=_space_columns(run, where),
    )


def _space_columns(run: Mapping[str, str], where: str) -> dict[str, SpaceColumns]:
    """Return the columns of values by the field that holds them; none of a job."""
    if kind_of(run) == "job":
        return {}
    spaces = spaces_of(run, where)
    fields = {"action": "action", "next_observation": "observation", "observation": "observation"}
    return {field: SpaceColumns(spaces[space], field, where) for field, space in fields.items()}


def merged(recording: Recording, topics: tuple[Topic, Topic]) -> Iterator[tuple[Topic, Records]]:
    """Yield the messages of a topic of training and one of evaluation in the order they were recorded.

    Args:
        recording: whose.
        topics: two fixed-width topics.
    """
    waiting = [(topic, iter(recording.blocks(topic))) for topic in topics]
    heads = [(topic, block, blocks) for topic, blocks in waiting if (block := next(blocks, None)) is not None]
    while len(heads) == 2:
        heads.sort(key=lambda head: int(head[1]["log_time"][0]))
        (topic, block, blocks), (_, other, _) = heads
        n = max(int(np.searchsorted(block["log_time"], other["log_time"][0])), 1)
        yield topic, block[:n]
        rest = block[n:] if n < len(block) else next(blocks, None)
        heads[:1] = [] if rest is None else [(topic, rest, blocks)]
    for topic, block, blocks in heads:
        yield topic, block
        yield from ((topic, further) for further in blocks)


def batch_of(topic: Topic, records: Records, shape: Shape) -> pa.RecordBatch:
    """Return the columns of message records of one fixed-width topic, [n] rows."""
    columns, _ = _WAYS[topic.message]
    made = {
        "run_id": _constant(0, len(records), [shape.run_id]),
        "phase": _constant(PHASES.index(topic.phase), len(records), PHASES),
        "position": (records["log_time"] // _TICK).astype(np.int64),
        **columns(records, shape),
    }
    table = shape.columns_of(topic.message)
    arrays = [made[field.name] for field in table]
    ready = [
        one if isinstance(one, pa.Array) else pa.array(one, field.type)
        for one, field in zip(arrays, table, strict=True)
    ]
    return pa.record_batch(ready, schema=table)


def records_of(topic: Topic, batch: pa.RecordBatch, shape: Shape) -> Records:
    """Return the message records of rows that are all of one topic."""
    records = _blanks(topic, shape.sizes[topic], batch.num_rows)
    columns = {name: batch.column(name) for name in batch.schema.names if name not in ("run_id", "phase")}
    times = _numbers(columns.pop("position")).astype(np.uint64) * _TICK
    records["log_time"] = records["publish_time"] = times
    _, fill = _WAYS[topic.message]
    fill(records, columns, shape)
    return records


def checked_batch(topic: Topic, records: Records, shape: Shape, where: str) -> pa.RecordBatch:
    """Return the columns of message records, after comparing what they are turned back into.

    Raises:
        RecordingError: it is not the same, to the byte: they hold what no recorder writes.
    """
    batch = batch_of(topic, records, shape)
    back = records_of(topic, batch, shape)
    found, told = (rows.view(np.uint8).reshape(len(records), -1) for rows in (records, back))
    if not np.array_equal(found, told):
        differs = (found != told).any(axis=1)
        number = int(records[int(differs.argmax())][schema.NUMBERED_BY[topic.message]])
        raise RecordingError(
            f"{where}: message {number} of {topic.name} holds what no recorder writes, so that columns "
            "cannot hold it; `dualtaxi verify` tells more."
        )
    return batch


def record_bytes(records: Records) -> memoryview:
    """Return the bytes of message records that stand one behind the other."""
    return records.view(np.uint8).data.cast("B")


def of_phase(batch: pa.RecordBatch, phase: str, where: str) -> pa.RecordBatch:
    """Return the rows of one phase.

    Raises:
        RecordingError: there are others than training's and evaluation's.
    """
    column = batch.column("phase")
    words = column.dictionary.to_pylist()
    codes = _numbers(column.indices)
    if not {words[code] for code in np.unique(codes)} <= set(PHASES):
        raise RecordingError(f"{where}: found phases {words}, expected {list(PHASES)}.")
    chosen = codes == words.index(phase) if phase in words else np.zeros(len(codes), np.bool_)
    return batch if chosen.all() else batch.filter(pa.array(chosen))


def _blanks(topic: Topic, sizes: Sizes, n: int) -> Records:
    """Return n blank records: if they are small, copied from others, which is quicker than to make them."""
    most = -(-n // _BLANKS) * _BLANKS
    if most * record_dtype(topic.message, sizes).itemsize > BLOCK_BYTES:
        return blank_records(topic, sizes, n)
    return _blank(topic, sizes, most)[:n].copy()


@lru_cache(8)
def _blank(topic: Topic, sizes: Sizes, n: int) -> Records:
    return blank_records(topic, sizes, n)


def _step_columns(records: Records, shape: Shape) -> dict[str, Any]:
    columns: dict[str, Any] = {name: _int32(records[name]) for name in _WHOLE_OF_STEPS}
    columns |= {name: np.ascontiguousarray(records[name]) for name in _SAME_OF_STEPS}
    if shape.own_actions:
        own = np.unravel_index(records["action"] % np.uint32(shape.joint_actions), shape.action_counts)
        columns |= dict(zip(shape.own_actions, (digit.astype(np.int32) for digit in own), strict=True))
    columns["explored"] = records["explored"] != 0
    for i, name in enumerate(shape.per_learner("explored")):
        columns[name] = (records["explored"] >> np.uint32(i) & np.uint32(1)) != 0
    return columns | _summed("reward", records["rewards"], shape)


def _fill_steps(records: Records, columns: Columns, shape: Shape) -> None:
    for name in (*_WHOLE_OF_STEPS, *_SAME_OF_STEPS):
        records[name] = _numbers(columns[name])
    explored = shape.per_learner("explored") or ["explored"]
    for i, name in enumerate(explored):
        records["explored"] |= _numbers(columns[name]).astype(np.uint32) << np.uint32(i)
    _fill_summed(records["rewards"], "reward", columns, shape)


def _transition_columns(records: Records, shape: Shape) -> dict[str, Any]:
    columns: dict[str, Any] = {name: _int32(records[name]) for name in _WHOLE_OF_TRANSITIONS}
    columns |= {name: np.ascontiguousarray(records[name]) for name in _SAME_OF_TRANSITIONS}
    for name in ("action", "next_observation"):
        columns |= shape.spaces[name].columns(records[name])
    return columns | _summed("reward", records["rewards"], shape)


def _fill_transitions(records: Records, columns: Columns, shape: Shape) -> None:
    for name in (*_WHOLE_OF_TRANSITIONS, *_SAME_OF_TRANSITIONS):
        records[name] = _numbers(columns[name])
    for name in ("action", "next_observation"):
        shape.spaces[name].fill(records[name], columns)
    _fill_summed(records["rewards"], "reward", columns, shape)


def _reset_columns(records: Records, shape: Shape) -> dict[str, Any]:
    columns: dict[str, Any] = {name: np.ascontiguousarray(records[name]) for name in _SAME_OF_RESETS}
    columns["environment"] = _int32(records["environment"])
    seed = np.ascontiguousarray(records["seed"])
    columns["seed"] = pa.array(seed, pa.uint64(), mask=~records["seeded"])
    return columns | shape.spaces["observation"].columns(records["observation"])


def _fill_resets(records: Records, columns: Columns, shape: Shape) -> None:
    for name in (*_SAME_OF_RESETS, "environment"):
        records[name] = _numbers(columns[name])
    records["seed"] = _numbers(columns["seed"].fill_null(0))
    records["seeded"] = _numbers(columns["seed"].is_valid())
    shape.spaces["observation"].fill(records["observation"], columns)


def _episode_columns(records: Records, shape: Shape) -> dict[str, Any]:
    columns: dict[str, Any] = {name: _int32(records[name]) for name in _WHOLE_OF_EPISODES}
    columns |= {name: np.ascontiguousarray(records[name]) for name in _SAME_OF_EPISODES}
    columns |= {name: _int32(records["events"][:, i]) for i, name in enumerate(shape.event_columns)}
    return columns | _summed("return", records["returns"], shape)


def _fill_episodes(records: Records, columns: Columns, shape: Shape) -> None:
    for name in (*_WHOLE_OF_EPISODES, *_SAME_OF_EPISODES):
        records[name] = _numbers(columns[name])
    for i, name in enumerate(shape.event_columns):
        records["events"][:, i] = _numbers(columns[name])
    _fill_summed(records["returns"], "return", columns, shape)


_WAYS: Final = {
    schema.STEP: (_step_columns, _fill_steps),
    schema.TRANSITION: (_transition_columns, _fill_transitions),
    schema.EPISODE: (_episode_columns, _fill_episodes),
    schema.RESET: (_reset_columns, _fill_resets),
}
"""To columns and back, by the message."""


def _summed(name: str, values: NDArray[np.float64], shape: Shape) -> dict[str, Any]:
    """Return what the learners got, [n, L], as columns: together and, where there are several, each."""
    own = dict(zip(shape.per_learner(name), values.T, strict=False))
    together = values.sum(axis=1) if own else np.ascontiguousarray(values[:, 0])
    return {name: together} | {key: np.ascontiguousarray(column) for key, column in own.items()}


def _fill_summed(values: NDArray[np.float64], name: str, columns: Columns, shape: Shape) -> None:
    for i, key in enumerate(shape.per_learner(name) or [name]):
        values[:, i] = _numbers(columns[key])


def _int32(values: NDArray[np.uint32]) -> NDArray[np.int32]:
    """Return numbers as signed ones, which readers can subtract; none of ours is as large as 2**31."""
    return np.ascontiguousarray(values).view(np.int32)


def _constant(code: int, n: int, words: Sequence[str]) -> pa.DictionaryArray:
    return pa.DictionaryArray.from_arrays(pa.array(np.full(n, code, np.int8)), pa.array(words, pa.string()))


def _numbers(column: pa.Array) -> NDArray[Any]:
    """Return a column as an array: a view where it can be one."""
    values: NDArray[Any] = column.to_numpy(zero_copy_only=False)
    return values
