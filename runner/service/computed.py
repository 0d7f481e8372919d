"""What child processes compute for responses: JSON, files, and parts of pages as HTML."""

from __future__ import annotations

import base64
import contextlib
import importlib
import io
import json
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import islice
from pathlib import Path
from types import MappingProxyType
from typing import Final, Literal
from urllib.parse import urlencode

from markupsafe import Markup, escape

from runner.analysis.axes import axis_of
from runner.analysis.compare.tasks import compare_algorithms, scores_of
from runner.analysis.diff import diff, with_seconds, without_ignored
from runner.analysis.diff.divergence import Divergence
from runner.analysis.diff.sections import made_sections, summary
from runner.analysis.episodes import TYPICAL, EpisodeRef, StepLike
from runner.analysis.evaluations import training_records
from runner.analysis.frames import Phase, episode_columns, step_columns
from runner.analysis.histograms import histograms
from runner.analysis.sections import Answer, Figure, Grid, Link, Section
from runner.analysis.series import series_of
from runner.analysis.summary import random_policy_sentence
from runner.archive.places import default_target
from runner.debugging.what_if import branch_playback, what_if
from runner.drawing import svg
from runner.environments.naming import actions_in_words, joint_action, state_of
from runner.errors import ConfigError, RunnerError, shortened
from runner.export.film import FORMATS, Shot, usual_speed, write_film
from runner.export.pictures import Pictures, episode_sketch, picture_note
from runner.export.plots.training import EXPLANATION, constants_in, heatmap_plots
from runner.export.plugin import installed_export
from runner.export.reports.comparisons import difference_sections, drawn_task_sections
from runner.export.reports.maps import learned_section, situations, start_of
from runner.export.reports.playback import Playback, playback_of
from runner.export.reports.rendering import partials
from runner.export.reports.report import render_report
from runner.export.rerun.selection import Request, locate
from runner.export.rerun.viewer import cached_export, require_rerun
from runner.recording import schema
from runner.recording.messages import media_type
from runner.recording.reader import Recording, open_recording
from runner.runs.branches import BranchOrigin, origin_in
from runner.runs.run import Run
from runner.service.settings import ServiceSettings, without_folders
from runner.sweep.charts import best_section, drawn_trials, learning, learning_section, parameters_section
from runner.sweep.results import Results, effects_sections, ranking_sections
from runner.util.extras import require
from runner.util.humanize import sentence
from runner.util.values import finite
from runner.views.queries import MAX_ROWS
from runner.views.runs import sweep_show
from runner.views.view import Given

MAX_FILM_STEPS: Final = 5_000
"""The most steps of a film, as one film is made at a time."""
MAX_PICTURES: Final = 48
"""Logged pictures that a page shows, of `MAX_PICTURE_BYTES` together."""
MAX_PICTURE_BYTES: Final = 16 << 20
_STEPS_BEFORE: Final = 1
"""Steps before the first one of a part, so that it includes the step that led there."""
RecordKind = Literal["training", "optimality"]
AnswerForm = Literal["json", "html", "file"]


@dataclass(frozen=True)
class ShownDifference:
    """What differs between two runs."""

    tabs: Mapping[str, tuple[str, Sequence[str], str]]
    """Lead, notes and HTML of tabs: where they diverge and what else differs, their Q-tables, their code."""
    first_frame: str | None = None
    """The first frame of the replays that differs; None if there is none."""


def run_histograms(path: Path, axis: str) -> bytes:
    """Return the histograms of a run's training over an axis, as JSON."""
    with open_recording(path) as recording:
        result, notes = histograms(recording, axis_of(axis))
        return as_json({"run_id": recording.run_id, "histograms": result, "notes": notes})


def records(path: Path, kind: RecordKind, rows: range, limit: int) -> bytes:
    """Return reports of training or exact measures by their numbers, as JSON."""
    with open_recording(path) as recording:
        if kind == "optimality":
            everything = list(recording.table(schema.OPTIMALITY_TOPIC).decoded())
        else:
            recording.require_job("a report of training", "Its metrics can be had all the same.")
            everything = [record.as_json() for record in training_records(recording)]
        in_range = everything[rows.start : rows.stop]
        require_few(len(in_range), limit)
        page = {
            "run_id": recording.run_id,
            "start": rows.start,
            "total": len(everything),
            "records": in_range,
        }
        return as_json(page)


