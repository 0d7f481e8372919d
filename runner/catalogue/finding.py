"""A run found by its name among very many: the index knows what they are called."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from runner.catalogue.index import Index, look
from runner.errors import RunNotFound
from runner.finding import run_at_once, the_one
from runner.runs import Run, runs_in


class Candidate(NamedTuple):
    """A run as the index knows it."""

    root: str
    entry: str
    run_id: str
    name: str
    seed: int
    milliseconds: int

    @property
    def created(self) -> datetime:
        """When it began, in UTC."""
        return datetime.fromtimestamp(self.milliseconds / 1000, UTC)


def candidates_in(index: Index) -> list[Candidate]:
    """Return what the runs of an index are called, the newest first."""
    return [Candidate(*facts) for facts in index.names()]


def candidates(recordings: Path, tell: Callable[[str], None] = lambda _: None) -> list[Candidate]:
    """Return what the runs of a folder are called, the newest first.

    Raises:
        StorageError: the folder is there and cannot be read.
    """
    return look([recordings], candidates_in, tell)


def find_run(name: str, recordings: Path, tell: Callable[[str], None] = lambda _: None) -> Run:
    """Return what `runner.finding.find_run` does, without reading every run's files.

    Raises:
        RunNotFound: no run answers to the name, or several do.
    """
    known = run_at_once(name, recordings)
    if known is not None:
        return known
    return run_of(the_one(name, candidates(recordings, tell), recordings), recordings)


def run_of(found: Candidate, recordings: Path) -> Run:
    """Return the run that the index knows to be in a folder.

    Raises:
        RunNotFound: it is no more.
    """
    for run in runs_in(recordings / found.entry):
        return run
    raise RunNotFound(f"run {found.run_id} was removed just now.")
