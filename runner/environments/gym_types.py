"""Gymnasium's generic types for environments and spaces whose values are known only at run time."""

from typing import Any

import gymnasium
from gymnasium import spaces
from gymnasium.vector import VectorEnv

from runner.util.values import Json

Space = spaces.Space[Any]
Env = gymnasium.Env[Any, Any]
AnyVectorEnv = VectorEnv[Any, Any, Any]
Info = Json
"""Further results of a step or reset, by name."""
StepResult = tuple[Any, Any, bool, bool, Info]
VectorStepResult = tuple[Any, Any, Any, Any, Info]
ResetResult = tuple[Any, Info]
ResetOptions = Json
