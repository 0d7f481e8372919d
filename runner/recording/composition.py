"""What a run's environment consists of: id, changed arguments, step limit, wrappers; in words and as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from runner.errors import shortened
from runner.recording.reader import Recording
from runner.recording.run_file import has_environment
from runner.util.values import Json, JsonView, is_whole

_CHANGE_NOTHING: Final = frozenset(
    (
        "HumanRendering",
        "Monitor",
        "OrderEnforcing",
        "PassiveEnvChecker",
        "RecordEpisodeStatistics",
        "RecordVideo",
        "RenderCollection",
    )
)
"""Classes of wrappers that are left out: no step is another one with them."""
_MAX_VALUE: Final = 60
"""The most characters of an argument in words."""


@dataclass(frozen=True)
class Composition:
    """What an environment consists of."""

    id: str
    arguments: JsonView = field(default_factory=dict)
    """Those that are not the registered ones; of a class that was called, all that are known."""
    step_limit: int | None = None
    registered_step_limit: int | None = None
    """None if the same, or if the environment is not registered."""
    wrappers: tuple[tuple[str, JsonView | None], ...] = ()
    """Name and arguments of each that changes steps, from the innermost out; None if they are unknown."""
    make: str = ""
    """The user's function that makes it; empty if none."""

    def __str__(self) -> str:
        parts = [_call(self.id, self.arguments)]
        if self.step_limit or self.registered_step_limit:
            limit = f"at most {self.step_limit:,} steps" if self.step_limit else "no step limit"
            registered = self.registered_step_limit
            parts.append(f"{limit} (registered: {registered:,})" if registered else limit)
        if self.wrappers:
            parts.append(f"wrapped by {', '.join(_call(*wrapper) for wrapper in self.wrappers)}")
        return ", ".join([*parts, f"made by {self.make}"] if self.make else parts)

    def as_json(self) -> Json:
        """Return it as JSON can hold it."""
        wrappers = [{"name": name, "arguments": arguments} for name, arguments in self.wrappers]
        return vars(self) | {"arguments": dict(self.arguments), "wrappers": wrappers}


def composition_of(recording: Recording) -> Composition | None:
    """Return what the environment consists of, as far as the recording states it; None if it has none.

    Raises:
        RecordingError: the recording is damaged.
    """
    if not has_environment(recording.config):
        return None
    stated = recording.environment
    maker = recording.train.maker_of()
    name = str(stated["env_id"]).rpartition(":")[2]
    limit = stated["step_limit"] or None
    if maker is None:
        return Composition(name, stated["kwargs"], limit)
    spec = json.loads(maker.spec or "{}")
    usual = maker.registered.get("kwargs", {})
    usual_limit = maker.registered.get("max_episode_steps")
    given = spec.get("kwargs", stated["kwargs"])
    if "additional_wrappers" in spec:
        limit = spec.get("max_episode_steps")
        limit = limit if is_whole(limit, 1, 2**62) else None
    changed = {
        key: value
        for key, value in (given.items() if isinstance(given, Mapping) else ())
        if key != "render_mode" and (key not in usual or usual[key] != value)
    }
    wrappers = [{"entry_point": name} for name in reversed(maker.wrappers)]
    if spec:
        listed = spec.get("additional_wrappers", spec.get("wrappers"))
        wrappers = listed if isinstance(listed, list) else []
    wrappers += json.loads(maker.vector.wrapper_specs or "[]") if maker.vector is not None else []
    named = (_wrapper(fields) for fields in wrappers if isinstance(fields, Mapping))
    return Composition(
        name,
        changed,
        limit,
        usual_limit if usual_limit != limit else None,
        tuple(wrapper for wrapper in named if wrapper[0] not in _CHANGE_NOTHING),
        maker.make,
    )


def _wrapper(fields: JsonView) -> tuple[str, JsonView | None]:
    arguments = fields.get("kwargs")
    name = str(fields.get("entry_point")).rpartition(":")[2]
    return name, arguments if isinstance(arguments, Mapping) else None


def _call(name: str, arguments: Mapping[str, object] | None) -> str:
    """Return a name with its arguments, as code; an ellipsis if they are unknown."""
    if not arguments:
        return f"{name}(…)" if arguments is None else name
    values = (f"{key}={shortened(json.dumps(value), _MAX_VALUE)}" for key, value in arguments.items())
    return f"{name}({', '.join(values)})"
