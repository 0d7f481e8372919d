"""Steps, episodes and metrics as tables (CSV or Parquet, a file each); metrics as TensorBoard's event file.

A loop has resets with their options, infos and extras too. A column holds a number or a text; an array of
more numbers than `runner.archive.columns` spreads over columns is a column of bytes, which CSV cannot hold.

Metrics are named numbers over training steps:

    train/mean_length, train/percent_filled/taxi_1, train/reward_counts/-1, train/epsilon, ...
    eval/success_percent, eval/mean_return/taxi_1, eval/events/taxi_1.drop_off, eval/training/epsilon, ...
    eval/exact/value/taxi_1, eval/exact/optimal_value, ... with `evaluation: {exact: true}`
    train/logged/loss, ... logged by a loop
    train/episode/length, train/episode/return/taxi_1, ... of each episode

Unknown values (a mean over no episode, success where the environment does not define it) are left out, so
every number is one that was recorded, unchanged. The event file is the same whenever it is written: an
event's wall time is that of the recorded clock; without one, when the run began, plus logical time.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet

from runner.analysis.contents import whole_ranges
from runner.analysis.series import training_steps_before
from runner.archive import layout
from runner.archive.batches import Batches
from runner.recording import schema
from runner.recording.machine import read_clock
from runner.recording.messages import Message
from runner.recording.metrics import METRICS, TABLE_METRICS
from runner.recording.reader import Recording
from runner.recording.schema import PHASES, SCALAR_TOPIC, STEP_NANOSECONDS
from runner.util.arrays import Ints
from runner.util.extras import require
from runner.util.values import Ranges

_TABLES: Final = {
    "steps": layout.STEPS,
    "episodes": layout.EPISODES,
    "resets": layout.RESETS,
    "reset_options": layout.RESET_OPTIONS,
    "infos": layout.INFOS,
    "extras": layout.EXTRAS,
}
"""The name of each file, without its ending, to the table of an archive that it holds."""
PATTERNS: Final = tuple(
    name + ending for name in (*_TABLES, "metrics") for ending in (".csv", ".csv.gz", ".parquet")
)
_METRICS: Final = pa.schema(
    [
        ("run_id", pa.string()),
        ("phase", pa.string()),
        ("position", pa.int64()),
        ("step", pa.int64()),
        ("episode", pa.int64()),
        ("seconds", pa.float64()),
        ("metric", pa.string()),
        ("value", pa.float64()),
    ]
)
_ROWS: Final = 8192
_OF_STEP: Final = ("episode", "t", "environment", "taken")
"""The columns of steps that the rows of extras have too."""
_ENVIRONMENT_BITS: Final = 40
"""Bits of an episode's number, above which its environment stands."""


def write_tables(
    recording: Recording,
    folder: Path,
    form: str,
    phase: str | None,
    episodes: Ranges,
    gz: bool,
    report: Callable[[int], None],
) -> dict[str, int]:
    """Write the tables of a recording into an empty folder; return the number of rows of each file.

    `form` is `csv` or `parquet`. A phase, and ranges of episodes (of training unless a phase is given), leave
    out other steps and episodes; all metrics are written anyway. `report` is called with the number of steps
    so far.
    """
    numbers, keys = None, None
    if episodes:
        phase = phase or "train"
        ranges = whole_ranges(episodes, _episode_count(recording, phase), phase, str(recording.path))
        numbers = np.concatenate([np.arange(*bounds) for bounds in ranges])
        keys = _keys_of(recording, phase, numbers)
    source = Batches(recording)
    archive_tables = source.shape.tables
    sources = {
        name: source.of(archive_tables[table]) for name, table in _TABLES.items() if table in archive_tables
    }
    if "extras" in sources:
        sources["extras"] = _with_episodes(sources["extras"], recording, archive_tables[layout.STEPS].columns)
    tables = {name: _selected(rows, phase, numbers, keys) for name, rows in sources.items()}
    tables["metrics"] = _metrics(recording)
    rows = {}
    for name, batches in tables.items():
        path = folder / f"{name}.{form}{'.gz' if gz else ''}"
        rows[path.name] = _write(path, form, batches, report if name == "steps" else lambda _: None)
    return {name: count for name, count in rows.items() if count}


