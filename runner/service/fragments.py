"""Parts of pages that take long to compute, for child processes: HTML, or JSON for a script."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from markupsafe import escape

from runner.analysis.axes import axis_of
from runner.analysis.compare.score_table import scores_of
from runner.analysis.compare.tasks import compare_algorithms
from runner.analysis.diff import diff, with_seconds, without_ignored
from runner.analysis.diff.divergence import Divergence
from runner.analysis.diff.sections import made_sections, summary
from runner.analysis.episodes import TYPICAL, EpisodeRef, StepLike
from runner.analysis.histograms import histograms
from runner.analysis.sections import Answer, Figure, Link, Section
from runner.analysis.series import series_of
from runner.analysis.summary import random_policy_sentence
from runner.debugging.what_if import branch_playback, what_if
from runner.drawing import svg
from runner.environments.naming import actions_in_words, joint_action, state_of
from runner.errors import ConfigError, RunnerError, shortened
from runner.export.encoded import picture_note
from runner.export.plots.heatmaps import EXPLANATION, constants_in, heatmap_plots
from runner.export.reports.compare import drawn_task_sections
from runner.export.reports.diff import difference_sections
from runner.export.reports.maps import learned_section, situations, start_of
from runner.export.reports.playback import playback_of
from runner.export.reports.player_data import Playback
from runner.export.reports.rendering import partials
from runner.export.rerun.location import locate
from runner.export.rerun.selection import Request
from runner.export.thumbnail import thumbnail
from runner.recording import schema
from runner.recording.messages import media_type
from runner.recording.reader import Recording, open_recording
from runner.runs.run import Run
from runner.service.addresses import link, places_in
from runner.service.computed import as_json
from runner.util.humanize import sentence
from runner.util.values import Json
from runner.views.view import Given

MAX_PICTURES: Final = 48
"""Logged pictures that a page shows, of `MAX_PICTURE_BYTES` together."""
MAX_PICTURE_BYTES: Final = 16 << 20
_STEPS_BEFORE: Final = 1
"""Steps before the first one of a part, so that it includes the step that led there."""


@dataclass(frozen=True)
class ShownDifference:
    """What differs between two runs."""

    tabs: Mapping[str, tuple[str, Sequence[str], str]]
    """Lead, notes and HTML of tabs: where they diverge and what else differs, their Q-tables, their code."""
    first_frame: str | None = None
    """The first frame of the replays that differs; None if there is none."""


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
    """Return a part of an episode as JSON without blanks; its numbers are finite."""
    return json.dumps(part, separators=(",", ":"), ensure_ascii=False).encode(errors="replace")


def what_if_page(path: Path, at: EpisodeRef, action: str | None, start: int, steps: int) -> bytes:
    """Return a part as `branch_part` does, with its action and, as HTML, where each joint action leads.

    It is the branch of `action`, None for the recorded one.
    """
    with open_recording(path) as recording:
        found = what_if(recording, at=at)
        base = f"/runs/{recording.run_id}/"
        number = next(row.action for row in found.actions if row.is_recorded)
        if action is not None:
            number = joint_action(recording.mdp, action)
        *before, after = found.sections(base)
        texts = {
            "action": str(number),
            "name": str(actions_in_words(recording.mdp)[number]),
            "before": str(partials().notes(found.notes) + partials().answer(before, base)),
            "after": str(partials().answer([after], base)),
        }
        return _compact(_branch_part(recording, at, str(number), start, steps) | texts)


def answer(subject: Path | Run, question: Callable[..., Answer], values: Given) -> bytes:
    """Return the answer to a question about a recording or a run as HTML."""
    with open_recording(subject) if isinstance(subject, Path) else nullcontext(subject) as content:
        sections = question(content, **dict(values)).sections()
        return str(partials().answer(sections, f"/runs/{content.run_id}/")).encode()


def _branch_part(recording: Recording, at: StepLike, action: str, start: int, steps: int) -> Json:
    episode = branch_playback(recording, at, action, steps, max(0, start - _STEPS_BEFORE))
    return _part(recording, episode, False, "" if episode.grid else "The environment has no scene to draw.")


def _part(recording: Recording, episode: Playback, has_pictures: bool, note: str) -> Json:
    scene = recording.environment["scene"] if episode.grid else None
    return {
        "episode": episode.as_json(),
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
        found = without_ignored(with_seconds(diff(ours, theirs), a, b), ())
        shown = difference_sections(found, ours, theirs)
    divergences = {"Training": found.divergence, "Evaluation": found.evaluation_divergence}
    known = {title: divergence for title, divergence in divergences.items() if divergence is not None}
    for title, divergence in known.items():
        shown[title] = replace(shown[title], links=_links([a, b], divergence))
    body = [section for title, section in shown.items() if title not in ("Metrics", "Q-tables", "Runs")]
    first = next(iter(known.values()), None)
    tables = shown.get("Q-tables", Section("Q-tables", ["There are none to compare."]))
    tabs = {
        "divergence": (summary(found), found.notes, partials().answer(body)),
        "tables": ("", [] if "Q-tables" in shown else found.notes, partials().answer([tables])),
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
