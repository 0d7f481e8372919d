"""The index of episodes, a file for each run in the user's cache, and conditions on episodes as SQL over it.

    episodes/RUN-HEX.parquet   a row for each episode: its columns, and of its steps the counts of flags,
                               events and actions, and least, greatest and last numbers

It is made from the run's own tables when it is first asked for. HEX has hashes of the recording's path and
state, and of the facts in the file's metadata. An index of another state is not found.

A condition is what `find` asks:

    ret < -100 and count(collision) >= 2 and length > 50
    any(next_observation[2] > 0.2) or then(pickup, drop_off, within=5)

A function of steps is a column of the index, follows from its columns, or is NULL. The condition is NULL for
episodes that this leaves open. Of those alone the steps are read, and the function is an aggregate of them.
"""

from __future__ import annotations

import ast
import glob
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final

import pyarrow as pa
import pyarrow.parquet as pq
from blake3 import blake3

from runner.analysis.evaluations import Evaluation, evaluations_of
from runner.archive import layout
from runner.archive.batches import Batches
from runner.archive.columns import Shape
from runner.archive.places import at_hand
from runner.environments.naming import action_names
from runner.errors import RecordingError, RunnerError, nearest
from runner.query.sql import Database
from runner.query.sql_views import SelectedRuns
from runner.recording.reader import Recording, open_recording
from runner.runs.catalogue.columns import IndexRow
from runner.runs.run import RECORDING_FILE, RUN_FILE, listed_run
from runner.util.expressions import CONDITION, NUMBER, TEXT, Operation, Parser, Term, spelt
from runner.util.files import CACHED_EPISODES, cache_folder, remove_oldest, replacing, storage_errors

if TYPE_CHECKING:
    from runner.query.chunks import Relation

ENDS: Final = ("success", "terminated", "truncated")
"""The conditions of an episode."""
AGGREGATES: Final[dict[Any, tuple[str, str]]] = {
    "any": ("coalesce(bool_or({0.sql}), FALSE)", "{0.high}"),
    "never": ("NOT coalesce(bool_or({0.sql}), FALSE)", "(NOT {0.high})"),
    "all": ("coalesce(bool_and({0.sql}), TRUE)", "{0.low}"),
    "count": ("count_if({0.sql})", "CASE WHEN NOT {0.high} THEN 0 WHEN {0.low} THEN length END"),
    "then": ("coalesce(bool_or({0.sql} AND {1.sql}), FALSE)", "({0.high} AND {1.high} AND NULL)"),
    "min": ("min({0.sql})", "{0.low}"),
    "max": ("max({0.sql})", "{0.high}"),
    "sum": ("nullif(sum({0.sql}), 'NaN')", "NULL"),
    "first": ("arg_min({0.sql}, step)", "NULL"),
    "last": ("arg_max({0.sql}, step)", "NULL"),
}
"""The functions of an episode's steps, and what the index says of them if it has no column for them."""
_OF_NUMBERS: Final = ("min", "max", "sum", "first", "last")
_LOGIC: Final = (ast.Not, ast.And, ast.Or)
_BOUNDS: Final[dict[Operation, tuple[str, str]]] = {
    ast.Not: ("(NOT {0.high})", "(NOT {0.low})"),
    ast.And: ("({0.low} AND {1.low})", "({0.high} AND {1.high} AND NULL)"),
    ast.Or: ("({0.low} OR {1.low} OR NULL)", "({0.high} OR {1.high})"),
    ast.Lt: ("({0.high} < {1.low})", "({0.low} < {1.high})"),
    ast.LtE: ("({0.high} <= {1.low})", "({0.low} <= {1.high})"),
    ast.Gt: ("({0.low} > {1.high})", "({0.high} > {1.low})"),
    ast.GtE: ("({0.low} >= {1.high})", "({0.high} >= {1.low})"),
    ast.Eq: (
        "({0.low} = {1.high} AND {0.high} = {1.low})",
        "({0.low} <= {1.high} AND {0.high} >= {1.low} AND NULL)",
    ),
}
"""Over the index, whether a condition holds at all steps of an episode, and whether it holds at some."""
_EXCLUDABLE: Final = "a filter of runs can exclude it"
_MAX_WITHIN: Final = 2**31 - 1
_OF_STEPS: Final = re.compile(r"(?:min|count)\((?!.* == )(.*)\)|n_(.*)")
"""A column of the index for each column of steps, and for each event, which may be known without steps."""


