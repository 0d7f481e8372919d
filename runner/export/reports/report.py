"""One self-contained page about one or several runs: their replays, learning curves, maps and evaluations.

The page needs no network: style, script, plots and data are in it. All of it is read from the recordings.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from runner.analysis.evaluations import EvaluationRecord, evaluation_records
from runner.analysis.groups import groups_of
from runner.analysis.series import RunSeries, read_series, values_left_out
from runner.analysis.summary import random_policy_sentence
from runner.drawing import svg
from runner.environments.naming import spoken
from runner.errors import RecordingError
from runner.export.contents import flat_text, shortcomings, why_no_steps
from runner.export.plots.curves import Plot, footnote, plots_of
from runner.export.reports.episode import (
    MAX_VALUES,
    Episode,
    last_whole_evaluation,
    payload,
    ranked_trials,
    training_episode,
    trial,
)
from runner.export.reports.evaluations import EvaluationTable, evaluation_table
from runner.export.reports.maps import MapRow, maps_of, stages_of
from runner.export.reports.rendering import LegendEntry, View, embedded, render, templates
from runner.recording import schema
from runner.recording.reader import Recording, open_recording

Choice = tuple[str, int, int]
"""An episode to show: ("train", number, 0), or ("eval", training episodes before it, trial)."""


@dataclass(frozen=True)
class Replay:
    """The episodes that the page of a run replays."""

    titles: list[str]
    picture: str
    """The grid at the first frame; empty without a scene."""
    key: str
    data: str
    """JSON for `replay.js`."""


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
    random_policy: str
    """A sentence on what a random policy achieves; empty if unknown."""
    has_steps: bool
    evaluations: EvaluationTable | None
    broad: bool
    facts: Mapping[str, str]
    config: Mapping[str, str]
    provenance: Mapping[str, str]
    notes: list[str]
    maps: list[MapRow]
    replay: Replay | None


@dataclass(frozen=True)
class _ReportView(View):
    TEMPLATE: ClassVar = "report.html"
    title: str
    runs: list[ReportedRun]
    plots: list[Plot]
    legend: list[LegendEntry]
    footnote: str
    max_values: int = MAX_VALUES


def write_report(
    path: Path,
    recordings: Sequence[Path],
    chosen: Sequence[Choice] = (),
    progress: Callable[[str], None] = lambda _: None,
) -> list[str]:
    """Write the page about some recordings, and return what is missing from it, a sentence each.

    Args:
        path: the file to write.
        recordings: the MCAP files.
        chosen: episodes to show in addition to those that are always shown.
        progress: called with the next stage of the work.

    Raises:
        MissingExtra: Jinja2 is not installed.
        RecordingError: a recording cannot be read, or has no such episode.
        OSError: the page cannot be written.
    """
    page, missing = render_report(recordings, chosen, progress)
    path.write_text(page, encoding="utf-8")
    return missing


def require_packages() -> None:
    """Check that the packages that a report needs are installed.

    Raises:
        MissingExtra: one is not.
    """
    templates()


def render_report(
    recordings: Sequence[Path],
    chosen: Sequence[Choice] = (),
    progress: Callable[[str], None] = lambda _: None,
) -> tuple[str, list[str]]:
    """Return the page about some recordings, and what is missing from it; see `write_report`."""
    require_packages()
    series: list[RunSeries] = []
    runs: list[ReportedRun] = []
    for count, path in enumerate(recordings, 1):
        progress(f"reading run {count} of {len(recordings)}")
        with open_recording(path) as recording:
            series.append(read_series(recording))
            runs.append(_run(recording, len(runs), chosen))
    progress("drawing")
    groups = groups_of(series)
    legend = [LegendEntry("", group.described) for group in groups]
    page = render(_ReportView(_title(runs), runs, plots_of(groups), legend, footnote(groups)))
    return page, [*(note for run in runs for note in run.notes), *values_left_out(series)]


def _run(recording: Recording, number: int, chosen: Sequence[Choice]) -> ReportedRun:
    evaluations = evaluation_records(recording)
    environment = recording.environment
    episodes = _episodes(recording, chosen)
    drawing = None if environment["scene"] is None else svg.Drawing(environment["scene"])
    events, is_job = environment["event_names"], recording.is_job
    table = evaluation_table(evaluations, recording.agents, events, is_job) if evaluations else None
    return ReportedRun(
        number=number,
        id=recording.run_id,
        name=recording.name,
        seed=recording.seed,
        title=recording.title,
        status=recording.status,
        environment=environment["env_id"].rpartition(":")[2],
        agents=[spoken(agent) for agent in environment["agents"]],
        is_random=is_job and recording.config["algorithm"] == "random",
        made_by="" if is_job else recording.config["made_by"],
        last=evaluations[-1] if evaluations else None,
        random_policy=random_policy_sentence(recording),
        has_steps=recording.has_steps,
        evaluations=table,
        broad=drawing is not None and drawing.width > svg.BROAD,
        facts=_facts(recording),
        config=flat_text(recording.config),
        provenance=recording.provenance,
        notes=_notes(recording),
        maps=_maps(recording, episodes),
        replay=_replay(recording, episodes, drawing) if episodes else None,
    )


def _notes(recording: Recording) -> list[str]:
    """Return what is missing from the recording, a sentence each."""
    notes = shortcomings(recording)
    if not recording.is_job:
        notes.append(
            f"Run {recording.run_id} was recorded from a loop: what it learned is unknown, so the page shows "
            "no episode of it; `dualtaxi view` shows what was recorded."
        )
    elif not recording.has_steps:
        notes.append(
            f"No episode of run {recording.run_id} can be replayed, as there are no steps: "
            f"{why_no_steps(recording)}."
        )
    return notes


def _facts(recording: Recording) -> dict[str, str]:
    """Return what identifies a run, and how much of it was recorded."""
    config = recording.config
    episodes, steps, trial_steps = map(
        recording.count, (schema.TRAIN_EPISODE, schema.TRAIN_STEP, schema.EVAL_STEP)
    )
    if recording.is_job:
        facts = {
            "Environment": config["env"]["id"],
            "Algorithm": spoken(config["algorithm"]),
            "Tables": f"{spoken(config['tables'])}, reward: {config['rewards']}",
            "Training": f"{episodes:,} of {config['episodes']:,} episodes, {steps:,} steps recorded",
            "Evaluation": f"{trial_steps:,} steps recorded",
            "Job": recording.job,
        }
    else:
        spaces = {name: space["type"] for name, space in recording.spaces.items()}
        parallel = f", {recording.environments} in parallel" if recording.environments > 1 else ""
        facts = {
            "Environment": f"{config['env']['id']}{parallel}",
            "Recorded": f"from a loop, by {config['made_by']}",
            "Spaces": f"observation {spaces['observation']}, action {spaces['action']}",
            "Training": f"{episodes:,} episodes, {steps:,} steps",
            "Evaluation": f"{trial_steps:,} steps",
        }
    facts["Begun"] = recording.created
    facts["Content digest"] = recording.result.content_digest or f"none ({recording.status})"
    return {key: str(value) for key, value in facts.items()}


def _episodes(recording: Recording, chosen: Sequence[Choice]) -> list[Episode]:
    """Return the episodes to show: the chosen ones, of the last evaluation, first and last of training."""
    if not recording.has_steps or not recording.is_job:
        return []
    found: dict[str, Episode] = {}

    def add(name: str, episode: Episode) -> None:
        found[episode.title] = found.get(episode.title, episode).called(name)

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
    last = recording.count(schema.TRAIN_EPISODE) - 1
    for name, number in (("first of training", 0), ("last of training", last)):
        with contextlib.suppress(RecordingError):  # its steps may have been cut off, or never recorded
            add(name, training_episode(recording, number))
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


def _replay(recording: Recording, episodes: list[Episode], drawing: svg.Drawing | None) -> Replay:
    mdp = recording.mdp
    data = payload(recording, episodes, drawing)
    picture, key = "", ""
    if drawing is not None:
        first = drawing.places(mdp, episodes[0].states[:1])
        picture = drawing.frame(first[0], "The grid at the step shown below it", first, style="")
        key = drawing.key()
    titles = [episode.heading for episode in episodes]
    return Replay(titles, picture, key, embedded(data))


def _title(runs: Sequence[ReportedRun]) -> str:
    if len(runs) == 1:
        return f"{runs[0].name}, run {runs[0].id}"
    names = list(dict.fromkeys(run.name for run in runs))
    return f"{', '.join(names[:4])}{' and others' if len(names) > 4 else ''}: {len(runs)} runs"
