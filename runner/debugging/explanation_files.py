"""Explanations on disk, next to the readings that they were computed from.

recordings/.explain/A-B-1f2e3d4c/values.jsonl           the readings of every run, a line each
recordings/.explain/A-B-1f2e3d4c/success_percent.json   the explanation of a metric
recordings/.explain/runs/                               the short runs that show first steps
"""

from __future__ import annotations

import contextlib
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from runner.debugging.explanation import Explanation
from runner.errors import RunnerError, nearest
from runner.runs.catalogue.removal import Removal, plan, remove
from runner.runs.listing import list_runs
from runner.runs.locking import acquired
from runner.runs.run import UNLISTED
from runner.util.files import open_regular, replacing, storage_errors
from runner.util.humanize import size

FOLDER: Final = ".explain"
LOCK: Final = "owner.lock"
TAG: Final = "explain={}"
"""The tag of the short runs of an explanation, with its name."""
MAX_BYTES: Final = 32 << 20
"""The largest file of a result that is read."""
MAX_VALUE: Final = 1e15
"""What no metric exceeds."""


def write_explanation(explanation: Explanation, recordings: Path) -> None:
    """Write a result next to what it was computed from."""
    path = recordings / FOLDER / f"{explanation.name}.json"
    with storage_errors(path), replacing(path) as fresh:
        fresh.write_text(json.dumps(explanation.as_json()), encoding="utf-8")


def explanations_in(recordings: Path) -> list[str]:
    """Return the names of the results in a recordings folder."""
    return sorted(f"{file.parent.name}/{file.stem}" for file in (recordings / FOLDER).glob("*/*.json"))


@dataclass(frozen=True)
class Trained:
    """What an explanation trained, and its results: what may be removed."""

    name: str
    """The folder of the pair."""
    folder: Path
    files: tuple[Path, ...]
    runs: tuple[Removal, ...]
    """The short runs that show its first step."""

    @property
    def bytes(self) -> int:
        """The bytes that removing it frees; runs that are kept or in use stay."""
        own = sum(file.stat().st_size for file in self.files)
        return own + sum(run.freed for run in self.runs if not run.refusal)


def trained_in(recordings: Path) -> list[Trained]:
    """Return what explanations trained in a recordings folder."""
    runs = list_runs(recordings / UNLISTED)
    return [
        Trained(
            folder.name,
            folder,
            tuple(file for file in sorted(folder.iterdir()) if file.suffix in (".json", ".jsonl")),
            tuple(plan(run, run.folder.parent) for run in runs if TAG.format(folder.name) in run.tags),
        )
        for folder in sorted((recordings / FOLDER).glob("*"))
        if folder.is_dir() and not folder.is_symlink() and folder.name != UNLISTED.name
    ]


def remove_trained(trained: Trained) -> None:
    """Remove what an explanation trained, but runs that are kept or in use."""
    lock = acquired(trained.folder / LOCK, RunnerError(f"{trained.name} is being computed; it stays."))
    try:
        for run in trained.runs:
            if not run.refusal:
                remove(run)
        with storage_errors(trained.folder):
            for file in trained.files:
                file.unlink(missing_ok=True)
    finally:
        lock.release()
    with contextlib.suppress(OSError):  # other files, or another process has begun to use it
        (trained.folder / LOCK).unlink(missing_ok=True)
        trained.folder.rmdir()


def read_explanation(name: str, recordings: Path) -> Explanation:
    """Return a result from its file.

    Raises:
        RunnerError: there is none of this name, or its file is damaged.
    """
    from pydantic import TypeAdapter

    explanations = explanations_in(recordings)
    if name not in explanations:
        raise RunnerError(f"no explanation {name!r} in {recordings}.{nearest(name, explanations)}")
    path = recordings / FOLDER / f"{name}.json"
    try:
        with open_regular(path) as file:
            content = file.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            raise RunnerError(f"{path}: larger than {size(MAX_BYTES)}, expected an explanation.")
        explanation = TypeAdapter(Explanation).validate_json(content)
        _check(explanation)
    except (OSError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise RunnerError(f"{path}: no longer describes an explanation ({reason}).") from error
    return explanation


def _check(explanation: Explanation) -> None:
    """Check what the types do not say, or raise a `ValueError`."""
    numbers = [
        explanation.difference.value,
        *(value for mixture in explanation.mixtures for value in mixture.values),
    ]
    numbers += [setting.share.value for setting in explanation.settings if setting.share is not None]
    numbers.append(explanation.seconds)
    counts = {len(mixture.values) for mixture in explanation.mixtures}
    known_settings = {setting.name for setting in explanation.settings}
    named = [mixture.settings for mixture in explanation.mixtures]
    named += [interaction.settings for interaction in explanation.interactions]
    if len(explanation.mixtures) < 2 or counts != {len(explanation.seeds)} or not explanation.seeds:
        raise ValueError("a mixture lacks values")
    if not all(math.isfinite(value) and abs(value) < MAX_VALUE for value in numbers):
        raise ValueError("a value is not finite")
    if not all(known_settings.issuperset(names) for names in named):
        raise ValueError("a setting is missing")
