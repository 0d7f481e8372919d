"""Find episodes in all runs, by a condition on them and their steps.

    found = runner.find("ret < -100 and count(collision) >= 2", runs='"tutorial" in tags', sort="ret")
    for hit in found.hits:
        print(hit.run_id, hit.at, hit.ret)

DuckDB asks the index of episodes, a file for each run; steps are read of those episodes alone that the index
does not decide. `runner.query.episode_index` has the language.
"""

from __future__ import annotations

import contextlib
import glob
import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

from runner.analysis.contents import END_WORDS
from runner.analysis.episodes import EpisodeRef, mark_steps
from runner.analysis.sections import Grid
from runner.environments.naming import event_in_words
from runner.errors import RecordingError, RunnerError, RunNotFound, StorageError
from runner.query.episode_index import (
    CUT_OFF,
    ENDS,
    EpisodeIndex,
    EpisodeParser,
    Facts,
    NotInRun,
    facts_of,
    in_files,
    kind_of,
    literal,
    number_of,
    register_steps,
    with_steps,
)
from runner.query.sql import MEMORY_MB, Database, QueryFailed
from runner.query.sql_views import Recordings, SelectedRuns
from runner.recording import schema
from runner.recording.marks import Mark, read_marks
from runner.runs.catalogue.columns import IndexRow
from runner.runs.catalogue.filters import parse
from runner.runs.run import listed_run
from runner.util.expressions import NUMBER
from runner.util.humanize import UNKNOWN, counted
from runner.util.processes import Tell
from runner.util.values import Json, is_whole

LIMIT: Final = 20
_WORDS: Final = re.compile(r"[\w\s-]+")
"""Words to search for in names and tags, if they are no condition."""
_OF_CONDITIONS: Final = frozenset({"ret", "length", "not", "and", "or", *ENDS})
_MAX_SPILLED: Final = "2GB"
"""The most that a search that needs more memory may write to the cache."""
_MOST_EVENTS: Final = 3
_MAX_LISTED: Final = 2_000
"""The most episodes whose steps are asked for one by one."""
_OPEN: Final = {"enable_external_access": "true"}
"""Until the folder that may be read is set."""


@dataclass(frozen=True)
class Hit:
    """An episode that matches."""

    run_id: str
    name: str
    at: str
    """The episode as other commands take it: `812`, or `eval:3000:17`.

    None takes `eval:-1:17`, trial 17 of all evaluations, of an evaluation that was cut off.
    """
    phase: str
    episode: int
    """Its number in the phase."""
    ret: float | None
    """The sum of all rewards; None if it is not a number."""
    length: int
    ended: str
    """`success`, `terminated`, `truncated`, or `reset` before its end."""
    events: dict[str, int]
    """How often each event happened, without those that did not."""
    marks: list[str]
    """The texts of its marks."""
    replay: str
    """The address of its replay; empty where no command takes `at`."""


