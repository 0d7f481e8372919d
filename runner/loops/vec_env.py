"""A `VecEnv` of Stable-Baselines3 with the interface of Gymnasium's vector environments."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from runner.environments.gym_types import AnyVectorEnv, ResetResult, VectorStepResult

LIBRARY: Final = "stable-baselines3"
_MODES: Final = {"DummyVecEnv": "sync", "SubprocVecEnv": "async"}


class VecEnvVector(AnyVectorEnv):
    """The environments of a `VecEnv` without wrappers, as a vector that resets itself within a step.

    A `DummyVecEnv` rounds rewards to float32. As long as this object is open they are kept as they came, and
    rounded for `native`.

    Args:
        base: the `VecEnv`. The methods that it has now are called, also when they are replaced afterwards.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, base: Any) -> None:
        self.base = base
        self.num_envs = base.num_envs
        self.single_observation_space = base.observation_space
        self.single_action_space = base.action_space
        self.observation_space = base.observation_space
        self.action_space = base.action_space
        self.render_mode = base.render_mode
        self.mode = _MODES.get(type(base).__name__, "custom")
        """How the environments are put together, as in `VectorMaker`."""
        self.envs: list[object] = base.envs if self.mode == "sync" else []
        self.spec = base.get_attr("spec", indices=[0])[0] if self.mode == "async" else None
        self.step_async = base.step_async
        self._step_wait = base.step_wait
        self._reset = base.reset
        self._close = base.close
        self._rewards_dtype = base.buf_rews.dtype if self.mode == "sync" else None
        if self.mode == "sync":
            base.buf_rews = np.zeros(self.num_envs)
        self.native: object = None
        """What the `VecEnv` returned last, for those who use it as such."""

    def step(self, actions: object) -> VectorStepResult:  # noqa: ARG002
        """Wait for the steps that `step_async` has begun."""
        observations, rewards, dones, infos = self._step_wait()
        rounded = rewards.astype(self._rewards_dtype) if self._rewards_dtype is not None else rewards
        self.native = observations, rounded, dones, infos
        if not dones.any():
            return observations, rewards, dones, dones, infos
        truncated = np.zeros(self.num_envs, np.bool_)
        for i in dones.nonzero()[0].tolist():
            truncated[i] = infos[i].get("TimeLimit.truncated", False)
        return observations, rewards, dones & ~truncated, truncated, infos

    def reset(self, *, seed: object = None, options: object = None) -> ResetResult:  # noqa: ARG002
        """Reset all environments, with the seeds and options that the `VecEnv` has for them."""
        self.native = self._reset()
        return self.native, self.base.reset_infos

    def render(self) -> Any:
        """Return a picture of each environment."""
        return self.base.get_images()

    def get_attr(self, name: str) -> object:
        """Return an attribute of each environment."""
        return self.base.get_attr(name)

    def release(self) -> None:
        """Leave the `VecEnv` as it was."""
        if self._rewards_dtype is not None:
            self.base.buf_rews = self.base.buf_rews.astype(self._rewards_dtype)

    def close(self, **kwargs: object) -> None:  # noqa: ARG002
        """Close the `VecEnv`."""
        self._close()


def mode_of(base: object) -> str:
    """Return how the environments of a vector without wrappers are put together, as in `VectorMaker`."""
    if isinstance(base, VecEnvVector):
        return base.mode
    if isinstance(base, AsyncVectorEnv):
        return "async"
    return "sync" if isinstance(base, SyncVectorEnv) else "custom"
