"""Find runs by id, prefix of an id, name, path or `@latest`, alike for commands, Python and the service."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from runner.errors import RunNotFound, nearest
from runner.recording.run_file import RUN_ID, run_title
from runner.runs.run import UNLISTED, Run, recordings_folder, run_at, run_in
from runner.util.humanize import counted
from runner.util.values import RUN_NAME_PATTERN

if TYPE_CHECKING:
    from runner.runs.catalogue.database import Candidate
    from runner.runs.catalogue.index import CatalogueIndex
    from runner.util.processes import Tell

LATEST: Final = "@latest"
"""Names the newest run; after a name, the newest run of that name."""
_MAX_LISTED: Final = 20
_MAX_SUGGESTED: Final = 1000
"""The newest runs, whose names are compared with one that was not found."""


def find_run(
    name: str,
    recordings: str | os.PathLike[str] | None = None,
    exclude: str = "",
    report: Tell = lambda _: None,
    newest: bool = False,
) -> Run:
    """Return the run with an id, a unique prefix of an id, a name, a path or `@latest`.

    `NAME@latest` is the newest run of that name.

    Args:
        name: the name.
        recordings: the recordings folder: $DUALTAXI_RECORDINGS, or ./recordings, by default.
        exclude: the id of a run that never matches.
        report: called with messages about the index, and about a choice.
        newest: whether a name that several runs have is the newest of them.

    Raises:
        RunNotFound: no run matches, or several do.
    """
    folder = recordings_folder(recordings)
    run = run_at(Path(name)) if _is_path(name) else run_of_id(name, folder)
    if run is not None and run.run_id != exclude:
        return run
    from runner.runs.catalogue.index import look

    candidates = look([folder], lambda index: matching(name, index, exclude), report)
    if not candidates:
        raise look([folder], lambda index: not_found(name, index, folder), report, cached=True)
    match = choose(name, candidates, newest)
    if match.name == name != match.run_id:
        count = sum(candidate.name == name for candidate in candidates)
        if count > 1:
            report(f"{count:,} runs are named {name}: the newest is taken, {match.run_id}.")
    return match.run(folder)


def run_of_id(run_id: str, recordings: Path) -> Run | None:
    """Return the run in the folder with this name and id, also an unlisted one.

    None if there is none, or it is not an id.
    """
    if not RUN_ID.fullmatch(run_id) or not run_id.strip("."):
        return None
    runs = (run_in(folder / run_id) for folder in (recordings, recordings / UNLISTED))
    return next((run for run in runs if run and run.run_id == run_id), None)


def find_runs(name: str, recordings: Path, report: Tell) -> list[Run]:
    """Return all runs of a name or a filter, the oldest first; else the run that `find_run` returns.

    Raises:
        RunNotFound: no run matches, or the name is a prefix of several ids.
        RunnerError: the filter is not valid.
    """
    from runner.runs.catalogue.filters import is_expression, parse
    from runner.runs.catalogue.index import look

    if is_expression(name) and not os.path.lexists(name):
        run_filter = parse(name)
        matches = look([recordings], lambda index: index.candidates(run_filter), report)
        if not matches:
            raise RunNotFound(f"no run in {recordings} matches {name}. `dualtaxi ls` lists the runs.")
        return [candidate.run(recordings) for candidate in reversed(matches)]
    runs = look([recordings], lambda index: of_name(name, index), report)
    return [candidate.run(recordings) for candidate in runs] or [find_run(name, recordings, report=report)]


def run_with_id(run_id: str, recordings: Path) -> Run | None:
    """Return the run with an id, whatever its folder is called; None if there is none."""
    from runner.runs.catalogue.index import look

    candidates = look([recordings], lambda index: matching(run_id, index))
    place = next((recordings / run.entry for run in candidates if run.run_id == run_id), None)
    return run_in(place) if place else None


def matching(name: str, index: CatalogueIndex, exclude: str = "") -> list[Candidate]:
    """Return the runs that a name, but no path, may stand for, the newest first; `choose` picks one."""
    if not name:
        return []
    newest = []
    if name.endswith(LATEST):
        newest = index.newest(name.removesuffix(LATEST), 2 if exclude else 1)
    candidates = [run for run in newest or index.named(name) if run.run_id != exclude]
    return candidates[:1] if newest else candidates


def of_name(name: str, index: CatalogueIndex) -> list[Candidate]:
    """Return all runs of a name, the oldest first."""
    return [run for run in reversed(matching(name, index)) if run.name == name]


def choose(name: str, candidates: Sequence[Candidate], newest: bool = False) -> Candidate:
    """Return the run that a name stands for, of those that `matching` returned, which are not empty.

    An id comes before a name, and a name that one run has before the beginnings of ids; with `newest`, also
    a name that several have.

    Raises:
        RunNotFound: the name is ambiguous.
    """
    exact = [run for run in candidates if run.run_id == name]
    named = [run for run in candidates if run.name == name]
    for group in (exact, named, candidates):
        if len(group) == 1 or (newest and group is named and named):
            return group[0]
    listed = [
        f"  {run.run_id}  {run_title(run.name, run.seed)}  {run.created:%Y-%m-%d %H:%M} UTC"
        for run in candidates[:_MAX_LISTED]
    ]
    if len(candidates) > _MAX_LISTED:
        listed.append(f"  and {len(candidates) - _MAX_LISTED:,} more")
    hint = f", or the newest of this name by {name}{LATEST}" if named else ""
    raise RunNotFound(
        "\n".join([f"{name!r} matches {len(candidates)} runs; name one by its id{hint}:", *listed])
    )


def not_found(name: str, index: CatalogueIndex, recordings: Path) -> RunNotFound:
    """Return the error for a name that no run matches, with the most similar name."""
    runs = index.newest(limit=_MAX_SUGGESTED)
    if not runs:
        return RunNotFound(
            f"no run {name!r}: there are no runs in {recordings} yet. `dualtaxi run` makes one."
        )
    if not name:
        return RunNotFound("found an empty name, expected an id, the beginning of one, a name or @latest.")
    names = {run.name for run in runs}
    if "@" in name:
        names = {LATEST} | {f"{name}{LATEST}" for name in names}
    hint = nearest(name, names | {run.run_id for run in runs})
    return RunNotFound(
        f"no run {name!r} in {recordings}, which has {counted(index.count(), 'run')}.{hint} `dualtaxi ls` "
        "lists all runs."
    )


def completions(beginning: str, recordings: Path) -> dict[str, str]:
    """Return the ids and names of runs that begin with a text, and what each stands for.

    Of very many only the newest are offered.
    """
    from runner.runs.catalogue.index import look

    def work(index: CatalogueIndex) -> dict[str, str]:
        meanings = {LATEST: "the newest run"} if index.newest() else {}
        meanings |= {run.run_id: run_title(run.name, run.seed) for run in index.with_id_prefix(beginning)}
        for name, count in index.names_from(beginning.rpartition("@")[0] or beginning):
            if count == 1:
                meanings[name] = "the run of this name"
            else:
                meanings[f"{name}{LATEST}"] = "the newest of this name"
        return {text: meaning for text, meaning in meanings.items() if text.startswith(beginning)}

    return look([recordings], work)


def _is_path(name: str) -> bool:
    """Return whether a name is a path; a missing one may be a name with a slash, such as `ALE/Pong-v5`."""
    if name.endswith(".mcap"):
        return True
    if os.sep not in name and not (os.altsep and os.altsep in name):
        return False
    return os.path.lexists(name) or not re.fullmatch(RUN_NAME_PATTERN, name.removesuffix(LATEST))
