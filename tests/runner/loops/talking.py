"""Environments and a game whose observations and actions are texts."""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from pettingzoo import ParallelEnv
from pettingzoo.utils.conversions import parallel_to_aec

ENVIRONMENTS = 8


class Tools(gymnasium.Env[str, str]):
    """A sum is asked for; "add N" adds a number, "look" shows the sum so far, "answer" ends the episode."""

    shown = "{} so far"

    def __init__(self) -> None:
        self.observation_space = spaces.Text(100, min_length=0, charset="x")
        self.action_space = spaces.Text(100, min_length=0, charset="x")

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[str, dict[str, Any]]:
        super().reset(seed=seed)
        self.goal, self.sum, self.t = int(self.np_random.integers(1, 2000)), 0, 0
        return f"Reach {self.goal}\N{HORIZONTAL ELLIPSIS}\0", {}

    def step(self, action: str) -> tuple[str, float, bool, bool, dict[str, Any]]:
        tool, _, number = action.partition(" ")
        self.t += 1
        said = ""
        if tool == "add":
            self.sum += int(number)
        elif tool == "look":
            said = self.shown.format("|" * (self.sum % 40) + str(self.sum))
        return said, float(self.sum == self.goal), tool == "answer", self.t == 9, {}


class Assistant(gymnasium.Wrapper[dict[str, Any], str, str, str]):
    """The same, which observes the number of the last tool, too."""

    def __init__(self) -> None:
        super().__init__(Tools())
        self.observation_space = spaces.Dict(text=spaces.Text(100), tool=spaces.Discrete(4))

    def reset(self, **arguments: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        text, info = self.env.reset(**arguments)
        return {"text": text, "tool": 0}, info

    def step(self, action: str) -> tuple[dict[str, Any], Any, bool, bool, dict[str, Any]]:
        text, *rest = self.env.step(action)
        tools = ("add", "look", "answer")
        tool, _, _ = action.partition(" ")
        return {"text": text, "tool": 1 + tools.index(tool) if tool in tools else 0}, *rest


def assistants() -> Any:
    """Return several of those."""
    return SyncVectorEnv([Assistant] * ENVIRONMENTS)


class Mistaken(Tools):
    """The same with another text after "look"."""

    shown = "{} now"


def make(kind: type[Tools] = Tools, mode: AutoresetMode = AutoresetMode.NEXT_STEP) -> Any:
    """Return several of them."""
    return SyncVectorEnv([kind] * ENVIRONMENTS, autoreset_mode=mode)


def make_same_step() -> Any:
    """Return several that are reset within the step that ends an episode."""
    return make(mode=AutoresetMode.SAME_STEP)


def make_disabled() -> Any:
    """Return several that are reset by the caller."""
    return make(mode=AutoresetMode.DISABLED)


make_mistaken = partial(make, Mistaken)

MAKERS = {
    AutoresetMode.NEXT_STEP: make,
    AutoresetMode.SAME_STEP: make_same_step,
    AutoresetMode.DISABLED: make_disabled,
}


def said(t: int, environment: int) -> str:
    """Return the action of an environment at a step: texts of many lengths, and an empty one."""
    if (t + environment) % 7 == 6:
        return "answer"
    return ("add {}", "look", "", "add -{}")[(3 * t + environment) % 4].format(10 ** (t % 4))


class Negotiation(ParallelEnv[str, dict[str, Any], dict[str, Any]]):
    """Two agents write to each other; the buyer leaves first."""

    metadata = {"name": "negotiation"}  # noqa: RUF012 - as PettingZoo has it
    render_mode = None
    answer = "no: "

    def __init__(self) -> None:
        self.possible_agents = ["buyer", "seller"]

    def observation_space(self, agent: str) -> Any:
        parts = {"heard": spaces.Text(200), "round": spaces.Discrete(10), "bids": BIDS}
        return spaces.Dict(parts)

    def action_space(self, agent: str) -> Any:
        text = spaces.Text(200)
        return text if agent == "buyer" else spaces.Dict({"text": text, "price": BIDS})

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        self.agents, self.t, self.bids = list(self.possible_agents), 0, []
        return self._seen(dict.fromkeys(self.agents, "hello")), {agent: {} for agent in self.agents}

    def _seen(self, heard: dict[str, str]) -> dict[str, Any]:
        bids = tuple(self.bids)
        return {agent: {"heard": text, "round": self.t, "bids": bids} for agent, text in heard.items()}

    def step(self, actions: dict[str, Any]) -> Any:
        self.t += 1
        self.bids += [len(action) for action in actions.values()]
        acting = self.agents
        heard = {agent: self.answer + str(actions.get("buyer"))[::-1] * self.t for agent in acting}
        terminated = {agent: agent == "buyer" and self.t == 3 for agent in acting}
        truncated = dict.fromkeys(acting, self.t == 6)
        self.agents = [] if self.t == 6 else [agent for agent in acting if not terminated[agent]]
        rewards = {agent: float(self.t) for agent in acting}
        return self._seen(heard), rewards, terminated, truncated, {agent: {} for agent in acting}


BIDS = spaces.Sequence(spaces.Discrete(10_000))


def in_turns() -> Any:
    """Return the same as a game in turns."""
    return parallel_to_aec(Negotiation())


class Changed(Negotiation):
    """The same with another answer."""

    answer = "yes: "


def offers(agents: list[str], t: int) -> dict[str, Any]:
    """Return the actions of agents at a step."""
    own = {"buyer": "a" * (t * 7), "seller": {"text": f"{t}!", "price": tuple(range(t))}}
    return {agent: own[agent] for agent in agents}
