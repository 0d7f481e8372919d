"""What vector environments and games of several agents have in common: records of episodes and resets.

Where a vector environment steps N environments at once, N records follow one another: number n of a
phase is of environment n modulo N. `AgentRows` records the steps of games, `vector.VectorRows` those of
vector environments.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.loops.spaces import Described, parts_of
from runner.loops.values import Leaf, leaves, put_batch, require_reset
from runner.recording import schema
from runner.recording.recorder import Recorder
from runner.recording.schema import Topic

Flags = NDArray[np.bool_]


class StagedRows:
    """The state of one phase's episodes in each environment, and their records.

    Not thread-safe: the caller holds the loop's lock.
    """

    off_table = 0

    def __init__(
        self, recorder: Recorder, described: Described, phase: str, first_action: Callable[[Any], None]
    ) -> None:
        self._first_action = first_action
        self._is_settled = False
        topics = {topic.name: topic for topic in schema.KINDS[described.kind]}
        self._recorder = recorder
        self._phase = phase
        self._steps = topics[f"/{phase}/step"]
        self._episodes = topics[f"/{phase}/episode"]
        self._resets = topics[f"/{phase}/reset"]
        n = described.environments
        self._n = n
        self._episode = np.zeros(n, np.int64)
        """The number of the episode under way, or to come, in each environment."""
        self._length = np.zeros(n, np.int64)
        self._return = np.zeros((n, len(described.agents)))
        self._ended = 0
        self._were_reset = 0
        self._set_leaves(described)

    def open(self) -> None:
        """Do nothing: blocks are taken from the recorder when records are complete."""

    def reshape(self, described: Described) -> None:
        """Prepare for actions of another dtype; no step was recorded yet."""
        self._set_leaves(described)

    def _set_leaves(self, described: Described) -> None:
        raise NotImplementedError

    def _settle(self, action: Any) -> None:
        """Learn the dtype of actions from the first one."""
        if not self._is_settled:
            self._is_settled = True
            self._first_action(action)

    def _put_ends(
        self,
        last: NDArray[Any],
        length: NDArray[Any],
        returns: NDArray[Any],
        terminated: NDArray[Any],
        truncated: NDArray[Any],
    ) -> None:
        """Record the ends of episodes, in the order in which they ended; `last` are their last steps."""
        block = self._recorder.blank(self._episodes, len(last))
        block["episode"] = self._ended + np.arange(len(last))
        block["last_step"] = last
        block["length"] = length
        block["returns"] = returns
        block["terminated"], block["truncated"] = terminated, truncated
        other = sum(self._recorder.steps.values()) - self._recorder.steps[self._phase]
        self._put(self._episodes, block, last + 1 + other)
        self._ended += len(last)

    def _end(self, which: NDArray[np.intp], terminated: Flags, truncated: Flags) -> None:
        """Record the ends of the episodes under way in these environments; their last steps just came."""
        last = self._recorder.steps[self._phase] - self._n + which
        self._put_ends(last, self._length[which], self._return[which], terminated[which], truncated[which])
        self._episode[which] += 1
        self._length[which] = 0
        self._return[which] = 0.0

    def _abandon(self, which: NDArray[np.intp]) -> None:
        """End the episodes of these environments that are under way, neither terminated nor truncated."""
        under_way = which[self._length[which] > 0]
        if len(under_way):
            nothing = np.zeros(self._n, np.bool_)
            self._end(under_way, nothing, nothing)

    def _begin(self, which: NDArray[np.intp], observation: NDArray[Any], seeds: Sequence[int | None]) -> None:
        """Record resets of these environments, with a row of observations and a seed for each."""
        steps = np.full(len(which), self._recorder.steps[self._phase])
        self._put_resets(which, observation, seeds, self._episode[which], steps)

    def _put_resets(
        self,
        which: NDArray[np.intp],
        observation: NDArray[Any],
        seeds: Sequence[int | None],
        episode: NDArray[Any],
        steps: NDArray[Any],
    ) -> None:
        """Record resets in the order in which they were; `steps` are the steps of the phase before each."""
        block = self._recorder.blank(self._resets, len(which))
        kept = [seed if seed is not None and 0 <= seed < 2**64 else None for seed in seeds]
        block["observation"] = observation
        block["reset"] = self._were_reset + np.arange(len(which))
        block["episode"] = episode
        block["step"] = steps
        block["environment"] = which
        block["seed"] = [seed or 0 for seed in kept]
        block["seeded"] = [seed is not None for seed in kept]
        other = sum(self._recorder.steps.values()) - self._recorder.steps[self._phase]
        self._put(self._resets, block, steps + other)
        self._were_reset += len(which)

    def _put(self, topic: Topic, records: NDArray[Any], positions: NDArray[Any]) -> None:
        """Copy whole records into the recorder's blocks."""
        done, size = 0, records.itemsize
        raw = records.view(np.uint8)
        while done < len(records):
            block = self._recorder.block(topic)
            n = min(len(block), len(records) - done)
            block[:n].view(np.uint8)[:] = raw[done * size : (done + n) * size]
            self._recorder.take(topic, positions[done : done + n].astype(np.uint64))
            done += n


