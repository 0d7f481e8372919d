"""A step of an episode, as an address has it and in words.

A *spot* is (episode, t) of training, or (training episodes before, trial, t) of an evaluation.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

from runner.errors import RunnerError
from runner.runs import Run

_SPOT: Final = re.compile(r"(\d{1,15}):(\d{1,15})|eval:(\d{1,15}):(\d{1,15}):(\d{1,15})")


def parse_spot(text: str) -> tuple[int, ...]:
    """Return the spot that a text such as `view --at` takes means; nothing of an empty one.

    Raises:
        RunnerError: it is none.
    """
    if not text:
        return ()
    found = _SPOT.fullmatch(text)
    if found is None:
        raise RunnerError(f"at: found {text!r}, expected EPISODE:T such as 120:5, or eval:N:TRIAL:T.")
    return tuple(int(part) for part in found.groups() if part is not None)


def spot_text(spot: Sequence[int]) -> str:
    """Return a spot as `parse_spot` takes it."""
    return f"{episode_text(spot)}:{spot[-1]}"


def episode_text(spot: Sequence[int]) -> str:
    """Return what of it names the episode: the text of any step of it begins so."""
    return ":".join(map(str, spot[:-1] if len(spot) == 2 else ["eval", *spot[:-1]]))


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
