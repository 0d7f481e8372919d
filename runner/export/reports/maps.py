"""Policy and highest values of a run before, in the middle of and after learning, as maps.

A map is about one situation: whatever does not move by itself stands as in the state the maps are made
for (a passenger at G, a destination R).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.drawing.svg_maps import pair_map, policy_map
from runner.environments.mdp import Mdp
from runner.environments.naming import spoken, states_in_words
from runner.errors import RecordingError
from runner.recording.reader import Recording
from runner.replay.tables import step_of_episode, tables_at

Tables = list[NDArray[np.float64]]


@dataclass(frozen=True)
class Stage:
    """A moment of learning, and the tables then."""

    title: str
    episode: int
    step: int
    tables: Tables


@dataclass(frozen=True)
class MapRow:
    """One kind of map at every stage, coloured alike."""

    title: str
    explanation: str
    svgs: tuple[tuple[str, str], ...]
    """(stage, svg)."""
    low: float
    high: float


_HALFWAY: Final = 0.05
"""How far from half of the episodes a snapshot may be, as a share of all, to be called the middle."""


def stages_of(recording: Recording) -> list[Stage]:
    """Return the tables before, in the middle of and after learning; fewer where they are the same.

    The middle is the snapshot nearest to half of the episodes; where there is none between the first and
    the last, the steps up to there are replayed, if they were recorded.
    """
    learners = len(recording.agents)
    found: dict[int, Stage] = {}
    for table in recording.snapshots():
        stage = found.setdefault(table.step, Stage("", table.episode, table.step, []))
        stage.tables.append(table.values)
    whole = [stage for stage in found.values() if len(stage.tables) == learners]
    if not whole:
        return []
    first, last = whole[0], whole[-1]
    half = (first.episode + last.episode) // 2
    between = sorted(whole[1:-1], key=lambda stage: abs(stage.episode - half))
    middle = between[0] if between else _replayed(recording, half)
    stages = [first, *([middle] if middle else []), last]
    titles = ["before learning", "during learning", "after learning"]
    if middle and abs(middle.episode - half) <= _HALFWAY * (last.episode - first.episode):
        titles[1] = "in the middle"
    if recording.status != "finished":
        titles[-1] = "at the last snapshot"
    named = zip([titles[0], *([titles[1]] if middle else []), titles[-1]], stages, strict=True)
    unique = {stage.step: Stage(f"{title}: {_after(stage)}", *_rest(stage)) for title, stage in named}
    return list(unique.values())


def maps_of(mdp: Mdp, learners: Sequence[str], stages: Sequence[Stage], state: int) -> list[MapRow]:
    """Return the maps for the situation of a state; none without a scene or a mover."""
    if mdp.scene is None or mdp.scene_cells is None or not stages:
        return []
    movers = [i for i, thing in enumerate(mdp.scene["things"]) if thing["kind"] == "mover"]
    rows = [
        _pair_row(mdp, learners, stages, state, movers, i) for i in range(len(learners)) if len(movers) == 2
    ]
    return rows + [_policy_row(mdp, learners, stages, state, mover) for mover in movers]


def situation(mdp: Mdp, state: int, free: Sequence[int]) -> NDArray[np.bool_]:
    """Return which states differ from one in nothing but the places of the free things, [S]."""
    assert mdp.scene_cells is not None
    fixed = [i for i in range(mdp.scene_cells.shape[1]) if i not in free]
    carriers = mdp.scene_carriers if mdp.scene_carriers is not None else np.full(mdp.scene_cells.shape, -1)
    alike = (carriers == carriers[state]).all(axis=1)
    standing = [i for i in fixed if carriers[state, i] < 0]
    return np.asarray(alike & (mdp.scene_cells[:, standing] == mdp.scene_cells[state, standing]).all(axis=1))


def situation_in_words(mdp: Mdp, state: int, free: Sequence[int]) -> str:
    """Return what stands still in a situation: `passenger at G, destination R`."""
    words = str(states_in_words(mdp)[state]).split(", ")
    return ", ".join(word for i, word in enumerate(words) if i not in free)


# --- inside -------------------------------------------------------------------------------------------


def _replayed(recording: Recording, episode: int) -> Stage | None:
    try:
        step = step_of_episode(recording, episode)
        return Stage("", episode, step, tables_at(recording, step))
    except RecordingError:
        return None


def _after(stage: Stage) -> str:
    return f"{stage.episode:,} episodes"


def _rest(stage: Stage) -> tuple[int, int, Tables]:
    return stage.episode, stage.step, stage.tables


def _pair_row(
    mdp: Mdp, learners: Sequence[str], stages: Sequence[Stage], state: int, movers: list[int], learner: int
) -> MapRow:
    """Return the highest value for each pair of cells of two movers."""
    assert mdp.scene is not None
    assert mdp.scene_cells is not None
    cells = mdp.scene["rows"] * mdp.scene["columns"]
    states = np.flatnonzero(situation(mdp, state, movers))
    at = mdp.scene_cells[states][:, movers]
    grids = []
    for stage in stages:
        values = np.full((cells, cells), np.nan)
        values[at[:, 0], at[:, 1]] = _highest(stage.tables[learner][states])
        grids.append(values)
    bounds = _bounds(grids)
    one, other = (mdp.scene["things"][mover]["label"] for mover in movers)
    whose = "" if len(learners) == 1 else f" of {spoken(learners[learner])}"
    title = f"Highest Q-value{whose} for every pair of places"
    fixed = situation_in_words(mdp, state, movers)
    told = (
        f"Large square: where {one} is. In it the grid again: where {other} is. "
        "Grey: all actions are worth the same." + (f" Situation: {fixed}." if fixed else "")
    )
    svgs = [
        (stage.title, pair_map(mdp.scene, grid, bounds, f"{title}, {stage.title}; {_span(grid)}"))
        for stage, grid in zip(stages, grids, strict=True)
    ]
    return MapRow(title, told, tuple(svgs), *bounds)


def _policy_row(mdp: Mdp, learners: Sequence[str], stages: Sequence[Stage], state: int, mover: int) -> MapRow:
    """Return the greedy action of one mover in each cell, all others standing still."""
    assert mdp.scene is not None
    assert mdp.scene_cells is not None
    thing = mdp.scene["things"][mover]
    agent = mdp.agents.index(thing["agent"]) if thing.get("agent") in mdp.agents else 0
    learner = agent if len(learners) > 1 else 0
    states = np.flatnonzero(situation(mdp, state, [mover]))
    at = mdp.scene_cells[states, mover]
    made = [_best(mdp, stage.tables[learner], states, at, agent, len(learners) == 1) for stage in stages]
    bounds = _bounds([values for values, _ in made])
    fixed = situation_in_words(mdp, state, [mover])
    title = f"What {thing['label']} would do, and the highest Q-value"
    told = "Arrow: the greedy action in that cell. Grey: all actions are worth the same there." + (
        f" Situation: {fixed}." if fixed else ""
    )
    svgs = [
        (
            stage.title,
            policy_map(mdp.scene, values, greedy, bounds, f"{title}, {stage.title}; {_span(values)}"),
        )
        for stage, (values, greedy) in zip(stages, made, strict=True)
    ]
    return MapRow(title, told, tuple(svgs), *bounds)


def _best(
    mdp: Mdp, table: NDArray[np.float64], states: NDArray[Any], at: NDArray[Any], agent: int, joint: bool
) -> tuple[NDArray[np.float64], list[int | None]]:
    """Return the highest value and the agent's greedy action in each cell."""
    assert mdp.scene is not None
    cells = mdp.scene["rows"] * mdp.scene["columns"]
    values = np.full(cells, np.nan)
    greedy: list[int | None] = [None] * cells
    rows = table[states]
    values[at] = _highest(rows)
    for cell, row in zip(at.tolist(), rows, strict=True):
        if row.max() > row.min():
            best = int(row.argmax())
            greedy[cell] = int(np.unravel_index(best, mdp.action_counts)[agent]) if joint else best
    return values, greedy


def _highest(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the highest value of each row; nan where all are the same, so that nothing is preferred."""
    best = rows.max(axis=1)
    return np.where(best > rows.min(axis=1), best, np.nan)


def _bounds(grids: Sequence[NDArray[np.float64]]) -> tuple[float, float]:
    known = np.concatenate([grid[~np.isnan(grid)] for grid in grids])
    return (float(known.min()), float(known.max())) if len(known) else (0.0, 0.0)


def _span(values: NDArray[np.float64]) -> str:
    if np.isnan(values).all():
        return "nothing is preferred anywhere"
    return f"from {np.nanmin(values):.4g} to {np.nanmax(values):.4g}"
