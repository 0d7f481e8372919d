"""What a run was branched from, as its configuration has it."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal

from runner.util.humanize import counted, setting
from runner.util.values import JsonView, flatten, is_whole

PATHS: Final = ("config.origin", "branches")
"""The paths of origins in configurations."""
_MAX_NUMBER: Final = 2**62


@dataclass(frozen=True)
class BranchOrigin:
    """What a run was branched from, as its configuration has it."""

    run: str
    """The run id of the parent."""
    phase: Literal["train", "eval"]
    episode: int
    """The number of the episode in its phase, in the parent; the branch has this one alone."""
    t: int
    """The step at which another action was taken."""
    at: str
    """The same as a step reference, such as `120:5`."""
    action: str
    """The action taken there, as JSON."""
    policy: str
    """What acts after it."""
    seed: int
    """The seed of a random policy."""
    action_name: str = ""
    """The name of the action, of several agents their names; empty if it has none."""

    def __str__(self) -> str:
        """Describe the branch: `at 120:5, action 1 (right), then random`."""
        named = f" ({self.action_name})" if self.action_name else ""
        return f"at {self.at}, action {self.action}{named}, then {self.policy}"


@dataclass(frozen=True)
class TrainingOrigin:
    """The run and the step that the training of a run was branched from, and what was changed there."""

    run: str
    """The run id of the parent."""
    step: int
    """The first training step that may differ."""
    actions: Mapping[str, str] = field(default_factory=dict)
    """Agent to the action that it took at this step, where that was set."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """The settings that changed from this step on, as the configuration has them."""
    episodes: int | None = field(default=None, compare=False)
    """Training episodes of the run, counted from the beginning; None if they are unknown."""

    def __str__(self) -> str:
        """Describe the branch: `at training step 4,000,000: taxi 1 north, epsilon 0.1`."""
        return f"at training step {self.step:,}: {self.changes}"

    @property
    def changes(self) -> str:
        """What was changed: `taxi 1 north, epsilon 0.1`."""
        changes = [f"{agent.replace('_', ' ')} {action}" for agent, action in self.actions.items()]
        changes += [f"{path} {setting(value)}" for path, value in flatten(self.settings).items()]
        total = "" if self.episodes is None else f", {counted(self.episodes, 'episode')} in all"
        return ", ".join(changes) or f"nothing changed{total}"


Origin = BranchOrigin | TrainingOrigin


def training_branches(config: JsonView) -> list[TrainingOrigin]:
    """Return the branches that led to the job with this configuration, the first one first.

    A branch stores whole sections, such as `quirks`; the origin has the settings that it changed.
    """
    branches = config.get("branches")
    origins: list[TrainingOrigin] = []
    for origin in map(parse_origin, branches if isinstance(branches, list) else ()):
        if isinstance(origin, TrainingOrigin):
            held = flatten(config)
            for earlier in sorted(origins, key=lambda other: other.step):
                held |= earlier.settings if earlier.step <= origin.step else {}
            settings = flatten(origin.settings).items()
            changed = {path: value for path, value in settings if path not in held or held[path] != value}
            origins.append(replace(origin, settings=changed))
    return origins


def origin_in(config: JsonView) -> Origin | None:
    """Return what the run with this configuration was branched from; None if it is no branch."""
    if branches := training_branches(config):
        episodes = config.get("episodes")
        return replace(branches[-1], episodes=episodes if is_whole(episodes, 0, _MAX_NUMBER) else None)
    settings = config.get("config")
    return parse_origin(settings.get("origin")) if isinstance(settings, Mapping) else None


def parse_origin(recorded: object) -> Origin | None:
    """Return the origin with these fields, among others; None if one is missing or of another type."""
    if not isinstance(recorded, Mapping) or "checkpoint" in recorded:  # an evaluated checkpoint is no branch
        return None
    import msgspec

    kind: type[Origin] = BranchOrigin if "phase" in recorded else TrainingOrigin
    with contextlib.suppress(msgspec.ValidationError, UnicodeEncodeError):  # a text may have half a character
        origin = msgspec.convert(recorded, kind)
        numbers = (value for value in vars(origin).values() if isinstance(value, int))
        return origin if all(0 <= number <= _MAX_NUMBER for number in numbers) else None
    return None


@dataclass(frozen=True)
class BranchNode:
    """A run in the tree of branches that it belongs to."""

    run: str
    """Its run id."""
    name: str | None
    """None if the run was removed, or is in another folder."""
    status: str
    success_percent: float | None
    """That of its last evaluation."""
    mean_return: float | None
    """That of its last evaluation; without one, of a loop's last training episodes."""
    origin: Origin | None
    """What it was branched from."""
    branches: tuple[BranchNode, ...]
    """The oldest first."""