def left_out(recording: Recording) -> list[str]:
    """Return the columns that CSV cannot hold: arrays of many numbers, or of varying length."""
    names = [
        column.name
        for name, table in Batches(recording).shape.tables.items()
        if name in _TABLES.values()
        for column in table.columns
        if not _is_plain(column)
    ]
    return list(dict.fromkeys(names))


def _is_plain(column: pa.Field) -> bool:
    """Return whether a column holds a number or a text in each row."""
    return not (pa.types.is_fixed_size_binary(column.type) or pa.types.is_list(column.type))


def _episode_count(recording: Recording, phase: str) -> int:
    """Return the number of episodes with steps, including one that did not end."""
    ended = recording.phase(phase).episodes.count()
    steps = int(recording.phase(phase).episodes.array(ended - 1, ended)[0]["last_step"]) + 1 if ended else 0
    return ended + (recording.phase(phase).steps.total() > steps)


def _with_episodes(
    batches: Iterator[pa.RecordBatch], recording: Recording, schema: pa.Schema
) -> Iterator[pa.RecordBatch]:
    """Yield extras with the places of their steps, whose table has this schema."""
    for batch in batches:
        steps = recording.phase(batch["phase"][0].as_py()).steps
        numbers = batch["step"].to_numpy()
        names = [name for name in _OF_STEP if name in (steps.row_dtype.names or ())]
        first, last = (batch["position"][k].as_py() * STEP_NANOSECONDS for k in (0, -1))
        blocks = steps.rows(range(first, last + 1))
        rows = [block[["step", *names]][np.isin(block["step"], numbers)] for block in blocks]
        known = np.concatenate([np.empty(0, steps.row_dtype)[["step", *names]], *rows])
        is_known = np.isin(numbers, known["step"])  # others were lost
        at = np.searchsorted(known["step"], numbers[is_known])
        for k, name in enumerate(names, batch.schema.get_field_index("step") + 1):
            kind = schema.field(name).type
            values = np.zeros(len(numbers), kind.to_pandas_dtype())
            values[is_known] = known[name][at]
            batch = batch.add_column(k, name, pa.array(values, kind, mask=~is_known))  # noqa: PLW2901
        yield batch


def _metrics(recording: Recording) -> Iterator[pa.RecordBatch]:
    """Yield a row for each value of a metric; its seconds of wall time are empty without a clock."""
    clock = wall_clock(recording)
    rows = (
        {
            **vars(moment),
            "run_id": recording.run_id,
            "seconds": None if clock is None else clock(moment.position),
            "metric": name,
            "value": value,
        }
        for moment in measures(recording)
        for name, value in moment.values.items()
    )
    while batch := list(islice(rows, _ROWS)):
        yield pa.RecordBatch.from_pylist(batch, _METRICS)


def _keys_of(recording: Recording, phase: str, numbers: Ints) -> list[int] | None:
    """Return a key of the steps and resets of each ended episode; None where one environment is alone.

    It is made of the environment and the episode as the rows count it, in their own environment; the phase
    counts the episodes of all as they ended.
    """
    records = recording.phase(phase)
    if not records.steps.have_turns:
        return None
    selected = map(records.episode, numbers[numbers < records.episodes.count()].tolist())
    return [steps.environment << _ENVIRONMENT_BITS | int(steps.one(0)["episode"]) for steps in selected]


def _selected(
    batches: Iterator[pa.RecordBatch], phase: str | None, numbers: Ints | None, keys: list[int] | None
) -> Iterator[pa.RecordBatch]:
    """Yield the rows of a phase and of the episodes of these numbers and `keys`, see `_keys_of`."""
    in_phase, in_environment = (None if ids is None else pa.array(ids, pa.int64()) for ids in (numbers, keys))
    for batch in batches:
        rows = batch if phase is None else batch.filter(pc.equal(batch["phase"], phase))
        names = set(rows.schema.names)
        if in_phase is not None and "episode" in names:
            selected, episode = in_phase, rows["episode"].cast(pa.int64())
            # The row of an ended episode, with its length, has its number in the phase.
            if in_environment is not None and "environment" in names and "length" not in names:
                environment = pc.shift_left(rows["environment"].cast(pa.int64()), _ENVIRONMENT_BITS)
                selected, episode = in_environment, pc.bit_wise_or(environment, episode)
            is_selected = pc.is_in(episode, selected)
            rows = rows.filter(pc.and_(is_selected, rows["taken"]) if "taken" in names else is_selected)
        if rows.num_rows:
            yield rows


