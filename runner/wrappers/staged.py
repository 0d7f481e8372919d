"""Steps of several environments at once, or of several agents: put down whole, as they come.

Where a vector environment steps N environments at once, N records follow one another: number n of a
phase is of environment n modulo N.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.recorder import Recorder
from runner.recording.schema import Topic
from runner.wrappers.described import Described, parts_of
from runner.wrappers.values import Leaf, leaves, put_batch, put_chosen

Flags = NDArray[np.bool_]


class StagedRows:
    """How the episodes of one phase stand, in each environment; nothing waits to be committed.

    Not thread-safe: whoever calls holds the loop's lock.
    """

    filled = 0
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
        self._stage = recorder.blank(self._steps, n)
        self._episode = np.zeros(n, np.int64)
        """The number of the episode under way, or to come, in each environment."""
        self._length = np.zeros(n, np.int64)
        self._return = np.zeros((n, len(described.agents)))
        self._ended = 0
        self._were_reset = 0
        self._set_leaves(described)

    @property
    def place(self) -> tuple[int, int]:
        """The steps of the phase so far, and how many episodes have ended."""
        return self._recorder.steps[self._phase], self._ended

    def open(self) -> None:
        """Do nothing: no rows wait."""

    def commit(self) -> None:
        """Do nothing: no rows wait."""

    def reshape(self, described: Described) -> None:
        """Make room for actions of another dtype; no step was put down yet."""
        self._stage = self._recorder.blank(self._steps, self._n)
        self._set_leaves(described)

    def _set_leaves(self, described: Described) -> None:
        raise NotImplementedError

    def _settle(self, action: Any) -> None:
        """Learn the dtype of actions from the first one."""
        if not self._is_settled:
            self._is_settled = True
            self._first_action(action)

    def _put_steps(
        self, rewards: NDArray[Any], only_reset: Flags, terminated: Flags, truncated: Flags
    ) -> None:
        """Complete the staged records and hand them on; `only_reset` are those that took no step."""
        stage, before = self._stage, sum(self._recorder.steps.values())
        first = self._recorder.steps[self._phase]
        stage["rewards"] = rewards
        stage["step"] = first + np.arange(self._n)
        stage["episode"] = self._episode
        stage["t"] = np.where(only_reset, schema.NEVER, self._length)
        stage["terminated"], stage["truncated"] = terminated, truncated
        self._put(self._steps, stage, np.arange(before + 1, before + self._n + 1))
        self._recorder.steps[self._phase] += self._n
        self._length += ~only_reset
        self._return = np.where(only_reset[:, np.newaxis], 0.0, self._return + rewards)
        over = terminated | truncated
        if over.any():
            self._end(np.flatnonzero(over), terminated, truncated)

    def _end(self, which: NDArray[np.intp], terminated: Flags, truncated: Flags) -> None:
        """Record the ends of the episodes under way in these environments; their last steps just came."""
        block = self._recorder.blank(self._episodes, len(which))
        last = self._recorder.steps[self._phase] - self._n + which
        block["episode"] = self._ended + np.arange(len(which))
        block["last_step"] = last
        block["length"] = self._length[which]
        block["returns"] = self._return[which]
        block["terminated"], block["truncated"] = terminated[which], truncated[which]
        other = sum(self._recorder.steps.values()) - self._recorder.steps[self._phase]
        self._put(self._episodes, block, last + 1 + other)
        self._ended += len(which)
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
        block = self._recorder.blank(self._resets, len(which))
        own = [seeds[i] if len(seeds) else None for i in which.tolist()]
        block["observation"] = observation
        block["reset"] = self._were_reset + np.arange(len(which))
        block["episode"] = self._episode[which]
        block["step"] = self._recorder.steps[self._phase]
        block["environment"] = which
        block["seed"] = [seed or 0 for seed in own]
        block["seeded"] = [seed is not None for seed in own]
        now = sum(self._recorder.steps.values())
        self._put(self._resets, block, np.full(len(which), now))
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


class VectorRows(StagedRows):
    """The steps of the environments of a vector environment."""

    def __init__(
        self, recorder: Recorder, described: Described, phase: str, first_action: Callable[[Any], None]
    ) -> None:
        super().__init__(recorder, described, phase, first_action)
        self._discrete = described.kind == "step"
        self._observation, self._action = described.observation, described.action
        dtype = recorder.blank(self._resets, 1).dtype["observation"]
        self._seen = np.zeros(self._n, np.dtype([("value", dtype)]))["value"]
        """What was last observed in each environment."""

    def _set_leaves(self, described: Described) -> None:
        self._observation_leaves = leaves(
            parts_of(described.observation, "the observation space"), "observation"
        )
        self._action_leaves = leaves(parts_of(described.recorded_action, "the action space"), "action")

    def take(
        self,
        action: Any,
        observation: Any,
        rewards: Any,
        terminated: Flags,
        truncated: Flags,
        only_reset: Flags,
        final: Any,
    ) -> None:
        """Put down a step of all environments.

        Args:
            action: batched, as the vector environment takes it.
            observation: batched, as it gives it.
            rewards: [N].
            terminated: [N].
            truncated: [N].
            only_reset: [N], environments that ignored their action and were reset instead.
            final: what was observed last of episodes that ended, where `observation` is already of the
                next; None where it is not.
        """
        self._settle(action)
        stage, over = self._stage, terminated | truncated
        now = np.zeros_like(self._seen)
        put_batch(self._observation_leaves, observation, now, (self._n,))
        last = now
        if final is not None and over.any():
            last = now.copy()
            put_chosen(self._observation_leaves, final, last, np.flatnonzero(over))
        if self._discrete:
            actions = np.asarray(action).astype(np.int64)
            stage["state"] = self._seen - _start(self._observation)
            stage["action"] = actions - _start(self._action)
            stage["next_state"] = last - _start(self._observation)
        else:
            put_batch(self._action_leaves, action, stage["action"], (self._n,))
            stage["next_observation"] = last
            stage["acted"] = 1
            stage["agents_terminated"], stage["agents_truncated"] = terminated, truncated
        if only_reset.any():
            self._begin(np.flatnonzero(only_reset), now[only_reset], ())
        paid = np.asarray(rewards, np.float64).reshape(self._n, 1)
        self._put_steps(paid, only_reset, terminated, truncated)
        if final is not None and over.any():
            self._begin(np.flatnonzero(over), now[over], ())
        self._seen[...] = now

    def reset(self, observation: Any, seeds: Sequence[int | None], which: Flags) -> None:
        """Put down a reset of some environments; episodes under way in them end by it."""
        chosen = np.flatnonzero(which)
        self._abandon(chosen)
        now = np.zeros_like(self._seen)
        put_batch(self._observation_leaves, observation, now, (self._n,))
        self._seen[which] = now[which]
        self._begin(chosen, now[which], seeds)


class AgentRows(StagedRows):
    """The steps of all agents of a PettingZoo parallel environment."""

    def __init__(
        self, recorder: Recorder, described: Described, phase: str, first_action: Callable[[Any], None]
    ) -> None:
        super().__init__(recorder, described, phase, first_action)
        self._agents = described.agents

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
        nothing = np.zeros(1, np.bool_)
        ends = [np.array([over and any(flags.values())]) for flags in (terminated, truncated)]
        self._put_steps(paid, nothing, ends[0], ends[1])
        if over and not (ends[0] | ends[1]).any():
            self._abandon(np.zeros(1, np.intp))

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


def _start(space: Any) -> int:
    return int(space.start)
