"""The difference of two runs as one self-contained page: the text of `dualtaxi diff`, and pictures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from runner.analysis.diff import RunDiff
from runner.analysis.diff.causes import Cause, Row
from runner.analysis.diff.divergence import Divergence
from runner.analysis.diff.sections import (
    evaluation_updates,
    overlap_in_words,
    sections,
    summary,
    updates_in_words,
    visits_grids,
    where_in_words,
    why_in_words,
)
from runner.analysis.diff.tables import common_snapshots
from runner.analysis.episodes import EpisodeRef
from runner.analysis.groups import Group
from runner.analysis.sections import Grid, Plot, Section
from runner.analysis.series import read_series
from runner.drawing import svg
from runner.environments.mdp import Mdp
from runner.environments.naming import (
    agent_actions_in_words,
    exploration_in_words,
    rewards_in_words,
    spoken,
    states_in_words,
)
from runner.export.plots.comparisons import tables_svg
from runner.export.plots.curves import plots_of
from runner.export.reports.maps import drawn, on_grid, situation, situation_in_words
from runner.export.reports.rendering import Figure, LegendEntry, Link, render
from runner.recording.reader import Recording
from runner.recording.run_file import run_title
from runner.util.arrays import Floats
from runner.util.humanize import capitalised

_MAX_VALUES: Final = 6
"""Q-values shown of each run: the highest."""


class StepPicture(NamedTuple):
    """The grid before or after a step, with a text below it."""

    title: str
    svg: str
    text: str
    broad: bool


@dataclass(frozen=True)
class ShownDivergence:
    """The first step that differs, on the page."""

    id: str
    step: EpisodeRef
    frame: EpisodeRef
    """The first frame of the replays that differs."""
    title: str
    where: str
    cause: str
    updates: list[str]
    pictures: list[StepPicture]
    rows: list[Grid]
    links: Sequence[Link] = ()


@dataclass(frozen=True)
class DifferenceView:
    """The page of a difference."""

    title: str
    lead: str
    notes: Sequence[str]
    legend: list[LegendEntry]
    divergences: list[ShownDivergence]
    training: list[str]
    visits: list[Grid]
    plots: list[Plot]
    metrics_section: Section
    tables: Section
    table_figures: list[Figure]
    others: list[Section]
    runs: Section


def render_diff(difference: RunDiff, a: Recording, b: Recording) -> str:
    """Return the page of a difference of two recordings."""
    groups = [Group(name, (read_series(recording),)) for name, recording in (("A", a), ("B", b))]
    return render("diff.html", **vars(difference_view(difference, a, b, plots_of(groups)[0])))


def difference_view(
    difference: RunDiff, a: Recording, b: Recording, plots: Sequence[Plot] = ()
) -> DifferenceView:
    """Return what the page of a difference shows, with plots of the learning curves of both runs."""
    parts = {section.title: section for section in sections(difference, everything=True)}
    sides = (difference.a, difference.b)
    pairs = (
        (difference.divergence, difference.cause),
        (difference.evaluation_divergence, difference.evaluation_cause),
    )
    return DifferenceView(
        title=f"{difference.a['name']} against {difference.b['name']}",
        lead=summary(difference),
        notes=difference.notes,
        legend=[
            LegendEntry(letter, f"{run_title(side['name'], side['seed'])} ({side['run_id']})")
            for letter, side in zip("AB", sides, strict=True)
        ],
        divergences=[
            _divergence(difference, divergence, cause, a, b)
            for divergence, cause in pairs
            if divergence is not None
        ],
        training=overlap_in_words(difference),
        visits=visits_grids(difference),
        plots=list(plots),
        metrics_section=parts["Metrics"],
        tables=parts["Q-tables"],
        table_figures=list(_table_figures(difference, a, b)),
        others=[parts[title] for title in ("Configuration", "Environment", "Code", "Costs", "Provenance")],
        runs=Section("Runs", grids=parts["Runs"].grids[:1]),
    )


def _divergence(
    difference: RunDiff, divergence: Divergence, cause: Cause | None, a: Recording, b: Recording
) -> ShownDivergence:
    is_training = divergence.phase == "train"
    where, why = where_in_words(divergence), why_in_words(divergence, cause)
    return ShownDivergence(
        id=f"divergence-{divergence.phase}",
        step=divergence.reference,
        frame=divergence.frame,
        title="Where training diverges" if is_training else "Where an evaluation diverges",
        where=capitalised(where),
        cause=capitalised(why),
        updates=updates_in_words(cause) if is_training else evaluation_updates(difference, cause),
        pictures=list(_pictures(divergence, a, b)),
        rows=[_values(row) for row in (() if cause is None else cause.rows)],
    )


def _pictures(divergence: Divergence, a: Recording, b: Recording) -> Iterator[StepPicture]:
    """Yield the grid before the step, if that is the same in both runs, and after it in each."""
    if not (a.tabular and b.tabular):
        return
    same_scene = a.environment.get("scene") == b.environment.get("scene")
    steps = [step for step in (divergence.a_step, divergence.b_step) if step is not None]
    other_starts = len({int(step["state"]) for step in steps}) > 1
    if same_scene and not other_starts and steps:
        yield _picture(a if divergence.a_step is not None else b, steps[0], "Before, in both", False)
    when = "at its start" if other_starts else "after its step"
    for letter, recording, step in (("A", a, divergence.a_step), ("B", b, divergence.b_step)):
        if step is not None:
            yield _picture(recording, step, f"{letter}, {when}", not other_starts)


def _picture(recording: Recording, step: np.void, title: str, after: bool) -> StepPicture:
    """Return the grid before or after a step, with the state or the step as text."""
    mdp = recording.mdp
    state = int(step["next_state"] if after else step["state"])
    state_text = str(states_in_words(mdp)[state])
    text = state_text
    if after:
        explored = exploration_in_words(int(step["explored"]), recording.agents) or "greedy"
        rewards = rewards_in_words(step["rewards"])
        end = "; the end" if step["terminated"] else "; the step limit" if step["truncated"] else ""
        text = f"{agent_actions_in_words(mdp)[int(step['action'])]} ({explored}); reward {rewards}{end}"
    if (drawing := svg.drawing_of(mdp)) is None:
        return StepPicture(title, "", f"{text}. {state_text}" if after else text, False)
    places = drawing.places(mdp, np.array([step["state"], state]))
    picture = drawing.frame(places[1], f"{title}: {state_text}", places, style="")
    return StepPicture(title, picture, text, drawing.width > svg.BROAD)


def _values(row: Row) -> Grid:
    """Return the highest Q-values of both runs in the state in which they diverge."""
    a, b = np.array(row.a), np.array(row.b)
    shown = dict.fromkeys(
        int(j) for values in (a, b) for j in np.argsort(-values, kind="stable")[:_MAX_VALUES]
    )
    rows = []
    for j in shown:
        greedy = " and ".join(name for name, own in (("A", a), ("B", b)) if j == int(own.argmax()))
        name = f"{row.actions[j]} (greedy in {greedy})" if greedy else row.actions[j]
        rows.append((name, f"{a[j]:.6g}", f"{b[j]:.6g}"))
    of = f", the highest of {len(row.actions)}" if len(row.actions) > len(shown) else ""
    return Grid((f"Q-values of {spoken(row.agent)} there{of}", "A", "B"), rows)


def _table_figures(difference: RunDiff, a: Recording, b: Recording) -> Iterator[Figure]:
    """Yield the plot of the difference over episodes, and a map of the last difference of each agent."""
    if not any(table.largest > 0 for table in difference.tables):
        return
    yield Figure(tables_svg(difference.tables), "Difference of the tables over training")
    last: dict[int, Floats] = {}
    for ours, theirs in common_snapshots(a, b):
        last[ours.table] = np.abs(ours.values - theirs.values).max(axis=1)
    agents = [table.agent for table in difference.tables[-len(last) :]]
    for number, distances in sorted(last.items()):
        yield from _map(a.mdp, distances, spoken(agents[number]))


def _map(mdp: Mdp, distances: Floats, agent: str) -> Iterator[Figure]:
    """Yield the map of the largest difference in each state, in the situation where it is largest."""
    drawing = svg.drawing_of(mdp)
    if drawing is None or len(drawing.movers) not in (1, 2) or not distances.max() > 0:
        return
    state, movers = int(distances.argmax()), drawing.movers
    states = np.flatnonzero(situation(mdp, state, movers))
    values = on_grid(mdp, states, movers, distances[states])
    bounds = (0.0, float(np.nanmax(values)))
    title = f"Largest difference of {agent}'s Q-values in each state"
    fixed = situation_in_words(mdp, state, movers)
    caption = f"{title}, at the end, in the situation where it is largest{f' ({fixed})' if fixed else ''}."
    if mdp.scene is not None and len(movers) == 2:
        one, other = (mdp.scene["things"][mover]["label"] for mover in movers)
        caption += f" Large square: the place of {one}; in it: the place of {other}."
    yield Figure(drawn(mdp, values, bounds, title), caption, bounds[1])
