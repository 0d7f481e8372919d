"""What came of a verification, and the comparisons that jobs and loops share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from runner.errors import Diverged
from runner.recording.reader import Recording
from runner.runs.provenance import Differences
from runner.util.values import Json

LOOP_NOT_COMPARED: Final = (
    "how its environment is described: scene, names of actions, agents, events and landmarks, step limit"
)
NAMES_NOT_COMPARED: Final = f"{LOOP_NOT_COMPARED}; --rerun compares them with the installed environment"
"""What a verification leaves out: the messages do not depend on it."""
CIRCUMSTANCES: Final = ("command", "directory", "host", "user")  # they cannot explain a difference
NOT_COMPLETE: Final = "the run did not end; verified as far as it got"


@dataclass(frozen=True)
class Verification:
    """The result of a verification."""

    path: Path
    finding: str = ""
    """The first thing that is wrong, or empty."""
    difference: Diverged | None = None
    """The finding as an error with attributes, if a message or a value differs."""
    train_steps: int = 0
    """Training steps that were compared."""
    eval_steps: int = 0
    """Evaluation steps that were compared."""
    content_digest: str = ""
    """The digest of all that was compared; empty if the recording has none, or is not complete."""
    notes: tuple[str, ...] = ()
    """What a reader should know though it is not wrong."""
    provenance: Differences = field(default_factory=dict)
    """The differences between the recording's provenance and this process's."""
    not_compared: str = ""
    """What of the recording was not compared."""
    needs_redo: bool = False
    """Whether its steps are compared with their environment by `runner.execution.redo` only."""
    nothing_yet: bool = False
    """Whether the run was interrupted before it recorded anything."""

    @property
    def sound(self) -> bool:
        """Whether nothing is wrong."""
        return not self.finding


def with_difference(found: Verification, error: Diverged) -> Verification:
    """Return a verification with a difference as its finding."""
    return replace(found, finding=str(error), difference=error)


def compare_names(recording: Recording, learners: list[str] | None = None) -> None:
    """Compare the names that are in a recording more than once.

    Raises:
        Diverged: two of them differ.
    """
    described, config = recording.environment, recording.config.get("env")
    for key, name in (("env_id", "id"), ("kwargs", "kwargs")):
        expected = config.get(name) if isinstance(config, Mapping) else None
        if described.get(key) != expected:
            raise Diverged("environment.json", key, described.get(key), expected)
    if learners is not None and list(recording.agents) != learners:
        raise Diverged("metadata run", "agents", list(recording.agents), learners)


def compare_values(path: str, found: object, expected: object) -> None:
    """Compare two values of the environment's description.

    Raises:
        Diverged: they differ; the error has the path of the first value that does.
    """
    if isinstance(found, dict) and isinstance(expected, dict) and found.keys() == expected.keys():
        for key in sorted(expected):
            compare_values(f"{path}.{key}", found[key], expected[key])
    elif isinstance(found, list) and isinstance(expected, list) and len(found) == len(expected):
        for k, pair in enumerate(zip(found, expected, strict=True)):
            compare_values(f"{path}[{k}]", *pair)
    elif found != expected:
        raise Diverged("environment.json", path, found, expected)


def compare_result(found: Verification, recording: Recording, expected: Json) -> Verification:
    """Compare the result in a recording with the computed one."""
    for key, value in expected.items():
        if recording.result.get(key) != value:
            return with_difference(found, Diverged("metadata result", key, recording.result.get(key), value))
    return replace(found, content_digest=expected["content_digest"])