@dataclass(frozen=True)
class Facts:
    """What the episodes and steps of a run have."""

    index: Sequence[str]
    """The columns of the index: of episodes, and functions of steps such as `count(collision)`."""
    actions: Mapping[str, Sequence[str]]
    """The names of actions by number, by the column of steps."""

    def columns(self, of_steps: bool) -> dict[str, str]:
        """Return the columns of steps, or of episodes, by their names in expressions."""
        matches = map(_OF_STEPS.fullmatch, self.index)
        steps = [match[1] or match[2] for match in matches if match]
        columns = steps if of_steps else [name for name in self.index if "(" not in name and name != "phase"]
        return {re.sub("^return(?=_|$)", "ret", spelt(column)): column for column in columns}


def quoted(name: str) -> str:
    """Return a name in SQL."""
    return '"' + name.replace('"', '""') + '"'


class NotInRun(RunnerError):
    """A run does not have what an expression names; `reason` says so of it."""

    def __init__(self, error: RunnerError, reason: str) -> None:
        super().__init__(str(error))
        self.reason = reason


@dataclass(frozen=True)
class Part(Term):
    """A part of a condition in SQL."""

    sql: str
    low: str = "NULL"
    """Over the index: its least value at the steps of an episode; of a condition, whether it always holds."""
    high: str = "NULL"
    """Its greatest value; of a condition, whether it holds at some step."""
    label: str = ""
    """What the index calls it."""
    value: float | str | None = None
    """The value of a constant."""


