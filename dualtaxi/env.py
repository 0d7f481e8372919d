"""DualTaxi as a Gymnasium environment."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from dualtaxi.grid import ACTIONS, AGENTS, DEFAULT_MAP, Grid, State, decode_action, encode_action
from dualtaxi.rendering import Picture, describe_scene, draw_text, place_things
from dualtaxi.transitions import (
    EVENT_NAMES,
    Rewards,
    Transitions,
    build_transitions,
    is_number,
    legal_actions,
    start_distribution,
    summed,
    transition_table,
)


class DualTaxiEnv(gymnasium.Env[Any, Any]):
    """Two taxis in one small town pick up a passenger and deliver them, together or against each other.

    ## Description
    Two taxis share a 4x4 grid with four landmarks: R(ed), G(reen), Y(ellow) and B(lue). A passenger waits
    at one landmark and wants to go to another. Either taxi may pick the passenger up; the episode ends
    when the passenger is dropped off at the destination. The taxis cannot be in one cell.

    Map (`:` is open, `|` a wall):

        +-------+
        |R: | :G|
        | : | : |
        | | : : |
        |Y: |B: |
        +-------+

    In the cooperative game one learner steers both taxis and earns the sum of their rewards. In the
    competitive game (`competitive=True`) each taxi has a reward of its own; the moves are the same. For
    one learner a taxi, see `dualtaxi.parallel.DualTaxiParallelEnv`.

    ## Action Space
    `Discrete(36)`: the joint action `action_1 * 6 + action_2`, taken at the same time. Each taxi has

    - 0: move south (down)
    - 1: move north (up)
    - 2: move east (right)
    - 3: move west (left)
    - 4: pick up the passenger
    - 5: drop off the passenger

    `encode_action` and `decode_action` translate.

    ## Observation Space
    `Discrete(6144)`: 16 cells of taxi 1, 16 of taxi 2, 6 places of the passenger, 4 destinations:
    `((((row_1 * 4 + column_1) * 4 + row_2) * 4 + column_2) * 6 + passenger) * 4 + destination`.

    - passenger: 0 to 3 = waits at R, G, Y, B; 4 = in taxi 1; 5 = in taxi 2
    - destination: 0 to 3 = R, G, Y, B

    `encode` and `decode` translate; landmarks are numbered in reading order.

    ## Transitions
    - A move against a wall or the edge leaves the taxi in place.
    - Pickup is legal where the passenger waits: the passenger gets in. Drop-off is legal at a landmark with
      the passenger aboard: the passenger gets out there. Any other pickup or drop-off is illegal and does
      nothing.
    - If both taxis would end the step in one cell, they collide: nothing of the step happens, neither
      moves, and the passenger stays. *But* if one of the actions was a legal drop-off at the destination,
      the episode ends all the same, undelivered: a quirk of the published game, kept.
    - Two taxis that change places pass each other without harm.
    - From a state with both taxis in one cell (no start leads there): the moves happen, the passenger
      stays, the rewards are -0.5 and 0, and the episode ends, unless they collide again.

    ## Starting State
    Uniform over the 2,880 states with the taxis in different cells and the passenger waiting at a landmark
    other than the destination; `initial_state_distrib` holds the probabilities.

    ## Rewards
    Each taxi gets, judged by the state before the step:

    - -2 a step; -1 while the passenger rides in the *other* taxi
    - 0 for a legal pickup
    - -10 for an illegal pickup or drop-off
    - +100 for dropping the passenger off at the destination
    - the step's -2 for dropping the passenger off at another landmark
    - -15 for a collision, instead of all of the above

    The reward of a step is the sum of both. In the competitive game `info["rewards"]` holds the two.

    ## Episode End
    - Termination: the passenger is delivered, or one of the two quirks above.
    - Truncation: after 1,500 steps, by the `TimeLimit` wrapper that `gymnasium.make` adds.

    ## Information
    `reset` and `step` return a dict with

    - `prob`: the probability of the outcome (1 after a reset)
    - `action_mask`: int8 [36], a new array each time: 1 for joint actions in which neither taxi drives
      against a wall and neither picks up or drops off illegally. It does not foresee collisions. Fit for
      `env.action_space.sample(info["action_mask"])`; there is always at least one such action.
    - `rewards`: float64 [2], after a step in the competitive game: the reward of each taxi

    ## Tables
    For planning, recording and fast training, read-only, S states and A joint actions:

    - `transitions`: arrays of all outcomes; see `dualtaxi.Transitions`. R = 1 (the sum) in the cooperative
      game, 2 in the competitive one.
    - `P[state][action] = [(probability, next_state, reward, terminated), ...]`; the reward is a pair in the
      competitive game. Built at its first use.
    - `initial_state_distrib`: float64 [S].
    - `agents`, `agent_action_counts`: names of the agents, and how many actions each has; the first agent
      is the most significant in a joint action.
    - `event_names`: names of the bits in `transitions.events`, `<agent>.<event>` or `collision`: `pickup`;
      `drop_off` (delivered); `wrong_stop` (put out at another landmark); `illegal_pickup`;
      `illegal_drop_off`. Events are what the step was rewarded for: a collision undoes everything else, so
      its bit is the only one, and no attempt, legal or not, is among the events.
    - `success_events`: the events that mean success.
    - `penalty_below`: the published statistics call a step whose summed reward is below it a penalty.
    - `scene`, `scene_cells` (int16 [S, things]), `scene_carriers` (int8 [S, things]): how to draw a state;
      see `dualtaxi.rendering.describe_scene`.

    `s` is the current state, as in Gymnasium's toy-text environments; it may be set, to look at a state.

    ## Rendering
    - `ansi`: the map with taxi 1 on yellow, taxi 2 on red, the taxi with the passenger on green, the
      waiting passenger's landmark in bold blue and the destination in magenta; below, the last actions.
      With the environment variable `NO_COLOR` set, letters say the same, with a legend.
    - `rgb_array`: a picture, uint8 [height, width, 3].

    ## Arguments
    ```python
    import gymnasium
    env = gymnasium.make("dualtaxi:DualTaxi-v1", competitive=True, rewards={"drop_off": 50}, slip=0.1)
    ```

    - `competitive=False`: see Description.
    - `rewards=None`: other rewards than the published ones, a mapping or `dualtaxi.Rewards`.
    - `map=None`: another map, a list of strings in the style above, of any size, with two or more
      landmarks (letters A to Z). The numbers of states follow.
    - `slip=0.0`: probability that a move goes sideways instead, half of it to either side, independently
      for each taxi. Walls then hold as for any move.

    ## References
    The game follows the DualTaxi-v1 of the two-taxi Q-learning tutorial by Satwik Kansal; the
    idea of the taxi is from T. G. Dietterich, "Hierarchical Reinforcement Learning with the MAXQ Value
    Function Decomposition", Journal of Artificial Intelligence Research 13, 2000.

    ## Version History
    * v1: the published transition table, state for state; rendering, masks, parameters and tables added.
    """

    metadata = {  # noqa: RUF012 - as the base class has it
        "render_modes": ["ansi", "rgb_array"],
        "render_fps": 4,
    }

    agents = AGENTS
    agent_action_counts = (len(ACTIONS), len(ACTIONS))
    event_names = EVENT_NAMES
    success_events = tuple(f"{agent}.drop_off" for agent in AGENTS)
    penalty_below = -2.0

    def __init__(
        self,
        render_mode: str | None = None,
        *,
        competitive: bool = False,
        rewards: Rewards | Mapping[str, float] | None = None,
        map: Sequence[str] | None = None,  # noqa: A002 - a config reads `map: [...]`
        slip: float = 0.0,
    ) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            modes = ", ".join(self.metadata["render_modes"])
            raise ValueError(f"render_mode is {render_mode!r}, expected one of {modes}, or None")
        if not is_number(slip) or not 0 <= slip <= 1:
            raise ValueError(f"slip is {slip!r}, expected a probability from 0 to 1")
        if not isinstance(competitive, bool):
            raise ValueError(f"competitive is {competitive!r}, expected True or False")
        self.render_mode = render_mode
        self.competitive = competitive
        self.rewards = Rewards.of(rewards)
        self.slip = float(slip)
        self.grid = Grid.from_text(DEFAULT_MAP if map is None else map)

        pairs = build_transitions(self.grid, self.rewards, self.slip)
        self.transitions: Transitions = pairs if self.competitive else summed(pairs)
        self.initial_state_distrib: NDArray[np.float64] = start_distribution(self.grid)
        self.initial_state_distrib.flags.writeable = False
        self._start_states = np.flatnonzero(self.initial_state_distrib)
        self._legal = legal_actions(self.grid)
        self.observation_space = spaces.Discrete(self.grid.states)
        self.action_space = spaces.Discrete(math.prod(self.agent_action_counts))
        self.s: int | None = None
        self.last_actions: tuple[int, int] | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[int, dict[str, Any]]:
        """Start an episode and return its first state and info; `seed` alone decides what follows."""
        super().reset(seed=seed, options=options)
        self.s = int(self._start_states[self.np_random.integers(len(self._start_states))])
        self.last_actions = None
        return self.s, {"prob": 1.0, "action_mask": self.action_mask(self.s)}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict[str, Any]]:
        """Take a joint action; return state, summed reward, terminated, truncated (never), info."""
        if self.s is None:
            raise ResetNeeded("step() before an episode has begun; call reset() first")
        self.last_actions = decode_action(action)
        action = encode_action(*self.last_actions)
        outcome = self._draw(self.s, action)
        table = self.transitions
        rewards = table.rewards[self.s, action, outcome]
        terminated = bool(table.terminated[self.s, action, outcome])
        probability = float(table.probability[self.s, action, outcome])
        self.s = int(table.next_state[self.s, action, outcome])
        info: dict[str, Any] = {"prob": probability, "action_mask": self.action_mask(self.s)}
        if self.competitive:
            info["rewards"] = rewards.copy()
        return self.s, float(rewards.sum()), terminated, False, info

    def _draw(self, state: int, action: int) -> int:
        """Return which outcome happens; draws nothing where there is only one."""
        probability = self.transitions.probability[state, action]
        real = np.count_nonzero(probability)
        if real == 1:
            return 0
        # The sum may miss 1 by a rounding error; a draw beyond it is the last real outcome's.
        drawn = int(np.searchsorted(np.cumsum(probability[:real]), self.np_random.random(), side="right"))
        return min(drawn, int(real) - 1)

    def action_mask(self, state: int) -> NDArray[np.int8]:
        """Return which joint actions hit no wall and are legal, int8 [36], a new array."""
        first, second = self._legal[state]
        mask: NDArray[np.int8] = np.logical_and.outer(first, second).ravel().astype(np.int8)
        return mask

    def agent_action_mask(self, state: int, agent: str) -> NDArray[np.int8]:
        """Return which actions of one taxi hit no wall and are legal, int8 [6], a new array."""
        mask: NDArray[np.int8] = self._legal[state, AGENTS.index(agent)].astype(np.int8)
        return mask

    @cached_property
    def P(self) -> dict[int, dict[int, list[tuple[Any, ...]]]]:  # noqa: N802 - Gymnasium's name
        """`P[state][action] = [(probability, next_state, reward, terminated), ...]`."""
        return transition_table(self.transitions)

    @property
    def scene(self) -> dict[str, Any]:
        """What never changes in a picture of the game; a new plain dict each time, see `describe_scene`."""
        return describe_scene(self.grid)

    @property
    def scene_cells(self) -> NDArray[np.int16]:
        """Cell index of each of the scene's things in each state, int16 [S, things]."""
        return self._places[0]

    @property
    def scene_carriers(self) -> NDArray[np.int8]:
        """Index of the thing that carries each thing in each state, or -1, int8 [S, things]."""
        return self._places[1]

    @cached_property
    def _places(self) -> tuple[NDArray[np.int16], NDArray[np.int8]]:
        return place_things(self.grid)

    def encode(
        self, taxi_1: tuple[int, int], taxi_2: tuple[int, int], passenger: int, destination: int
    ) -> int:
        """Return the number of a state; taxis as (row, column), passenger and destination as numbers."""
        return self.grid.encode(taxi_1, taxi_2, passenger, destination)

    def decode(self, state: int) -> State:
        """Return the fields of a state."""
        return self.grid.decode(state)

    def encode_action(self, action_1: int, action_2: int) -> int:
        """Return the joint action of the two taxis' actions."""
        return encode_action(action_1, action_2)

    def decode_action(self, action: int) -> tuple[int, int]:
        """Return the actions of taxi 1 and taxi 2 in a joint action."""
        return decode_action(action)

    def render(self) -> Any:
        """Return the current state as text (`ansi`) or as a picture (`rgb_array`)."""
        if self.render_mode is None:
            gymnasium.logger.warn(
                "render() without a render mode does nothing; give one when the environment is made, "
                'for example gymnasium.make("dualtaxi:DualTaxi-v1", render_mode="rgb_array")'
            )
            return None
        if self.s is None:
            raise ResetNeeded("render() before an episode has begun; call reset() first")
        state = self.decode(self.s)
        if self.render_mode == "ansi":
            return draw_text(self.grid, state, self.last_actions)
        return self._picture.draw(state, self.last_actions)

    @cached_property
    def _picture(self) -> Picture:
        return Picture(self.grid)
