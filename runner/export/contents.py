"""What a recording has to be shown or exported, and what is to be said of what it has not."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.reader import Recording
from runner.util.values import flatten, is_whole


def shortcomings(recording: Recording) -> list[str]:
    """Return what is missing from a recording, a sentence each; of a whole one nothing."""
    said, status = [], recording.status
    if status != "finished":
        done = "there is what its loop had done"
        if recording.is_job:
            planned = recording.config.get("episodes")
            of = f" of {planned:,}" if is_whole(planned, 0, 2**63) else ""
            done = f"there are {recording.count(schema.TRAIN_EPISODE):,}{of} training episodes"
        how = "is still running" if status == "running" else f"did not finish ({status})"
        said.append(f"Run {recording.run_id} {how}: {done}.")
    said += [f"Of {topic} some messages were lost in a repair; they are missing." for topic in recording.lost]
    return said


def require_steps(recording: Recording, purpose: str) -> None:
    """Refuse a recording without steps; the purpose is what is to be done with them, such as `play`.

    Raises:
        RecordingError: it has none.
    """
    if not recording.has_steps:
        raise RecordingError(f"{recording.path}: found no steps to {purpose}: {why_no_steps(recording)}.")


def why_no_steps(recording: Recording) -> str:
    """Return why a recording has no steps, and what gives it some."""
    if recording.leaves_out_steps:
        return (
            f"they were left out (recording.steps: none); `dualtaxi rerecord {recording.run_id}` records them"
        )
    return "it ended before one was recorded"


def whole_ranges(
    ranges: Iterable[tuple[int, int | None]], count: int, phase: str, where: str
) -> list[tuple[int, int]]:
    """Return ranges of episodes, the second number not included, with an end where none is said.

    Raises:
        RecordingError: one is empty, or goes beyond the `count` that there are; it begins with `where`.
    """
    whole = [(start, count if stop is None else stop) for start, stop in ranges]
    for start, stop in whole:
        if not start < stop <= count:
            raise RecordingError(
                f"{where}: found no {schema.PHASE_NAMES[phase]} episodes {start}:{stop}; "
                f"there are {count:,}, from 0. Ranges are START:STOP, STOP not included."
            )
    return whole


def flat_text(config: Mapping[str, Any]) -> dict[str, str]:
    """Return a resolved configuration as flat text: `evaluation.trials` is `100`; lists as JSON."""
    flat = flatten(config, keep_empty=True)
    return {key: value if isinstance(value, str) else json.dumps(value) for key, value in flat.items()}
