"""One self-contained page about one or several runs: their replays, learning curves, maps and evaluations.

The page needs no network: style, script, plots and data are in it. All of it is read from the recordings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from runner.analysis.axes import EPISODES, Axis
from runner.analysis.contents import shortcomings, why_no_steps
from runner.analysis.episodes import EpisodeRef, first_state, last_whole_evaluation, ranked, ranked_trials
from runner.analysis.evaluations import EvaluationRecord, evaluation_records, evaluations_section
from runner.analysis.groups import groups_of
from runner.analysis.sections import Section
from runner.analysis.series import RunSeries, read_series, values_left_out
from runner.analysis.summary import describe_recording, random_policy_sentence
from runner.drawing import svg
from runner.environments.naming import spoken
from runner.errors import RecordingError
from runner.export.encoded import Thumbnails, picture_note, thumbnails
from runner.export.plots.curves import plots_of
from runner.export.plots.style import PLAIN, CurveStyle
from runner.export.reports.maps import MapRow, maps_of, stages_of
from runner.export.reports.playback import MAX_VALUES, playback_of, titled
from runner.export.reports.rendering import LegendEntry, embedded, render, templates
from runner.recording.metrics import METRICS
from runner.recording.reader import Recording, open_recording
from runner.recording.run_file import RecentTraining, has_environment
from runner.runs.listing import run_at
from runner.util.processes import Tell


@dataclass(frozen=True)
class ReportReplay:
    """The episodes that the page of a run replays."""

    titles: list[str]
    picture: str
    """The grid at the first frame; empty without a scene."""
    key: str
    data: str
    """JSON for `replay.js`."""
    has_frames: bool
    """Whether it has pictures of the environment."""


@dataclass(frozen=True)
class ReportedRun:
    """A run on the page."""

    number: int
    id: str
    name: str
    seed: int | None
    title: str
    status: str
    environment: str
    agents: list[str]
    is_random: bool
    made_by: str
    """The program that recorded a loop; empty for a job."""
    last: EvaluationRecord | None
    """The last evaluation."""
    recent: RecentTraining
    """The last training episodes."""
    random_policy: str
    """A sentence on what a random policy achieves; empty if unknown."""
    has_steps: bool
    evaluations: Section | None
    broad: bool
    origin: list[Section]
    notes: list[str]
    maps: list[MapRow]
    replay: ReportReplay | None
    has_tables: bool


def require_packages() -> None:
    """Check that the packages that a report needs are installed."""
    templates()


def render_report(
    recordings: Sequence[Path],
    chosen: Sequence[EpisodeRef] = (),
    progress: Tell = lambda _: None,
    axis: Axis = EPISODES,
    style: CurveStyle = PLAIN,
) -> tuple[str, list[str]]:
    """Return the page about some recordings, and what is missing from it, a sentence each.

    The chosen episodes are shown in addition to those that are always shown; `progress` is called with the
    next stage of the work; axis and style are those of the plots.
    """
    require_packages()
    series: list[RunSeries] = []
    runs: list[ReportedRun] = []
    for count, path in enumerate(recordings, 1):
        progress(f"reading run {count} of {len(recordings)}")
        with open_recording(path) as recording:
            series.append(read_series(recording, axis))
            runs.append(_run(recording, len(runs), chosen, progress))
    progress("drawing")
    groups = groups_of(series)
    legend = [LegendEntry("", group.described) for group in groups]
    columns = [  # the metrics of the last evaluations that any run knows
        metric
        for metric in METRICS
        if not (metric.per_agent and any(run.has_tables for run in runs))
        and any(run.last is not None and run.last.value(metric.name) is not None for run in runs)
    ]
    plots, footnote = plots_of(groups, style)
    page = render(
        "report.html",
        title=_title(runs),
        runs=runs,
        plots=plots,
        footnote=footnote,
        legend=legend,
        columns=columns,
        max_values=MAX_VALUES,
    )
    return page, [*(note for run in runs for note in run.notes), *values_left_out(series)]


def _run(recording: Recording, number: int, chosen: Sequence[EpisodeRef], progress: Tell) -> ReportedRun:
    evaluations = evaluation_records(recording)
    environment = recording.environment
    episodes = _episodes(recording, chosen)
    replay = _replay(recording, episodes, progress)
    notes = shortcomings(recording)
    if not recording.has_actions:
        notes.append(
            f"No episode of run {recording.run_id} can be replayed, as there are no steps: "
            f"{why_no_steps(recording)}."
        )
    drawing = None if environment["scene"] is None else svg.SvgDrawing(environment["scene"])
    return ReportedRun(
        number=number,
        id=recording.run_id,
        name=recording.name,
        seed=recording.seed,
        title=recording.title,
        status=recording.status,
        environment=environment["env_id"].rpartition(":")[2] if has_environment(recording.config) else "",
        agents=[spoken(agent) for agent in environment["agents"]],
        is_random=recording.has_tables and recording.config["algorithm"] == "random",
        made_by="" if recording.can_train_again else recording.config["made_by"],
        last=evaluations[-1] if evaluations else None,
        recent=recording.train.recent_means(),
        random_policy=random_policy_sentence(recording),
        has_steps=any(phase.steps for phase in recording.phases),
        evaluations=evaluations_section(recording, evaluations) if evaluations else None,
        broad=drawing is not None and drawing.width > svg.BROAD,
        origin=describe_recording(run_at(recording.path), recording, with_results=False).origin_sections(),
        notes=notes,
        maps=_maps(recording, next(iter(episodes), None)),
        replay=replay,
        has_tables=recording.has_tables,
    )


def _episodes(recording: Recording, chosen: Sequence[EpisodeRef]) -> dict[EpisodeRef, list[str]]:
    """Return the episodes to show, each with the reasons for it.

    They are the chosen ones; the typical, the best and the worst one of the last evaluation, or else of the
    last tenth of training; and of a tabular environment the first and the last one of training.
    """
    if not recording.has_actions:
        return {}
    last, ended = last_whole_evaluation(recording), recording.train.episodes.count()
    reasons = [(at.resolved(recording), "chosen") for at in chosen]
    if last is not None:
        worst, typical, best = ranked_trials(recording, last)
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


def _maps(recording: Recording, episode: EpisodeRef | None) -> list[MapRow]:
    """Return the maps, for the situation in which an episode begins."""
    if not recording.tabular:
        return []
    mdp = recording.mdp
    start = int(mdp.start.argmax())
    try:
        if episode is not None:
            start = first_state(recording, episode)
        return maps_of(mdp, recording.agents, stages_of(recording), start)
    except RecordingError:
        return []


def _replay(
    recording: Recording, episodes: Mapping[EpisodeRef, list[str]], progress: Tell
) -> ReportReplay | None:
    """Return what the page replays; None if no episode can be."""
    shown = []
    for at, names in episodes.items():
        try:
            shown.append((at, titled(playback_of(recording, at), names)))
        except RecordingError:  # its steps may have been cut off, or never recorded
            if "chosen" in names:
                raise
    if not shown:
        return None
    picture, key, first, scene = "", "", shown[0][1], recording.environment["scene"]
    if first.grid is not None and scene is not None:
        drawing = svg.SvgDrawing(scene)
        places = np.array(first.grid.places, np.int16)[first.grid.at[:1]].reshape(1, -1, 3)
        picture = drawing.frame(places[0], "The grid at the step shown below it", places, style="")
        key = drawing.key()
    data, has_frames = [], False
    for number, (at, episode) in enumerate(shown, 1):
        own = Thumbnails()
        if episode.grid is None:
            progress(f"pictures of episode {number} of {len(shown)}")
            own = thumbnails(recording.path, at.phase, at.number_in(recording), len(episode.reward) + 1)
            own.picture_note = own.picture_note or picture_note(recording, at.phase)[1]
        has_frames = has_frames or bool(own.pictures)
        data.append(asdict(episode) | asdict(own))
    return ReportReplay([episode.title for _, episode in shown], picture, key, embedded(data), has_frames)


def _title(runs: Sequence[ReportedRun]) -> str:
    if len(runs) == 1:
        return f"{runs[0].name}, run {runs[0].id}"
    names = list(dict.fromkeys(run.name for run in runs))
    return f"{', '.join(names[:4])}{' and others' if len(names) > 4 else ''}: {len(runs)} runs"
