"""The index of episodes: what `find` asks about them, a file for each run in the user's cache.

    episodes/RUN-HEX.parquet     a row for each episode: its columns, and of its steps the counts of flags,
                                 events and actions, and least, greatest and last numbers
    episodes/packs/HEX.parquet   the rows of some sixty of these files, to open one instead

It is made from the run's own tables when it is first asked for. HEX has hashes of the recording's path and
state, and of the facts in the file's metadata. An index of another state is not found.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import pyarrow as pa
import pyarrow.parquet as pq
from blake3 import blake3

from runner.analysis.evaluations import Evaluation, evaluations_of
from runner.archive import layout
from runner.archive.batches import Batches
from runner.archive.columns import Shape
from runner.archive.places import at_hand
from runner.environments.naming import action_names, actions_in_words
from runner.errors import RecordingError
from runner.query.conditions import ENDS, Facts, quoted
from runner.query.views import SelectedRuns
from runner.recording.reader import Recording, open_recording
from runner.runs.catalogue.columns import IndexRow
from runner.runs.listing import listed_run
from runner.runs.run import RECORDING_FILE, RUN_FILE
from runner.util.files import EPISODES, cache_folder, remove_oldest, replacing, storage_errors

if TYPE_CHECKING:
    from runner.query.chunks import Relation

MAX_FILES: Final = 20_000
_VERSION: Final = 6
_PACKED: Final = 64
"""The files that a pack has in the mean."""
_LEAST: Final = 8
"""The fewest files for which a pack is made, or read."""
_HEX: Final = 16
"""The digits of each hash in a name."""
_MAX_COLUMNS: Final = 64
"""The most numbers of steps, and the most actions, that are in an index."""
_NOT_INDEXED: Final = ("run", "phase", "position", "step", "episode", "environment")
_PLAIN: Final = ("phase", "episode", "first_step", "last_step", "length", "penalties", "return", *ENDS[1:])
_AT: Final = (
    "CASE WHEN phase = 'train' THEN '' || episode WHEN episode < stop "
    "THEN 'eval:' || after || ':' || (episode - start) ELSE 'eval:-1:' || episode END"
)
"""The text of a reference to an episode."""
_COUNTED: Final = "row_number() OVER (PARTITION BY phase, environment ORDER BY episode) - 1"
"""The number by which steps of several environments name their episode."""


class EpisodeIndex:
    """The files of the index, made by a connection to DuckDB."""

    def __init__(self, connection: Any) -> None:
        self.folder = cache_folder() / EPISODES
        self._connection = connection
        with storage_errors(self.folder):
            (self.folder / "packs").mkdir(parents=True, exist_ok=True)
            written = self.folder.glob("[!.]*-*.parquet")  # a hidden one is being written by another search
            self._files = {path.stem[:-_HEX]: path for path in written}
        self.read = set[Path]()
        """The files that were asked for, their packs, and what else is packed there."""
        self._of_runs = defaultdict[str, list[Path]](list)
        for stem, path in self._files.items():
            self._of_runs[stem[:-_HEX]].append(path)

    def file(self, row: IndexRow, runs: SelectedRuns) -> Path:
        """Return the file of a run, which is made if it is missing.

        Raises:
            RunnerError: the run has no episodes, is damaged, or its archive cannot be reached.
        """
        name = RUN_FILE if row["status"] == "archived" else RECORDING_FILE
        path = Path(row["root"], row["entry"], name)
        with storage_errors(path):
            state = path.stat()
        start = f"{row['id']}-{_hash(str(path))}"
        stem = start + _hash([_VERSION, state.st_mtime_ns, state.st_size, state.st_ino])
        if stem not in self._files:
            for older in self._of_runs[start]:  # a search that reads it now begins again
                older.unlink(missing_ok=True)
                self._files.pop(older.stem[:-_HEX], None)
            self._files[stem] = self._make(row, runs, stem)
        self.read.add(self._files[stem])
        return self._files[stem]

    def trim(self) -> None:
        """Remove the oldest files beyond the limit."""
        remove_oldest(self.folder, "*.parquet", keep=MAX_FILES)
        remove_oldest(self.folder / "packs", "*.parquet", keep=MAX_FILES // _LEAST)

    def packs(self, files: Set[Path]) -> Iterator[tuple[Path, list[Path]]]:
        """Yield packs of files with the same facts, each with all files that are in it.

        The files, by their age, are cut where a name says so. Thus a pack is made once, and a new file, which
        comes last, changes none. It is named by its files and their times. Packs of other files are removed.
        """
        kind, group = kind_of(next(iter(files))), list[tuple[int, str]]()
        folder, kept = self.folder / "packs", set[Path]()
        alike = [path for path in self._files.values() if kind_of(path) == kind]
        for changed, path in sorted((path.stat().st_mtime_ns, str(path)) for path in alike):
            group.append((changed, path))
            if int(Path(path).stem[-2 * _HEX : -_HEX], 16) % _PACKED:
                continue
            packed, pack = [Path(path) for _, path in group], folder / f"{kind}-{_hash(group)}.parquet"
            group.clear()
            kept.add(pack)
            if len(files & set(packed)) >= _LEAST:
                self.read.update(packed)
                if not pack.exists():
                    self._pack(packed, pack)
                self.read.add(pack)
                yield pack, packed
        for other in folder.glob(f"{kind}-*"):
            if other not in kept:
                other.unlink(missing_ok=True)

    def _pack(self, files: Sequence[Path], pack: Path) -> None:
        with storage_errors(pack), replacing(pack) as fresh:
            self._connection.execute(
                "COPY (SELECT file_index::BIGINT AS part, file_row_number AS row, * FROM "
                f"read_parquet([{', '.join(literal(str(path)) for path in files)}])) TO "
                f"{literal(str(fresh))} (FORMAT parquet, COMPRESSION zstd, ROW_GROUP_SIZE 30720)"
            )

    def _make(self, row: IndexRow, runs: SelectedRuns, stem: str) -> Path:
        """Make the file of a run."""
        episodes, own_steps = (runs.table(name, [row]) for name in ("episodes", "steps"))
        runs.left_out.get(row["id"], {}).pop("steps", None)  # a run need not have steps
        _check(row, runs)
        run = at_hand(listed_run(Path(row["root"], row["entry"]), row["id"]))
        with open_recording(run.recording) as recording:
            if row["status"] == "finished" != recording.status:
                raise RecordingError(
                    f"{run.recording}: is cut off, though its run is finished; `dualtaxi verify` says where."
                )
            shape, unknown = Batches(recording).shape, Evaluation(-1, 0, -1, -1)
            evaluations = pa.Table.from_pylist(list(map(vars, (unknown, *evaluations_of(recording)))))
            actions = _names_of_actions(shape, recording)
        self._connection.register("episodes", episodes)
        self._connection.register("evaluations", evaluations)
        steps = register_steps(
            self._connection, own_steps, runs.table("extras", [row]) if shape.extras else None
        )
        episodes = episodes.schema
        plain = [name for name in episodes.names if name in _PLAIN or name.startswith(("return_", "n_"))]
        if shape.mdp is not None and shape.mdp.success_events:
            plain.append("success")
        environment, own = ("environment", _COUNTED) if "environment" in episodes.names else ("0", "episode")
        numbers = {column.name for column in episodes if pa.types.is_floating(column.type)}
        columns = ", ".join(
            f"nullif({quoted(name)}, 'NaN') AS {quoted(name)}" if name in numbers else quoted(name)
            for name in plain
        )
        rows = (
            f"SELECT {columns}, {environment} AS environment, {own} AS own, {_AT} AS at FROM episodes "
            "ASOF LEFT JOIN evaluations ON episode >= start"
        )
        if aggregates := _aggregates(shape, steps):
            rows = with_steps(rows, steps, aggregates, {})
        facts = json.dumps(asdict(Facts([*plain, *aggregates], actions)))
        path = self.folder / f"{stem}{_hash(facts)}.parquet"
        with storage_errors(path), replacing(path) as fresh:
            self._connection.execute(
                f"COPY (FROM ({rows}) ORDER BY phase DESC, episode) TO {literal(str(fresh))} "
                f"(FORMAT parquet, COMPRESSION zstd, KV_METADATA {{facts: {literal(facts)}}})"
            )
            _check(row, runs)
        return path


def _check(row: IndexRow, runs: SelectedRuns) -> None:
    """Raise the error for which a run was left out."""
    for sentence in runs.left_out.get(row["id"], {}).values():
        raise RecordingError(sentence)


def kind_of(path: Path) -> str:
    """Return the hash of the facts in an index."""
    return path.stem[-_HEX:]


def facts_of(path: Path) -> Facts:
    """Return what the episodes and steps of the run of an index have."""
    return Facts(**json.loads(pq.read_schema(path).metadata[b"facts"]))


def register_steps(connection: Any, steps: Relation, extras: Relation | None) -> pa.Schema:
    """Register the view `steps` with columns for extras, and return its columns.

    An extra that a step lacks is NULL, a flag false.
    """
    connection.register("own_steps", steps)
    joined, columns, more = "", "own_steps.*", []
    if extras is not None and "step" in steps.schema.names:
        connection.register("extras", extras)
        joined = "LEFT JOIN extras USING (phase, step)"
        more = [column for column in extras.schema if column.name.startswith(layout.EXTRA_PREFIX)]
        for column in more:
            name = f"extras.{quoted(column.name)}"
            if pa.types.is_boolean(column.type):
                name = f"coalesce({name}, FALSE) AS {quoted(column.name)}"
            columns += f", {name}"
    connection.execute(f"CREATE OR REPLACE TEMP VIEW steps AS SELECT {columns} FROM own_steps {joined}")
    return pa.schema([*steps.schema, *more])


def with_steps(
    chosen: str,
    steps: pa.Schema,
    aggregates: Mapping[str, str],
    windows: Mapping[str, str],
    among: str = "TRUE",
) -> str:
    """Return SQL for episodes and aggregates of their steps, which are NULL where steps were lost.

    Args:
        chosen: SQL for the episodes.
        steps: the columns of the view `steps`. NaN in them is NULL.
        aggregates: the SQL of each, by name.
        windows: columns of steps that these need, the SQL of each by name.
        among: a condition on the steps to read.
    """
    numbers = [quoted(one.name) for one in steps if pa.types.is_floating(one.type)]  # rewards, at least
    replaced = ", ".join(f"nullif({name}, 'NaN') AS {name}" for name in numbers)
    environment = "" if "environment" in steps.names else ", 0 AS environment"
    more, parts = (
        "".join(f", {sql} AS {quoted(name)}" for name, sql in named.items())
        for named in (windows, aggregates)
    )
    read = f"SELECT * REPLACE ({replaced}){environment} FROM steps WHERE {among}"
    return (
        f"SELECT chosen.*, s.* EXCLUDE (of, turn, own, n) FROM ({chosen}) chosen LEFT JOIN "
        f"(SELECT phase AS of, environment AS turn, episode AS own, count(*) AS n{parts} "
        f"FROM (SELECT *{more} FROM ({read})) GROUP BY ALL) s "
        "ON of = phase AND turn = environment AND s.own = chosen.own AND n = length"
    )


def literal(text: str) -> str:
    """Return a text in SQL."""
    return "'" + text.replace("'", "''") + "'"


def _hash(value: object) -> str:
    return blake3(json.dumps(value).encode()).hexdigest()[:_HEX]


def _aggregates(shape: Shape, steps: pa.Schema) -> dict[str, str]:
    """Return the columns of the index that need steps, with their SQL."""
    numbers = [one.name for one in steps if pa.types.is_integer(one.type) or pa.types.is_floating(one.type)]
    columns = {
        f"{function}({name})": f"CASE WHEN count({{0}}) = count(*) THEN {sql} END".format(quoted(name))
        for name in [name for name in numbers if name not in _NOT_INDEXED][:_MAX_COLUMNS]
        for function, sql in (("min", "min({0})"), ("max", "max({0})"), ("last", "arg_max({0}, step)"))
    }
    flags = [one.name for one in steps if pa.types.is_boolean(one.type)]
    columns |= {f"count({name})": f"count_if({quoted(name)})" for name in flags}
    return columns | {
        f"count({name} == {k})": f"count_if({quoted(name)} = {k})"
        for name, values in shape.action_values.items()
        if name in numbers and len(values) <= _MAX_COLUMNS
        for k in values
    }


def _names_of_actions(shape: Shape, recording: Recording) -> dict[str, list[str]]:
    """Return the names of actions by number, by the column of steps."""
    if shape.mdp is None or (names := action_names(shape.mdp)) is None:
        named = {}
        space = recording.spaces.get("action", {})
        for agent, part in (space["spaces"] if len(recording.agents) > 1 else {"": space}).items():
            if recording.has_states or not part.get("start"):  # names are by number from 0
                column = "_".join(filter(None, ("action", agent.replace(".", "_"))))
                named[column] = list(recording.train.action_names(agent))
        return named
    own = dict(zip(shape.own_actions, names, strict=False))
    return {"action": list(actions_in_words(shape.mdp))} | own
