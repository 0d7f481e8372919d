"""What can be shown and checked of a run's steps: the one place that decides it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from runner.recording.reader import Recording
from runner.recording.schema import PHASES
from runner.replay.makers import why_not_made

Picture = Literal["scene", "recorded", "redrawn", "values"]


@dataclass(frozen=True)
class Capabilities:
    """What can be shown and checked of a run's steps."""

    picture: Picture
    """Where the picture of a step comes from.

    `scene`: the recorded scene of a tabular environment. `recorded`: frames that were recorded, of all
    environments or of some (`environments_with_frames`). `redrawn`: the environment is made again and draws
    them (`runner.replay.environment.redo`); it may turn out that it cannot draw, which raises `CannotRedo`.
    `values`: there is none, only the values of the step.
    """
    has_tables: bool
    """Whether the Q-tables at any step are known (`runner.replay.tables`)."""
    can_redo: bool
    """Whether the environment can be made again to repeat the recorded actions."""
    reason: str = ""
    """Why not, as a sentence; empty if it can be."""


def capabilities(recording: Recording, trust: bool = False) -> Capabilities:
    """Return what can be shown and checked of a run's steps; imports and makes no environment.

    Args:
        recording: any run.
        trust: whether what the recording names may be imported, beyond installed packages of environments.

    Raises:
        RecordingError: the recording is damaged.
    """
    has_steps = recording.has_steps
    reason = why_not_redone(recording, trust)
    picture: Picture = "values"
    if recording.tabular and recording.environment.get("scene") is not None:
        picture = "scene"
    elif any(environments_with_frames(recording, phase) for phase in PHASES):
        picture = "recorded"
    elif has_steps and not reason:
        picture = "redrawn"
    return Capabilities(picture, has_tables=recording.is_job, can_redo=not reason, reason=reason)


def environments_with_frames(recording: Recording, phase: str) -> Sequence[int]:
    """Return the environments of which frames were recorded in a phase; of a job none."""
    if recording.is_job or not recording.has_messages(f"/{phase}/frame"):
        return ()
    frames = recording.config.get("frames")
    chosen = frames.get("environments") if isinstance(frames, Mapping) else None
    return chosen if isinstance(chosen, list) else range(recording.environments)


def why_not_redone(recording: Recording, trust: bool = False) -> str:
    """Return why the recorded actions cannot be repeated in the environment; empty if it can be tried."""
    if recording.is_job:
        return "The run was trained here: `dualtaxi verify` trains it again instead."
    if not recording.has_steps:
        return "No steps were recorded."
    if recording.lost:
        return "A part of the recording was lost, and what follows depends on it."
    return why_not_made(recording.maker, trust)
