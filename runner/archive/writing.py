"""Write a recording as an archive: tables of Parquet, its metadata and attachments, and a manifest.

The tables of the run, of states, actions and transitions are for readers only.

Memory does not grow with the run: blocks of records become batches of columns, written in row groups.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Final, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from blake3 import blake3

from runner.archive import layout
from runner.archive.batches import Batches
from runner.archive.columns import Shape, Table
from runner.archive.layout import Entry, Manifest, entries_of, is_attachment
from runner.environments.mdp import Mdp
from runner.environments.naming import actions_in_words, states_in_words
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.description import recorded_facts
from runner.recording.layout import message_record
from runner.recording.marks import MARKS_FILE, Marks, read_marks
from runner.recording.messages import QTable, decode_q_table, encode_q_table
from runner.recording.metadata import kind_of
from runner.recording.reader import Recording
from runner.replay.tables import DerivedTables, StepReplay
from runner.runs.checkpoints import read_checkpoints
from runner.util.files import write_object
from runner.util.processes import Report

ROWS_A_GROUP: Final = 1 << 18
BYTES_A_GROUP: Final = 32 << 20
PAGE_BYTES: Final = 1 << 18
LEVEL: Final = 9
"""The zstd level: a higher one saves a tenth of a byte per step, and takes three times as long."""


def write_archive(recording: Recording, folder: Path, report: Report = lambda _: None) -> Manifest:
    """Write a recording into a folder as an archive, the manifest last; return the manifest.

    Args:
        folder: an empty folder.

    Raises:
        OSError: the folder cannot be written.
    """
    manifest = _ArchiveWriter(recording, folder, report).write()
    (folder / layout.MANIFEST).write_bytes(manifest.to_json())
    return manifest


class TableWriter:
    """A Parquet file that is being written; batches are compressed a row group at a time."""

    def __init__(self, path: Path, columns: pa.Schema) -> None:
        encodings = layout.encodings_of(columns)
        self._writer = pq.ParquetWriter(
            path,
            columns,
            compression="zstd",
            compression_level=LEVEL,
            data_page_size=PAGE_BYTES,
            use_dictionary=[name for name in columns.names if name not in encodings] if encodings else True,
            column_encoding=encodings or None,
        )
        self._waiting: list[pa.RecordBatch] = []
        self._rows = 0
        self._bytes = 0

    def add(self, batch: pa.RecordBatch) -> None:
        """Add rows."""
        self._waiting.append(batch)
        self._rows += batch.num_rows
        self._bytes += batch.nbytes
        if self._rows >= ROWS_A_GROUP or self._bytes >= BYTES_A_GROUP:
            self.flush()

    def flush(self) -> None:
        """Write the rows that were added as a row group, if there are any."""
        if self._waiting:
            self._writer.write_table(pa.Table.from_batches(self._waiting), self._rows)
        self._waiting = []
        self._rows = 0
        self._bytes = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if kind is None:
                self.flush()
        finally:
            self._writer.close()


class _ArchiveWriter:
    """Writes one recording as an archive."""

    def __init__(self, recording: Recording, folder: Path, report: Report) -> None:
        self._recording = recording
        self._folder = folder
        self._report = report
        self._where = str(recording.path)
        self._batches = Batches(recording)

    def write(self) -> Manifest:
        """Write all but the manifest."""
        self._write_descriptions()
        for table in self._batches.shape.tables.values():
            if table.name in layout.LEFT_OUT_IF_EMPTY and not any(map(self._recording.table, table.topics)):
                continue
            with TableWriter(self._folder / table.name, table.columns) as writer:
                if table.gives_tables:
                    self._write_learning(table, writer)
                    continue
                for batch in self._batches.of(table):
                    writer.add(batch)
                    self._report(self._batches.steps)
        self._copy_contents()
        if (marks := read_marks(self._recording.path.parent)) != Marks():
            write_object(self._folder / MARKS_FILE, marks.as_json())
        topics = self._batches.entries
        self._compare(topics)
        facts = recorded_facts(self._recording) | {"name": self._recording.name}
        run = {key: facts[key] for key in ("run_id", "name", "seed", "created", "status")}
        run |= {"content_digest": self._recording.result.content_digest, "lost": self._recording.lost}
        return Manifest(run, topics, entries_of(self._folder))

    def _compare(self, topics: dict[str, Entry]) -> None:
        """Compare the messages with the digests in the recording's result."""
        result = self._recording.result
        stated = result.topic_digests
        left_out = set() if result.steps_recorded else set(schema.STEP_TOPICS)
        compared = (stated.keys() | topics.keys()) & schema.DIGESTED - left_out if stated else set()
        for name in sorted(compared):
            found = topics[name].blake3 if name in topics else "nothing"
            if found != stated.get(name):
                raise RecordingError(
                    f"{self._where}: {name}: found {found}, expected {stated.get(name, 'nothing')} "
                    "by its result: it is damaged."
                )

    def _write_descriptions(self) -> None:
        recording = self._recording
        attachments = []
        for name, media_type, data in recording.file.attachments():
            if not is_attachment(name):
                raise RecordingError(
                    f"{self._where}: found an attachment {name!r}, expected a relative path that is not "
                    "the path of an archive's own file."
                )
            attachments.append([name, media_type])
            path = self._folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        metadata = [[name, recording.file.metadata(name)] for name in recording.file.metadata_names]
        description = {"metadata": metadata, "attachments": attachments}
        (self._folder / layout.METADATA).write_text(json.dumps(description, indent=1), encoding="utf-8")
        tables = {layout.RUN: run_table(recording)}
        if recording.tabular:
            mdp, shape = recording.mdp, self._batches.shape
            tables[layout.TRANSITIONS] = _transitions(mdp, shape)
            tables |= {layout.STATES: _states(mdp, shape), layout.ACTIONS: _actions(mdp, shape)}
        for name, table in tables.items():
            pq.write_table(table, self._folder / name, compression="zstd", compression_level=LEVEL)

    def _copy_contents(self) -> None:
        """Copy the contents of the checkpoints that are in the store next to the run."""
        recordings = self._recording.path.absolute().parent.parent
        for checkpoint in read_checkpoints(self._recording, recordings):
            path = self._folder / f"{layout.CONTENTS}{checkpoint.digest}"
            if checkpoint.is_here and not path.exists():
                checkpoint.check()
                path.parent.mkdir(exist_ok=True)
                shutil.copyfile(checkpoint.path, path)

    def _write_learning(self, table: Table, steps: TableWriter) -> None:
        """Write the steps of a job, and its snapshots, which follow from them."""
        recording = self._recording
        seed = recording.seed or 0
        replay = StepReplay(recording.config, recording.mdp, seed, self._where)
        with TableWriter(self._folder / layout.Q_TABLES, layout.Q_TABLE_COLUMNS) as snapshots:
            tables = DerivedTables(
                replay,
                self._snapshots(),
                lambda tables, found: snapshots.add(self._snapshot_row(tables, *found)),
            )
            for topic, records, batch in self._batches.blocks(table):
                steps.add(batch)
                if topic is schema.TRAIN_STEP:
                    tables.take(records)
                self._report(self._batches.steps)
            tables.finish()

    def _snapshots(self) -> Iterator[tuple[int, tuple[int, QTable]]]:
        """Yield the step of each snapshot, and the snapshot with its position."""
        topic = schema.Q_TABLE_TOPIC
        for number, (time, payload) in enumerate(self._recording.table(topic).messages()):
            table = decode_q_table(payload)
            position, rest = divmod(time, schema.STEP_NANOSECONDS)
            if rest or encode_q_table(table) != payload:
                raise self._batches.unarchivable(topic, number)
            self._batches.count(topic, message_record(topic, time, payload), 1)
            yield table.step, (position, table)

    def _snapshot_row(
        self, tables: DerivedTables[tuple[int, QTable]], position: int, table: QTable
    ) -> pa.RecordBatch:
        """Return the row of a snapshot; of values that the steps before it give, only their hash."""
        derived = tables.at(table.step, table.table)
        data = table.values.tobytes()
        is_derived = derived is not None and derived.tobytes() == data
        if not is_derived:
            tables.give(table.step, table.table, table.values)
        states, actions = table.values.shape
        row = {
            "run_id": self._batches.shape.run_id,
            "position": position,
            "step": table.step,
            "episode": table.episode,
            "agent": table.agent,
            "table": table.table,
            "states": states,
            "actions": actions,
            "blake3": blake3(data).hexdigest(),
            "data": None if is_derived else data,
        }
        return pa.RecordBatch.from_pylist([row], layout.Q_TABLE_COLUMNS)