@dataclass
class EpisodeParser(Parser[Part]):
    """Parses a condition on episodes, or a number to sort them by."""

    given: str
    facts: Facts
    reads_steps: bool = False
    """Whether `aggregates` are columns, as steps were read; else the index alone is asked."""
    aggregates: dict[str, str] = field(default_factory=dict)
    """The functions of steps in it, the SQL of each by name."""
    windows: dict[str, str] = field(default_factory=dict)
    """The columns of steps that they need, the SQL of each by name."""
    what = "expression"
    example = "ret < -100 and count(collision) >= 2"
    max_length = 1_000
    max_nodes = 300
    max_number = 2**53
    operations: ClassVar[Mapping[Operation, Any]] = {
        ast.And: "({} AND {})",
        ast.Or: "({} OR {})",
        ast.Not: "(NOT {})",
        ast.UAdd: "{}",
        ast.USub: "(- {}::DOUBLE)",
        ast.Add: "nullif({}::DOUBLE + {}, 'NaN')",
        ast.Sub: "nullif({}::DOUBLE - {}, 'NaN')",
        ast.Mult: "nullif({}::DOUBLE * {}, 'NaN')",
        ast.Div: "nullif({}::DOUBLE / {}, 'NaN')",
        ast.Lt: "({} < {})",
        ast.LtE: "({} <= {})",
        ast.Gt: "({} > {})",
        ast.GtE: "({} >= {})",
        ast.Eq: "({} = {})",
        "abs": "abs({}::DOUBLE)",
        **AGGREGATES,
    }
    expected = f"expected comparisons, and, or, not, in, + - * /, abs(), {'(), '.join(AGGREGATES)}()"
    not_numbers = {TEXT: "a number; names are compared to actions, with == or !="}  # noqa: RUF012
    _is_inside: bool = False

    def __post_init__(self) -> None:
        super().__init__(self.given)

    def fixed(self, kind: str, value: float | str) -> Part:
        """Return a constant; the SQL of a text is never used."""
        sql = f"'{value!r}'::DOUBLE" if kind == NUMBER else repr(value)
        return Part(kind, sql, sql, sql, repr(value), value)

    def applied(self, kind: str, operation: Operation, *parts: Part) -> Part:
        """Return an operation on one or two terms, and what the index knows of it."""
        left, right = parts[0], parts[-1]
        if operation is ast.USub and isinstance(left.value, int | float):
            return self.fixed(kind, -left.value)
        sql = self.operations[operation].format(*(part.sql for part in parts))
        if not self._is_inside or operation not in _BOUNDS:
            return Part(kind, sql)
        low, high = (text.format(*parts) for text in _BOUNDS[operation])
        if operation in _LOGIC:
            return Part(kind, sql, low, high)
        label = f"{left.label} == {right.label}" if operation is ast.Eq else ""
        counted = self._flag(Part(kind, f"coalesce({sql}, FALSE)", label=label))
        is_known = counted.high != "NULL" or left.value is right.value is None
        return counted if is_known else replace(counted, low=low, high=high)

    def _flag(self, part: Part) -> Part:
        """Return a condition on steps, which the index may count."""
        if (count := self._column("count", part)) == "NULL":
            return part
        return replace(part, low=f"({count} >= length)", high=f"({count} > 0)")

    def _column(self, function: str, part: Part) -> str:
        """Return the column of the index with a function of steps; NULL if there is none."""
        for name in (f"{function}({part.label})", f"n_{part.label}" if function == "count" else ""):
            if name in self.facts.index:
                return quoted(name)
        return "NULL"

    def number(self, node: ast.expr) -> Part:
        """Return a number; a condition counts as 0 or 1."""
        term = super().number(node)
        return Part(NUMBER, f"({term.sql})::INTEGER") if term.kind == CONDITION else term

    def compared(self, node: ast.Compare, left: ast.expr, operator: type[ast.cmpop], right: ast.expr) -> Part:
        """Return the condition that compares two numbers, or an action with its name."""
        action, text = self.term(left), self.term(right)
        if text.kind != TEXT or operator is not ast.Eq or not re.match("action(_|$)", action.label):
            return super().compared(node, left, operator, right)
        names = self.facts.actions.get(action.label, ())
        try:
            if not names:
                raise self.error(
                    right, f"found {text.label}, expected a number, as its actions have no names."
                )
            number = self.numbered(right, names, "action")
        except RunnerError as error:
            raise NotInRun(error, f"it has no action {text.label}; {_EXCLUDABLE}.") from None
        return self.applied(CONDITION, ast.Eq, action, self.fixed(NUMBER, number))

    def call(self, node: ast.Call, name: str) -> Part:
        """Return the term of a call: of abs(), or of a function of steps."""
        if name not in AGGREGATES:
            return super().call(node, name)
        within = "UNBOUNDED"
        for option in node.keywords:
            if (name, option.arg) != ("then", "within"):
                raise self.error(node, f"expected {name}() without options; then() alone has within=STEPS.")
            within = self.text_of(option.value)
            if not (within.isdecimal() and 0 < int(within) <= _MAX_WITHIN):
                raise self.error(
                    option.value,
                    f"found within={within}, expected a whole number of steps from 1 to {_MAX_WITHIN:,}; D "
                    "comes after C in then(C, D), so C and D at one step are any(C and D).",
                )
        if self._is_inside or len(node.args) != 1 + (name == "then"):
            raise self.error(
                node,
                f"expected {name}() of values of a step: any(reward < -5), then(reward < 0, reward > 5).",
            )
        self._is_inside = True
        parts = list(map(self.number if name in _OF_NUMBERS else self.condition, node.args))
        self._is_inside = False
        if name == "then":
            rows = f"ORDER BY t ROWS BETWEEN {within} PRECEDING AND 1 PRECEDING"
            window = f"w{len(self.windows)}"
            sql = f"bool_or({parts[0].sql}) OVER (PARTITION BY phase, environment, episode {rows})"
            self.windows[window], parts[0] = sql, replace(parts[0], sql=window)
        of_steps, known = (text.format(*parts) for text in AGGREGATES[name])
        if (column := self._column(name, parts[0])) != "NULL":
            known = column
        read = f"a{len(self.aggregates)}"
        self.aggregates[read] = of_steps
        kind = NUMBER if name in (*_OF_NUMBERS, "count") else CONDITION
        return Part(kind, f"coalesce({read}, {known})" if self.reads_steps else known)

    def named(self, node: ast.expr) -> Part:
        """Return the column that a node names: `next_observation[2]` is next_observation_2."""
        text = self.text_of(node)[:60]
        columns = self.facts.columns(self._is_inside)
        if (column := columns.get(spelt(text))) is None:
            hint = nearest(text, [*columns, *AGGREGATES])
            more = ""
            reason = f"no {text}; {_EXCLUDABLE}"
            if not self._is_inside:
                more = ", any(), count(), then()"
                if spelt(text) in self.facts.columns(True):
                    hint = f" Steps have it: any({text}), count({text})."
            elif "t" not in columns:
                more, reason = (
                    ", as the run has no steps",
                    "no steps; `dualtaxi rerecord` records those of jobs",
                )
            listed = f"{', '.join(columns)[:1000] or 'nothing'}{more}"
            raise NotInRun(
                self.error(node, f"found {text}, expected one of {listed}.{hint}"), f"it has {reason}."
            )
        part = Part(CONDITION if column in ENDS else NUMBER, quoted(column), label=column)
        if not self._is_inside:
            return part
        if f"min({column})" in self.facts.index:
            return replace(part, low=self._column("min", part), high=self._column("max", part))
        return self._flag(replace(part, kind=CONDITION))


