"""What is asked of a difference, and how it is told to programs."""

from __future__ import annotations

import dataclasses
import fnmatch
from collections.abc import Sequence
from typing import Any

from runner.analysis.diff import PARTS, Change, RunDiff
from runner.analysis.diff.settings import changes_in
from runner.errors import RunnerError
from runner.runs.run import Run


def with_seconds(difference: RunDiff, a: Run, b: Run) -> RunDiff:
    """Return the difference with how long the runs took, which recordings do not say."""
    took = [{"seconds": run.summary.get("seconds")} for run in (a, b)]
    return dataclasses.replace(difference, costs=[*difference.costs, *changes_in(*took)])


def without(difference: RunDiff, ignore: Sequence[str], everything: bool = False) -> RunDiff:
    """Return the difference without what has a path that fits a pattern; it is named as ignored.

    Args:
        difference: of two runs.
        ignore: patterns.
        everything: keep also what is alike.
    """
    changes: dict[str, list[Change]] = {part: getattr(difference, part) for part in PARTS}
    kept: dict[str, Any] = {
        part: [change for change in some if not _fits(change.path, ignore)] for part, some in changes.items()
    }
    kept["alike"] = {
        part: {path: value for path, value in values.items() if not _fits(path, ignore)}
        for part, values in difference.alike.items()
        if everything
    }
    ignored = [change.path for some in changes.values() for change in some if _fits(change.path, ignore)]
    return dataclasses.replace(difference, **kept, ignored=ignored)


def _fits(path: str, globs: Sequence[str]) -> bool:
    return any(fnmatch.fnmatchcase(path, glob) for glob in globs)


def as_json(difference: RunDiff) -> dict[str, Any]:
    """Return the difference as JSON can hold it; whole step records are left out."""
    told = dataclasses.asdict(difference)
    evaluations = (pair[0] for pair in told["evaluations"])
    for parting in (told["parting"], told["loop_evaluation"], *evaluations):
        if parting is not None:
            del parting["a_step"], parting["b_step"]
    return told


def level_of(text: str) -> tuple[str, float]:
    """Return metric and level of a target such as `success_percent=80`.

    Raises:
        RunnerError: it is none.
    """
    metric, _, level = text.partition("=")
    try:
        return metric, float(level)
    except ValueError:
        raise RunnerError(
            f"target: found {text!r}, expected METRIC=LEVEL such as success_percent=80."
        ) from None
