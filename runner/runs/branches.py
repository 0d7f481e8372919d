"""What a run was branched from, as its configuration has it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from runner.util.values import is_whole

ORIGIN: Final = "config.origin."
"""What the paths of its fields in a configuration begin with."""
_MAX_NUMBER: Final = 2**62


@dataclass(frozen=True)
class BranchOrigin:
    """What a run was branched from, as its configuration has it."""

    run: str
    """The run id of the parent."""
    phase: str
    """`train` or `eval`."""
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


def origin_in(config: Mapping[str, object]) -> BranchOrigin | None:
    """Return what the run with this configuration was branched from; None if it is no branch."""
    settings = config.get("config")
    found = settings.get("origin") if isinstance(settings, Mapping) else None
    return parse_origin(found) if isinstance(found, Mapping) else None


def parse_origin(found: Mapping[str, Any]) -> BranchOrigin | None:
    """Return the origin with these fields, among others; None if one is missing or of another type."""
    values: dict[str, Any] = {name: found.get(name) for name in BranchOrigin.__dataclass_fields__}
    are_numbers = all(is_whole(values[name], 0, _MAX_NUMBER) for name in ("episode", "t", "seed"))
    values["action_name"] = found.get("action_name", "")
    are_texts = all(
        isinstance(values[name], str) for name in ("run", "at", "action", "policy", "action_name")
    )
    return (
        BranchOrigin(**values) if are_numbers and are_texts and values["phase"] in ("train", "eval") else None
    )
