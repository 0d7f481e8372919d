"""An episode as a small picture: the way through its scene, or the return over its steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from runner.drawing import palette, svg
from runner.recording import schema
from runner.recording.reader import Recording

WIDTH, HEIGHT = 160, 120
MAX_STEPS: Final = 100_000
"""Steps after which a picture says no more."""
_POINTS: Final = 200


def thumbnail(recording: Recording, phase: str, episode: int, title: str) -> str:
    """Return an episode as SVG: its last state with the ways of the movers, or its return over its steps.

    No environment is made: without recorded steps the picture says so.

    Raises:
        RecordingError: there is no such episode, or the recording is damaged.
    """
    tables = recording.phase(phase)
    is_empty = recording.leaves_out_steps or tables.steps.are_actions
    if is_empty:
        where = f'x="{WIDTH / 2}" y="{HEIGHT / 2}" text-anchor="middle"'
        return svg.picture(
            WIDTH, HEIGHT, title, f'<text {where} font-size="13" fill="#808080">no steps</text>'
        )
    drawing = svg.drawing_of(recording.mdp) if recording.tabular else None
    states = []
    rewards = [np.zeros(1)]
    count = 0
    for rows in tables.episode(episode).rows(0):
        rewards.append(rows["rewards"].sum(axis=1))
        if drawing is not None:
            recording.mdp.check_steps(rows, str(recording.path), schema.PHASE_NAMES[phase])
            states += [rows["state"], rows["next_state"][-1:]]
        count += len(rows)
        if count >= MAX_STEPS:
            break
    if drawing is not None and states:
        places = drawing.places(recording.mdp, np.concatenate(states).astype(np.int64))
        return drawing.frame(places[-1], title, places)
    returns = np.concatenate(rewards).cumsum()
    return _curve(returns[:: -(-len(returns) // _POINTS)].tolist(), title)


def _curve(values: Sequence[float], title: str) -> str:
    """Return a curve without axes."""
    finite = [value for value in values if np.isfinite(value)]
    low, high = min(finite, default=0.0), max(finite, default=0.0)
    across = WIDTH / max(1, len(values) - 1)
    up = (HEIGHT - 20) / ((high - low) or 1.0)
    points = " ".join(
        f"{k * across:.1f},{HEIGHT - 10 - (value - low) * up:.1f}"
        for k, value in enumerate(values)
        if np.isfinite(value)
    )
    line = f'<polyline fill="none" stroke="{palette.agent(0)}" stroke-width="2" points="{points}"/>'
    return svg.picture(WIDTH, HEIGHT, title, line)
