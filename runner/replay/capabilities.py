"""What a recording allows: of which environments there are frames, and whether they can be made again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from runner.recording import schema
from runner.recording.reader import Recording
from runner.replay.makers import is_whole_vector, why_not_made


def environments_with_frames(recording: Recording, phase: str) -> Sequence[int]:
    """Return the environments of which frames were recorded in a phase; of a job none."""
    if recording.can_train_again or not recording.has_messages(f"/{phase}/frame"):
        return ()
    frames = recording.config.get("frames")
    chosen = frames.get("environments") if isinstance(frames, Mapping) else None
    return chosen if isinstance(chosen, list) else range(recording.environments)


def why_not_redone(recording: Recording, trust: bool = False) -> str:
    """Return why the recorded actions cannot be repeated in the environment; empty if it can be tried."""
    if recording.can_train_again:
        return "The run was trained here: `dualtaxi verify` trains it again instead."
    if not recording.has_actions:
        return "No steps were recorded."
    if recording.lost:
        return "A part of the recording was lost, and what follows depends on it."
    first, reason = 0, ""
    for shard in recording.shards:
        phases = [phase for phase, n in zip(schema.PHASES, shard[-2:], strict=True) if n]
        for maker in (recording.maker_of(phase, first) for phase in phases):
            if maker is not None and is_whole_vector(maker):
                return (
                    "A process stepped a vector that cannot be taken apart. As several processes recorded "
                    "the run, its environments are recorded one by one."
                )
            reason = reason or why_not_made(maker, trust)
        first += shard.environments
    return reason or why_not_made(recording.maker, trust)
