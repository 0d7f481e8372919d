"""Comparisons as self-contained pages: of groups of runs, of algorithms over environments, of two runs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from runner.analysis.compare import Comparison, MetricResult
from runner.analysis.compare import sections as comparison_text
from runner.analysis.compare.tasks import TaskComparison
from runner.analysis.diff import RunDiff
from runner.analysis.diff import sections as diff_text
from runner.analysis.diff.divergence import Divergence
from runner.analysis.diff.extent import common_snapshots
from runner.analysis.groups import Group
from runner.analysis.sections import Figure, Grid, LegendEntry, Section
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
from runner.export.plots.comparisons import intervals_svg, letter, profile_chart, tables_svg, task_charts
from runner.export.plots.curves import curves_section
from runner.export.reports.maps import drawn, on_grid, situation, situation_in_words
from runner.export.reports.rendering import render
from runner.recording.reader import Recording
from runner.recording.run_file import run_title
from runner.util.arrays import Floats
from runner.util.humanize import UNKNOWN, counted

_KEY = (
    "In the plots of values, a dot is a run, the tick the median, the large sign the IQM, and the bar its "
    "interval. A performance profile shows the share of the runs that reach a level; bands are pointwise "
    "95 % intervals."
)


def render_comparison(comparison: Comparison, groups: Sequence[Group]) -> str:
    """Return the page of a comparison, with the learning curves of its groups."""
    labels = [group.label for group in groups]
    _, *metrics, how = comparison_text.sections(comparison)
    rows = [
        (
            run.run_id,
            f"{letter(i)}: {group.label}",
            run.name,
            UNKNOWN if run.seed is None else str(run.seed),
            run.status,
        )
        for i, group in enumerate(groups)
        for run in group.runs
    ]
    return render(
        " against ".join(labels) if len(labels) < 4 else f"{len(labels)} groups of runs compared",
        comparison_text.summary(comparison),
        [
            *(
                replace(section, figures=list(_figures(metric, labels)), layout="pair")
                for section, metric in zip(metrics, comparison.metrics, strict=True)
            ),
            curves_section(groups),
            Section("Runs", grids=[Grid(("run", "group", "name", "seed", "status"), rows)]),
            replace(how, sentences=[*how.sentences, _KEY]),
        ],
        f"the recordings of these runs, {comparison.moment}",
        notes=comparison.notes,
        legend=[
            LegendEntry(letter(i), f"{group.label}: {counted(len(group.runs), 'run')}")
            for i, group in enumerate(groups)
        ],
    )


def _figures(metric: MetricResult, labels: list[str]) -> Iterator[Figure]:
    if not metric.groups:
        return
    yield Figure(intervals_svg(metric, labels), "Values")
    if len(metric.thresholds) > 1:
        title = f"{metric.title}: performance profile"
        is_lower_better = metric.higher_is_better is False
        chart = profile_chart(
            "", title, metric.unit, metric.thresholds, metric.groups, labels, is_lower_better
        )
        yield Figure(chart.svg(), "Performance profile")


def render_tasks(comparison: TaskComparison) -> str:
    """Return the page of a comparison over environments."""
    labels = [result.label for result in comparison.algorithms]
    return render(
        f"{' against '.join(labels)} over {len(comparison.tasks)} environments",
        [],
        drawn_task_sections(comparison),
        f"the recordings of these runs, {comparison.moment}",
    )


def drawn_task_sections(comparison: TaskComparison) -> list[Section]:
    """Return the text of a comparison over environments with its charts."""
    algorithms, scores, how = comparison_text.task_sections(comparison)
    legend = [
        LegendEntry(letter(i), f"{result.label}: {sum(result.seeds.values())} runs")
        for i, result in enumerate(comparison.algorithms)
    ]
    figures = [Figure(chart.svg()) for chart in task_charts(comparison)]
    sentences = [*scores.sentences, "Bands are pointwise 95 % intervals."]
    return [replace(scores, sentences=sentences, figures=figures, legend=legend), algorithms, how]


# --- two runs -----------------------------------------------------------------------------------------


def render_diff(difference: RunDiff, a: Recording, b: Recording) -> str:
    """Return the page of a difference of two recordings."""
    groups = [Group(name, (read_series(recording),)) for name, recording in (("A", a), ("B", b))]
    sides = (difference.a, difference.b)
    return render(
        f"{difference.a['name']} against {difference.b['name']}",
        [diff_text.summary(difference)],
        list(difference_sections(difference, a, b, curves_section(groups).figures).values()),
        "the two recordings",
        notes=difference.notes,
        legend=[
            LegendEntry(name, f"{run_title(side['name'], side['seed'])} ({side['run_id']})")
            for name, side in zip("AB", sides, strict=True)
        ],
    )


def difference_sections(
    difference: RunDiff, a: Recording, b: Recording, curves: Iterable[Figure] = ()
) -> dict[str, Section]:
    """Return the text of a difference with pictures, by title; `curves` are the metrics of both runs."""
    known = {"Metrics", *(section.title for section in diff_text.sections(difference))}
    if "Q-tables" not in difference.not_compared:
        known.add("Q-tables")
    others = {section.title: section for section in diff_text.sections(difference, everything=True)}
    others["Runs"] = replace(others["Runs"], sentences=[])
    drawn = {}
    for title, figures, layout in (
        ("Training", _pictures(difference.divergence, a, b), "grids"),
        ("Evaluation", _pictures(difference.evaluation_divergence, a, b), "grids"),
        ("Metrics", curves, ""),
        ("Q-tables", _table_figures(difference, a, b), "pair"),
    ):
        section = others.pop(title, Section(title))
        if title in known:
            drawn[title] = replace(section, figures=list(figures), layout=layout)
    return drawn | others


def _pictures(divergence: Divergence | None, a: Recording, b: Recording) -> Iterator[Figure]:
    """Yield the grid before the step, if that is the same in both runs, and after it in each."""
    if divergence is None or not (a.tabular and b.tabular):
        return
    same_scene = a.environment.get("scene") == b.environment.get("scene")
    steps = [step for step in (divergence.a_step, divergence.b_step) if step is not None]
    other_starts = len({int(step["state"]) for step in steps}) > 1
    if same_scene and not other_starts and steps:
        yield _picture(a if divergence.a_step is not None else b, steps[0], "Before, in both", False)
    when = "at its start" if other_starts else "after its step"
    for name, recording, step in (("A", a, divergence.a_step), ("B", b, divergence.b_step)):
        if step is not None:
            yield _picture(recording, step, f"{name}, {when}", not other_starts)


def _picture(recording: Recording, step: np.void, title: str, after: bool) -> Figure:
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
        return Figure("", f"{text}. {state_text}" if after else text, title)
    places = drawing.places(mdp, np.array([step["state"], state]))
    picture = drawing.frame(places[1], f"{title}: {state_text}", places, style="")
    return Figure(picture, text, title, drawing.width > svg.BROAD)


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
    state = int(distances.argmax())
    movers = drawing.movers
    states = np.flatnonzero(situation(mdp, state, movers))
    values = on_grid(mdp, states, movers, distances[states])
    bounds = (0.0, float(np.nanmax(values)))
    title = f"Largest difference of {agent}'s Q-values in each state"
    fixed = situation_in_words(mdp, state, movers)
    caption = f"{title}, at the end, in the situation where it is largest{f' ({fixed})' if fixed else ''}."
    if mdp.scene is not None and len(movers) == 2:
        outer, inner = (mdp.scene["things"][mover]["label"] for mover in movers)
        caption += f" Large square: the place of {outer}; in it: the place of {inner}."
    yield Figure(drawn(mdp, values, bounds, title), caption, ramp=bounds)
