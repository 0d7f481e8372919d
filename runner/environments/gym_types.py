"""Gymnasium's generic types for environments and spaces whose values are known only at run time."""

from typing import Any

import gymnasium
from gymnasium import spaces
from gymnasium.vector import VectorEnv

Space = spaces.Space[Any]
Env = gymnasium.Env[Any, Any]
AnyVectorEnv = VectorEnv[Any, Any, Any]
StepResult = tuple[Any, Any, bool, bool, dict[str, Any]]
VectorStepResult = tuple[Any, Any, Any, Any, dict[str, Any]]
ResetResult = tuple[Any, dict[str, Any]]
ResetOptions = dict[str, Any]
