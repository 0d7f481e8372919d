"""What a run's environment consists of, in words and as JSON; the names of the numbers in observations."""

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


NAMES: Final = {
    "AcrobotEnv": (
        "cosine of theta 1",
        "sine of theta 1",
        "cosine of theta 2",
        "sine of theta 2",
        "angular velocity of theta 1",
        "angular velocity of theta 2",
    ),
    "BipedalWalker": (
        "hull angle",
        "hull angular velocity",
        "velocity x",
        "velocity y",
        "hip 1 angle",
        "hip 1 speed",
        "knee 1 angle",
        "knee 1 speed",
        "leg 1 contact",
        "hip 2 angle",
        "hip 2 speed",
        "knee 2 angle",
        "knee 2 speed",
        "leg 2 contact",
        *(f"lidar {ray}" for ray in range(10)),
    ),
    "CartPoleEnv": ("cart position", "cart velocity", "pole angle", "pole angular velocity"),
    "Continuous_MountainCarEnv": ("position", "velocity"),
    "HalfCheetahEnv": (
        "front tip z",
        "front tip angle",
        "back thigh angle",
        "back shin angle",
        "back foot angle",
        "front thigh angle",
        "front shin angle",
        "front foot angle",
        "front tip velocity x",
        "front tip velocity z",
        "front tip angular velocity",
        "back thigh angular velocity",
        "back shin angular velocity",
        "back foot angular velocity",
        "front thigh angular velocity",
        "front shin angular velocity",
        "front foot angular velocity",
    ),
    "HopperEnv": (
        "torso z",
        "torso angle",
        "thigh angle",
        "leg angle",
        "foot angle",
        "torso velocity x",
        "torso velocity z",
        "torso angular velocity",
        "thigh angular velocity",
        "leg angular velocity",
        "foot angular velocity",
    ),
    "LunarLander": (
        "x",
        "y",
        "velocity x",
        "velocity y",
        "angle",
        "angular velocity",
        "left leg contact",
        "right leg contact",
    ),
    "MountainCarEnv": ("position", "velocity"),
    "PendulumEnv": ("x = cos(theta)", "y = sin(theta)", "angular velocity"),
    "Walker2dEnv": (
        "torso z",
        "torso angle",
        "thigh angle",
        "leg angle",
        "foot angle",
        "left thigh angle",
        "left leg angle",
        "left foot angle",
        "torso velocity x",
        "torso velocity z",
        "torso angular velocity",
        "thigh angular velocity",
        "leg angular velocity",
        "foot angular velocity",
        "left thigh angular velocity",
        "left leg angular velocity",
        "left foot angular velocity",
    ),
}
"""The numbers in order, by the class of Gymnasium, as its documentation describes them."""
_KNOWN_WRAPPERS: Final = ("gymnasium.wrappers.", "stable_baselines3.common.")
"""Modules of wrappers that change the shape of an observation, or keep the meaning of its numbers."""


def observation_names(recording: Recording) -> tuple[str, ...]:
    """Return the name of each number of an observation, in order; empty if they are unknown.

    They are unknown, too, if wrappers of the user may have changed their meaning.

    Raises:
        RecordingError: what the recording says of its environment is damaged.
    """
    maker = recording.maker
    if maker is None or not maker.spec:
        return ()
    wrappers = maker.wrappers + (maker.vector.wrappers if maker.vector else ())
    if any(
        not wrapper.startswith(_KNOWN_WRAPPERS) or wrapper.endswith("TransformObservation")
        for wrapper in wrappers
    ):
        return ()
    module, _, kind = str(json.loads(maker.spec).get("entry_point")).partition(":")
    names = NAMES.get(kind, ()) if module.startswith("gymnasium.envs.") else ()
    return names if recording.spaces["observation"].get("shape") == [len(names)] else ()
