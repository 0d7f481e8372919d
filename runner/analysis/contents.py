"""What a recording contains for a display or an export, and messages about what it lacks."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np

from runner.errors import NotInRecording, RecordingError
from runner.recording import schema
from runner.recording.messages import Message
from runner.recording.metadata import RECORDING_STOPPED
from runner.recording.reader import Recording
from runner.recording.run_file import has_environment
from runner.runs.run import Run, run_at
from runner.util.values import is_whole

ENDINGS: Final = {
    "success": "ended in success",
    "terminated": "ended",
    "truncated": "ended by the step limit",
    "reset": "reset before its end",
    "cut off": "cut off with the recording",
    "stopped": "stopped before its end",
}
"""How an episode may end, and its description."""
END_WORDS: Final = {
    "success": "success",
    "terminated": "terminated",
    "truncated": "step limit",
    "reset": "reset",
    "cut off": "cut off",
    "stopped": "not over",
}
"""How an episode ends, in the words of a table."""

Step = np.void | Message
"""A step: a record, or the fields of a message where values vary in size."""


def shortcomings(recording: Recording) -> list[str]:
    """Return what is missing from a recording, a sentence each; nothing if it is complete."""
    sentences = []
    status = recording.status
    if damage := damage_of(run_at(recording.path), recording):
        sentences.append(damage)
    elif status != "finished":
        recorded = "its loop is recorded up to its last step"
        if (planned := recording.config.get("episodes")) is not None:
            of = f" of {planned:,}" if is_whole(planned, 0, 2**63) else ""
            recorded = f"there are {recording.train.episodes.count():,}{of} training episodes"
        problem = "is still running" if status == "running" else f"did not finish ({status})"
        sentence = f"Run {recording.run_id} {problem}: {recorded}."
        if (error := recording.result.error or "").startswith(RECORDING_STOPPED):
            sentence = f"Run {recording.run_id}: {error.partition(', and ')[0]}."
        sentences.append(sentence)
    return sentences + [f"Some messages of {topic} were lost in a repair." for topic in recording.lost]


def damage_of(run: Run, recording: Recording) -> str:
    """Return what is wrong with the recording of a run, as far as opening it shows; empty if nothing is."""
    if run.status == "finished" != recording.status:
        return f"{run.recording}: is cut off, though its run is finished; `dualtaxi verify` says where."
    return ""


def require_steps(recording: Recording, purpose: str, may_redo: bool = False) -> None:
    """Refuse a recording without steps for a purpose, such as `play`.

    With `may_redo` recorded actions are enough, as their environment is rerun.

    Raises:
        RecordingError: it has none.
    """
    if not (any(phase.steps for phase in recording.phases) or (may_redo and recording.has_actions)):
        raise RecordingError(f"{recording.path}: found no steps to {purpose}: {why_no_steps(recording)}.")


def why_no_steps(recording: Recording) -> str:
    """Return why a recording has no steps, and the command that records them, if there is one."""
    if recording.leaves_out_steps and recording.maker is not None and not recording.has_actions:
        return (
            "they were left out (steps: none), and without its actions a loop's environment cannot be rerun"
        )
    if recording.leaves_out_steps:
        return (
            f"they were left out (steps: {recording.config['recording']['steps']}); "
            f"`dualtaxi rerecord {recording.run_id}` records them"
        )
    if not has_environment(recording.config):
        return "values were logged, and no environment was recorded"
    return "it ended before one was recorded"


def ending_of(recording: Recording, phase: str, number: int) -> str:
    """Return how an episode ended, a key of `ENDINGS`."""
    records = recording.phase(phase).episodes.array(number, number + 1)
    if not len(records):
        steps = recording.phase(phase).episode(number)
        last = [row for rows in steps.rows(len(steps) - 1) for row in rows]
        return next((end for end in ("terminated", "truncated") if any(row[end] for row in last)), "cut off")
    return next((end for end in ("success", "terminated", "truncated") if records[0][end]), "reset")


def whole_ranges(
    ranges: Iterable[tuple[int, int | None]], count: int, phase: str, where: str
) -> list[tuple[int, int]]:
    """Return ranges of episodes, which must be among `count` ones, with an end in place of None."""
    whole = [(start, count if stop is None else stop) for start, stop in ranges]
    for start, stop in whole:
        if not 0 <= start < stop <= count:
            raise NotInRecording(
                f"{where}: found no {schema.PHASE_NAMES[phase]} episodes {start}..{stop}; "
                f"there are {count:,}, from 0. Ranges are of whole episodes: START..STOP, STOP not included."
            )
    return whole
