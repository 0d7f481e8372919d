"""Reads the logical content of a recording: tables of columns, whatever the format of the file.

It is the only part of the oracle that follows the reader and the format. Names of tables and columns, and
what they hold, stay:

| table | a row for |
|---|---|
| `run`, `environment` | the run |
| `PHASE.steps` | each turn of an environment; `taken` is false where it was only reset |
| `PHASE.resets`, `PHASE.reset_options`, `PHASE.reset_states` | a reset; its options; what it depends on |
| `PHASE.episodes`, `PHASE.metrics`, `PHASE.infos`, `PHASE.frames` | an episode, a report, an info, a frame |
| `PHASE.extras.NAME` | a value that was recorded with a step |
| `optimality`, `q_tables`, `scalars`, `arrays`, `texts`, `checkpoints`, `images` | a message |
"""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from blake3 import blake3
from numpy.typing import NDArray
from PIL import Image

from runner.recording import schema
from runner.recording.description import environment_count
from runner.recording.messages import frame_place
from runner.recording.reader import Phase, Recording, open_recording
from runner.recording.run_file import has_environment
from runner.recording.steps import COLUMNS as KEPT_COLUMNS

Column = NDArray[Any]
"""The values of a column, [rows, ...]; texts as objects."""
Table = dict[str, Column]
Content = dict[str, Table]

PHASES = ("train", "eval")
MAX_ROW_BYTES = 128
"""Longer values are represented by a digest."""
_OWN_LOGGER = "dualtaxi"
_PARENT = "run"
"""The entry of a configuration with the id of the run that was branched, another one each time."""
_WHOLE_MAPPINGS = ("info", "config", "spaces")
_BOOKKEEPING = {
    **dict.fromkeys(
        ("state", "next_state", "step", "episode", "t", "length", "penalties", "last_step"), np.int64
    ),
    **dict.fromkeys(("reset", "environment", "events"), np.int64),
    **dict.fromkeys(("rewards", "returns"), np.float64),
    **dict.fromkeys(("terminated", "truncated", "success", "explored", "seeded"), np.bool_),
}
"""The type of columns that do not follow from a space: not that in which the file stores them."""


def read(path: Path) -> Content:
    """Return the logical content of a recording; tables without rows are left out."""
    with open_recording(path) as recording:
        tables = dict(_tables(recording))
    return {name: table for name, table in tables.items() if table and len(next(iter(table.values())))}


def _tables(recording: Recording) -> Iterator[tuple[str, Table]]:
    yield "run", _run(recording)
    if recording.tabular:
        yield "environment", _environment(recording)
    for phase in PHASES:
        for name, table in _phase_tables(recording, phase):
            yield f"{phase}.{name}", table
    yield "texts", _texts(recording)
    if recording.eval.has_metrics:
        yield "optimality", _of_messages(recording.table(schema.OPTIMALITY_TOPIC).decoded())
    if recording.has_tables:
        yield "q_tables", _of_messages(map(vars, recording.snapshots(tables=99)))
        return
    yield "scalars", _of_messages(_decoded(recording, "/scalar"))
    yield "arrays", _of_messages(map(vars, recording.arrays()))
    yield "checkpoints", _of_messages(_decoded(recording, "/checkpoint"))
    yield "images", _images(_decoded(recording, "/image"))


def _phase_tables(recording: Recording, phase: str) -> Iterator[tuple[str, Table]]:
    resets = _resets(recording, phase)
    yield "resets", resets
    yield "steps", _steps(recording, phase)
    yield "episodes", _episodes(recording, phase)
    if recording.eval.has_metrics:
        yield "metrics", _of_messages(recording.phase(phase).metrics.decoded())
        return
    yield (
        "infos",
        _of_messages(
            {
                "position": one["position"],
                "step": one["step"],
                "is_reset": one["reset"],
                "info": json.loads(one["json"]),
            }
            for one in _decoded(recording, f"/{phase}/info")
        ),
    )
    yield "reset_options", _of_messages(_reset_options(recording.phase(phase), resets))
    yield "reset_states", _of_messages(state._asdict() for state in recording.phase(phase).reset_states())
    yield "frames", _images(_decoded(recording, f"/{phase}/frame"))
    for name in recording.phase(phase).extras:
        blocks = [
            block[block["given"][name]] for block in _with(recording.phase(phase).extras.blocks(), name)
        ]
        if blocks:
            whole = {key: np.concatenate([block[key] for block in blocks]) for key in ("log_time", "step")}
            values = np.concatenate([block["values"][name] for block in blocks])
            yield f"extras.{name}", _of_columns(_positioned(whole) | {"value": values})