def require_few(found: int, limit: int) -> None:
    """Refuse a range of more records than a response may have."""
    if found > limit:
        raise ConfigError(
            f"query: found a range of {found:,} records, expected at most {limit:,}; request them in parts.",
        )


def answer(
    subject: Path | Run | Sequence[Run], question: Callable[..., Answer], form: AnswerForm, values: Given
) -> bytes:
    """Return an answer about a recording or runs: as --json prints it, as HTML, or as a file."""
    with open_recording(subject) if isinstance(subject, Path) else nullcontext(subject) as content:
        found = question(content, **dict(values))
        if form == "html":
            assert isinstance(content, Recording | Run)  # a page is about one run
            return str(partials().answer(found.sections(), f"/runs/{content.run_id}/")).encode()
        if form == "json":
            return as_json(found.as_json())
        with io.BytesIO() as stream:
            found.write(stream)
            return stream.getvalue()


def installed_file(path: Path, name: str) -> bytes:
    """Return the file that an export of an installed package makes of a recording."""
    with tempfile.TemporaryDirectory() as folder, open_recording(path) as recording:
        file = Path(folder) / "export"
        installed_export(name).write(recording, file)
        return file.read_bytes()


def report(path: Path, settings: ServiceSettings) -> bytes:
    """Return the report of a run, a page without links to others."""
    return settings.without_folders(render_report([path])[0]).encode()


def film(path: Path, title: str, step: EpisodeRef, ending: str) -> bytes:
    """Return the film of an episode from a step on, below the title of its run.

    The ending of its file, such as `.mp4`, is its format.
    """
    if ending not in FORMATS:
        raise RunnerError(f"format: found {ending[:20]!r}, expected one of {', '.join(FORMATS)}.")
    with tempfile.TemporaryDirectory() as folder, open_recording(path) as recording:
        file = Path(folder, f"film{ending}")
        episode = step.resolved(recording)
        pictures = Pictures(recording, episode.phase, episode.number_in(recording))
        if episode.t > pictures.steps:
            raise episode.no_step(recording, pictures.steps, episode.t)
        if (steps := pictures.steps - episode.t) > MAX_FILM_STEPS:
            raise RunnerError(
                f"found {steps:,} steps to film, expected at most {MAX_FILM_STEPS:,}: begin at a later step, "
                "or use `dualtaxi export film`, which has no limit."
            )
        shot = Shot(f"{title}: {episode.title}", pictures, episode.t)
        write_film(file, shot, usual_speed(pictures.source), None, lambda _: None)
        return file.read_bytes()


def archive(run: Run, remove: bool) -> bytes:
    """Archive a run as `dualtaxi archive` does; `remove` its recording once the archive was compared."""
    require("pyarrow", extra="archive", purpose="an archive")
    from runner.archive.runs import archive_run

    return as_json(archive_run(run, default_target(run.folder.parent), remove).as_json())


def arrow(path: Path, table: str, phase: Phase, rows: range) -> bytes:
    """Return the columns of steps or episodes by their numbers as an Arrow stream."""
    require("pyarrow", extra="archive", purpose="Arrow")
    import pyarrow as pa

    with open_recording(path) as recording:
        if table == "steps":
            columns = step_columns(recording, phase, start=rows.start, stop=rows.stop)
        else:
            columns = episode_columns(recording, phase, rows.start, rows.stop)
    arrays = {
        name: pa.array(values if values.ndim == 1 else values.tolist()) for name, values in columns.items()
    }
    whole = pa.table(arrays)
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, whole.schema) as writer:
        writer.write_table(whole)
    return bytes(sink.getvalue())


def replay(runs: Sequence[Run], request: Request) -> Path:
    """Return the path of an export for the Rerun viewer, from the user's cache or new."""
    require_rerun("a replay")
    return cached_export(runs, request)[0]


def query(settings: ServiceSettings, text: str, runs: str) -> bytes:
    """Return the first rows of a query in SQL, as JSON."""
    require("pyarrow", extra="sql", purpose="SQL")
    from runner.query.sql import sql

    result = sql(text, recordings=settings.recordings, runs=runs)
    with contextlib.closing(result.rows()) as rows:
        first = list(islice(rows, MAX_ROWS + 1))
    answer = {
        "columns": result.columns.names,
        "rows": first[:MAX_ROWS],
        "more": len(first) > MAX_ROWS,
        "left_out": result.left_out,
    }
    return settings.without_folders(as_json(answer).decode()).encode()


