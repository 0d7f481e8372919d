"""What came of a verification, and the comparisons that jobs and loops share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from runner.errors import Diverged
from runner.recording.composition import Composition
from runner.recording.reader import Recording
from runner.runs.provenance import Differences
from runner.util.values import Json

if TYPE_CHECKING:
    from runner.replay.engine import Difference  # loads Gymnasium

LOOP_NOT_COMPARED: Final = (
    "how its environment is described: scene, names of actions, agents, events and landmarks, step limit"
)
NAMES_NOT_COMPARED: Final = f"{LOOP_NOT_COMPARED}; --rerun compares them with the installed environment"
"""What a verification leaves out: the messages do not depend on it."""
CIRCUMSTANCES: Final = ("command", "directory", "host", "user")  # they cannot explain a difference

Verdict = Literal["reproduced", "consistent", "interrupted", "differs", "damaged"]
"""The verdict on a recording:

- `reproduced`: its job was retrained, or its environment rerun, and everything compared is equal;
- `consistent`: only the file was checked, and agrees with itself; `Verification.reason` is why;
- `interrupted`: the run did not end, and all up to its end is reproduced, or consistent;
- `differs`: the job or the environment gives something else, each time the same;
- `damaged`: the bytes of the file are wrong, or its parts contradict each other.
"""


@dataclass(frozen=True)
class Verification:
    """The result of a verification."""

    path: Path
    verdict: Verdict = "consistent"
    act: Literal["checked", "retrained", "rerun"] = "checked"
    """What was done: only the file was checked, a job was retrained, or a loop's environment was rerun."""
    environment: Literal["", "recorded", "installed"] = ""
    """The environment with which it was retrained or rerun."""
    composition: Composition | None = None
    """What the environment consists of; None if there is none, or nothing can be read."""
    reason: str = ""
    """Why the environment cannot be rerun, as a sentence; empty if it was, or was not to be."""
    finding: str = ""
    """The first thing that differs or is damaged; empty if nothing is."""
    difference: Diverged | Difference | None = None
    """The first difference with attributes; that of a loop which cannot be rerun shows why."""
    train_steps: int = 0
    """Training steps that were compared, with one another or with the retrained ones."""
    eval_steps: int = 0
    """Evaluation steps that were compared."""
    episodes: int = 0
    """Episodes that were retrained, or rerun; of a job, training episodes."""
    unfinished: int = 0
    """Rerun episodes that were in progress when the recording ended."""
    steps: int = 0
    """Steps that were retrained or rerun; of a loop, all before the first difference were equal."""
    left_out: int = 0
    """Steps that could not be rerun: the random generators' state at their beginning was not recorded."""
    cut_off: int = 0
    """Steps at the end that could not be rerun: their resets were lost when the loop was killed."""
    of_episodes: int | None = None
    """The number of episodes that a rerun sample is of; None if all were to be rerun."""
    tolerance: float = 0.0
    """Absolute and relative, for floating-point values that were rerun; 0 if bytes were compared."""
    assumed: tuple[str, ...] = ()
    """What was rerun with default arguments, as its own were not recorded."""
    content_digest: str = ""
    """The digest of all that was compared; empty if the recording has none, or is not complete."""
    notes: tuple[str, ...] = ()
    """What a reader should know though it is not wrong."""
    changes: Differences = field(default_factory=dict)
    """What is not as recorded here and may explain a difference: packages, platform, code, environment."""
    not_compared: str = ""
    """What of the recording was not compared."""
    is_loop: bool = False
    """Whether its steps can be compared by a rerun of its environment only."""
    if_rerun: Verification | None = None
    """What holds instead if a rerun gives the recorded steps, though their order is unlikely."""

    @property
    def sound(self) -> bool:
        """Whether nothing differs, and nothing is damaged."""
        return self.verdict not in ("differs", "damaged")


def with_difference(found: Verification, error: Diverged, verdict: Verdict = "damaged") -> Verification:
    """Return a verification with a difference as its finding."""
    return replace(found, verdict=verdict, finding=str(error), difference=error)


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
