"""One self-contained page about one or several runs: what they were, how they learned, how they drive.

The page needs no network: styles, script, plots and data are in it. All of it is read from the recordings.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from runner.analysis.evaluations import evaluation_records, evaluation_summary
from runner.analysis.groups import groups_of
from runner.analysis.series import RunSeries, read_series, values_left_out
from runner.analysis.summary import random_policy_sentence
from runner.drawing import palette, svg
from runner.environments.naming import event_in_words, spoken
from runner.errors import RecordingError
from runner.export.contents import flat_text, shortcomings, why_no_steps
from runner.export.plots.curves import footnote, plots_of
from runner.export.reports.episode import (
    Episode,
    last_whole_evaluation,
    payload,
    ranked_trials,
    training_episode,
    trial,
)
from runner.export.reports.maps import MapRow, maps_of, stages_of
from runner.export.reports.rendering import embedded, templates
from runner.recording import schema
from runner.recording.reader import Recording, open_recording

if TYPE_CHECKING:
    pass

Choice = tuple[str, int, int]
"""An episode to show: ("train", number, 0), or ("eval", training episodes before it, trial)."""


def write_report(
    path: Path,
    recordings: Sequence[Path],
    chosen: Sequence[Choice] = (),
    progress: Callable[[str], None] = lambda _: None,
) -> list[str]:
    """Write the page about these recordings, and return what is missing from it, a sentence each.

    Args:
        path: where to.
        recordings: the MCAP files.
        chosen: episodes to show beside those that are always there.
        progress: called with what is done next.

    Raises:
        MissingExtra: Jinja2 is not installed.
        RecordingError: a recording cannot be read, or has no such episode.
        OSError: the page cannot be written.
    """
    page, said = render_report(recordings, chosen, progress)
    path.write_text(page, encoding="utf-8")
    return said


def require_packages() -> None:
    """Refuse to begin where a package is missing that a report needs.

    Raises:
        MissingExtra: it is.
    """
    templates()


def render_report(
    recordings: Sequence[Path],
    chosen: Sequence[Choice] = (),
    progress: Callable[[str], None] = lambda _: None,
) -> tuple[str, list[str]]:
    """Return the page about these recordings, and what is missing from it; see `write_report`."""
    require_packages()
    series: list[RunSeries] = []
    runs: list[dict[str, Any]] = []
    for number, path in enumerate(recordings):
        progress(f"reading run {number + 1} of {len(recordings)}")
        with open_recording(path) as recording:
            series.append(read_series(recording))
            runs.append(_run(recording, len(runs), chosen))
    progress("drawing")
    page = (
        templates()
        .get_template("report.html")
        .render(
            title=_title(runs),
            runs=runs,
            plots=_plots(series),
        )
    )
    return page, [*(sentence for run in runs for sentence in run["notes"]), *values_left_out(series)]


# --- one run ------------------------------------------------------------------------------------------


def _run(recording: Recording, number: int, chosen: Sequence[Choice]) -> dict[str, Any]:
    """Return all that the page says of a run."""
    evaluations = evaluation_records(recording)
    environment = recording.environment
    episodes = _episodes(recording, chosen)
    drawing = None if environment["scene"] is None else svg.Drawing(environment["scene"])
    return {
        "number": number,
        "id": recording.run_id,
        "name": recording.name,
        "seed": recording.seed,
        "title": recording.title,
        "state": recording.status,
        "agents": [spoken(agent) for agent in environment["agents"]],
        "learners": recording.agents,
        "environment": environment,
        "facts": _facts(recording),
        "conduct": _conduct(recording),
        "made_by": recording.config.get("made_by", ""),
        "last": evaluations[-1] if evaluations else None,
        "last_return": evaluation_summary(evaluations[-1])["mean_return"] if evaluations else None,
        "random": random_policy_sentence(recording),
        "steps": recording.has_steps,
        "evaluations": evaluations,
        "event_names": [_heading(name) for name in environment["event_names"]],
        "broad": drawing is not None and drawing.width > svg.BROAD,
        "config": flat_text(recording.config),
        "provenance": recording.provenance,
        "notes": _notes(recording),
        "maps": _maps(recording, episodes),
        "replay": _replay(recording, episodes, drawing),
    }


def _notes(recording: Recording) -> list[str]:
    """Return what a reader should know that is missing, a sentence each."""
    run, notes = recording.run_id, shortcomings(recording)
    if not recording.is_job:
        notes.append(
            f"Run {run} was recorded from a loop: what it learned is not known, so no episode is shown with "
            "it; `dualtaxi view` shows what was recorded."
        )
    elif not recording.has_steps:
        notes.append(
            f"No episode of run {run} can be replayed, as there are no steps: {why_no_steps(recording)}."
        )
    return notes


def _conduct(recording: Recording) -> str:
    """Return how the agents of a run act: `learning`, `random`, or unknown, in a `loop`."""
    if not recording.is_job:
        return "loop"
    return "random" if recording.config["algorithm"] == "random" else "learning"


def _facts(recording: Recording) -> dict[str, str]:
    """Return what identifies a run and how much of it there is."""
    counts = {
        topic: recording.count(topic) for topic in (schema.TRAIN_EPISODE, schema.TRAIN_STEP, schema.EVAL_STEP)
    }
    config = recording.config
    if not recording.is_job:
        return _loop_facts(recording, counts)
    told = {
        "Environment": config["env"]["id"],
        "Algorithm": spoken(config["algorithm"]),
        "Tables": f"{spoken(config['tables'])}, reward: {config['rewards']}",
        "Training": f"{counts[schema.TRAIN_EPISODE]:,} of {config['episodes']:,} episodes, "
        f"{counts[schema.TRAIN_STEP]:,} steps recorded",
        "Evaluation": f"{counts[schema.EVAL_STEP]:,} steps recorded",
        "Begun": recording.created,
        "Job": recording.job,
        "Content digest": recording.result.content_digest or f"none ({recording.status})",
    }
    return {key: str(value) for key, value in told.items()}


def _loop_facts(recording: Recording, counts: Mapping[schema.Topic, int]) -> dict[str, str]:
    """Return what identifies somebody's own loop and how much of it there is."""
    spaces = {name: str(space["type"]) for name, space in recording.spaces.items()}
    environments = f", {recording.environments} at once" if recording.environments > 1 else ""
    return {
        "Environment": f"{recording.config['env']['id']}{environments}",
        "Recorded": f"from a loop, by {recording.config['made_by']}",
        "Spaces": f"observation {spaces['observation']}, action {spaces['action']}",
        "Training": f"{counts[schema.TRAIN_EPISODE]:,} episodes, {counts[schema.TRAIN_STEP]:,} steps",
        "Evaluation": f"{counts[schema.EVAL_STEP]:,} steps",
        "Begun": recording.created,
        "Content digest": recording.result.content_digest or f"none ({recording.status})",
    }