def _reset_options(phase: Phase, resets: Table) -> Iterator[dict[str, object]]:
    """Yield the options of each reset that has some, or a seed of more than 64 bits."""
    for given in phase.reset_options():
        seed = None if given.large_seed is None else {"value": str(given.large_seed)}
        yield {"step": int(resets["step"][given.reset]), "options": given.options, "seed": seed}


def _with(blocks: Iterable[Column], name: str) -> Iterator[Column]:
    return (block for block in blocks if name in (block["given"].dtype.names or ()))


def _run(recording: Recording) -> Table:
    facts = {
        "agents": recording.agents,
        "spaces": recording.spaces if has_environment(recording.config) else None,
        "environments": environment_count(recording),
        "shards": [shard.name for shard in recording.shards],
        "seed": recording.seed,
        "config": _without_parent(recording.config),
        "event_names": recording.environment["event_names"] if has_environment(recording.config) else None,
        "status": recording.status,
        "lost": sum(stop - first for ranges in recording.lost.values() for first, stop in ranges),
        **recording.done(),
    }
    return _of_messages([facts])


def _without_parent(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _without_parent(own) for key, own in value.items() if key != _PARENT}
    return [_without_parent(own) for own in value] if isinstance(value, list) else value


def _environment(recording: Recording) -> Table:
    mdp = recording.mdp
    fields = {field.name: getattr(mdp, field.name) for field in dataclasses.fields(mdp)}
    return _of_messages(
        [{name: value for name, value in fields.items() if isinstance(value, np.ndarray | tuple)}]
    )


def _steps(recording: Recording, phase: str) -> Table:
    if recording.phase(phase).steps.are_actions:
        blocks = list(recording.phase(phase).steps.rows())
        columns = {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0].dtype.names}
        columns = {name: values for name, values in columns.items() if name in ("step", *KEPT_COLUMNS)}
    else:
        steps = recording.phase(phase).steps
        spaces = {"action": "action", "next_observation": "observation"}
        columns = _values(recording, recording.phase(phase)._values(steps, steps.rows(), **spaces))
    if not columns:
        return {}
    if recording.has_states:
        columns["action"] = columns["action"].astype(np.int64)
    taken = columns.setdefault("taken", np.full(len(columns["t"]), True))
    columns["t"] = np.where(taken, columns["t"].astype(np.int64), -1)
    columns.setdefault("environment", np.zeros(len(taken), np.int64))
    if recording.can_train_again:
        return _of_columns(_positioned(columns))
    columns.pop("explored", None)
    for name in ("acted", "agents_terminated", "agents_truncated"):
        bits = columns.pop(name, None)
        if bits is not None and len(recording.agents) > 1:
            flags = bits.astype(np.int64)[:, np.newaxis] >> np.arange(len(recording.agents)) & 1
            columns[name] = flags.astype(np.bool_)
    return _of_columns(_positioned(columns))


def _resets(recording: Recording, phase: str) -> Table:
    return _of_columns(_positioned(_values(recording, recording.phase(phase).reset_values())))


def _episodes(recording: Recording, phase: str) -> Table:
    episodes = recording.phase(phase).episodes.array()
    if not len(episodes):
        return {}
    columns = {name: episodes[name] for name in episodes.dtype.names or () if _is_content(name)}
    columns.setdefault("environment", np.zeros(len(episodes), np.int64))
    del columns["first_step"]
    return _of_columns(_positioned(columns))


def _values(recording: Recording, rows: Iterable[Any]) -> dict[str, Column | list[Any]]:
    """Return the columns of rows, as NumPy records or mappings."""
    rows = list(rows)
    if rows and isinstance(rows[0], Mapping):
        return {
            name: [row[name] for row in rows] if _is_value(name) else np.array([row[name] for row in rows])
            for name in rows[0]
        }
    whole = np.array(rows, rows[0].dtype) if rows else np.empty(0)
    return {name: whole[name] for name in whole.dtype.names or () if _is_content(name)}


def _is_value(name: str) -> bool:
    return name in ("action", "observation", "next_observation")


def _is_content(name: str) -> bool:
    """Return whether a field of a record is one of the message, or its time."""
    return not (
        name.startswith("tag_")
        or name in ("opcode", "record_length", "channel_id", "sequence", "publish_time")
    )


