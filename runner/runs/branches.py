"""The branches of runs: what each was branched from, and the branches that a run has."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from peewee import fn

from runner.recording.schema import PHASES
from runner.runs.catalogue.filters import Filter, setting_path
from runner.runs.catalogue.index import Index, look
from runner.runs.catalogue.rows import Row
from runner.util.values import is_whole

_MAX_NUMBER: Final = 2**62
_PATH: Final = "config.origin"
"""The path of an origin in the configuration."""


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

    def __str__(self) -> str:
        """Describe the branch: `at 120:5, action 1, then random`."""
        return f"at {self.at}, action {self.action}, then {self.policy}"


def origin_in(config: Mapping[str, Any]) -> BranchOrigin | None:
    """Return what the run with this configuration was branched from; None if it is no branch."""
    settings = config.get("config")
    found = settings.get("origin") if isinstance(settings, Mapping) else None
    return _origin(found) if isinstance(found, Mapping) else None


def _origin(found: Mapping[str, Any]) -> BranchOrigin | None:
    values: dict[str, Any] = {name: found.get(name) for name in BranchOrigin.__dataclass_fields__}
    are_numbers = all(is_whole(values[name], 0, _MAX_NUMBER) for name in ("episode", "t", "seed"))
    are_texts = all(isinstance(values[name], str) for name in ("run", "at", "action", "policy"))
    return BranchOrigin(**values) if are_numbers and are_texts and values["phase"] in PHASES else None


def branches_of(
    run_id: str, recordings: Path, report: Callable[[str], None] = lambda _: None
) -> dict[str, BranchOrigin]:
    """Return the branches of a run in its folder by run id, the newest first."""
    return look([recordings], lambda index: branches_in(index, run_id), report)


def branches_in(index: Index, run_id: str) -> dict[str, BranchOrigin]:
    """Return the branches of a run by run id, the newest first."""
    parent = fn.json_extract(Row.settings, setting_path(f"{_PATH}.run"))
    branches = {}
    for row in index.rows(Filter(parent == run_id), columns=("id", "settings")):
        settings = json.loads(row["settings"])
        found = {name: settings.get(f"{_PATH}.{name}") for name in BranchOrigin.__dataclass_fields__}
        if (origin := _origin(found)) is not None:
            branches[row["id"]] = origin
    return branches