class AgentRows(StagedRows):
    """Records the steps of all agents of a PettingZoo parallel environment, each as it comes."""

    filled = 0

    def __init__(
        self, recorder: Recorder, described: Described, phase: str, first_action: Callable[[Any], None]
    ) -> None:
        super().__init__(recorder, described, phase, first_action)
        self._agents = described.agents
        self._stage = recorder.blank(self._steps, 1)

    @property
    def place(self) -> tuple[int, int]:
        """The steps of the phase so far, and how many episodes have ended."""
        return self._recorder.steps[self._phase], self._ended

    def commit(self) -> None:
        """Do nothing: every step was handed to the recorder as it came."""

    def reshape(self, described: Described) -> None:
        """Prepare for actions of another dtype; no step was recorded yet."""
        super().reshape(described)
        self._stage = self._recorder.blank(self._steps, 1)

    def _set_leaves(self, described: Described) -> None:
        self._observation_leaves = _by_agent(described.observation, "observation")
        self._action_leaves = _by_agent(described.recorded_action, "action")

    def take(
        self,
        actions: Mapping[str, Any],
        observations: Mapping[str, Any],
        rewards: Mapping[str, float],
        terminated: Mapping[str, bool],
        truncated: Mapping[str, bool],
        over: bool,
    ) -> None:
        """Put down a step; agents that are missing take no part in it."""
        require_reset(self._were_reset, self._phase)
        self._settle(actions)
        stage = self._stage
        for name in ("action", "next_observation"):
            stage[name] = np.zeros((), stage.dtype[name])
        self._put_agents(self._action_leaves, actions, stage["action"])
        self._put_agents(self._observation_leaves, observations, stage["next_observation"])
        stage["acted"] = self._mask(dict.fromkeys(actions, True))
        stage["agents_terminated"] = self._mask(terminated)
        stage["agents_truncated"] = self._mask(truncated)
        paid = np.array([[float(rewards.get(agent, 0.0)) for agent in self._agents]])
        stage["rewards"] = paid
        stage["step"] = self._recorder.steps[self._phase]
        stage["episode"], stage["t"] = self._episode, self._length
        ends = [np.array([over and any(flags.values())]) for flags in (terminated, truncated)]
        stage["terminated"], stage["truncated"] = ends
        self._put(self._steps, stage, np.array([sum(self._recorder.steps.values()) + 1]))
        self._recorder.steps[self._phase] += 1
        self._length += 1
        self._return += paid
        if over:
            self._end(np.zeros(1, np.intp), *ends)

    def reset(self, observations: Mapping[str, Any], seed: int | None) -> None:
        """Put down a reset; an episode under way ends by it."""
        only = np.zeros(1, np.intp)
        self._abandon(only)
        row = self._recorder.blank(self._resets, 1)["observation"]
        self._put_agents(self._observation_leaves, observations, row)
        self._begin(only, row, [seed])

    def _put_agents(
        self, own: Mapping[str, Sequence[Leaf]], values: Mapping[str, Any], into: NDArray[Any]
    ) -> None:
        for agent, value in values.items():
            if agent not in own:
                raise RecordingError(
                    f"found the agent {agent!r}, expected one of possible_agents: {', '.join(self._agents)}"
                )
            put_batch(own[agent], {agent: value}, into)

    def _mask(self, flags: Mapping[str, bool]) -> int:
        return sum(bool(flags.get(agent)) << i for i, agent in enumerate(self._agents))


def _by_agent(space: spaces.Space[Any], what: str) -> dict[str, list[Leaf]]:
    assert isinstance(space, spaces.Dict)
    own = leaves(parts_of(space, "the agents' spaces"), what)
    return {agent: [leaf for leaf in own if leaf.keys[0] == agent] for agent in space.spaces}
