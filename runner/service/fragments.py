"""Parts of pages that take long to compute, for child processes: HTML, or JSON for a script."""

from __future__ import annotations

import base64
import json
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final

from markupsafe import Markup, escape

from runner.analysis.axes import axis_of
from runner.analysis.compare.score_table import parse_table
from runner.analysis.compare.task_sections import EXPLANATION as TASKS_EXPLANATION
from runner.analysis.compare.task_sections import task_sections
from runner.analysis.compare.tasks import compare_algorithms
from runner.analysis.diff import diff, with_seconds, without_ignored
from runner.analysis.episodes import (
    EpisodeRef,
    StepLike,
    first_state,
    last_whole_evaluation,
    ranked_trials,
)
from runner.analysis.histograms import histograms
from runner.analysis.sections import Grid, Plot
from runner.analysis.series import series_of
from runner.analysis.summary import random_policy_sentence
from runner.debugging.what_if import branch_playback, what_if
from runner.drawing import svg
from runner.environments.naming import actions_in_words, joint_action, state_of
from runner.errors import ConfigError, RecordingError, RunnerError, shortened
from runner.export.encoded import picture_note
from runner.export.plots.heatmaps import EXPLANATION, constants_in, heatmap_plots
from runner.export.plots.tasks import task_charts
from runner.export.reports.compare import tasks_legend
from runner.export.reports.diff import ShownDivergence, difference_view
from runner.export.reports.maps import maps_of, situations, stages_of
from runner.export.reports.playback import playback_of
from runner.export.reports.player_data import Playback
from runner.export.reports.rendering import Link, partials
from runner.export.rerun.location import locate
from runner.export.rerun.selection import Request
from runner.export.thumbnail import thumbnail
from runner.recording import schema
from runner.recording.messages import media_type
from runner.recording.reader import Recording, open_recording
from runner.runs.run import Run
from runner.service.addresses import link, places_in
from runner.service.computed import TABLE_NAME, as_json
from runner.util.values import Json
from runner.views.view import Answer, Given

MAX_PICTURES: Final = 48
"""Logged pictures that a page shows, of `MAX_PICTURE_BYTES` together."""
MAX_PICTURE_BYTES: Final = 16 << 20
_STEPS_BEFORE: Final = 1
"""Steps before the first one of a part, so that it includes the step that led there."""


@dataclass(frozen=True)
class ShownBranches:
    """Where each joint action at a step leads, and a part of the episode to which one of them leads."""

    facts: dict[str, str]
    notes: Sequence[str]
    action: int
    """The action whose branch is shown, and its name."""
    name: str
    picture: str
    """The grid in the state of the step, as SVG; empty without a scene."""
    matrix: str
    """The actions of two agents, as SVG; empty for other environments."""
    grid: Grid
    addresses: list[str]
    """The page of each action's branch."""
    part: Json
    """As for `episode_part`."""


@dataclass(frozen=True)
class ShownDifference:
    """The difference of two runs."""

    lead: str
    notes: Sequence[str]
    first_frame: str | None
    """The first frame of the replays that differs; None if there is none."""
    body: str
    tables: str
    """Their Q-tables, as HTML as the body is."""


def episode_part(path: Path, at: EpisodeRef, start: int, steps: int) -> bytes:
    """Return a part of an episode as JSON for `replay.js`."""
    with open_recording(path) as recording:
        at = replace(at, t=max(at.t, start))  # the step that an error names
        episode = playback_of(recording, at, steps, max(0, start - _STEPS_BEFORE))
        return _compact(_part(recording, episode, *picture_note(recording, at.phase)))


def branch_part(path: Path, at: str, action: str, start: int, steps: int) -> bytes:
    """Return a part of the episode to which a joint action leads, as `episode_part` does."""
    with open_recording(path) as recording:
        return _compact(_branch_part(recording, at, action, start, steps))


def _compact(part: Json) -> bytes:
    """Return a part of an episode, whose numbers are finite, as JSON without blanks."""
    return json.dumps(part, separators=(",", ":"), ensure_ascii=False).encode(errors="replace")


def what_if_page(run: Run, at: EpisodeRef, action: str | None, start: int, steps: int) -> bytes:
    """Return `ShownBranches` as JSON; the branch shown is that of `action`, None for the recorded one."""

    def address(number: int) -> str:
        return f"/runs/{run.run_id}/what-if/{at}/{number}"

    with open_recording(run.recording) as recording:
        branches = what_if(recording, at=at)
        number = next(row.action for row in branches.actions if row.is_recorded)
        if action is not None:
            number = joint_action(recording.mdp, action)
        shown = ShownBranches(
            facts=branches.facts,
            notes=branches.notes,
            action=number,
            name=str(actions_in_words(recording.mdp)[number]),
            picture=branches.picture(style=""),
            matrix=branches.matrix(address),
            grid=branches.grid,
            addresses=[address(row.action) for row in branches.actions],
            part=_branch_part(recording, at, str(number), start, steps),
        )
        return as_json(shown)


def answer(path: Path, question: Callable[..., Answer], values: Given) -> bytes:
    """Return the answer to a question about a recording as HTML."""
    with open_recording(path) as recording:
        sections = question(recording, **dict(values)).sections()
        return str(partials().answer(sections, recording.run_id)).encode()


def answer_of_run(run: Run, question: Callable[..., Answer], values: Given) -> bytes:
    """Return the answer to a question about a run and the files stored with it as HTML."""
    return str(partials().answer(question(run, **dict(values)).sections(), run.run_id)).encode()


def _branch_part(recording: Recording, at: StepLike, action: str, start: int, steps: int) -> Json:
    episode = branch_playback(recording, at, action, steps, max(0, start - _STEPS_BEFORE))
    return _part(recording, episode, False, "" if episode.grid else "The environment has no scene to draw.")