def find(settings: ServiceSettings, expression: str, runs: str, phase: str, sort: str, limit: int) -> bytes:
    """Return the episodes that match an expression, as `dualtaxi find --json` prints them."""
    require("pyarrow", extra="sql", purpose="`find`")
    from runner.query import find

    result = find.find(
        expression,
        settings.recordings,
        runs=runs,
        phase=phase or None,
        sort=sort,
        limit=limit or MAX_ROWS,
    )
    return settings.without_folders(as_json(result.as_json()).decode()).encode()


def as_json(value: object) -> bytes:
    """Return a value as JSON; NaN and infinity become null."""
    return json.dumps(finite(value), allow_nan=False, ensure_ascii=False).encode(errors="replace")


def link(path: str, values: Mapping[str, object]) -> str:
    """Return an address with a query of the values that are not empty."""
    query = [(key, value) for key, value in values.items() if value not in ("", None, [], ())]
    return f"{path}?{urlencode(query, doseq=True)}" if query else path


def places_in(runs: Sequence[Run], step: EpisodeRef) -> list[EpisodeRef]:
    """Return the step in each of two runs: a branch of a loop has its parent's episode as its only one."""
    alone = EpisodeRef(0, step.t, None if step.after is None else 0)
    origins = [origin_in(run.file.config) for run in runs]
    return [
        alone if isinstance(origin, BranchOrigin) and origin.run == other.run_id else step
        for origin, other in zip(origins, reversed(runs), strict=True)
    ]


def episode_part(path: Path, at: EpisodeRef, start: int, steps: int) -> bytes:
    """Return a part of an episode as JSON for `replay.js`."""
    with open_recording(path) as recording:
        at = replace(at, t=max(at.t, start))  # the step that an error names
        episode = playback_of(recording, at, steps, max(0, start - _STEPS_BEFORE))
        return _part(recording, episode, *picture_note(recording, at.phase))


def branch_part(path: Path, at: str, action: str, start: int, steps: int) -> bytes:
    """Return a part of the episode to which a joint action leads, as `episode_part` does."""
    with open_recording(path) as recording:
        return _branch_part(recording, at, action, start, steps)


def what_if_page(path: Path, at: EpisodeRef, action: str | None, start: int, steps: int) -> bytes:
    """Return a part as `branch_part` does, with its action and, as HTML, where each joint action leads.

    It is the branch of `action`, None for the recorded one.
    """
    with open_recording(path) as recording:
        result = what_if(recording, at=at)
        base = f"/runs/{recording.run_id}/"
        number = next(row.action for row in result.actions if row.is_recorded)
        if action is not None:
            number = joint_action(recording.mdp, action)
        *before, after = result.sections(base)
        texts = {
            "action": str(number),
            "name": str(actions_in_words(recording.mdp)[number]),
            "before": str(partials().notes(result.notes) + partials().answer(before, base)),
            "after": str(partials().answer([after], base)),
        }
        return _branch_part(recording, at, str(number), start, steps, texts)


def _branch_part(
    recording: Recording,
    at: StepLike,
    action: str,
    start: int,
    steps: int,
    texts: Mapping[str, str] = MappingProxyType({}),
) -> bytes:
    episode = branch_playback(recording, at, action, steps, max(0, start - _STEPS_BEFORE))
    note = "" if episode.grid else "The environment has no scene to draw."
    return _part(recording, episode, False, note, texts)


def _part(
    recording: Recording,
    episode: Playback,
    has_pictures: bool,
    note: str,
    texts: Mapping[str, str] = MappingProxyType({}),
) -> bytes:
    """Return a part of an episode as JSON without blanks; its numbers are finite."""
    part = {
        "episode": episode.as_json(),
        "scene": recording.environment["scene"] if episode.grid else None,
        "has_pictures": has_pictures,
        "picture_note": note,
        **texts,
    }
    return json.dumps(part, separators=(",", ":"), ensure_ascii=False).encode(errors="replace")