def _episodes(recording: Recording, chosen: Sequence[Choice]) -> list[Episode]:
    """Return the episodes that are shown: of the last evaluation, and the first and last of training."""
    if not recording.has_steps or not recording.is_job:
        return []
    found: dict[str, Episode] = {}

    def add(told: str, episode: Episode) -> None:
        known = found.setdefault(episode.title, episode)
        found[episode.title] = known.called(told)

    for phase, number, of in chosen:
        add(
            "chosen",
            training_episode(recording, number) if phase == "train" else trial(recording, number, of),
        )
    after = last_whole_evaluation(recording)
    if after is not None:
        worst, typical, best = ranked_trials(recording, after)
        add("typical trial", trial(recording, after, typical))
        add("best trial", trial(recording, after, best))
        add("worst trial", trial(recording, after, worst))
    ended = recording.count(schema.TRAIN_EPISODE)
    for told, number in (("first of training", 0), ("last of training", ended - 1)):
        with contextlib.suppress(RecordingError):  # the steps may have been cut off, or never recorded
            add(told, training_episode(recording, number))
    return list(found.values())


def _maps(recording: Recording, episodes: Sequence[Episode]) -> list[MapRow]:
    """Return the maps, for the situation in which the first episode shown begins."""
    if not recording.is_job:
        return []
    mdp = recording.mdp
    start = int(episodes[0].states[0]) if episodes else int(mdp.start.argmax())
    try:
        return maps_of(mdp, recording.agents, stages_of(recording), start)
    except RecordingError:
        return []


def _replay(recording: Recording, episodes: list[Episode], drawing: svg.Drawing | None) -> dict[str, Any]:
    """Return the replay's picture at the first frame, and its data."""
    if not episodes:
        return {}
    mdp = recording.mdp
    places = None if drawing is None else lambda states: drawing.places(mdp, states)
    data = payload(recording, episodes, places)
    picture = ""
    if drawing is not None:
        first = drawing.places(mdp, episodes[0].states[:1])
        picture = drawing.frame(first[0], "The grid at the step shown below it", first, style="")
    return {
        "data": embedded(data | {"trail": svg.TRAIL}),
        "picture": picture,
        "key": "" if drawing is None else drawing.key(),
        "episodes": data["episodes"],
    }


# --- the page -----------------------------------------------------------------------------------------


def _title(runs: Sequence[dict[str, Any]]) -> str:
    if len(runs) == 1:
        return f"{runs[0]['name']}, run {runs[0]['id']}"
    names = list(dict.fromkeys(run["name"] for run in runs))
    return f"{', '.join(names[:4])}{' and others' if len(names) > 4 else ''}: {len(runs)} runs"


def _plots(series: Sequence[RunSeries]) -> dict[str, Any]:
    """Return the panels as SVG, what their colours mean, and what lines and bands are."""
    groups = groups_of(series)
    panels = plots_of(groups)
    if not panels:
        return {}
    return {
        "panels": panels,
        "groups": [(i % len(palette.SERIES), group.described) for i, group in enumerate(groups)],
        "footnote": footnote(groups),
    }


def _heading(event: str) -> str:
    """Return an event as the heading of a column, the agent on a line of its own."""
    agent, dot, _ = event.rpartition(".")
    words = event_in_words(event)
    return f"{words[: len(agent)]}\n{words[len(agent) + 1 :]}" if dot else words
