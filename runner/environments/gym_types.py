"""Gymnasium's generic types for environments and spaces whose values are known only at run time."""

from typing import Any

import gymnasium
from gymnasium import spaces
from gymnasium.vector import VectorEnv

Space = spaces.Space[Any]
Env = gymnasium.Env[Any, Any]
AnyVectorEnv = VectorEnv[Any, Any, Any]
Info = dict[str, Any]
"""What an environment tells besides, by field."""
StepResult = tuple[Any, Any, bool, bool, Info]
VectorStepResult = tuple[Any, Any, Any, Any, Info]
ResetResult = tuple[Any, Info]
ResetOptions = dict[str, Any]
