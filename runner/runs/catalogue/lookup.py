"""A run found by its name among very many: the index knows what they are called."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from runner.errors import RunNotFound
from runner.recording.run_file import run_title
from runner.runs.catalogue.folders import Depth
from runner.runs.catalogue.index import Index, look
from runner.runs.resolve import LATEST, run_at_once, the_one
from runner.runs.run import Run, runs_in


class Candidate(NamedTuple):
    """A run as the index knows it."""

    root: str
    entry: str
    run_id: str
    name: str
    seed: int | None
    milliseconds: int

    @property
    def title(self) -> str:
        """Its name, and its seed if it has one."""
        return run_title(self.name, self.seed)

    @property
    def created(self) -> datetime:
        """When it began, in UTC."""
        return datetime.fromtimestamp(self.milliseconds / 1000, UTC)


def answering(name: str, index: Index) -> list[Candidate]:
    """Return the runs that a name may stand for, the newest first: `the_one` of them is meant."""
    found = index.newest(name.removesuffix(LATEST)) if name.endswith(LATEST) else []
    return [Candidate(*facts) for facts in found or index.named(name)]


def all_of_name(name: str, index: Index) -> list[Candidate]:
    """Return the runs that are called so, the oldest first."""
    return [run for run in reversed(answering(name, index)) if run.name == name]


def find_run(name: str, recordings: Path, tell: Callable[[str], None] = lambda _: None) -> Run:
    """Return what `runner.runs.resolve.find_run` does, without reading every run's files.

    Raises:
        RunNotFound: no run answers to the name, or several do.
    """
    known = run_at_once(name, recordings)
    if known is not None:
        return known
    found: list[Candidate] = []
    for depth in Depth:
        found = look([recordings], lambda index: answering(name, index), tell, depth=depth)
        # Ids and ages never change, but a run may have been given or have lost a name since the last look.
        by_id = len(found) == 1 and found[0].run_id.startswith(name) and found[0].name != name
        if found and (by_id or name == LATEST or depth > Depth.NAMES):
            break
    else:
        found = look([recordings], lambda index: answering("", index), tell, as_known=True)
    return run_of(the_one(name, found, recordings), recordings)


def find_all(name: str, recordings: Path, tell: Callable[[str], None] = lambda _: None) -> list[Run]:
    """Return all runs of a name, the oldest first; else the one that answers to it.

    Raises:
        RunNotFound: none does, or it is the beginning of several ids.
    """
    alike = look([recordings], lambda index: all_of_name(name, index), tell, depth=Depth.FOLDERS)
    return [run_of(found, recordings) for found in alike] or [find_run(name, recordings, tell)]


def with_id(run_id: str, recordings: Path) -> Candidate | None:
    """Return the run of an id, whatever its folder is called; None if there is none.

    Raises:
        StorageError: the folder is there and cannot be read.
    """
    found = look([recordings], lambda index: answering(run_id, index), depth=Depth.FOLDERS)
    return next((run for run in found if run.run_id == run_id), None)


def completions(beginning: str, recordings: Path) -> dict[str, str]:
    """Return what may be typed for a run and begins so, and what each stands for.

    Of very many only the newest are offered.

    Raises:
        StorageError: the folder is there and cannot be read.
    """

    def work(index: Index) -> dict[str, str]:
        newest = index.newest()
        found = {LATEST: "the newest run"} if newest else {}
        found |= {run_id: run_title(name, seed) for run_id, name, seed in index.ids_from(beginning)}
        for name, count in index.names_from(beginning.rpartition("@")[0] or beginning):
            if count == 1:
                found[name] = "the run of this name"
            else:
                found[f"{name}{LATEST}"] = "the newest of this name"
        return {text: meaning for text, meaning in found.items() if text.startswith(beginning)}

    return look([recordings], work, depth=Depth.FOLDERS)


def run_of(found: Candidate, recordings: Path) -> Run:
    """Return the run that the index knows to be in a folder.

    Raises:
        RunNotFound: it is no more.
    """
    for run in runs_in(recordings / found.entry):
        return run
    raise RunNotFound(f"run {found.run_id} was removed just now.")
