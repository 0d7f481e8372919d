"""Addresses of pages, and of steps of episodes in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from urllib.parse import urlencode

from runner.analysis.episodes import EpisodeRef
from runner.errors import RunnerError
from runner.runs.branches import BranchOrigin, origin_in
from runner.runs.run import Run


def link(path: str, values: Mapping[str, object]) -> str:
    """Return an address with a query of the values that are not empty."""
    query = [(key, value) for key, value in values.items() if value not in ("", None, [], ())]
    return f"{path}?{urlencode(query, doseq=True)}" if query else path


def step_in(text: str) -> EpisodeRef:
    """Return the step that an address names by its episode: words may differ between two runs.

    Raises:
        RunnerError: the text is no such reference.
    """
    expected = "EPISODE:T such as 120:5, or eval:N:TRIAL:T"
    step = EpisodeRef.parse(text, expected)
    if step.word:
        raise RunnerError(f"found {text[:60]!r}, expected {expected}.")
    return step


def places_in(runs: Sequence[Run], step: EpisodeRef) -> list[EpisodeRef]:
    """Return the step in each of two runs: a branch of a loop has its parent's episode as its only one."""
    alone = EpisodeRef(0, step.t, None if step.after is None else 0)
    origins = [origin_in(run.file.config) for run in runs]
    return [
        alone if isinstance(origin, BranchOrigin) and origin.run == other.run_id else step
        for origin, other in zip(origins, reversed(runs), strict=True)
    ]
