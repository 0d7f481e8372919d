"""The pages that show a step of an episode.

A *spot* is a parsed step reference: (episode, t), or (training episodes before an evaluation, trial, t).
"""

from __future__ import annotations

from collections.abc import Sequence

from runner.runs.run import Run


def after_step(spot: Sequence[int]) -> tuple[int, ...]:
    """Return the place of the frame after a step: the first that shows what differs in it."""
    return (*spot[:-1], spot[-1] + 1)


def episode_place(spot: Sequence[int]) -> str:
    """Return where the replay of a spot's episode is, below that of its run."""
    return "/".join(["train" if len(spot) == 2 else "eval", *map(str, spot[:-1])])


def replay_address(run: Run, spot: Sequence[int]) -> str:
    """Return the page of the replay at the frame after a step."""
    return f"/runs/{run.run_id}/replay/{episode_place(spot)}?t={after_step(spot)[-1]}"


def episode_in_words(spot: Sequence[int]) -> str:
    """Return which episode a spot is in."""
    if len(spot) == 2:
        return f"Training episode {spot[0]:,}"
    return f"Trial {spot[1]} of the evaluation after {spot[0]:,} episodes"
