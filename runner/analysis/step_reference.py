"""References to a step of an episode, as commands (`view --at`) and addresses of pages (`?at=`) have them.

    120:5            step 5 of training episode 120; `120` is its first step
    eval:3000:17:5   step 5 of trial 17 of the evaluation after 3,000 training episodes;
                     `eval:3000` is the first step of its first trial

Parsed it is (episode, t), or (training episodes before the evaluation, trial, t).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

from runner.errors import RunnerError

EXPECTED: Final = "EPISODE:T such as 120:5, or eval:N:TRIAL:T; a TRIAL or T that is left out is 0"
_NUMBER: Final = "([0-9]{1,15})"
_TRAINING: Final = re.compile(f"{_NUMBER}(?::{_NUMBER})?")
_EVALUATION: Final = re.compile(f"eval:{_NUMBER}(?::{_NUMBER})?(?::{_NUMBER})?")


def parse_step_reference(text: str) -> tuple[int, ...]:
    """Return (episode, t), or (training episodes, trial, t) of an evaluation.

    Raises:
        RunnerError: the text is no step reference.
    """
    match = _TRAINING.fullmatch(text) or _EVALUATION.fullmatch(text)
    if match is None:
        raise RunnerError(f"found {text[:60]!r}, expected {EXPECTED}.")
    return tuple(int(part or 0) for part in match.groups())


def step_reference(step: Sequence[int]) -> str:
    """Return the text that `parse_step_reference` parses to this step."""
    return f"{episode_reference(step)}:{step[-1]}"


def episode_reference(step: Sequence[int]) -> str:
    """Return the part of a step's reference that names the episode: all without the `:T`."""
    return ":".join(map(str, step[:-1] if len(step) == 2 else ["eval", *step[:-1]]))
