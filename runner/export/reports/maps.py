"""Policy and highest values of a run before, in the middle of and after learning, as maps.

A map shows one situation: everything that does not move by itself is as in the state that the maps are made
for (a passenger at G, a destination R).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from runner.analysis.episodes import EpisodeRef, first_state
from runner.analysis.qtable import recorded_tables
from runner.analysis.sections import Figure, Section
from runner.drawing.svg import BROAD, drawing_of
from runner.drawing.svg_maps import pair_map, policy_map
from runner.environments.mdp import Mdp
from runner.environments.naming import spoken, states_in_words
from runner.errors import RecordingError
from runner.recording.messages import Snapshot
from runner.recording.reader import Recording
from runner.replay.steps import step_of_episode
from runner.replay.tables import tables_at
from runner.util.arrays import Array, Flags, Floats, Ints
from runner.util.humanize import capitalised

Bounds = tuple[float, float]

_HALFWAY: Final = 0.05
"""Largest distance of a snapshot from half of the episodes to be called the middle, as a share of all."""


@dataclass(frozen=True)
class MapStage:
    """A moment of learning, and the tables then."""

    title: str
    episode: int
    step: int
    tables: list[Floats]


class Choice(NamedTuple):
    """A part of the name of a state."""

    label: str
    texts: list[str]
    """All that it may be."""
    chosen: str


def stages_of(recording: Recording) -> list[MapStage]:
    """Return the tables before, in the middle of and after learning; fewer where they are the same.

    The middle is the snapshot nearest to half of the episodes; without one between the first and the last,
    the steps up to there are replayed, if they were recorded. Of a loop, the first table counts.
    """
    by_step: dict[int, MapStage] = {}
    for table in recording.snapshots() if recording.has_tables else _first_tables(recording):
        stage = by_step.setdefault(table.step, MapStage("", table.episode, table.step, []))
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


def start_of(recording: Recording, at: EpisodeRef) -> int:
    """Return the state in which an episode begins; of an unknown one, the most likely."""
    try:
        return first_state(recording, at.resolved(recording))
    except RecordingError:  # it has no steps
        return int(recording.mdp.start.argmax())


def learned_section(recording: Recording, state: int) -> Section:
    """Return the maps for the situation of a state, if the recording has a scene and tables."""
    rows = maps_of(recording.mdp, recording.agents, stages_of(recording), state) if recording.tabular else []
    text = "A Q-value is the expected return of an action in a state, if the best actions follow."
    without = "There are no maps: the recording has no scene or no Q-table."
    return Section("What was learned", [text if rows else without], parts=rows)


def maps_of(mdp: Mdp, learners: Sequence[str], stages: Sequence[MapStage], state: int) -> list[Section]:
    """Return each kind of map at every stage, for the situation of a state."""
    drawing = drawing_of(mdp)
    if drawing is None or mdp.scene is None or not stages:
        return []
    rows = []
    things = [mdp.scene["things"][mover] for mover in drawing.movers]
    if len(things) == 2:
        for learner, name in enumerate(learners):
            whose = "" if len(learners) == 1 else f" of {spoken(name)}"
            outer, inner = (thing["label"] for thing in things)
            explanation = (
                f"Large square: the place of {outer}. In it the grid again: the place of {inner}. Grey: all "
                "actions have the same value."
            )
            title = f"Highest Q-value{whose} for every pair of places"
            rows.append(_row(title, explanation, mdp, stages, state, drawing.movers, learner))
    explanation = "Arrow: the greedy action in that cell. Grey: all actions have the same value there."
    for mover, thing in zip(drawing.movers, things, strict=True):
        agent = mdp.agents.index(thing["agent"]) if thing.get("agent") in mdp.agents else 0
        # Of a joint table the mover's part of each action is shown.
        learner, own_actions = (0, mdp.own_actions[:, agent]) if len(learners) == 1 else (agent, None)
        title = f"Greedy actions of {thing['label']}, and the highest Q-value"
        rows.append(_row(title, explanation, mdp, stages, state, [mover], learner, own_actions))
    return rows


def situation(mdp: Mdp, state: int, free: Sequence[int]) -> Flags:
    """Return which states differ from one in nothing but the places of the free things, [S]."""
    assert mdp.scene_cells is not None
    carriers = mdp.carriers
    same_carriers = (carriers == carriers[state]).all(axis=1)
    fixed = [i for i in range(mdp.scene_cells.shape[1]) if i not in free and carriers[state, i] < 0]
    same_cells = (mdp.scene_cells[:, fixed] == mdp.scene_cells[state, fixed]).all(axis=1)
    return np.asarray(same_carriers & same_cells)


def situations(mdp: Mdp, state: int) -> list[Choice]:
    """Return what may be chosen of a state with a scene, as in this one; nothing if that is ambiguous."""
    assert mdp.scene is not None
    names = [str(name).split(", ") for name in states_in_words(mdp)]
    if any(len(texts) != len(mdp.scene["things"]) for texts in names):  # a label has a comma in it
        return []
    parts = zip(mdp.scene["things"], zip(*names, strict=True), names[state], strict=True)
    return [Choice(thing["label"], list(dict.fromkeys(texts)), selected) for thing, texts, selected in parts]


def situation_in_words(mdp: Mdp, state: int, free: Sequence[int]) -> str:
    """Return what does not move in a situation: `passenger at G, destination R`."""
    words = str(states_in_words(mdp)[state]).split(", ")
    return ", ".join(word for i, word in enumerate(words) if i not in free)


def _first_tables(recording: Recording) -> Iterator[Snapshot]:
    """Yield the tables that a loop recorded under the first name."""
    name = ""
    for table in recorded_tables(recording):
        name = name or table.name
        if table.name == name:
            yield table


def _replayed(recording: Recording, episode: int) -> MapStage | None:
    try:
        step = step_of_episode(recording, episode)
        return MapStage("", episode, step, tables_at(recording, step))
    except RecordingError:
        return None


def _row(
    title: str,
    explanation: str,
    mdp: Mdp,
    stages: Sequence[MapStage],
    state: int,
    movers: list[int],
    learner: int,
    own_actions: Ints | None = None,
) -> Section:
    """Return the maps of a learner's table at each stage, with the same colours for the same values.

    `own_actions` has a mover's part of its actions.
    """
    states = np.flatnonzero(situation(mdp, state, movers))
    grids, policies = [], []
    for stage in stages:
        rows = stage.tables[learner][states]
        greedy = rows.argmax(axis=1)
        best = rows.max(axis=1)
        # Where all actions have the same value, none is preferred.
        grids.append(on_grid(mdp, states, movers, np.where(best > rows.min(axis=1), best, np.nan)))
        policies.append(on_grid(mdp, states, movers, greedy if own_actions is None else own_actions[greedy]))
    numbers = np.concatenate([grid[~np.isnan(grid)] for grid in grids])
    bounds = (float(numbers.min()), float(numbers.max())) if len(numbers) else (0.0, 0.0)
    figures = []
    for stage, grid, policy in zip(stages, grids, policies, strict=True):
        span = "no action is preferred anywhere"
        if not np.isnan(grid).all():
            span = f"from {np.nanmin(grid):.4g} to {np.nanmax(grid):.4g}"
        picture = drawn(mdp, grid, bounds, f"{title}, {stage.title}; {span}", policy)
        figures.append(Figure(picture, capitalised(stage.title)))
    fixed = situation_in_words(mdp, state, movers)
    drawing = drawing_of(mdp)
    layout = "maps broad" if drawing is not None and drawing.width > BROAD else "maps"
    text = explanation + (f" Situation: {fixed}." if fixed else "")
    return Section(title, [text], figures=figures, layout=layout, ramp=bounds)


def on_grid(mdp: Mdp, states: Ints, movers: list[int], values: Array) -> Floats:
    """Return the values of states by the cells of one or two movers, [cells] or [cells, cells], else NaN."""
    assert mdp.scene is not None
    assert mdp.scene_cells is not None
    grid = np.full((mdp.scene["rows"] * mdp.scene["columns"],) * len(movers), np.nan)
    grid[tuple(mdp.scene_cells[states][:, movers].T)] = values
    return grid


def drawn(mdp: Mdp, grid: Floats, bounds: Bounds, title: str, greedy: Floats | None = None) -> str:
    """Return the map of values as `on_grid` returns them, with the greedy actions of one mover."""
    assert mdp.scene is not None
    if grid.ndim == 2:
        return pair_map(mdp.scene, grid, bounds, title)
    return policy_map(mdp.scene, grid, greedy, bounds, title)
