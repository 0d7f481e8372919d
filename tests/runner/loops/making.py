"""Loops and environments for the tests of the wrappers."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from click.testing import CliRunner
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import runner
from runner.cli import cli

KWARGS = {"FrozenLake-v1": {"is_slippery": True}}


class Rooms(gymnasium.Env[Any, Any]):
    """Values of every kind of space, a random goal, and an info of changing fields."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 - as Gymnasium has it
    render_mode = "rgb_array"

    def __init__(self, with_text: bool = False) -> None:
        self.with_text = with_text
        inside: dict[str, spaces.Space[Any]] = {
            "position": spaces.Box(-1, 1, (2,), np.float32),
            "doors": spaces.MultiBinary(3),
            "room": spaces.Tuple((spaces.Discrete(5, start=-2), spaces.MultiDiscrete([2, 3]))),
        }
        if with_text:
            inside["mission"] = spaces.Text(30)
        self.observation_space = spaces.Dict(inside)
        self.action_space = spaces.Dict(
            {"go": spaces.Discrete(4), "push": spaces.Box(0, 1, (1,), np.float64)}
        )
        self._t = 0

    def _observation(self) -> Any:
        seed = int(self.np_random.integers(2**31))
        self.observation_space.seed(seed)
        return self.observation_space.sample()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self._t = 0
        return self._observation(), {"first": True}

    def step(self, action: Any) -> Any:
        self._t += 1
        over = bool(self.np_random.random() < 0.1)
        info = {"luck": np.float32(0.5), "way": [1, 2]} if self._t % 2 else {}
        return self._observation(), float(action["go"]), over, self._t >= 25, info

    def render(self) -> Any:
        return np.full((16, 24, 3), self._t, np.uint8)


def make(name: str, **kwargs: Any) -> gymnasium.Env[Any, Any]:
    if name.startswith("Rooms"):
        return Rooms(with_text=name.endswith("Text"))
    return gymnasium.make(name, **KWARGS.get(name, {}), **kwargs)


NAMES = (
    "Taxi-v4",
    "FrozenLake-v1",
    "CliffWalking-v1",
    "Blackjack-v1",
    "CartPole-v1",
    "Rooms",
    "RoomsText",
)


def play(env: gymnasium.Env[Any, Any], steps: int, seed: int = 5) -> Iterator[tuple[Any, ...]]:
    """Play at random; yield ("reset", seed, observation) and ("step", action, ...)."""
    actions = env.action_space
    actions.seed(seed)
    yield "reset", seed, env.reset(seed=seed)[0]
    over = False
    for _ in range(steps):
        if over:
            yield "reset", None, env.reset()[0]
        action = actions.sample()
        observation, reward, terminated, truncated, info = env.step(action)
        over = terminated or truncated
        yield "step", action, observation, reward, terminated, truncated, info


def recorded(folder: Path, name: str, steps: int, **options: Any) -> tuple[Path, list[tuple[Any, ...]]]:
    """Return the recording of a loop, and the values that the loop got."""
    with runner.record(make(name), folder, **options) as env:
        seen = list(play(env, steps))
    return env.run.recording, seen


class Leaving:
    """Three agents, of which one leaves at each step, as PettingZoo requires."""

    metadata = {"name": "leaving_v0"}  # noqa: RUF012 - as PettingZoo has it
    possible_agents = ("a", "b", "c")

    def __init__(self) -> None:
        self.agents: list[str] = []

    def observation_space(self, agent: str) -> Any:
        return spaces.Box(0, 9, (2,), np.float32)

    def action_space(self, agent: str) -> Any:
        return spaces.Discrete(5)

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.agents = list(self.possible_agents)
        return {agent: np.zeros(2, np.float32) for agent in self.agents}, {a: {} for a in self.agents}

    def step(self, actions: Any) -> Any:
        there = list(self.agents)
        gone = self.agents.pop(0)
        values = {agent: np.full(2, len(there), np.float32) for agent in there}
        ends = {agent: agent == gone for agent in there}
        never = dict.fromkeys(there, False)
        return values, dict.fromkeys(there, 1.0), ends, never, {agent: {"left": gone} for agent in there}

    def close(self) -> None:
        pass


def drive(envs: Any, steps: int) -> list[Any]:
    """Play at random, with resets by mask where the environments do not reset themselves."""
    envs.action_space.seed(2)
    seen = [envs.reset(seed=7)[0]]
    disabled = envs.metadata["autoreset_mode"] == AutoresetMode.DISABLED
    for _ in range(steps):
        result = envs.step(envs.action_space.sample())
        seen.append(result[:4])
        over = result[2] | result[3]
        if disabled and over.any():
            seen.append(envs.reset(options={"reset_mask": over})[0])
    return seen


def parallel(env: Any, episodes: int) -> list[Any]:
    """Play at random; agents may leave before the others."""
    generator, seen = np.random.default_rng(3), []
    for k in range(episodes):
        seen.append(("reset", env.reset(seed=k)[0]))
        while env.agents:
            actions = {agent: int(generator.integers(env.action_space(agent).n)) for agent in env.agents}
            seen.append((actions, *env.step(actions)[:4]))
    return seen


def dualtaxi(folder: Path, *words: str) -> Any:
    """Run a command, whose output must not have a traceback."""
    done = CliRunner().invoke(cli, [*words, "--recordings", str(folder)])
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done


N_COUNTING = 3


class Counting(gymnasium.Env[Any, Any]):
    """Draws its own number, its episode and the steps of the episode, which has 4 to 8 of them."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012 - as Gymnasium has it
    render_mode = "rgb_array"
    observation_space = spaces.Box(0, 255, (3,), np.float32)
    action_space = spaces.Discrete(2)

    def __init__(self, number: int) -> None:
        self._state = [number, -1, 0]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self._state[1:] = self._state[1] + 1, 0
        return self._observation(), {}

    def step(self, action: Any) -> Any:
        self._state[2] += 1
        number, episode, t = self._state
        return self._observation(), 1.0, t == 4 + (number + episode) % 5, False, {}

    def _observation(self) -> Any:
        return np.array(self._state, np.float32)

    def render(self) -> Any:
        return np.tile(np.array(self._state, np.uint8), (2, 4, 1))


def counting(number: int) -> Any:
    return lambda: Counting(number)


def record_counting(
    folder: Path, mode: AutoresetMode, kind: Any = SyncVectorEnv, steps: int = 60, **options: Any
) -> Path:
    envs = kind([counting(i) for i in range(N_COUNTING)], autoreset_mode=mode)
    options = {"frames_every": 1} | options
    with runner.record_vector(envs, folder, name="counting", index="chunk", **options) as rec:
        rec.reset(seed=0)
        for k in range(steps):
            over = np.logical_or(*rec.step(np.zeros(N_COUNTING, int))[2:4])
            if mode == AutoresetMode.DISABLED and over.any():
                rec.reset(options={"reset_mask": over})
            if k == steps // 2:
                with rec.phase("eval"):
                    rec.reset(seed=1)
                    rec.step(np.zeros(N_COUNTING, int))
                rec.reset(seed=2)
    return rec.run.recording


class Described(Rooms):
    """Rooms with a method that RLlib's games have too."""

    def get_observation_space(self, agent: object = None) -> object:
        """Return the space of the observations."""
        return self.observation_space
