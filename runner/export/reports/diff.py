"""The difference of two runs as one self-contained page: what `dualtaxi diff` tells, and pictures of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.analysis.diff import Cause, Divergence, Row, RunDiff
from runner.analysis.diff.sections import (
    evaluation_updates,
    overlap_in_words,
    sections,
    summary,
    updates_in_words,
    visits_grids,
    where_in_words,
)
from runner.analysis.diff.tables import common_snapshots
from runner.analysis.groups import Group
from runner.analysis.sections import Grid, Section
from runner.analysis.series import read_series
from runner.drawing import svg, svg_maps
from runner.environments.mdp import Mdp
from runner.environments.naming import exploration_in_words, spoken, states_in_words
from runner.export.plots.comparisons import tables_svg
from runner.export.plots.curves import Plot, plots_of
from runner.export.reports.episode import deeds_in_words
from runner.export.reports.maps import situation, situation_in_words
from runner.export.reports.rendering import templates
from runner.export.reports.report import require_packages
from runner.recording.reader import Recording
from runner.recording.run_file import run_title

_MOST_VALUES: Final = 6
"""Q-values shown of each run: the highest."""
_GREEDY: Final = "\N{NO-BREAK SPACE}◀\N{NO-BREAK SPACE}greedy"


def render_diff(difference: RunDiff, a: Recording, b: Recording) -> str:
    """Return the page.

    Args:
        difference: of these two.
        a: one run.
        b: the other.

    Raises:
        MissingExtra: Jinja2 or Matplotlib is not installed.
    """
    require_packages()
    return (
        templates()
        .get_template("diff.html")
        .render(
            told_of(difference, a, b),
            panels=_curves(a, b),
        )
    )


def told_of(difference: RunDiff, a: Recording, b: Recording) -> dict[str, Any]:
    """Return what a page tells and shows of a difference, its pictures as SVG.

    Args:
        difference: of these two.
        a: one run.
        b: the other.

    Raises:
        MissingExtra: Matplotlib is not installed.
    """
    names = [
        f"{run_title(who['name'], who['seed'])} ({who['run_id']})" for who in (difference.a, difference.b)
    ]
    told = {section.title: section for section in sections(difference, everything=True)}
    return {
        "title": f"{difference.a['name']} against {difference.b['name']}",
        "lead": summary(difference),
        "notes": difference.notes,
        "legend": [(i, "AB"[i], name) for i, name in enumerate(names)],
        "divergences": [_divergence(difference, *pair, a, b) for pair in _divergences(difference)],
        "training": overlap_in_words(difference) + _loop_divergences(told, difference),
        "visits": visits_grids(difference),
        "tables": {"figures": _table_figures(difference, a, b), **_parts(told["Q-tables"])},
        "metrics": _parts(told["Metrics"]),
        "others": [
            {"id": title.lower(), "title": title, **_parts(told[title])}
            for title in ("Configuration", "Environment", "Costs", "Provenance")
        ],
        "runs": told["Runs"].grids[0],
    }


def _parts(section: Section) -> dict[str, Any]:
    return {"sentences": section.sentences, "grids": section.grids}


def _divergences(difference: RunDiff) -> Iterator[tuple[Divergence, Cause]]:
    """Yield where two jobs diverge, and why."""
    if difference.divergence is not None and difference.cause is not None:
        yield difference.divergence, difference.cause
    if difference.evaluation_divergence is not None and difference.evaluation_cause is not None:
        yield difference.evaluation_divergence, difference.evaluation_cause


def _loop_divergences(told: Mapping[str, Section], difference: RunDiff) -> list[str]:
    """Return where loops diverge: their cause is unknown, so there is nothing to picture."""
    sentences = []
    if difference.divergence is not None and difference.cause is None:
        sentences += told["Training"].sentences
    if difference.evaluation_divergence is not None and difference.evaluation_cause is None:
        sentences += told["Evaluation"].sentences
    return sentences


# --- where they diverge -------------------------------------------------------------------------------


def _divergence(
    difference: RunDiff, divergence: Divergence, cause: Cause, a: Recording, b: Recording
) -> dict[str, Any]:
    where = where_in_words(divergence)
    return {
        "id": f"divergence-{divergence.phase}",
        "at": _step_reference(divergence),
        "title": f"Where {'training' if divergence.phase == 'train' else 'an evaluation'} diverges",
        "where": where[0].upper() + where[1:],
        "cause": cause.text[0].upper() + cause.text[1:],
        "updates": evaluation_updates(difference, cause)
        if divergence.phase == "eval"
        else updates_in_words(cause),
        "pictures": list(_pictures(divergence, a, b)),
        "rows": [_values(row) for row in cause.rows],
    }


def _step_reference(divergence: Divergence) -> list[int]:
    """Return (episode, t) of training, or (training episodes before, trial, t) of an evaluation."""
    before = [] if divergence.after is None else [divergence.after]
    return [*before, divergence.episode, divergence.t]


def _pictures(divergence: Divergence, a: Recording, b: Recording) -> Iterator[dict[str, str]]:
    """Yield the grid before the step, if that is the same in both, and after it in each."""
    alike = a.environment.get("scene") == b.environment.get("scene")
    steps = [step for step in (divergence.a_step, divergence.b_step) if step is not None]
    starts = len({int(step["state"]) for step in steps}) > 1
    if alike and not starts and steps:
        yield _picture(a if divergence.a_step is not None else b, steps[0], "Before, in both", False)
    for name, recording, step in (("A", a, divergence.a_step), ("B", b, divergence.b_step)):
        if step is not None:
            yield _picture(
                recording, step, f"{name}, {'where it stood' if starts else 'after its step'}", not starts
            )


def _picture(recording: Recording, step: np.void, title: str, after: bool) -> dict[str, str]:
    """Return the grid before or after a step, and what is said below it."""
    mdp = recording.mdp
    state = int(step["next_state"] if after else step["state"])
    if after:
        explored = exploration_in_words(int(step["explored"]), recording.agents) or "greedy"
        rewards = " and ".join(f"{reward:g}" for reward in step["rewards"])
        end = "; the end" if step["terminated"] else "; the step limit" if step["truncated"] else ""
        told = f"{deeds_in_words(mdp)[int(step['action'])]} ({explored}); reward {rewards}{end}"
    else:
        told = str(states_in_words(mdp)[state])
    if mdp.scene is None or mdp.scene_cells is None:
        return {"title": title, "svg": "", "told": f"{told}. {states_in_words(mdp)[state]}", "broad": ""}
    drawing = svg.Drawing(mdp.scene)
    places = drawing.places(mdp, np.array([step["state"], state]))
    picture = drawing.frame(places[1], f"{title}: {states_in_words(mdp)[state]}", places, style="")
    return {
        "title": title,
        "svg": picture,
        "told": told,
        "broad": "broad" if drawing.width > svg.BROAD else "",
    }


def _values(row: Row) -> Grid:
    """Return the highest Q-values of both runs in the state in which they diverge."""
    a, b = np.array(row.a), np.array(row.b)
    shown = dict.fromkeys(
        int(j) for values in (a, b) for j in np.argsort(-values, kind="stable")[:_MOST_VALUES]
    )
    rows = [
        (row.actions[j], *(f"{v[j]:.6g}{_GREEDY if j == int(v.argmax()) else ''}" for v in (a, b)))
        for j in shown
    ]
    of = f", the highest of {len(row.actions)}" if len(row.actions) > len(shown) else ""
    return Grid((f"Q-values of {spoken(row.agent)} there{of}", "A", "B"), rows)


# --- Q-tables and metrics -----------------------------------------------------------------------------


def _table_figures(difference: RunDiff, a: Recording, b: Recording) -> list[dict[str, Any]]:
    """Return the plot of the difference over episodes, and a map of it in the end."""
    if not any(table.largest > 0 for table in difference.tables):
        return []
    figures: list[dict[str, Any]] = [
        {"svg": tables_svg(difference.tables), "caption": "How far the tables are apart, over training"}
    ]
    last: dict[int, NDArray[np.float64]] = {}
    for ours, theirs in common_snapshots(a, b):
        last[ours.table] = np.abs(ours.values - theirs.values).max(axis=1)
    agents = [table.agent for table in difference.tables[-len(last) :]]
    for number, apart in sorted(last.items()):
        figures += _map(a.mdp, apart, spoken(agents[number]))
    return figures


def _map(mdp: Mdp, apart: NDArray[np.float64], agent: str) -> list[dict[str, Any]]:
    """Return the map of the largest difference in each state, in the situation where it is largest."""
    if mdp.scene is None or mdp.scene_cells is None or not apart.max() > 0:
        return []
    movers = [i for i, thing in enumerate(mdp.scene["things"]) if thing["kind"] == "mover"]
    if len(movers) not in (1, 2):
        return []
    state = int(apart.argmax())
    states = np.flatnonzero(situation(mdp, state, movers))
    at = tuple(mdp.scene_cells[states][:, movers].T)
    cells = mdp.scene["rows"] * mdp.scene["columns"]
    values = np.full((cells,) * len(movers), np.nan)
    values[at] = apart[states]
    bounds = (0.0, float(np.nanmax(values)))
    title = f"Largest difference of {agent}'s Q-values in each state"
    fixed = situation_in_words(mdp, state, movers)
    caption = f"{title}, in the end, where it is largest{f' ({fixed})' if fixed else ''}."
    if len(movers) == 2:
        one, other = (mdp.scene["things"][mover]["label"] for mover in movers)
        caption += f" Large square: where {one} is; in it, where {other} is."
        picture = svg_maps.pair_map(mdp.scene, values, bounds, title)
    else:
        picture = svg_maps.policy_map(mdp.scene, values, [None] * cells, bounds, title)
    return [{"svg": picture, "caption": caption, "high": bounds[1]}]


def _curves(a: Recording, b: Recording) -> list[Plot]:
    """Return both runs' metrics, a plot each."""
    return plots_of([Group(name, (read_series(recording),)) for name, recording in (("A", a), ("B", b))])