@dataclass(frozen=True)
class Found:
    """The episodes that match an expression."""

    expression: str
    hits: list[Hit]
    """The first of them, as they are sorted."""
    count: int
    """The number of all that match."""
    runs: int
    """The number of runs that were searched."""
    left_out: list[str]
    """Sentences on the runs that could not be searched."""
    folders: dict[str, Path] = field(default_factory=dict)
    """The folders of the runs with hits, by id."""

    def mark(self, text: str = "", *, tags: Iterable[str] = ()) -> int:
        """Mark the first step of each hit, and return how many were marked.

        A hit with a mark of this text is left as it is, and one without a replay. Arguments and errors as for
        `runner.mark`.
        """
        steps = defaultdict[str, list[str]](list)
        for hit in self.hits:
            if hit.replay and text.strip() not in hit.marks:
                steps[hit.run_id].append(f"{hit.at}:0")
        tags = list(tags)
        return sum(
            len(mark_steps(listed_run(self.folders[run], run), steps[run], text, tags=tags)) for run in steps
        )

    @property
    def sentence(self) -> str:
        """How many episodes match, in words."""
        if not self.runs and are_words(self.expression):
            return (
                f"No run has {self.expression!r} in its id, name, tags or note; a condition on the steps of "
                f"episodes is such as any({self.expression.split()[0]})."
            )
        if not self.runs:
            return "No run was searched."
        verb = "matches" if self.count == 1 else "match"
        return f"{counted(self.count, 'episode')} of {counted(self.runs, 'run')} {verb}."

    @property
    def episodes(self) -> dict[tuple[str, str], list[int]]:
        """The numbers of the episodes of the hits, by run and phase."""
        episodes = defaultdict[tuple[str, str], list[int]](list)
        for hit in self.hits:
            episodes[hit.run_id, hit.phase].append(hit.episode)
        return dict(episodes)

    @property
    def grid(self) -> Grid:
        """The hits as a table."""
        cut = ("name", "events", "marks")
        headings = ("run", "name", "episode", "return", "length", "end", "events", "marks")
        rows = []
        for hit in self.hits:
            most = sorted(hit.events, key=lambda name: -hit.events[name])[:_MOST_EVENTS]
            events = ", ".join(f"{event_in_words(name)} {hit.events[name]:,}" for name in most)
            numbers = UNKNOWN if hit.ret is None else f"{hit.ret:,.6g}", f"{hit.length:,}"
            rows.append(
                (hit.run_id, hit.name, hit.at, *numbers, END_WORDS[hit.ended], events, ", ".join(hit.marks))
            )
        columns = [
            (heading, *cells)
            for heading, *cells in zip(headings, *rows, strict=True)
            if any(cells) or heading not in cut
        ]
        headings, *rows = zip(*columns, strict=True)
        return Grid(headings, rows, left=("run", "end", *cut), cut=cut)

    def as_json(self) -> Json:
        """Return the result as JSON can hold it."""
        values = vars(self) | {"hits": list(map(vars, self.hits))}
        del values["folders"]
        return values


def find(
    expression: str,
    recordings: Recordings = None,
    *,
    runs: str = "",
    phase: str | None = None,
    sort: str = "",
    limit: int | None = LIMIT,
    memory: int = MEMORY_MB,
    report: Tell = lambda _: None,
) -> Found:
    """Return the episodes of all runs that match an expression.

    Args:
        expression: such as `any(action == "north + east") and length > 50`; words alone are searched for in
            the ids, names, tags and notes of runs.
        recordings: the folder of runs, or several: $DUALTAXI_RECORDINGS, or ./recordings, by default.
        runs: a filter as of `dualtaxi ls`; the runs that match it are searched.
        phase: `train` or `eval`; both by default.
        sort: a number to sort by, such as `ret` or `-count(collision)`; the newest run is first by default.
        limit: the most hits; None for all.
        memory: the megabytes that DuckDB may use.
        report: called with how far it has read, a few times a second.

    Raises:
        RunnerError: an expression is wrong, with a mark at its place, or names what no run has.
        MissingExtra: DuckDB is not installed.
    """
    if limit is not None and not is_whole(limit, 1, 2**53):
        raise RunnerError(f"limit: found {limit!r}, expected a whole number from 1, or None for all.")
    if phase not in (None, *schema.PHASES):
        raise RunnerError(f"phase: found {phase!r}, expected train or eval.")
    run_filter = parse(runs)
    condition = expression.strip()
    if are_words(condition):
        words = parse(condition).condition
        condition = "True"
        run_filter = run_filter.also(words) if words is not None else run_filter
    for _ in range(2):
        search = _Search(SelectedRuns(recordings, run_filter, report), memory)
        # a file may be missing where another search replaced an index, as its recording grows
        with contextlib.suppress(FileNotFoundError), contextlib.closing(search.database):
            return search.answer(expression, condition, phase, sort, limit)
    raise RunnerError("find: a recording changed while it was read; search again.")


def are_words(expression: str) -> bool:
    """Return whether an expression is words to search for in runs, and no condition."""
    return bool(_WORDS.fullmatch(expression)) and _OF_CONDITIONS.isdisjoint(expression.split())


class _Question(NamedTuple):
    """A condition in SQL, over the index alone or with the steps read."""

    where: str
    key: str
    """The number to sort by."""
    aggregates: dict[str, str]
    """The functions of steps that both need, the SQL of each by name."""
    windows: dict[str, str]
    """The columns of steps that the aggregates need, the SQL of each by name."""