def _part(recording: Recording, episode: Playback, has_pictures: bool, note: str) -> Json:
    scene = recording.environment["scene"] if episode.grid else None
    return {
        "episode": asdict(episode),
        "scene": scene,
        "has_pictures": has_pictures,
        "picture_note": note,
    }


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
        return thumbnail(recording, step.phase, step.number_in(recording), step.heading).encode()


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
    shown = partials()
    with open_recording(path) as recording:
        drawing = svg.drawing_of(recording.mdp) if recording.tabular else None
        if drawing is None:
            return f"<h2>What was learned</h2>{shown.maps([], broad=False)}".encode()
        mdp, problem, number = recording.mdp, "", _typical_start(recording)
        try:
            number = state_of(mdp, ", ".join(state)) if state else number
        except ConfigError:
            problem = f"There is no state with {shortened(', '.join(state), 200)}."
        rows = maps_of(mdp, recording.agents, stages_of(recording), number)
        form = shown.situation(situations(mdp, number) if rows else [], problem)
        maps = shown.maps(rows, drawing.width > svg.BROAD)
        return f"<h2>What was learned</h2>{form}{maps}".encode()


def distributions(path: Path, axis: str) -> bytes:
    """Return the histograms of a run's training over an axis, as HTML."""
    with open_recording(path) as recording:
        result, notes = histograms(recording, axis_of(axis))
    if not result:
        return b""
    text = " ".join([EXPLANATION, *constants_in(result), *notes])
    return str(partials().charts("distributions", "Distributions", text, heatmap_plots(result))).encode()


def tasks(paths: Sequence[Path], axis: str, scores: str) -> bytes:
    """Return the comparison of runs over environments as HTML; `scores` is a table as CSV, or empty.

    Where nobody asked for scores, a reason why the runs cannot be compared is an answer, not an error.
    """
    table = parse_table(scores, TABLE_NAME) if scores.strip() else None
    try:
        comparison = compare_algorithms(series_of(paths, axis_of(axis)), table)
    except RunnerError as error:
        if table is not None:
            raise
        return f'<p class="hint">{escape(str(error).removeprefix("normalise: "))}</p>'.encode()
    shown = partials()
    plots = [Plot(chart.title, chart.svg(), False) for chart in task_charts(comparison)]
    html = [shown.charts("tasks", "Normalised scores", TASKS_EXPLANATION, plots, tasks_legend(comparison))]
    html += [
        shown.section(f"tasks-{i}", each.title, each) for i, each in enumerate(task_sections(comparison)[:-1])
    ]
    return "".join(html).encode()


def _typical_start(recording: Recording) -> int:
    evaluation = last_whole_evaluation(recording)
    try:
        if evaluation is not None:
            return first_state(recording, ranked_trials(recording, evaluation)[1])
    except RecordingError:  # it has no steps
        pass
    return int(recording.mdp.start.argmax())


def pictures(path: Path) -> bytes:
    """Return the last pictures and films that were logged under a name, the newest first, as HTML."""
    last: deque[tuple[str, int, bytes]] = deque()
    size = 0
    total = 0
    with open_recording(path) as recording:
        for image in recording.table(schema.IMAGE_TOPIC).decoded():
            total, size = total + 1, size + len(image["data"])
            last.append((image["frame_id"], image["log_time"] // schema.STEP_NANOSECONDS, image["data"]))
            while len(last) > MAX_PICTURES or size > MAX_PICTURE_BYTES:
                size -= len(last.popleft()[2])
    figures = [
        Markup(
            '<figure><img src="data:{};base64,{}" alt=""><figcaption>{}, step {:,}</figcaption></figure>'
        ).format(kind, base64.b64encode(data).decode(), name, step)
        for name, step, data in reversed(last)
        if (kind := media_type(data))
    ]
    texts = ["No picture was logged."] if not total else []
    if len(figures) < total:
        texts = [f"The last {len(figures):,} of {total:,} pictures."]
    return str(
        partials().paragraphs(texts) + Markup('<div class="pictures">{}</div>').format(Markup().join(figures))
    ).encode()


def difference(a: Run, b: Run) -> bytes:
    """Return `ShownDifference` as JSON."""
    with open_recording(a.recording) as ours, open_recording(b.recording) as theirs:
        view = difference_view(without_ignored(with_seconds(diff(ours, theirs), a, b), ()), ours, theirs)

    def linked(shown: ShownDivergence) -> ShownDivergence:
        runs = [a.run_id, b.run_id]
        both = link("/compare/replay", {"run": runs, "at": str(shown.frame)})
        viewers = [
            Link(f"{letter} in Rerun", link(f"/runs/{run}/rerun", {"at": str(place)}))
            for letter, run, place in zip("AB", runs, places_in([a, b], shown.step), strict=True)
        ]
        return replace(shown, links=[Link("Both replays at this step", both), *viewers])

    shown = partials()
    body = [shown.divergences(list(map(linked, view.divergences)), view.training, view.visits)]
    body += [shown.section(other.title.lower(), other.title, other) for other in view.others]
    shown_difference = ShownDifference(
        lead=view.lead,
        notes=view.notes,
        first_frame=str(view.divergences[0].frame) if view.divergences else None,
        body="".join(body),
        tables=shown.tables(view.tables, view.table_figures),
    )
    return as_json(shown_difference)


def viewer_place(run: Run, at: EpisodeRef | None) -> bytes:
    """Return the step of the viewer's timeline at a step, and its trial as a loop counts it, as JSON."""
    location = locate(run, Request(), at)
    return as_json({"time": location.time, "trials": location.request.trials})
