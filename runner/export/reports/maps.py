"""Policy and highest values of a run before, in the middle of and after learning, as maps.

A map shows one situation: everything that does not move by itself is as in the state that the maps are made
for (a passenger at G, a destination R).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runner.analysis.qtable import recorded_tables
from runner.drawing.svg_maps import pair_map, policy_map
from runner.environments.mdp import Mdp
from runner.environments.naming import spoken, states_in_words
from runner.errors import RecordingError
from runner.recording.messages import Snapshot
from runner.recording.reader import Recording
from runner.replay.steps import step_of_episode
from runner.replay.tables import tables_at

Values = NDArray[np.float64]
Bounds = tuple[float, float]

_HALFWAY: Final = 0.05
"""Largest distance of a snapshot from half of the episodes to be called the middle, as a share of all."""


@dataclass(frozen=True)
class Stage:
    """A moment of learning, and the tables then."""

    title: str
    episode: int
    step: int
    tables: list[Values]


@dataclass(frozen=True)
class MapRow:
    """One kind of map at every stage, with the same colours for the same values."""

    title: str
    explanation: str
    svgs: tuple[tuple[str, str], ...]
    """(stage, svg)."""
    low: float
    high: float


def stages_of(recording: Recording) -> list[Stage]:
    """Return the tables before, in the middle of and after learning; fewer where they are the same.

    The middle is the snapshot nearest to half of the episodes; without one between the first and the last,
    the steps up to there are replayed, if they were recorded. A loop's are those of its first table's name.
    """
    by_step: dict[int, Stage] = {}
    name = ""
    for table in recording.snapshots() if recording.has_tables else recorded_tables(recording):
        if isinstance(table, Snapshot) and table.name != (name := name or table.name):
            continue
        stage = by_step.setdefault(table.step, Stage("", table.episode, table.step, []))
        stage.tables.append(np.asarray(table.values, np.float64))
    whole = [stage for stage in by_step.values() if len(stage.tables) == len(recording.agents)]
    if not whole:
        return []
    first, last = whole[0], whole[-1]
    half = (first.episode + last.episode) // 2
    between = sorted(whole[1:-1], key=lambda stage: abs(stage.episode - half))
    middle = between[0] if between else _replayed(recording, half) if recording.has_tables else None
    named = [("before learning" if recording.has_tables else "at the first snapshot", first)]
    if middle:
        is_half = abs(middle.episode - half) <= _HALFWAY * (last.episode - first.episode)
        named.append(("in the middle" if is_half else "during learning", middle))
    is_end = recording.has_tables and recording.status == "finished"
    named.append(("after learning" if is_end else "at the last snapshot", last))
    unique = {
        stage.step: replace(stage, title=f"{title}: {stage.episode:,} episodes") for title, stage in named
    }
    return list(unique.values())


def maps_of(mdp: Mdp, learners: Sequence[str], stages: Sequence[Stage], state: int) -> list[MapRow]:
    """Return the maps for the situation of a state; none without a scene or a mover."""
    if mdp.scene is None or mdp.scene_cells is None or not stages:
        return []
    movers = [i for i, thing in enumerate(mdp.scene["things"]) if thing["kind"] == "mover"]
    pairs = range(len(learners)) if len(movers) == 2 else ()
    return [
        *(_pair_row(mdp, learners, stages, state, movers, learner) for learner in pairs),
        *(_policy_row(mdp, learners, stages, state, mover) for mover in movers),
    ]


def situation(mdp: Mdp, state: int, free: Sequence[int]) -> NDArray[np.bool_]:
    """Return which states differ from one in nothing but the places of the free things, [S]."""
    assert mdp.scene_cells is not None
    carriers = mdp.scene_carriers if mdp.scene_carriers is not None else np.full(mdp.scene_cells.shape, -1)
    same_carriers = (carriers == carriers[state]).all(axis=1)
    fixed = [i for i in range(mdp.scene_cells.shape[1]) if i not in free and carriers[state, i] < 0]
    same_cells = (mdp.scene_cells[:, fixed] == mdp.scene_cells[state, fixed]).all(axis=1)
    return np.asarray(same_carriers & same_cells)


def situation_in_words(mdp: Mdp, state: int, free: Sequence[int]) -> str:
    """Return what does not move in a situation: `passenger at G, destination R`."""
    words = str(states_in_words(mdp)[state]).split(", ")
    return ", ".join(word for i, word in enumerate(words) if i not in free)


def _replayed(recording: Recording, episode: int) -> Stage | None:
    try:
        step = step_of_episode(recording, episode)
        return Stage("", episode, step, tables_at(recording, step))
    except RecordingError:
        return None


def _pair_row(
    mdp: Mdp, learners: Sequence[str], stages: Sequence[Stage], state: int, movers: list[int], learner: int
) -> MapRow:
    """Return the highest value for each pair of cells of two movers."""
    assert mdp.scene is not None
    assert mdp.scene_cells is not None
    scene, cells = mdp.scene, mdp.scene["rows"] * mdp.scene["columns"]
    states = np.flatnonzero(situation(mdp, state, movers))
    places = tuple(mdp.scene_cells[states][:, movers].T)
    grids = []
    for stage in stages:
        values = np.full((cells, cells), np.nan)
        values[places] = _highest(stage.tables[learner][states])
        grids.append(values)
    one, other = (scene["things"][mover]["label"] for mover in movers)
    whose = "" if len(learners) == 1 else f" of {spoken(learners[learner])}"
    return _row(
        f"Highest Q-value{whose} for every pair of places",
        f"Large square: the place of {one}. In it the grid again: the place of {other}. Grey: all actions "
        "have the same value.",
        situation_in_words(mdp, state, movers),
        stages,
        grids,
        lambda i, bounds, title: pair_map(scene, grids[i], bounds, title),
    )


def _policy_row(mdp: Mdp, learners: Sequence[str], stages: Sequence[Stage], state: int, mover: int) -> MapRow:
    """Return the greedy action and the highest value of one mover in each cell."""
    assert mdp.scene is not None
    assert mdp.scene_cells is not None
    scene, cells = mdp.scene, mdp.scene["rows"] * mdp.scene["columns"]
    thing = scene["things"][mover]
    agent = mdp.agents.index(thing["agent"]) if thing.get("agent") in mdp.agents else 0
    is_joint = len(learners) == 1
    states = np.flatnonzero(situation(mdp, state, [mover]))
    places = mdp.scene_cells[states, mover]
    grids, policies = [], []
    for stage in stages:
        rows = stage.tables[0 if is_joint else agent][states]
        values = np.full(cells, np.nan)
        values[places] = _highest(rows)
        greedy: list[int | None] = [None] * cells
        for cell, best in zip(places.tolist(), rows.argmax(axis=1).tolist(), strict=True):
            if not np.isnan(values[cell]):
                greedy[cell] = int(mdp.own_actions[best, agent]) if is_joint else best
        grids.append(values)
        policies.append(greedy)
    return _row(
        f"Greedy actions of {thing['label']}, and the highest Q-value",
        "Arrow: the greedy action in that cell. Grey: all actions have the same value there.",
        situation_in_words(mdp, state, [mover]),
        stages,
        grids,
        lambda i, bounds, title: policy_map(scene, grids[i], policies[i], bounds, title),
    )


def _row(
    title: str,
    explanation: str,
    fixed: str,
    stages: Sequence[Stage],
    grids: Sequence[Values],
    draw: Callable[[int, Bounds, str], str],
) -> MapRow:
    """Return the maps of some grids of values, a grid for each stage, drawn by number, bounds and title."""
    numbers = np.concatenate([grid[~np.isnan(grid)] for grid in grids])
    bounds = (float(numbers.min()), float(numbers.max())) if len(numbers) else (0.0, 0.0)
    svgs = []
    for i, (stage, grid) in enumerate(zip(stages, grids, strict=True)):
        span = "no action is preferred anywhere"
        if not np.isnan(grid).all():
            span = f"from {np.nanmin(grid):.4g} to {np.nanmax(grid):.4g}"
        svgs.append((stage.title, draw(i, bounds, f"{title}, {stage.title}; {span}")))
    return MapRow(title, explanation + (f" Situation: {fixed}." if fixed else ""), tuple(svgs), *bounds)


def _highest(rows: Values) -> Values:
    """Return the highest value of each row; nan where all are the same, so that no action is preferred."""
    best = rows.max(axis=1)
    return np.where(best > rows.min(axis=1), best, np.nan)
