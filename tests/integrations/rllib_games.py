"""Environments of several agents for RLlib, made at the top of a module so that a recording can name them."""

from __future__ import annotations

from typing import Any

from mpe2 import simple_spread_v3
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv, PettingZooEnv


def at_once(_: object = None) -> Any:
    """Return a game of four agents that act at once."""
    return ParallelPettingZooEnv(simple_spread_v3.parallel_env(N=4, max_cycles=20))


def in_turns(_: object = None) -> Any:
    """Return the same game in turns."""
    return PettingZooEnv(simple_spread_v3.env(N=4, max_cycles=20))