def _write(path: Path, form: str, batches: Iterator[pa.RecordBatch], report: Callable[[int], None]) -> int:
    """Write batches into a file; return the number of rows. Without any there is no file."""
    first = next(batches, None)
    if first is None:
        return 0
    columns, rows = first.schema, 0
    with contextlib.ExitStack() as stack:
        if form == "csv":  # without bytes, and with texts in full where they are stored by number
            columns = pa.schema(
                [
                    (column.name, pa.string() if pa.types.is_dictionary(column.type) else column.type)
                    for column in columns
                    if _is_plain(column)
                ]
            )
            target = stack.enter_context(pa.output_stream(str(path)))  # compressed if its name ends in .gz
            options = pa.csv.WriteOptions(quoting_style="needed")
            writer: Any = pa.csv.CSVWriter(target, columns, write_options=options)
        else:
            writer = pa.parquet.ParquetWriter(str(path), columns, compression="zstd")
        stack.enter_context(writer)
        for batch in chain([first], batches):
            writer.write_batch(batch.select(columns.names).cast(columns) if form == "csv" else batch)
            rows += batch.num_rows
            report(rows)
    return rows


# --- metrics as named numbers -------------------------------------------------------------------------

_TRAINING: Final = (
    "mean_length",
    *(metric.field for metric in TABLE_METRICS),
    "epsilon",
    "step_size",
    "discount",
)
_EVALUATION: Final = {
    **{name: name for name in ("trials", "successes", "terminations")},
    **{metric.name: metric.field for metric in METRICS},
}
_EXACT: Final = {
    **{name: name for name in ("success_percent", "timeout_percent", "mean_length", "mean_penalties")},
    **{"mean_return": "mean_returns", "value": "values", "best_response": "best_responses"},
    **{f"optimal_{name}": f"optimal_{name}" for name in ("value", "success_percent", "mean_length")},
}
"""Name to field of a message, for each kind of metrics."""

EVENT_FILES: Final = ("events.out.tfevents.*",)


@dataclass(frozen=True)
class Measures:
    """The numbers of one moment."""

    phase: str
    """`train` or `eval`."""
    position: int
    """Environment steps executed before, of training and evaluation together: the logical time."""
    step: int
    """Training steps taken."""
    episode: int
    """Training episodes finished; for values that a loop logged in evaluation, episodes of evaluation."""
    values: Mapping[str, float]
    """By name, without the phase."""

    @property
    def by_phase(self) -> dict[str, float]:
        """The values by name, with the phase: `train/epsilon`."""
        return {f"{self.phase}/{name}": value for name, value in self.values.items()}


def measures(recording: Recording) -> Iterator[Measures]:
    """Yield reports of training, evaluations, their exact metrics, and the values that a loop logged."""
    agents = recording.agents
    exact_values = {f"exact/{name}": field for name, field in _EXACT.items()}
    for phase in PHASES:
        for row in recording.phase(phase).metrics.decoded():
            values = _named(row, {name: name for name in _TRAINING}, agents)
            rewards = zip(row["rewards"], row["reward_counts"], strict=True)
            values |= {f"reward_counts/{reward:g}": float(count) for reward, count in rewards}
            if phase == "eval":
                training = {f"training/{name}": value for name, value in values.items()}
                names = dict(_EVALUATION)
                if row["successes"] < 0:  # the environment does not define success
                    del names["successes"]
                events = _named(row, {"events": "events"}, recording.environment["event_names"])
                values = _named(row, names, agents) | events | training
            yield _measures(phase, row, values)
    for row in recording.table(schema.OPTIMALITY_TOPIC).decoded():
        yield _measures("eval", row, _named(row, exact_values, agents))
    for scalar in recording.table(SCALAR_TOPIC).decoded():
        if math.isfinite(scalar["value"]):
            position = scalar["log_time"] // STEP_NANOSECONDS
            step = training_steps_before(scalar)
            values = {f"logged/{scalar['name']}": scalar["value"]}
            yield Measures(scalar["phase"], position, step, scalar["episode"], values)


