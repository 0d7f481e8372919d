"""One self-contained page about one or several runs: their replays, learning curves, maps and evaluations.

The page needs no network: style, script, plots and data are in it. All of it is read from the recordings.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from runner.analysis.axes import EPISODES, Axis
from runner.analysis.contents import shortcomings, why_no_steps
from runner.analysis.episodes import EpisodeRef, last_whole_evaluation, ranked
from runner.analysis.evaluations import (
    EvaluationRecord,
    evaluations_section,
    metric_columns,
)
from runner.analysis.groups import groups_of
from runner.analysis.sections import Grid, LegendEntry, Player, Section
from runner.analysis.series import RunSeries, read_series, values_left_out
from runner.analysis.summary import describe_recording, random_policy_sentence
from runner.drawing import svg
from runner.environments.naming import spoken
from runner.errors import RecordingError, RunnerError
from runner.export.pictures import Thumbnails, picture_note, thumbnails
from runner.export.plots.curves import PLAIN, CurveStyle, curves_section
from runner.export.reports.maps import learned_section, start_of
from runner.export.reports.playback import MAX_VALUES, playback_of, titled
from runner.export.reports.rendering import embedded, render, templates
from runner.recording.reader import Recording, open_recording
from runner.recording.run_file import has_environment
from runner.runs.run import run_at
from runner.util.humanize import UNKNOWN, capitalised, number
from runner.util.processes import Tell


def require_packages() -> None:
    """Check that the packages that a report needs are installed."""
    templates()


def render_report(
    recordings: Sequence[Path],
    references: Sequence[EpisodeRef] = (),
    progress: Tell = lambda _: None,
    axis: Axis = EPISODES,
    style: CurveStyle = PLAIN,
) -> tuple[str, list[str]]:
    """Return the page about some recordings, and what is missing from it, a sentence each.

    The chosen episodes are shown in addition to those that are always shown; `progress` is called with the
    next stage of the work; axis and style are those of the plots.

    Raises:
        RecordingError: a recording cannot be read, or does not have the axis or an episode.
        RunnerError: there is no recording.
    """
    if not recordings:
        raise RunnerError("report: found no runs, expected at least one.")
    require_packages()
    series: list[RunSeries] = []
    articles: list[Section] = []
    runs: list[dict[str, str]] = []
    notes: list[str] = []
    for count, path in enumerate(recordings, 1):
        progress(f"reading run {count} of {len(recordings)}")
        with open_recording(path) as recording:
            series.append(read_series(recording, axis))
            article, run = _run(recording, references, progress, notes)
            articles.append(article)
            runs.append(run)
    progress("drawing")
    groups = groups_of(series)
    legend = [LegendEntry("", group.described) for group in groups]
    curves = curves_section(groups, style, legend if len(legend) > 1 else [])
    first, *others = articles[0].parts
    lead = articles[0].sentences
    sections = [first, curves, *others]
    source = "recording"
    if len(runs) > 1:
        headings = tuple(dict.fromkeys(heading for run in runs for heading in run))
        rows = [tuple(run.get(heading, UNKNOWN) for heading in headings) for run in runs]
        links = [f"#{article.anchor}-{i}" for i, article in enumerate(articles, 2)]
        summary = Section(
            "Summary", ["The last evaluation of each run."], [Grid(headings, rows, links=links)]
        )
        lead = []
        sections = [summary, curves, *articles]
        source = "recordings"
    ids = ", ".join(f"run {run['run']}" for run in runs)
    page = render(
        _title(runs),
        lead,
        sections,
        f"the {source} of {ids}. The replay rounds numbers "
        f"to five digits and shows the {MAX_VALUES} highest Q-values, and that of the action taken",
        notes=notes,
        replays=True,
    )
    return page, [*notes, *values_left_out(series)]


def _run(
    recording: Recording, references: Sequence[EpisodeRef], progress: Tell, notes: list[str]
) -> tuple[Section, dict[str, str]]:
    """Return all about a run but its learning curves, and its row in the table of runs, by heading.

    `notes` gets what is missing from the page.
    """
    details = describe_recording(run_at(recording.path), recording)
    records = details.evaluations
    episodes = _episodes(recording, references)
    player = _player(recording, episodes, progress)
    notes += shortcomings(recording)
    if not recording.has_actions:
        notes.append(
            f"No episode of run {recording.run_id} can be replayed, as there are no steps: "
            f"{why_no_steps(recording)}."
        )
    recorded = (
        "no episode ended" if any(phase.steps for phase in recording.phases) else "no steps were recorded"
    )
    sections = [
        Section("Replay", [] if player else [f"There is nothing to replay: {recorded}."], player=player)
    ]
    start = start_of(recording, next(iter(episodes), EpisodeRef(0))) if recording.tabular else 0
    try:
        learned = learned_section(recording, start)
    except RecordingError as error:  # its tables may be damaged
        learned = Section("What was learned", [f"There are no maps: {error}"])
    if recording.has_tables or learned.parts:
        sections.append(learned)
    if records:
        sections.append(evaluations_section(recording, records))
    elif recording.has_tables:
        sections.append(Section("Evaluations", ["No evaluation was recorded."]))
    sections += details.result_sections()
    origin = details.origin_sections()
    sections.append(Section("Configuration and provenance", parts=origin, layout="tables"))
    last = records[-1] if records else None
    row = {
        "run": recording.run_id,
        "name": recording.name,
        "seed": UNKNOWN if recording.seed is None else str(recording.seed),
        "status": recording.status,
    }
    if last is not None:
        row |= {heading: texts[0] for heading, texts in metric_columns([last], is_narrow=True).items()}
    title = f"{recording.title} ({recording.run_id})"
    lead = " ".join(_lead(recording, last))
    return Section(title, [lead], parts=sections, is_article=True), row


def _lead(recording: Recording, last: EvaluationRecord | None) -> Iterator[str]:
    """Yield what a run is, and what it achieved at last, a sentence each."""
    config = recording.config
    recent = recording.train.recent_means()
    environment = recording.environment["env_id"].rpartition(":")[2]
    if not has_environment(config):
        yield f"Logged values, recorded by {config['made_by']}."
    elif not recording.can_train_again:
        yield f"A loop over {environment}, recorded by {config['made_by']}."
    else:
        agents = [spoken(agent) for agent in recording.environment["agents"]]
        verb, how = "learn", "by trial and error"
        if recording.has_tables and config["algorithm"] == "random":
            verb, how = "act", "at random: nothing is learned"
        verb += "s" if len(agents) == 1 else ""
        yield f"{capitalised(' and '.join(agents))} {verb} in {environment} {how}."
    if last is not None:
        took = f"took {number(last.value('mean_length'))} steps on average"
        after = f"After {last.episode:,} training episodes"
        returned = last.value("mean_return")
        if last.value("success_percent") is not None:
            yield f"{after} {last.successes} of {last.trials} test trials ended in success; a trial {took}."
        elif returned is not None:
            yield f"{after} a test trial {took} and returned {number(returned)}."
        else:
            yield f"{after} a test trial {took}."
        if sentence := random_policy_sentence(recording):
            yield sentence
    elif not recording.can_train_again and recent.mean_return is not None:
        yield (
            f"The last {recent.episodes:,} training episodes returned {number(recent.mean_return)} on "
            f"average and took {number(recent.mean_length)} steps."
        )


def _episodes(recording: Recording, references: Sequence[EpisodeRef]) -> dict[EpisodeRef, list[str]]:
    """Return the episodes to show, each with the reasons for it.

    They are the chosen ones; the typical, the best and the worst one of the last evaluation, or else of the
    last tenth of training; and of a tabular environment the first and the last one of training.
    """
    if not recording.has_actions:
        return {}
    last = last_whole_evaluation(recording)
    ended = recording.train.episodes.count()
    reasons = [(at.resolved(recording), "chosen") for at in references]
    if last is not None:
        worst, typical, best = ranked(recording, "eval", last.start, last.stop)
        reasons += [(typical, "typical trial"), (best, "best trial"), (worst, "worst trial")]
    elif ended:
        worst, typical, best = ranked(recording, "train", ended - max(1, ended // 10), ended)
        reasons += [
            (typical, "typical of the last tenth"),
            (best, "best of the last tenth"),
            (worst, "worst of the last tenth"),
        ]
    if recording.tabular:
        reasons += [(EpisodeRef(0), "first of training"), (EpisodeRef(max(0, ended - 1)), "last of training")]
    episodes: dict[EpisodeRef, list[str]] = {}
    for at, reason in reasons:
        episodes.setdefault(at, []).append(reason)
    return episodes


def _player(recording: Recording, episodes: Mapping[EpisodeRef, list[str]], progress: Tell) -> Player | None:
    """Return what the page replays; None if no episode can be."""
    playbacks = []
    for at, names in episodes.items():
        try:
            playbacks.append((at, titled(playback_of(recording, at), names)))
        except RecordingError:  # its steps may have been cut off, or never recorded
            if "chosen" in names:
                raise
    if not playbacks:
        return None
    picture = ""
    key = ""
    is_broad = False
    first = playbacks[0][1]
    scene = recording.environment["scene"]
    if first.grid is not None and scene is not None:
        drawing = svg.SvgDrawing(scene)
        places = np.array(first.grid.places, np.int16)[first.grid.at[:1]].reshape(1, -1, 3)
        picture = drawing.frame(places[0], "The grid at the step shown below it", places, style="")
        key = drawing.key()
        is_broad = drawing.width > svg.BROAD
    data = []
    has_frames = False
    for i, (at, episode) in enumerate(playbacks, 1):
        images = Thumbnails()
        if episode.grid is None:
            progress(f"pictures of episode {i} of {len(playbacks)}")
            images = thumbnails(recording.path, at.phase, at.number_in(recording), len(episode.reward) + 1)
            images.picture_note = images.picture_note or picture_note(recording, at.phase)[1]
        has_frames = has_frames or bool(images.pictures)
        data.append(episode.as_json() | asdict(images))
    titles = [episode.title for _, episode in playbacks]
    return Player(titles, picture, key, embedded(data), has_frames, is_broad)


def _title(rows: Sequence[Mapping[str, str]]) -> str:
    if len(rows) == 1:
        return f"{rows[0]['name']}, run {rows[0]['run']}"
    names = list(dict.fromkeys(row["name"] for row in rows))
    return f"{', '.join(names[:4])}{' and others' if len(names) > 4 else ''}: {len(rows)} runs"
