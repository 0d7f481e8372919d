"""Jobs that tests submit."""

from __future__ import annotations

from typing import Any, Final

ICY: Final[dict[str, Any]] = {
    "name": "icy",
    "env": {"id": "FrozenLake-v1"},
    "episodes": 60,
    "evaluation": {"every": 30, "trials": 5},
    "seeds": [0, 1],
}
ENDLESS: Final[dict[str, Any]] = {
    "name": "endless",
    "env": {"id": "CliffWalking-v1"},
    "epsilon": 1,
    "episodes": 10**7,
    "evaluation": None,
    "recording": {"steps": "none"},
}
"""Half an hour of thousands of steps an episode, for very little disk."""