_RUN_TYPES: Final = {
    "seed": pa.uint64(),
    "created": pa.timestamp("ms", tz="UTC"),
    **dict.fromkeys(("episodes", "train_steps", "eval_steps"), pa.int64()),
    "environments": pa.int32(),
}
"""The types of the columns of a run that are no text."""


def run_table(recording: Recording) -> pa.Table:
    """Return the table with one row that describes a run."""
    facts = recorded_facts(recording)
    summary = facts["summary"]
    result = recording.file.metadata("result") if "result" in recording.file.metadata_names else {}
    columns = {
        "run_id": facts["run_id"],
        "name": recording.name,
        "seed": facts["seed"],
        "job": recording.run["job"],
        "status": facts["status"],
        "created": recording.created,
        **{key: summary.get(key) for key in ("content_digest", "episodes", "train_steps", "eval_steps")},
        "kind": kind_of(recording.run),
        "env_id": str(recording.environment.get("env_id")),
        "environments": recording.environments,
        "spaces": recording.run.get("spaces"),
        "config": json.dumps(recording.config),
        "result": result["json"] if result else "{}",
        "provenance": json.dumps(recording.provenance),
    }
    try:
        return pa.table(
            {name: pa.array([value], _RUN_TYPES.get(name, pa.string())) for name, value in columns.items()}
        )
    except (pa.ArrowException, OverflowError) as error:
        raise RecordingError(f"{recording.path}: its result is invalid ({error}).") from error


