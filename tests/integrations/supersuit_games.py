"""A vector of SuperSuit's, made at the top of a module so that a recording can name it."""

from __future__ import annotations

from typing import Any

import supersuit
from mpe2 import simple_spread_v3


def spread() -> Any:
    """Return two games of three agents each as a vector of six environments."""
    game = supersuit.pettingzoo_env_to_vec_env_v1(simple_spread_v3.parallel_env(max_cycles=20))
    return supersuit.concat_vec_envs_v1(game, 2, num_cpus=0, base_class="gymnasium")