def episodes(recording: Recording, phase: str) -> Iterator[Measures]:
    """Yield length and return of each episode of a phase, at its last step: `episode/return/AGENT`."""
    names = ["episode/length"] + [f"episode/return/{agent}" for agent in recording.agents]
    for block in recording.phase(phase).episodes.blocks():
        columns = (
            block[field].tolist() for field in ("log_time", "episode", "last_step", "length", "returns")
        )
        for time, episode, last_step, length, returns in zip(*columns, strict=True):
            position = time // STEP_NANOSECONDS
            step = last_step + 1 if phase == "train" else position - last_step - 1
            values = zip(names, [float(length), *returns], strict=True)
            yield Measures(phase, position, step, episode, _finite(values))


def wall_clock(recording: Recording) -> Callable[[int], float] | None:
    """Return a function that returns the seconds that had passed at a position; None without a clock.

    The clock of a run that several processes recorded is that of one of them: it does not count.
    """
    clock = read_clock(recording)
    if clock is None or recording.shards:
        return None
    return lambda position: float(np.interp(position, clock.positions, clock.seconds))


def times(recording: Recording) -> Callable[[int], float]:
    """Return a function that returns the time of a position in seconds since 1970.

    Where no clock was recorded, logical time is added to the time at which the run was created.
    """
    began = recording.created.timestamp()
    passed = wall_clock(recording) or (lambda position: position * STEP_NANOSECONDS / 1e9)
    return lambda position: began + passed(position)


def _measures(phase: str, row: Message, values: Mapping[str, float]) -> Measures:
    return Measures(phase, row["log_time"] // STEP_NANOSECONDS, row["step"], row["episode"], values)


def _named(row: Message, fields: Mapping[str, str], owners: Sequence[str]) -> dict[str, float]:
    """Return the known values of fields by name; a list has a value for each owner, `NAME/OWNER`."""
    values: dict[str, float] = {}
    for name, field in fields.items():
        if isinstance(value := row.get(field), list):
            parts = zip(owners, value, strict=bool(value))  # older recordings lack a newer measure
            values |= _finite((f"{name}/{owner}", float(part)) for owner, part in parts)
        elif value is not None:
            values |= _finite([(name, float(value))])
    return values


def _finite(values: Iterable[tuple[str, float]]) -> dict[str, float]:
    return {name: value for name, value in values if math.isfinite(value)}


def require_tensorboard() -> None:
    """Check that the writer is installed."""
    require("tensorboardX", extra="tensorboard", purpose="export tensorboard")


def write_events(recording: Recording, folder: Path) -> int:
    """Write the event file of a run into a folder; return how many numbers it has.

    Each number is at its training step, under its name of `runner.export.tables`; length and return of an
    episode are at its last step.
    """
    from tensorboardX.proto.event_pb2 import Event
    from tensorboardX.proto.summary_pb2 import Summary
    from tensorboardX.record_writer import RecordWriter

    began = recording.created.timestamp()
    at = times(recording)
    count = 0
    writer = RecordWriter(str(folder / f"events.out.tfevents.{int(began)}.{recording.run_id}"))
    try:
        writer.write(Event(wall_time=began, file_version="brain.Event:2").SerializeToString())
        for moment in chain(measures(recording), episodes(recording, "train")):
            numbers = [Summary.Value(tag=name, simple_value=x) for name, x in moment.by_phase.items()]
            event = Event(wall_time=at(moment.position), step=moment.step, summary=Summary(value=numbers))
            writer.write(event.SerializeToString())
            count += len(numbers)
    finally:
        writer.close()
    return count