def _transitions(mdp: Mdp, shape: Shape) -> pa.Table:
    possible = mdp.probability > 0
    state, action, _ = np.nonzero(possible)
    columns: dict[str, object] = {
        "state": state.astype(np.int32),
        "action": action.astype(np.int32),
        "next_state": mdp.next_state[possible],
        "probability": mdp.probability[possible],
        "reward": mdp.rewards.sum(axis=-1)[possible],
        "terminated": mdp.terminated[possible],
    }
    events = mdp.events[possible]
    for i, name in enumerate(shape.event_columns):
        columns[name] = ((events >> np.uint32(i)) & 1).astype(np.int32)
    return _table(columns, shape)


def _states(mdp: Mdp, shape: Shape) -> pa.Table:
    columns: dict[str, object] = {
        "state": np.arange(mdp.states, dtype=np.int32),
        "words": states_in_words(mdp).tolist(),
        "start_probability": mdp.start,
    }
    if mdp.scene is not None and mdp.scene_cells is not None:
        names = [f"{i + 1}" for i in range(mdp.scene_cells.shape[1])]
        given = [str(thing["name"]) for thing in mdp.scene["things"]]
        names = given if len(set(given)) == len(names) else names
        for i, name in enumerate(names):
            row, column = np.divmod(mdp.scene_cells[:, i], mdp.scene["columns"])
            columns |= {f"{name}_row": row.astype(np.int32), f"{name}_column": column.astype(np.int32)}
    return _table(columns, shape)


def _actions(mdp: Mdp, shape: Shape) -> pa.Table:
    action = np.arange(mdp.joint_actions, dtype=np.int32)
    columns: dict[str, object] = {"action": action, "words": actions_in_words(mdp).tolist()}
    if shape.own_actions:
        actions = mdp.own_actions.T.astype(np.int32)
        columns |= dict(zip(shape.own_actions, actions, strict=True))
    return _table(columns, shape)


def _table(columns: dict[str, object], shape: Shape) -> pa.Table:
    table = pa.table(columns)
    run_id = pa.array([shape.run_id] * len(table)).dictionary_encode().cast(layout.TEXT)
    return table.add_column(0, pa.field("run_id", layout.TEXT), run_id)
