"""The one run that an id, the beginning of one, a name, a path or `@latest` stands for."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Final, Protocol, TypeVar

from runner.errors import RunNotFound, nearest
from runner.runs.run import Run, list_runs, recordings_folder, run_at, run_of_id
from runner.util.values import RUN_NAME_PATTERN

LATEST: Final = "@latest"
"""What stands for the newest run, after a name for the newest of that name."""
_TOLD: Final = 20
"""Runs that an error names."""
_MAX_NEAR: Final = 1000
"""Runs, the newest, whose names are compared with one that was not found."""


class Named(Protocol):
    """What a run can be named by."""

    @property
    def run_id(self) -> str:
        """Its id."""

    @property
    def name(self) -> str:
        """What it is called."""

    @property
    def title(self) -> str:
        """Its name, and its seed if it has one."""

    @property
    def created(self) -> datetime:
        """When it began."""


AnyNamed = TypeVar("AnyNamed", bound=Named)


def find_run(name: str, recordings: str | os.PathLike[str] | None = None, but: str = "") -> Run:
    """Return the one run that answers to an id, a unique prefix of it, a name, a path or `@latest`.

    `NAME@latest` is the newest run of that name.

    Args:
        name: what it must answer to.
        recordings: the folder to look in: $DUALTAXI_RECORDINGS, or ./recordings, unless given.
        but: the id of a run that does not answer: the one that is asking.

    Raises:
        RunNotFound: none does, or several do.
    """
    folder = recordings_folder(recordings)
    known = run_at_once(name, folder)
    if known is not None and known.run_id != but:
        return known
    return the_one(name, [run for run in list_runs(folder) if run.run_id != but], folder)


def run_at_once(name: str, recordings: Path) -> Run | None:
    """Return the run at a path, or in the folder called like its id; None if others must be looked at.

    What looks like a path may also be a name with a slash, such as `ALE/Pong-v5`, if nothing is there.

    Raises:
        RunNotFound: it is a path, and there is no run.
    """
    if os.sep in name or name.endswith(".mcap") or (os.altsep and os.altsep in name):
        stem = name.removesuffix(LATEST)
        if re.fullmatch(RUN_NAME_PATTERN, stem) and not name.endswith(".mcap") and not os.path.lexists(name):
            return None
        return run_at(Path(name))
    return run_of_id(name, recordings)


def the_one(name: str, runs: Sequence[AnyNamed], recordings: Path) -> AnyNamed:
    """Return the one of these runs, the newest first, that answers to a name, but no path.

    Raises:
        RunNotFound: none does, or several do.
    """
    if not runs:
        raise RunNotFound(
            f"no run {name!r}: there are no runs in {recordings} yet. `dualtaxi run` makes one."
        )
    if not name:
        raise RunNotFound("found an empty name, expected an id, the beginning of one, a name or @latest.")
    if name.endswith(LATEST):
        stem = name.removesuffix(LATEST)
        newest = next((run for run in runs if stem in ("", run.name)), None)
        if newest is not None:
            return newest
    exact = [run for run in runs if run.run_id == name]
    found = exact or [run for run in runs if run.name == name or run.run_id.startswith(name)]
    if len(found) == 1:
        return found[0]
    if found:
        several = "\n".join(
            f"  {run.run_id}  {run.title}  {run.created:%Y-%m-%d %H:%M}" for run in found[:_TOLD]
        )
        more = f"\n  and {len(found) - _TOLD:,} more" if len(found) > _TOLD else ""
        or_newest = (
            f", or the newest of this name by {name}@latest" if any(run.name == name for run in found) else ""
        )
        raise RunNotFound(
            f"{name!r} answers to {len(found)} runs; name one by its id{or_newest}:\n{several}{more}"
        )
    newest_runs = runs[:_MAX_NEAR]
    hint = nearest(name, {run.name for run in newest_runs} | {run.run_id for run in newest_runs})
    raise RunNotFound(
        f"no run {name!r} in {recordings}.{hint} `dualtaxi ls` lists the {len(runs):,} there are."
    )
