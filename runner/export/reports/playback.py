"""What a page plays of an episode of any recording.

Frame k is the state after k steps, with the step that led there and the Q-values of the next choice. So an
episode of T steps has T + 1 frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from runner.analysis.contents import ENDINGS, ending_of, require_steps
from runner.analysis.episodes import EpisodeRef
from runner.drawing import svg
from runner.environments.mdp import events_of
from runner.environments.naming import (
    actions_in_words,
    agent_actions,
    agent_actions_in_words,
    event_in_words,
    numbered_actions,
    spoken,
    states_in_words,
)
from runner.errors import RecordingError
from runner.export.reports.loop_playback import loop_playback
from runner.export.reports.player_data import (
    Playback,
    PlayerGrid,
    Value,
    Words,
    frame_times,
    logged_near,
    outcome_in_words,
    short,
    short_rows,
    words,
)
from runner.recording import schema
from runner.recording.reader import Recording
from runner.replay.steps import steps_of
from runner.replay.tables import TableReplay, tables_at
from runner.util.arrays import Floats, Records
from runner.util.humanize import capitalised

MAX_STEPS: Final = 1000
"""Steps of an episode that a page shows; the page says so where an episode has more."""
MAX_VALUES: Final = 6
"""Q-values of a state that a page shows: the highest, and that of the action taken."""

QValues = tuple[Floats, ...]
"""For each learner the Q-values in the states of T steps, [T, actions]; empty if they are unknown."""


def playback_of(recording: Recording, at: EpisodeRef, limit: int = MAX_STEPS, first: int = 0) -> Playback:
    """Return what a page plays of an episode, ended or not: at most `limit` steps from step `first` on."""
    require_steps(recording, "show", may_redo=True)
    with np.errstate(over="ignore", invalid="ignore"):  # rewards may be infinite
        if not recording.tabular:
            return loop_playback(recording, at, limit, first)
        number = at.number_in(recording)
        steps = steps_of(recording, at.phase, number)
        shown = steps[first : first + limit]
        if not len(shown):
            raise at.no_step(recording, len(steps), max(first, at.t))
        recording.mdp.check_steps(shown, str(recording.path))
        values = _values(recording, shown, at)
        ended = ending_of(recording, at.phase, number)
        return tabular_playback(recording, at, steps, ended, values, first, limit)


def titled(playback: Playback, names: Sequence[str]) -> Playback:
    """Return what a page plays, its title after the reasons for showing it: `Best trial: trial 3 of ...`.

    Its description says so if not all steps are there.
    """
    names_text = " and ".join(names)
    title = playback.title
    shown = len(playback.reward)
    part = "" if shown == playback.length else f" Shown are the first {shown:,} steps."
    return replace(
        playback,
        title=f"{capitalised(names_text)}: {title[0].lower()}{title[1:]}",
        description=playback.description + part,
    )


def tabular_playback(
    recording: Recording,
    at: EpisodeRef,
    steps: Records,
    ended: str,
    values: QValues,
    first: int,
    limit: int,
) -> Playback:
    """Return what a page plays of an episode whose states and actions the environment's table names.

    Of all its `steps`, which the environment can have, at most `limit` are shown, from step `first` on; the
    values are those of the steps shown. `ended` is a key of `ENDINGS`.
    """
    mdp = recording.mdp
    agents = recording.agents
    drawing = svg.drawing_of(recording.mdp)
    shown = steps[first : first + limit]
    distinct, state_of = np.unique(np.append(shown["state"], shown["next_state"][-1]), return_inverse=True)
    grid = None
    if drawing is not None:
        grid = PlayerGrid(
            drawing.places(mdp, distinct).reshape(len(distinct), -1).tolist(), state_of.tolist()
        )
    states = [str(word) for word in states_in_words(mdp)[distinct]]
    named = agent_actions_in_words(mdp)
    actions = shown["action"].tolist()
    taken = [actions] * len(values)
    if len(values) > 1:  # each learner has a table of its own actions
        taken = [list(own) for own in zip(*(agent_actions(mdp, action) for action in actions), strict=True)]
    time = frame_times((shown["log_time"] // schema.STEP_NANOSECONDS).astype(np.int64))
    before = steps["rewards"][:first].sum(axis=0).tolist() if first else []
    return Playback(
        title=at.heading,
        description=outcome_in_words(len(steps), ended, float(steps["rewards"].sum())),
        length=len(steps),
        first=first,
        end=ENDINGS[ended],
        agents=[spoken(agent) for agent in agents],
        before=[short(value) for value in before],
        reward=short_rows(shown["rewards"]),
        actions=[words("", "action", [named[action] for action in actions])],
        texts=[Words("", "state", states, state_of.tolist())],
        time=time,
        logged=logged_near(recording, at.phase, time),
        events=[event_in_words(name) for name in mdp.event_names],
        event=events_of(mdp, shown).tolist(),
        explored=shown["explored"].tolist(),
        choices=[actions_in_words(mdp).tolist()] if len(agents) == 1 else numbered_actions(mdp),
        values=[_highest(own, which) for own, which in zip(values, taken, strict=True)],
        grid=grid,
    )


def _values(recording: Recording, steps: Records, at: EpisodeRef) -> QValues:
    """Return each learner's Q-values in the states of an episode's steps; those of a trial do not change."""
    if not recording.has_tables:
        return ()
    try:
        if at.after is not None:
            tables = tables_at(recording, at.evaluation_in(recording).train_step)
            return tuple(table[steps["state"]] for table in tables)
        first = int(steps["step"][0])
        replay = TableReplay(recording, first)
        widths = [table.shape[1] for table in replay.tables]
        rows = replay.rows(first + len(steps))
    except RecordingError:
        return ()
    return tuple(rows[:, i, :width] for i, width in enumerate(widths))


def _highest(values: Floats, taken: list[int]) -> dict[str, object]:
    """Return the highest Q-values of each step, [action, value] pairs, and the action taken."""
    rows: dict[tuple[tuple[int, Value], ...], int] = {}
    which: list[int] = []
    for row, action in zip(values, taken, strict=True):
        best = np.argsort(-row, kind="stable")[:MAX_VALUES].tolist()
        shown = best if action in best else [*best[:-1], action]
        if len(row) <= MAX_VALUES:
            shown = sorted(shown)
        pairs = tuple((int(choice), short(float(row[choice]))) for choice in shown)
        which.append(rows.setdefault(pairs, len(rows)))
    return {
        "rows": list(rows),
        "row": which,
        "taken": [int(action) for action in taken],
        "of": values.shape[1],
    }
