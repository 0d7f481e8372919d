"""The names of the numbers in the observations of well-known environments."""

from __future__ import annotations

import json
from typing import Final

from runner.recording.reader import Recording

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
