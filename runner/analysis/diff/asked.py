"""What is asked of a difference, and how it is told to programs."""

from __future__ import annotations

import dataclasses
import fnmatch
from collections.abc import Sequence
from typing import Any

from runner.analysis.diff import Change, RunDiff
from runner.errors import RunnerError


def without(difference: RunDiff, ignore: Sequence[str]) -> RunDiff:
    """Return the difference without the settings and provenance whose path fits one of these patterns."""

    def kept(changes: list[Change]) -> list[Change]:
        return [c for c in changes if not any(fnmatch.fnmatchcase(c.path, glob) for glob in ignore)]

    return dataclasses.replace(
        difference,
        config=kept(difference.config),
        provenance=kept(difference.provenance),
        costs=kept(difference.costs),
    )


def as_json(difference: RunDiff) -> dict[str, Any]:
    """Return the difference as JSON can hold it; whole step records are left out."""
    told = dataclasses.asdict(difference)
    evaluations = (pair[0] for pair in told["evaluations"])
    for parting in (told["parting"], told["loop_evaluation"], *evaluations):
        if parting is not None:
            del parting["a_step"], parting["b_step"]
    return told


def level_of(text: str) -> tuple[str, float]:
    """Return metric and level of a target such as `finish_percent=80`.

    Raises:
        RunnerError: it is none.
    """
    metric, _, level = text.partition("=")
    try:
        return metric, float(level)
    except ValueError:
        raise RunnerError(
            f"target: found {text!r}, expected METRIC=LEVEL such as finish_percent=80."
        ) from None
