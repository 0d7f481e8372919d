"""DualTaxi: two taxis, one passenger, for Gymnasium and PettingZoo.

Importing the package registers `DualTaxi-v1`; `gymnasium.make("dualtaxi:DualTaxi-v1")` does both at once.
The PettingZoo version is `dualtaxi.parallel.DualTaxiParallelEnv`.
"""

import gymnasium

from dualtaxi.env import DualTaxiEnv
from dualtaxi.grid import DEFAULT_MAP
from dualtaxi.transitions import Rewards, Transitions

__all__ = ["DEFAULT_MAP", "DualTaxiEnv", "Rewards", "Transitions"]

gymnasium.register(id="DualTaxi-v1", entry_point="dualtaxi.env:DualTaxiEnv", max_episode_steps=1500)