def _texts(recording: Recording) -> Table:
    """Return the texts that a loop logged; what the runner says has times of the clock."""
    return _of_messages(
        {"position": one["position"], "name": one["name"], "text": one["message"]}
        for one in _decoded(recording, "/log")
        if one["name"] != _OWN_LOGGER
    )


def _images(messages: Iterable[dict[str, Any]]) -> Table:
    """Return pictures with their pixels: how they are packed is no content."""
    rows = []
    for message in messages:
        environment, is_reset = frame_place(message)
        with Image.open(io.BytesIO(message["data"])) as image:
            pixels = np.asarray(image)
        rows.append(
            {
                "position": message["position"],
                "name": message["frame_id"],
                "environment": environment,
                "is_reset": is_reset,
                "pixels": pixels,
            }
        )
    return _of_messages(rows)


def _decoded(recording: Recording, name: str) -> list[dict[str, Any]]:
    """Return the messages of a topic of variable size."""
    messages = []
    for fields in recording.table(name).decoded():
        message = dict(fields)
        message["position"] = message.pop("log_time") // schema.STEP_NANOSECONDS
        messages.append(message)
    return messages


def _positioned(columns: Mapping[str, Any]) -> dict[str, Any]:
    """Return columns with the number of steps executed so far in place of the time in nanoseconds."""
    columns = dict(columns)
    if "log_time" in columns:
        columns["position"] = np.asarray(columns.pop("log_time")).astype(np.int64) // schema.STEP_NANOSECONDS
    return columns


def _of_messages(messages: Iterable[Mapping[str, Any]]) -> Table:
    rows = [dict(message) for message in messages]
    for row in rows:
        if "log_time" in row:
            row["position"] = row.pop("log_time") // schema.STEP_NANOSECONDS
    return _of_columns({name: [row[name] for row in rows] for name in rows[0]}) if rows else {}


def _of_columns(columns: Mapping[str, Any]) -> Table:
    """Return columns with the parts of values as columns of their own."""
    return dict(sorted(part for name, values in columns.items() for part in _parts(name, values)))


def _parts(name: str, values: Column | Sequence[Any]) -> Iterator[tuple[str, Column]]:
    first_name = name.split(".", maxsplit=1)[0]
    if isinstance(values, np.ndarray):
        if values.dtype.names:
            for field in values.dtype.names:
                yield from _parts(f"{name}.{field}", values[field])
        else:
            yield name, _column(values.astype(_BOOKKEEPING.get(name, values.dtype)))
    elif name in _BOOKKEEPING and len({np.shape(value) for value in values}) == 1:
        yield name, _column(np.array(values, _BOOKKEEPING[name]))
    elif all(isinstance(value, np.ndarray | np.generic) for value in values) and _are_alike(values):
        yield from _parts(name, np.stack(values))
    elif all(isinstance(value, Mapping) for value in values) and first_name not in _WHOLE_MAPPINGS:
        for key in values[0]:
            yield from _parts(f"{name}.{key}", [value[key] for value in values])
    elif all(isinstance(value, tuple) for value in values) and _is_value(first_name):
        for i in range(len(values[0])):
            yield from _parts(f"{name}.{i}", [value[i] for value in values])
    elif all(isinstance(value, int | float | bool) for value in values):
        yield name, np.array(values)
    else:
        yield name, np.array([*map(_text, values), None], object)[:-1]


def _are_alike(values: Sequence[Any]) -> bool:
    return len({(value.dtype, value.shape) for value in values}) == 1


def _column(values: Column) -> Column:
    """Return a column, with digests in place of long values."""
    row_bytes = values.dtype.itemsize * int(np.prod(values.shape[1:]))
    if row_bytes <= MAX_ROW_BYTES or values.dtype == object:
        return values
    return np.array([*map(_text, values), None], object)[:-1]


def _text(value: object) -> str:
    """Return a value as text, a long one as its digest."""
    if isinstance(value, str):
        text = value
    elif isinstance(value, bytes):
        text = value.hex()
    elif isinstance(value, np.ndarray | np.generic):
        values = np.ascontiguousarray(value)
        text = f"{values.dtype.str}{list(np.shape(value))} {values.tobytes().hex()}"
    else:
        text = json.dumps(value, sort_keys=True, default=_text)
    return text if len(text) <= 400 else f"BLAKE3 {blake3(text.encode()).hexdigest()[:32]}"
