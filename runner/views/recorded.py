"""Views of what a recording holds: episodes, evaluations, checkpoints, output, machine and code."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Final

from runner.analysis.sections import Grid, Paging, Section, SourceFile
from runner.errors import RecordingError
from runner.util.humanize import counted, duration, number_column, size
from runner.views.view import PHASES, START, STOP, ReadyAnswer, View, rows_in, view_input

if TYPE_CHECKING:
    from runner.analysis.episodes import EpisodeRef
    from runner.analysis.frames import Phase
    from runner.recording.code import Code
    from runner.recording.machine import Clock, HostMetrics
    from runner.recording.reader import Recording
    from runner.runs.run import Run

_EPISODES_A_PAGE: Final = 100
_HIDDEN: Final = ("success", "terminated", "truncated", "episode", "last_step")
"""Columns that the table does not show as they are."""


_PHASE: Final = view_input(
    "phase",
    "Training episodes, or the trials of evaluations.  [default: train]",
    default="train",
    label="Phase",
    values=PHASES,
)


_ORDER: Final = view_input(
    "order",
    "What comes first: newest, best, worst (by success, return and length), longest or shortest.  "
    "[default: number]",
    default="number",
    metavar="ORDER",
    label="Order",
    values=("number", "newest", "best", "worst", "longest", "shortest"),
)


def episodes(
    recording: Recording,
    phase: Phase = _PHASE,
    order: str = _ORDER,
    start: Any = START,
    stop: Any = STOP,
) -> ReadyAnswer:
    """Show the episodes of RUN: how each ended, its length, returns and events.

    In Python, runner.frames.episodes() has all of them.

    Examples:
      dualtaxi episodes @latest
      dualtaxi episodes k3v9m2xq --phase eval --start 100 --stop 200
      dualtaxi episodes k3v9m2xq --order longest --stop 10
    """
    from runner.analysis.episodes import in_order, references
    from runner.analysis.frames import columns_of_episodes, episode_columns
    from runner.environments.naming import event_in_words

    total, rows = recording.phase(phase).episodes.count(), rows_in(start, stop)
    if order == "number":
        columns = episode_columns(recording, phase, min(rows.start, total), min(rows.stop, total))
    else:
        numbers = in_order(recording, phase, order)[rows.start : rows.stop]
        columns = columns_of_episodes(recording, recording.phase(phase).episodes.selected(numbers))
    names = [name for name in columns if name not in _HIDDEN]
    if recording.environment["penalty_below"] is None:
        names.remove("penalties")
    headings = {name: event_in_words(name) for name in names}
    for agent in recording.agents:
        name = f"return.{agent}"
        headings[name] = "return" if len(recording.agents) == 1 else event_in_words(name)
    values = {name: column.tolist() for name, column in columns.items()}
    episodes_shown = references(recording, phase, values["episode"])
    is_training = phase == "train"
    noun = "episode" if is_training else "trial"
    sentence = counted(total, noun)
    if not episodes_shown:
        sentence = f"There are {total:,}, from 0" if total else f"No {noun} has ended"
    elif len(episodes_shown) < total:
        sentence = f"Rows {rows.start:,} to {rows.start + len(episodes_shown) - 1:,} of {sentence}"
    address = f"{EPISODES.name}?phase={phase}&order={order}"
    paging = Paging(rows.start // _EPISODES_A_PAGE + 1, total, _EPISODES_A_PAGE, address)
    table = Section(
        "Training episodes" if is_training else "Trials of evaluations",
        [f"{sentence}."],
        [_grid(is_training, values, episodes_shown, headings, paging)] if episodes_shown else [],
    )
    data = {"run_id": recording.run_id, "start": rows.start, "total": total, "columns": values}
    return ReadyAnswer(data, [table])


def _grid(
    is_training: bool,
    columns: Mapping[str, list[Any]],
    numbers: Sequence[EpisodeRef],
    headings: dict[str, str],
    paging: Paging,
) -> Grid:
    """Return a table with a row for each episode, and a column for each heading."""
    from runner.analysis.contents import END_WORDS
    from runner.analysis.episodes import UNKNOWN_EVALUATION

    cells = [number_column(columns[name]) for name in headings]
    rows = [
        (
            str(at.episode) if at.after in (None, UNKNOWN_EVALUATION) else f"{at.after}, trial {at.episode}",
            next((END_WORDS[end] for end in _HIDDEN[:3] if columns[end][i] > 0), END_WORDS["reset"]),
            *(column[i] for column in cells),
        )
        for i, at in enumerate(numbers)
    ]
    links = ["" if at.after == UNKNOWN_EVALUATION else f"replay/{at.episode_path}" for at in numbers]
    names = ("episode" if is_training else "trial", "end", *headings.values())
    spare = [text for name, text in reversed(headings.items()) if "return" not in name]
    return Grid(names, rows, links=links, paging=paging, cut=(), spare=tuple(spare))


EPISODES: Final = View(
    "episodes",
    "Episodes",
    episodes,
    button="Show",
    has_default=True,
    is_live=True,
    needs="episodes",
    rows_per_page=_EPISODES_A_PAGE,
)


_EVALUATIONS_A_PAGE: Final = 500


def evaluations(
    recording: Recording, start: Any = START, stop: Any = STOP, *, newest_first: bool = False
) -> ReadyAnswer:
    """Show the evaluations of RUN: returns, lengths, successes, and every event counted.

    The evaluations of a loop are its evaluation episodes between two training episodes.

    Examples:
      dualtaxi evaluations @latest
      dualtaxi evaluations k3v9m2xq --start 10 --stop 20 --json
    """
    from runner.analysis.evaluations import evaluation_records, evaluations_section

    every, rows = evaluation_records(recording), rows_in(start, stop)
    if newest_first:
        every.reverse()
    records = every[rows.start : rows.stop]
    table = Section("Evaluations", ["No evaluation was recorded."])
    if records:
        paging = Paging(
            rows.start // _EVALUATIONS_A_PAGE + 1, len(every), _EVALUATIONS_A_PAGE, EVALUATIONS.name
        )
        table = evaluations_section(recording, records, paging)
        table.sentences.extend(["The newest come first."] * newest_first)
    elif every:
        table = Section("Evaluations", [f"There are {len(every):,} evaluations, from 0."])
    data = {"run_id": recording.run_id, "start": rows.start, "total": len(every)}
    return ReadyAnswer(data | {"records": [record.as_json() for record in records]}, [table])


EVALUATIONS: Final = View(
    "evaluations",
    "Evaluations",
    evaluations,
    page_values=(("newest_first", True),),
    has_default=True,
    is_live=True,
    needs="episodes",
    rows_per_page=_EVALUATIONS_A_PAGE,
)


_CHECKPOINT_TEXTS: Final = ("checkpoint", "phase", "format", "digest", "content")
_CHECKPOINT_HEADINGS: Final = ("checkpoint", "phase", "last episode", "format", "size", "digest", "content")


def checkpoints(run: Run) -> ReadyAnswer:
    """List the checkpoints of RUN, which a loop recorded by `rec.checkpoint(name, ...)`.

    Examples:
      dualtaxi checkpoints @latest
      dualtaxi checkpoints cartpole --json
    """
    checkpoints = run.checkpoints()
    data = {"checkpoints": [checkpoint.as_json() for checkpoint in checkpoints]}
    if not checkpoints:
        nothing = "There are no checkpoints; a loop records one by `rec.checkpoint(name, value)`."
        return ReadyAnswer(data, [Section("Checkpoints", [nothing])])
    rows = [
        (
            checkpoint.reference,
            checkpoint.phase,
            f"{checkpoint.episode:,}",
            checkpoint.format,
            size(checkpoint.size),
            checkpoint.digest[:16],
            "here" if checkpoint.is_here else "missing",
        )
        for checkpoint in checkpoints
    ]
    command = f"dualtaxi checkpoint get {run.run_id} {rows[-1][0]}"
    sentence = f"{counted(len(rows), 'checkpoint')}. `{command}` writes the last."
    address = f"/api/v1/runs/{run.run_id}/checkpoints/"
    links = [f"{address}{checkpoint.digest}" if checkpoint.is_here else "" for checkpoint in checkpoints]
    grid = Grid(_CHECKPOINT_HEADINGS, rows, links=links, left=_CHECKPOINT_TEXTS)
    return ReadyAnswer(data, [Section("Checkpoints", [sentence], [grid])])


CHECKPOINTS: Final = View(
    "checkpoints",
    "Checkpoints",
    checkpoints,
    has_default=True,
    needs="checkpoints",
    subject="run",
)


_BOTH: Final = "both"
_STREAMS: Final = (_BOTH, "stdout", "stderr")
_NONE: Final = (
    "No output was recorded. What the runner itself prints is never recorded, and nothing is if `console` "
    "is off."
)


def console(
    recording: Recording,
    search: str = view_input(
        "search", "Only lines with this text, in any case.", default="", metavar="TEXT", label="Text"
    ),
    stream: str = view_input(
        "stream",
        "Only lines of stdout, or of stderr.  [default: both]",
        default=_BOTH,
        label="Stream",
        values=_STREAMS,
    ),
    limit: int = view_input(
        "limit",
        "Maximum number of rows, 0 for all.  [default: 1000]",
        kind=int,
        default=1000,
        maximum=10**9,
    ),
) -> ReadyAnswer:
    """Show what the process that recorded RUN printed: the last lines of its output, or of those with a text.

    Each line has the time at which it began and about the number of steps taken until then, interpolated
    between samples of the clock. A progress bar has its last state; 10 MB are recorded.

    Examples:
      dualtaxi console @latest
      dualtaxi console cartpole --search nan
      dualtaxi console cartpole --stream stderr --limit 20
    """
    from runner.recording.console import read_console
    from runner.recording.machine import read_clock

    lines = read_console(recording, read_clock(recording))
    matching = [
        line for line in lines if search.casefold() in line.text.casefold() and stream in (_BOTH, line.stream)
    ]
    last_lines = matching[-limit:]
    data = {"lines": [asdict(line) for line in last_lines], "found": len(matching), "total": len(lines)}
    if not last_lines:
        return ReadyAnswer(data, [Section("Output", ["No line was found." if lines else _NONE])])
    sentence = counted(len(matching), "line")
    if len(last_lines) < len(matching):
        sentence = f"The last {len(last_lines):,} of {sentence}"
    if len(matching) < len(lines):
        sentence += f" found, of {len(lines):,}"
    streams = [line.stream or "note" for line in last_lines]
    rows = [
        (duration(line.seconds), f"{line.position:,}", name, line.text)
        for line, name in zip(last_lines, streams, strict=True)
    ]
    grid = Grid(("time", "about step", "stream", "output"), rows, streams=streams)
    return ReadyAnswer(data, [Section("Output", [f"{sentence}."], [grid])])


CONSOLE: Final = View(
    "console",
    "Console",
    console,
    button="Search",
    has_default=True,
    is_live=True,
)


def system(recording: Recording) -> ReadyAnswer:
    """Show how fast RUN went, and what it used of its machine: memory, GPU memory and disk.

    The page of the run has charts of processor, memory, GPUs, disk and network over time.

    Examples:
      dualtaxi system @latest
      dualtaxi system cartpole --json
    """
    from runner.recording.machine import read_clock, read_host

    clock = read_clock(recording)
    host = read_host(recording, clock)
    data = {
        "seconds": clock and clock.duration,
        "sessions": clock and len(clock.earlier),
        "steps_a_second": clock and clock.steps_a_second,
        **({} if host is None else host.largest),
    }
    return ReadyAnswer(data, _machine_sections(clock, host))


def _machine_sections(clock: Clock | None, host: HostMetrics | None) -> Iterator[Section]:
    """Yield facts, and charts over time."""
    from runner.export.plots.training import machine_facts, machine_plots

    if clock is None:
        yield Section("Time and machine", ["Its recording has no clock."])
        return
    yield Section("Time and machine", facts=machine_facts(clock, host))
    text = "No use of the machine was recorded: it is measured once a second, unless `system` is off."
    yield Section("Over time", [text] if host is None else [], figures=machine_plots(clock, host))


SYSTEM: Final = View("system", "System", system, has_default=True, is_live=True)


_MAX_LINES: Final = 5000
"""Lines of the changes that people see; the file has all."""
_MAX_FILES: Final = 100
_NAMES: Final = {
    "git": "Commit",
    "git.branch": "Branch",
    "git.remote": "Remote",
    "git.not_recorded": "Git",
    "command": "Command",
    "code.script": "Script",
    "code.not_recorded": "Not recorded",
    "code.left_out": "Left out",
}
_PACKAGE: Final = "package."
_ABOUT_CODE: Final = ("git", "code.")
_NOTHING: Final = "The code of this run was not recorded."


def code(recording: Recording) -> ReadyAnswer:
    """Show the code that ran RUN: commit, script, changes since the commit, and files.

    `git checkout COMMIT && dualtaxi code RUN -o - | git apply` restores it; without a commit the patch has
    all files. With --json, `files` has the text of each recorded file, `new` those that the commit does not
    have, `patch` the changes since the commit, and `packages` the installed packages.

    Examples:
      dualtaxi code @latest
      dualtaxi code k3v9m2xq -o changes.patch
      dualtaxi code k3v9m2xq -o - | git apply
      dualtaxi code k3v9m2xq --json
    """
    from runner.recording.code import Code

    provenance, recorded, problem = recording.provenance, Code(), ""
    try:
        recorded = recording.code
    except RecordingError as error:
        problem = str(error).removeprefix(f"{recording.path}: ")
    facts = {key: text for key, text in provenance.items() if key.startswith(_ABOUT_CODE) or key == "command"}
    packages = {
        key.removeprefix(_PACKAGE): text for key, text in provenance.items() if key.startswith(_PACKAGE)
    }
    files = {"files": dict(recorded.files), "new": recorded.new, "patch": recorded.patch}
    data = {**facts, **files, "packages": packages}
    return ReadyAnswer(
        data, _code_sections(facts, packages, recorded, problem), lambda: _patch(facts, recorded, problem)
    )


def _code_sections(
    facts: Mapping[str, str], packages: Mapping[str, str], recorded: Code, problem: str
) -> Iterator[Section]:
    """Yield facts, packages, the changes since the commit, and the files."""
    if facts:
        named = {_NAMES.get(key, key): text for key, text in facts.items()}
        yield Section("Commit and command", facts=named)
    if packages:
        sentence = f"{counted(len(packages), 'package')}."
        yield Section("Installed packages", [sentence], facts=packages, is_folded=True)
    if lines := recorded.patch.splitlines():
        more = f"{len(lines) - _MAX_LINES:,} more lines: `dualtaxi code RUN -o FILE.patch` writes all."
        left_out = [more] * (len(lines) > _MAX_LINES)
        yield Section("Changes since the commit", left_out, diffs=[lines[:_MAX_LINES]])
    script = facts.get("code.script")
    names = sorted(recorded.files, key=lambda path: path != script)
    new = recorded.new if "git" in facts else ()
    sources = [
        SourceFile(path, "not in the commit" if path in new else "", recorded.files[path])
        for path in names[:_MAX_FILES]
    ]
    if sources:
        more = f"{len(names) - _MAX_FILES:,} more files: `dualtaxi code RUN --json` has all."
        left_out = [more] * (len(names) > _MAX_FILES)
        yield Section("Files", left_out, sources=sources)
    elif problem or not any(key.startswith(_ABOUT_CODE) for key in facts):
        yield Section("Files", [problem or _NOTHING])


def _patch(facts: Mapping[str, str], recorded: Code, problem: str) -> str:
    """Return the facts as comments, which `git apply` ignores, and a patch.

    Raises:
        RecordingError: the files cannot be read.
    """
    if problem:
        raise RecordingError(problem)
    about = (facts or {"code.not_recorded": _NOTHING}).items()
    comments = [f"# {key}: {' '.join(text.split())}\n" for key, text in about]
    return "".join(comments) + recorded.to_patch()


CODE: Final = View(
    "code",
    "Code",
    code,
    has_default=True,
    file_ending=".patch",
    file_help="Write a patch for `git apply` that turns the commit into this code.",
)