# --- the index ----------------------------------------------------------------------------------------

MAX_FILES: Final = 20_000
_VERSION: Final = 7
_HEX: Final = 16
"""The digits of each hash in a name."""
_MAX_COLUMNS: Final = 64
"""The most numbers of steps, and the most actions, that are in an index."""
_NOT_INDEXED: Final = ("run", "phase", "position", "step", "episode", "environment")
_PLAIN: Final = ("phase", "episode", "first_step", "last_step", "length", "penalties", "return", *ENDS[1:])
CUT_OFF: Final = "eval:-1:"
"""Begins the text of a trial of an evaluation that was cut off, before its number in the phase."""
_AT: Final = (
    "CASE WHEN phase = 'train' THEN '' || episode WHEN episode < stop "
    f"THEN 'eval:' || after || ':' || (episode - start) ELSE '{CUT_OFF}' || episode END"
)
"""The text of a reference to an episode."""
_COUNTED: Final = "row_number() OVER (PARTITION BY phase, environment ORDER BY episode) - 1"
"""The number by which steps of several environments name their episode."""


class EpisodeIndex:
    """The files of the index, made by DuckDB."""

    def __init__(self, database: Database) -> None:
        self.folder = cache_folder() / CACHED_EPISODES
        self._database = database
        with storage_errors(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            self._files = {path.stem[:-_HEX]: path for path in self.folder.glob("*.parquet")}
        self.read = set[Path]()
        """The files of the index that were asked for."""

    def file(self, row: IndexRow, runs: SelectedRuns) -> Path:
        """Return the file of a run; make it if it is missing.

        Raises:
            RunnerError: the run has no episodes, is damaged, or its archive cannot be reached.
            StorageError: the cache cannot be written.
        """
        name = RUN_FILE if row["status"] == "archived" else RECORDING_FILE
        path = Path(row["root"], row["entry"], name)
        with storage_errors(path):
            state = path.stat()
        start = f"{row['id']}-{_hash(path)}"
        stem = start + _hash([_VERSION, state.st_mtime_ns, state.st_size, state.st_ino])
        if stem not in self._files:
            with storage_errors(self.folder):
                for older in [older for older in self._files if older.startswith(start)]:
                    self._files.pop(older).unlink(missing_ok=True)  # a search that reads it now begins again
            self._files[stem] = self._make(row, runs, stem)
        self.read.add(self._files[stem])
        return self._files[stem]

    def trim(self) -> None:
        """Remove the oldest files beyond the limit."""
        remove_oldest(self.folder, "*.parquet", keep=MAX_FILES)

    def _make(self, row: IndexRow, runs: SelectedRuns, stem: str) -> Path:
        """Make the file of a run."""
        episodes, own_steps = (runs.table(name, [row]) for name in ("episodes", "steps"))
        runs.left_out.get(row["id"], {}).pop("steps", None)  # a run need not have steps
        _check(row, runs)
        run = at_hand(listed_run(Path(row["root"], row["entry"]), row["id"]))
        with open_recording(run.recording) as recording:
            shape = Batches(recording).shape
            unknown = Evaluation(-1, 0, -1, -1)
            evaluations = pa.Table.from_pylist(list(map(vars, (unknown, *evaluations_of(recording)))))
            actions = _names_of_actions(shape, recording)
        connection = self._database.connection
        connection.register("episodes", episodes)
        connection.register("evaluations", evaluations)
        steps = register_steps(connection, own_steps, runs.table("extras", [row]) if shape.extras else None)
        columns = episodes.schema
        plain = [name for name in columns.names if name in _PLAIN or name.startswith(("return_", "n_"))]
        if shape.mdp is not None and shape.mdp.success_events:
            plain.append("success")
        environment, number = (
            ("environment", _COUNTED) if "environment" in columns.names else ("0", "episode")
        )
        aggregates = _aggregates(shape, steps)
        facts = json.dumps(asdict(Facts([*plain, *aggregates], actions)))
        path = self.folder / f"{stem}{_hash(facts)}.parquet"
        named = cleaned(map(columns.field, plain))
        rows = (
            f"SELECT {number_of(path)} AS file, row_number() OVER (ORDER BY phase DESC, episode) AS row, "
            f"{named}, {environment} AS environment, {number} AS own, {_AT} AS at FROM episodes "
            "ASOF LEFT JOIN evaluations ON episode >= start"
        )
        if aggregates:
            rows = with_steps(rows, aggregates, {})
        options = f"FORMAT parquet, COMPRESSION zstd, KV_METADATA {{facts: {literal(facts)}}}"
        with storage_errors(path), replacing(path) as fresh:
            self._database.rows(f"COPY (FROM ({rows}) ORDER BY row) TO {literal(fresh)} ({options})")
            _check(row, runs)
        return path


def _check(row: IndexRow, runs: SelectedRuns) -> None:
    """Raise the error for which a run was left out."""
    for sentence in runs.left_out.get(row["id"], {}).values():
        raise RecordingError(sentence)


def number_of(path: Path) -> int:
    """Return the number of an index in its rows."""
    return int(_hash(path.stem[:-_HEX]), 16) >> 1


def kind_of(path: Path) -> str:
    """Return the hash of the facts in an index."""
    return path.stem[-_HEX:]


def facts_of(path: Path) -> Facts:
    """Return what the episodes and steps of the run of an index have."""
    return Facts(**json.loads(pq.read_schema(path).metadata[b"facts"]))


def cleaned(columns: Iterable[pa.Field]) -> str:
    """Return SQL for columns: NaN is NULL, and a flag that is missing is false."""
    texts = []
    for column in columns:
        name = text = quoted(column.name)
        if pa.types.is_floating(column.type):
            text = f"nullif({name}, 'NaN')"
        elif pa.types.is_boolean(column.type):
            text = f"coalesce({name}, FALSE)"
        texts.append(f"{text} AS {name}")
    return ", ".join(texts)


def register_steps(connection: Any, steps: Relation, extras: Relation | None) -> pa.Schema:
    """Register the view `steps` with columns for extras, and return its columns.

    An extra that a step lacks is NULL, a flag false.
    """
    connection.register("own_steps", steps)
    columns = list(steps.schema)
    joined = ""
    if extras is not None and "step" in steps.schema.names:
        connection.register("extras", extras)
        named = f"SELECT phase, step, COLUMNS('^{layout.EXTRA_PREFIX}') FROM extras"
        joined = f"LEFT JOIN ({named}) USING (phase, step)"
        columns += [column for column in extras.schema if column.name.startswith(layout.EXTRA_PREFIX)]
    environment = "" if "environment" in steps.schema.names else ", 0 AS environment"
    selected = f"SELECT {cleaned(columns)}{environment} FROM own_steps {joined}"
    connection.execute(f"CREATE OR REPLACE TEMP VIEW steps AS {selected}")
    return pa.schema(columns)


def with_steps(
    chosen: str, aggregates: Mapping[str, str], windows: Mapping[str, str], among: str = "TRUE"
) -> str:
    """Return SQL for episodes and aggregates of their steps, which are NULL where steps were lost.

    Args:
        chosen: SQL for the episodes.
        aggregates: the SQL of each, by name.
        windows: columns of steps that these need, the SQL of each by name.
        among: a condition on the steps to read.
    """
    more, parts = (
        "".join(f", {sql} AS {quoted(name)}" for name, sql in named.items())
        for named in (windows, aggregates)
    )
    return (
        f"SELECT chosen.*, s.* EXCLUDE (of, turn, own, n) FROM ({chosen}) chosen LEFT JOIN "
        f"(SELECT phase AS of, environment AS turn, episode AS own, count(*) AS n{parts} "
        f"FROM (SELECT *{more} FROM steps WHERE {among}) GROUP BY ALL) s "
        "ON of = phase AND turn = environment AND s.own = chosen.own AND n = length"
    )


def literal(text: object) -> str:
    """Return a text in SQL."""
    return "'" + str(text).replace("'", "''") + "'"


def in_files(paths: Iterable[Path], options: str = "") -> str:
    """Return SQL for the rows of files of Parquet."""
    return f"read_parquet([{', '.join(literal(glob.escape(str(path))) for path in paths)}]{options})"


def _hash(value: object) -> str:
    return blake3(json.dumps(value, default=str).encode()).hexdigest()[:_HEX]


def _aggregates(shape: Shape, steps: pa.Schema) -> dict[str, str]:
    """Return the columns of the index that need steps, with their SQL."""
    numbers = [
        column.name
        for column in steps
        if pa.types.is_integer(column.type) or pa.types.is_floating(column.type)
    ]
    columns = {
        f"{function}({name})": f"CASE WHEN count({{0}}) = count(*) THEN {sql} END".format(quoted(name))
        for name in [name for name in numbers if name not in _NOT_INDEXED][:_MAX_COLUMNS]
        for function, sql in (("min", "min({0})"), ("max", "max({0})"), ("last", "arg_max({0}, step)"))
    }
    flags = [column.name for column in steps if pa.types.is_boolean(column.type)]
    columns |= {f"count({name})": f"count_if({quoted(name)})" for name in flags}
    return columns | {
        f"count({name} == {k})": f"count_if({quoted(name)} = {k})"
        for name, values in shape.action_values.items()
        if name in numbers and len(values) <= _MAX_COLUMNS
        for k in values
    }


def _names_of_actions(shape: Shape, recording: Recording) -> dict[str, Sequence[str]]:
    """Return the names of actions by number, by the column of steps."""
    train = recording.train
    space = recording.spaces.get("action", {})
    agents = recording.agents
    if shape.mdp is not None:
        agent_names = zip(shape.own_actions, action_names(shape.mdp) or (), strict=False)
        return {"action": train.action_names(), **dict(agent_names)}
    return {
        "_".join(filter(None, ("action", agent.replace(".", "_")))): train.action_names(agent)
        for agent, part in (space["spaces"] if len(agents) > 1 else {"": space}).items()
        if recording.has_states or not part.get("start")  # names are by number from 0
    }
