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
from runner.errors import RecordingError
from runner.mdp import Mdp
from runner.recording import schema
from runner.recording.reader import Recording
from runner.recording.schema import STEP_NANOSECONDS, Topic

Records = NDArray[np.void]
Columns = Mapping[str, pa.Array]
_TICK: Final = np.uint64(STEP_NANOSECONDS)
_BLANKS: Final = 16_384
_WHOLE_OF_STEPS: Final = ("t", "state", "action", "next_state")
_SAME_OF_STEPS: Final = ("step", "episode", "terminated", "truncated")
_WHOLE_OF_EPISODES: Final = ("length", "penalties")
_SAME_OF_EPISODES: Final = ("episode", "last_step", "success", "terminated", "truncated")


def shape_of(run: Mapping[str, str], mdp: Mdp, where: str) -> Shape:
    """Return what fixes the columns of a run's steps and episodes.

    Args:
        run: the recording's metadata record of that name.
        mdp: its environment.
        where: named in errors.

    Raises:
        RecordingError: the two contradict each other.
    """
    try:
        learners = json.loads(run["agents"])
    except (ValueError, RecursionError):
        learners = None
    known = isinstance(learners, list) and all(isinstance(name, str) for name in learners)
    if not known or (len(learners), len(mdp.event_names)) != (int(run["learners"]), int(run["events"])):
        raise RecordingError(
            f"{where}: found learners {learners!r} and {len(mdp.event_names)} events, "
            f"expected {run['learners']} and {run['events']}."
        )
    return Shape(run["run_id"], tuple(learners), mdp.agents, mdp.action_counts, mdp.event_names)


def merged(
    recording: Recording, topics: tuple[Topic, Topic], stop: int | None = None
) -> Iterator[tuple[Topic, Records]]:
    """Yield the messages of a topic of training and one of evaluation in the order they were recorded.

    Args:
        recording: whose.
        topics: two fixed-width topics.
        stop: how many of each at most.
    """
    waiting = [(topic, iter(recording.blocks(topic, 0, stop))) for topic in topics]
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
    columns = _step_columns if topic.message is schema.STEP else _episode_columns
    made = {
        "run_id": _constant(0, len(records), [shape.run_id]),
        "phase": _constant(PHASES.index(topic.phase), len(records), PHASES),
        "position": (records["log_time"] // _TICK).astype(np.int64),
        **columns(records, shape),
    }
    table = shape.steps if topic.message is schema.STEP else shape.episodes
    return pa.record_batch([pa.array(made[field.name], field.type) for field in table], schema=table)


def records_of(topic: Topic, batch: pa.RecordBatch, shape: Shape) -> Records:
    """Return the message records of rows that are all of one topic."""
    records = _blank(topic, shape.counts[topic], -(-batch.num_rows // _BLANKS) * _BLANKS)[
        : batch.num_rows
    ].copy()
    columns = {name: batch.column(name) for name in batch.schema.names if name not in ("run_id", "phase")}
    times = _numbers(columns.pop("position")).astype(np.uint64) * _TICK
    records["log_time"] = records["publish_time"] = times
    fill = _fill_steps if topic.message is schema.STEP else _fill_episodes
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


@lru_cache(8)
def _blank(topic: Topic, counts: tuple[int, ...], n: int) -> Records:
    """Return n blank records, to be copied: that is quicker than to make them."""
    return schema.blank_records(topic, counts, n)


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