def random_policy(path: Path) -> bytes:
    """Return what a random policy achieves in a recording's environment, as HTML; empty if unknown."""
    with open_recording(path) as recording:
        return str(escape(random_policy_sentence(recording))).encode()


def resolved_step(path: Path, at: EpisodeRef) -> bytes:
    """Return a step as JSON, with an episode of the recording in place of a word."""
    with open_recording(path) as recording:
        return as_json(at.resolved(recording))


def episode_thumbnail(path: Path, at: EpisodeRef) -> bytes:
    """Return an episode as a small SVG picture."""
    with open_recording(path) as recording:
        step = at.resolved(recording)
        return episode_sketch(recording, step.phase, step.number_in(recording), step.heading).encode()


def latest_episode(path: Path) -> bytes:
    """Return the address of the training episode that ended last, as `train/120`; empty without one."""
    with open_recording(path) as recording:
        ended = recording.train.episodes.count()
        has_one = ended and any(phase.steps for phase in recording.phases)
        return EpisodeRef(ended - 1).episode_path.encode() if has_one else b""


def maps(path: Path, state: Sequence[str] = ()) -> bytes:
    """Return the maps of policy and values at stages of learning, as HTML.

    They are of the situation of a state, given by the parts of its name; of a typical one by default.
    """
    with open_recording(path) as recording:
        form, number = "", 0
        if recording.tabular and svg.drawing_of(recording.mdp) is not None:
            problems = []
            number = start_of(recording, EpisodeRef.parse(TYPICAL))
            try:
                number = state_of(recording.mdp, ", ".join(state)) if state else number
            except ConfigError:
                problems.append(f"There is no state with {shortened(', '.join(state), 200)}.")
            form = partials().situation(situations(recording.mdp, number), problems)
        section = replace(learned_section(recording, number), title="")
        return f"<h2>What was learned</h2>{form}{partials().answer([section])}".encode()


def distributions(path: Path, axis: str) -> bytes:
    """Return the histograms of a run's training over an axis, as HTML."""
    with open_recording(path) as recording:
        result, notes = histograms(recording, axis_of(axis))
    if not result:
        return b""
    text = " ".join([EXPLANATION, *constants_in(result), *notes])
    section = Section("Distributions", [text], figures=heatmap_plots(result))
    return str(partials().answer([section])).encode()


def tasks(paths: Sequence[Path], axis: str, scores: str) -> bytes:
    """Return the comparison of runs over environments as HTML; `scores` is a table as CSV, or empty.

    Where nobody asked for scores, a reason why the runs cannot be compared is an answer, not an error.
    """
    table = scores_of(scores) if scores.strip() else None
    try:
        comparison = compare_algorithms(series_of(paths, axis_of(axis)), table)
    except RunnerError as error:
        if table is not None:
            raise
        return f'<p class="hint">{escape(sentence(str(error).removeprefix("normalise: ")))}</p>'.encode()
    return str(partials().answer(drawn_task_sections(comparison))).encode()


def pictures(path: Path) -> bytes:
    """Return the last pictures and films that were logged under a name, the newest first, as HTML."""
    figures = list[Figure]()
    size = 0
    with open_recording(path) as recording:
        images = recording.table(schema.IMAGE_TOPIC)
        for image in images.newest():
            name = image["frame_id"]
            data = image["data"]
            step = image["log_time"] // schema.STEP_NANOSECONDS
            size += len(data)
            if len(figures) == MAX_PICTURES or size > MAX_PICTURE_BYTES:
                break
            if kind := media_type(data):
                source = f"data:{kind};base64,{base64.b64encode(data).decode()}"
                figures.append(Figure(f'<img src="{source}" alt="">', f"{name}, step {step:,}"))
        total = images.count()
    texts = [f"The last {len(figures):,} of {total:,} pictures."] if len(figures) < total else []
    if not total:
        texts = ["No picture was logged."]
    return str(partials().answer([Section("", texts, figures=figures, layout="pictures")])).encode()


