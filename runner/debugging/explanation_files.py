"""Explanations on disk, next to the readings that they were computed from.

recordings/.explain/A-B-1f2e3d4c/values.jsonl           the readings of every run, a line each
recordings/.explain/A-B-1f2e3d4c/success_percent.json   the explanation of a metric
recordings/.explain/runs/                               the short runs that show first steps
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Final

from runner.debugging.explanation import Explanation
from runner.errors import RunnerError, nearest
from runner.util.files import open_regular, replacing, storage_errors

FOLDER: Final = ".explain"
MAX_BYTES: Final = 32 << 20
"""The largest file of a result that is read."""
MAX_VALUE: Final = 1e15
"""What no metric exceeds."""


def write_explanation(explanation: Explanation, recordings: Path) -> None:
    """Write a result next to what it was computed from.

    Raises:
        StorageError: the folder cannot be written.
    """
    path = recordings / FOLDER / f"{explanation.name}.json"
    with storage_errors(path), replacing(path) as fresh:
        fresh.write_text(json.dumps(explanation.as_json()), encoding="utf-8")


def explanations_in(recordings: Path) -> list[str]:
    """Return the names of the results in a recordings folder."""
    return sorted(f"{file.parent.name}/{file.stem}" for file in (recordings / FOLDER).glob("*/*.json"))


def read_explanation(name: str, recordings: Path) -> Explanation:
    """Return a result from its file.

    Raises:
        RunnerError: there is none of this name, or its file is damaged.
    """
    from pydantic import TypeAdapter, ValidationError

    known = explanations_in(recordings)
    if name not in known:
        raise RunnerError(f"no explanation {name!r} in {recordings}.{nearest(name, known)}")
    path = recordings / FOLDER / f"{name}.json"
    try:
        with open_regular(path) as file:
            content = file.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            raise RunnerError(f"{path}: larger than {MAX_BYTES >> 20} MiB, expected an explanation.")
        explanation = TypeAdapter(Explanation).validate_json(content)
    except (OSError, ValidationError) as error:
        reason = str(error).splitlines()[0]
        raise RunnerError(f"{path}: no longer describes an explanation ({reason}).") from error
    numbers = [explanation.difference.value, *(value for one in explanation.mixtures for value in one.values)]
    numbers += [each.share.value for each in explanation.settings if each.share is not None]
    numbers.append(explanation.seconds)
    if not all(one.values for one in explanation.mixtures) or not explanation.mixtures:
        raise RunnerError(f"{path}: no longer describes an explanation (a mixture has no values).")
    if not all(math.isfinite(value) and abs(value) < MAX_VALUE for value in numbers):
        raise RunnerError(f"{path}: no longer describes an explanation (a value is not finite).")
    known_settings = {each.name for each in explanation.settings}
    named = [each.settings for each in explanation.mixtures]
    named += [each.settings for each in explanation.interactions]
    if not all(known_settings.issuperset(names) for names in named):
        raise RunnerError(f"{path}: no longer describes an explanation (a setting is missing).")
    return explanation
