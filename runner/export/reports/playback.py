"""What a page plays of an episode of any recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runner.drawing import svg
from runner.environments.naming import (
    actions_in_words,
    agent_actions,
    deeds_in_words,
    event_in_words,
    numbered_actions,
    spoken,
    states_in_words,
)
from runner.export.contents import ENDINGS, require_steps
from runner.export.episodes import place_of
from runner.export.reports.episode import MAX_STEPS, Episode, episode_at, outcome_in_words
from runner.export.reports.loop_playback import loop_playback
from runner.export.reports.player_data import (
    Grid,
    Playback,
    Words,
    frame_times,
    logged_near,
    short,
    short_rows,
    words,
)
from runner.recording.reader import Recording

MAX_VALUES: Final = 6
"""Q-values of a state that a page shows: the highest, and that of the action taken."""


def playback_of(
    recording: Recording, which: tuple[int, ...], limit: int = MAX_STEPS, first: int = 0
) -> Playback:
    """Return what a page plays of an episode: at most `limit` steps from step `first` on.

    Which episode is given as for `place_of`.
    """
    require_steps(recording, "show", may_redo=True)
    place = place_of(recording, which)
    with np.errstate(over="ignore", invalid="ignore"):  # rewards may be infinite
        if recording.tabular:
            return tabular_playback(recording, episode_at(recording, place, limit, first))
        return loop_playback(recording, place, limit, first)


def titled(playback: Playback, names: Sequence[str]) -> Playback:
    """Return what a page plays, its title after the reasons for showing it: `Best trial: trial 3 of ...`.

    Its description says so if not all steps are there.
    """
    names_text, title = " and ".join(names), playback.title
    shown = len(playback.reward)
    part = "" if shown == playback.length else f" Shown are the first {shown:,} steps."
    return replace(
        playback,
        title=f"{names_text[0].upper()}{names_text[1:]}: {title[0].lower()}{title[1:]}",
        description=playback.description + part,
    )


def tabular_playback(recording: Recording, episode: Episode) -> Playback:
    """Return what a page plays of an episode whose states and actions the environment's table names."""
    mdp, agents, drawing = recording.mdp, recording.agents, svg.drawing_of(recording.mdp)
    distinct, at = np.unique(episode.states, return_inverse=True)
    grid = None
    if drawing is not None:
        grid = Grid(drawing.places(mdp, distinct).reshape(len(distinct), -1).tolist(), at.tolist())
    states = [str(word) for word in states_in_words(mdp)[distinct]]
    deeds = deeds_in_words(mdp)
    chosen = [agent_actions(mdp, action) for action in episode.actions.tolist()]
    time = frame_times(episode.times)
    return Playback(
        title=episode.title[0].upper() + episode.title[1:],
        description=outcome_in_words(episode.length, episode.ended, episode.total),
        length=episode.length,
        first=episode.first,
        end=ENDINGS[episode.ended],
        agents=[spoken(agent) for agent in agents],
        before=[short(value) for value in episode.before],
        reward=short_rows(episode.rewards),
        actions=[words("", "action", [deeds[action] for action in episode.actions.tolist()])],
        texts=[Words("", "state", states, at.tolist())],
        time=time,
        logged=logged_near(recording, episode.phase, time),
        events=[event_in_words(name) for name in mdp.event_names],
        event=episode.events.tolist(),
        explored=episode.explored.tolist(),
        choices=[actions_in_words(mdp).tolist()] if len(agents) == 1 else numbered_actions(mdp),
        values=[
            _highest(
                values, [own[i] for own in chosen] if len(episode.values) > 1 else episode.actions.tolist()
            )
            for i, values in enumerate(episode.values)
        ],
        grid=grid,
    )


def _highest(values: NDArray[np.float64], taken: list[int]) -> dict[str, object]:
    """Return the highest Q-values of each step, [action, value] pairs, and the action taken."""
    rows: dict[str, int] = {}
    which: list[int] = []
    packed: list[list[list[float | int | str | None]]] = []
    for row, action in zip(values, taken, strict=True):
        best = np.argsort(-row, kind="stable")[:MAX_VALUES].tolist()
        shown = best if action in best else [*best[:-1], action]
        if len(row) <= MAX_VALUES:
            shown = sorted(shown)
        pairs = [[int(choice), short(float(row[choice]))] for choice in shown]
        key = str(pairs)
        if key not in rows:
            rows[key] = len(packed)
            packed.append(pairs)
        which.append(rows[key])
    return {"rows": packed, "row": which, "taken": [int(action) for action in taken], "of": values.shape[1]}