class _Search:
    """A search in some runs."""

    def __init__(self, runs: SelectedRuns, memory: int) -> None:
        self.runs = runs
        self.database = Database("find", runs, memory, settings=_OPEN)
        self.index = EpisodeIndex(self.database)
        folder = str(self.index.folder)
        for name, value in {
            "allowed_directories": f"[{literal(folder)}, {literal(glob.escape(folder))}]",
            "temp_directory": literal(self.index.folder / "spilled"),
            "max_temp_directory_size": literal(_MAX_SPILLED),
            "enable_external_access": "false",
        }.items():
            self.database.rows(f"SET {name} = {value}")
        self.database.rows("CREATE TABLE hits (run INTEGER, row INTEGER, key DOUBLE, is_open BOOLEAN)")
        self.files: dict[int, Path] = {}
        """The indexes of runs, by the number of the row."""

    def answer(
        self, expression: str, condition: str, phase: str | None, sort: str, limit: int | None
    ) -> Found:
        """Search all runs, and return the first episodes.

        Raises:
            RunnerError: no run has what the expression names, or DuckDB fails.
            FileNotFoundError: a file of the index was removed meanwhile.
        """
        try:
            self._search_runs(condition, phase, sort)
            return self._first_hits(expression, limit)
        except QueryFailed as error:
            if not all(path.exists() for path in self.index.read):
                raise FileNotFoundError from error
            for path in self.index.read:
                path.unlink(missing_ok=True)
            raise RunnerError(
                f"{error}\nThe index of these runs was removed: the next search makes it again."
            ) from error

    def _search_runs(self, condition: str, phase: str | None, sort: str) -> None:
        """Add the hits in all runs; leave out the runs that have no index or not what the condition names."""
        kinds = defaultdict[str, list[int]](list)
        for k, row in enumerate(self.runs.rows):
            try:
                self.files[k] = self.index.file(row, self.runs)
                kinds[kind_of(self.files[k])].append(k)
            except (RecordingError, StorageError, RunNotFound, QueryFailed) as error:
                self.runs.left_out[row["id"]] = {"find": str(error)}
        self.index.trim()
        self.database.rows(
            "CREATE TABLE runs AS SELECT unnest($files) AS file, unnest($runs) AS run",
            {"files": list(map(number_of, self.files.values())), "runs": list(self.files)},
        )
        wrong = []
        for numbers in kinds.values():
            facts = self.database.call(facts_of, self.files[numbers[0]])
            try:
                of_index, of_steps = (_parsed(facts, condition, sort, reads) for reads in (False, True))
            except RunnerError as error:
                wrong.append(error)
                reason = error.reason if isinstance(error, NotInRun) else str(error).partition("\n")[0]
                for k in numbers:
                    self.runs.left_out[self.runs.rows[k]["id"]] = {"find": reason}
            else:
                self._add_hits(numbers, of_index, of_steps, f" AND phase = '{phase}'" if phase else "")
        if wrong and len(wrong) == len(kinds):
            raise next((error for error in wrong if "Did you mean" in str(error)), wrong[0])

    def _add_hits(
        self, numbers: Sequence[int], of_index: _Question, of_steps: _Question, in_phase: str
    ) -> None:
        """Add hits in runs with the same facts: by their indexes, and by the steps that these leave open."""
        where, key, aggregates, _ = of_index
        is_open = f"{where} IS NULL OR {key} IS NULL" if aggregates else "FALSE"
        files = in_files({self.files[k] for k in numbers})
        self.database.rows(
            f"INSERT INTO hits SELECT run, row, {key}, {is_open} FROM {files} JOIN runs USING (file) "
            f"WHERE {where} {'IS NOT FALSE' if aggregates else ''}{in_phase}"
        )
        for (k,) in self.database.rows("SELECT DISTINCT run FROM hits WHERE is_open ORDER BY run"):
            with self.runs.reading("find", self.runs.rows[k]):
                self._add_hits_by_steps(k, of_steps)
        self.database.rows("DELETE FROM hits WHERE is_open")

    def _add_hits_by_steps(self, k: int, question: _Question) -> None:
        """Add the open episodes of a run that match by their steps."""
        where, key, aggregates, windows = question
        row = self.runs.rows[k]
        chosen = (
            f"SELECT * FROM {in_files([self.files[k]])} "
            f"JOIN (SELECT row FROM hits WHERE is_open AND run = {k}) USING (row)"
        )
        ends = "min(first_step), max(last_step), list(DISTINCT own)"
        ((low, high, episodes),) = self.database.rows(f"SELECT {ends} FROM ({chosen})")
        steps = self.runs.table("steps", [row])
        if "step" not in steps.schema.names:
            return  # it is left out
        among = f"step BETWEEN {low} AND {high}"
        if len(episodes) <= _MAX_LISTED:
            among += f" AND episode IN ({', '.join(map(str, episodes))})"
        needs_extras = any('"extra_' in sql for sql in (*aggregates.values(), *windows.values()))
        register_steps(
            self.database.connection, steps, self.runs.table("extras", [row]) if needs_extras else None
        )
        rows = with_steps(chosen, aggregates, windows, among)
        self.database.rows(f"INSERT INTO hits SELECT {k}, row, {key}, FALSE FROM ({rows}) WHERE {where}")

    def _first_hits(self, expression: str, limit: int | None) -> Found:
        """Return the first episodes in the order of the search."""
        searched = [k for k, row in enumerate(self.runs.rows) if not self.runs.left_out.get(row["id"])]
        self.database.rows("DELETE FROM hits WHERE run NOT IN (SELECT unnest($runs))", {"runs": searched})
        ((count,),) = self.database.rows("SELECT count(*) FROM hits")
        order = "ORDER BY key NULLS LAST, first.run, first.row"
        wanted = {"limit": count if limit is None else limit}
        self.database.rows(f"CREATE TABLE first AS FROM hits AS first {order} LIMIT $limit", wanted)
        runs = {k: self.runs.rows[k] for (k,) in self.database.rows("SELECT DISTINCT run FROM first")}
        folders = {k: Path(run["root"], run["entry"]) for k, run in runs.items()}
        marks = {k: read_marks(folder).marks for k, folder in folders.items()}
        hits = []
        if runs:
            files = in_files((self.files[k] for k in runs), ", union_by_name = TRUE")
            joined = f"first JOIN runs USING (run) JOIN {files} USING (file, row)"
            query = f"SELECT COLUMNS('^[^(]*$') FROM {joined} {order}"
            table = self.database.call(lambda: self.database.connection.sql(query).to_arrow_table())
            hits = [_hit(runs[row["run"]], row, marks[row["run"]]) for row in table.to_pylist()]
        by_id = {runs[k]["id"]: folder for k, folder in folders.items()}
        return Found(expression, hits, count, len(searched), self.runs.sentences, by_id)


def _hit(run: IndexRow, row: Json, marks: Sequence[Mark]) -> Hit:
    """Return the episode of a row in the index of a run, which has these marks."""
    is_cut_off = row["at"].startswith(CUT_OFF)
    return Hit(
        run["id"],
        run["name"],
        row["at"],
        row["phase"],
        row["episode"],
        row["return"],
        row["length"],
        next((name for name in ENDS if row.get(name)), "reset"),
        {name[2:]: n for name, n in row.items() if name.startswith("n_") and n},
        [mark.text for mark in marks if (mark.phase, mark.episode) == (row["phase"], row["episode"])],
        "" if is_cut_off else f"/runs/{run['id']}/replay/{EpisodeRef.parse(row['at']).episode_path}",
    )


def _parsed(facts: Facts, condition: str, sort: str, reads_steps: bool) -> _Question:
    parser = EpisodeParser(condition, facts, reads_steps)
    where = parser.whole().sql
    key = "0"
    if sort:
        sorting = EpisodeParser(sort, facts, reads_steps, parser.aggregates, parser.windows)
        key = sorting.whole(NUMBER).sql
    return _Question(f"({where})", f"({key})::DOUBLE", parser.aggregates, parser.windows)