def difference(a: Run, b: Run) -> bytes:
    """Return `ShownDifference` as JSON."""
    with open_recording(a.recording) as ours, open_recording(b.recording) as theirs:
        comparison = without_ignored(with_seconds(diff(ours, theirs), a, b), ())
        sections = difference_sections(comparison, ours, theirs)
    divergences = {"Training": comparison.divergence, "Evaluation": comparison.evaluation_divergence}
    known = {title: divergence for title, divergence in divergences.items() if divergence is not None}
    for title, divergence in known.items():
        sections[title] = replace(sections[title], links=_links([a, b], divergence))
    body = [section for title, section in sections.items() if title not in ("Metrics", "Q-tables", "Runs")]
    first = next(iter(known.values()), None)
    tables = sections.get("Q-tables", Section("Q-tables", ["There are none to compare."]))
    tabs = {
        "divergence": (summary(comparison), comparison.notes, partials().answer(body)),
        "tables": ("", [] if "Q-tables" in sections else comparison.notes, partials().answer([tables])),
    }
    return as_json(ShownDifference(tabs, None if first is None else str(first.frame)))


def made_difference(a: Run, b: Run) -> bytes:
    """Return how the code of two runs differs, and how else they were made, as `ShownDifference` in JSON."""
    with open_recording(a.recording) as ours, open_recording(b.recording) as theirs:
        lead, sections = made_sections(ours, theirs)
    return as_json(ShownDifference({"code": (lead, [], partials().answer(sections))}))


def _links(runs: list[Run], divergence: Divergence) -> list[Link]:
    """Return links to the replays at the first step that differs."""
    query = {"run": [run.run_id for run in runs], "at": str(divergence.frame)}
    places = zip("AB", runs, places_in(runs, divergence.reference), strict=True)
    return [
        Link("Both replays at this step", link("/compare/replay", query)),
        *(
            Link(f"{letter} in Rerun", link(f"/runs/{run.run_id}/rerun", {"at": str(place)}))
            for letter, run, place in places
        ),
    ]


def viewer_place(run: Run, at: EpisodeRef | None) -> bytes:
    """Return the step of the viewer's timeline at a step, and its trial as a loop counts it, as JSON."""
    location = locate(run, Request(), at)
    return as_json({"time": location.time, "trials": location.request.trials})


def load_sweep_libraries() -> None:
    """Import SciPy, scikit-learn and Optuna, which take seconds, before the page of a sweep needs them."""
    for module in ("scipy.stats", "sklearn.ensemble", "optuna.samplers", "runner.sweep.results"):
        with contextlib.suppress(ImportError):  # the function that needs it explains how to install it
            importlib.import_module(module)


@lru_cache(maxsize=1)
def _sweep_results(name: str, recordings: Path, digest: str) -> Results:  # noqa: ARG001
    """Return the results of a sweep in the state that the digest identifies."""
    return sweep_show((name, recordings), everything=True)


def sweep_part(
    part: Callable[[Results, Path], Iterable[Section]], name: str, recordings: Path, digest: str
) -> bytes:
    """Return a part of the page of a sweep as HTML, without the path of the recordings folder."""
    sections = [
        replace(section, sentences=[without_folders(text, recordings) for text in section.sentences])
        for section in part(_sweep_results(name, recordings, digest), recordings)
    ]
    return str(partials().answer(sections)).encode()


def sweep_ranking(results: Results, _: Path) -> Iterator[Section]:
    """Yield the ranking of a sweep, with links to its runs, and the best configuration."""
    first, *others = ranking_sections(results)
    address = Markup('<a href="/runs/{0}" title="{0}">{1}</a>')
    runs = {
        str(entry.number): Markup(" ").join(address.format(run, seed) for seed, run in entry.runs.items())
        for entry in results.ranking
    }
    grids = [
        Grid((*grid.headings, "runs, by seed"), [(*row, runs[row[0]]) for row in grid.rows])
        for grid in first.grids
    ]
    yield replace(first, title="Ranking", grids=grids)
    yield from others
    if results.best_yaml:
        yield best_section(results)


def sweep_importance(results: Results, _: Path) -> Iterable[Section]:
    """Return the importance of a sweep's parameters; nothing if it is unknown."""
    return effects_sections(results)


def sweep_pictures(results: Results, recordings: Path) -> Iterator[Section]:
    """Yield the charts of a sweep: its parameters, and learning curves of some of its trials."""
    with contextlib.suppress(RunnerError):  # no trial is finished yet, as the ranking says
        yield parameters_section(drawn_trials(results))
    try:
        yield learning_section(learning(results, recordings))
    except RunnerError as error:
        yield Section("Learning curves", [str(error)])
