"""One environment, stepped through recorded actions, with what it returns in the layout of the recording."""

from __future__ import annotations

import json
import struct
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from runner.environments.gym_types import Space
from runner.errors import CannotRedo, shortened
from runner.recording.gym_spaces import describe_space, parts_of, value_of
from runner.recording.gym_values import Put, filler, filler_by_agent, leaves_by_agent, leaves_of
from runner.recording.reader import Recording
from runner.recording.reset_states import ResetState
from runner.recording.spaces import Value, decode
from runner.recording.spaces import leaves_of as recorded_leaves
from runner.replay.recorded import RecordedReset
from runner.replay.redone import Frame, Values
from runner.util.arrays import Array
from runner.util.extras import missing
from runner.util.processes import raise_if_out_of_memory

_MAX_TEXT: Final = 300
_ENDING: Final = struct.Struct("<d??")
_ENDING_DTYPE: Final = np.dtype([("reward", "<f8"), ("terminated", "?"), ("truncated", "?")])


@dataclass(frozen=True)
class Dtypes:
    """The dtypes of recorded observations; `object` where values vary in size."""

    step: np.dtype[np.generic]
    """That of the observation after a step."""
    reset: np.dtype[np.generic]
    """That of the first observation of an episode."""


class Results:
    """What an environment returned for some steps and resets, as it is recorded: arrays [rows], [resets]."""

    def __init__(self, rows: int, resets: int, dtypes: Dtypes, learners: int, drawn: int = 0) -> None:
        self._drawn = drawn
        self.observations: Array = np.empty(rows, dtypes.step)
        self.rewards: NDArray[np.float64] = np.zeros((rows, learners))
        self.terminated: NDArray[np.bool_] = np.zeros(rows, np.bool_)
        self.truncated: NDArray[np.bool_] = np.zeros(rows, np.bool_)
        masks = rows if learners > 1 else 0
        self.agents_terminated = np.zeros(masks, np.uint32)
        """Bit i: agent i of a game; empty for one agent."""
        self.agents_truncated = np.zeros(masks, np.uint32)
        self.first_observations: Array = np.empty(resets, dtypes.reset)
        self.frames: list[Frame] = []
        """After each row; of a vector, after each step of all environments, of the one that is drawn."""
        self.first_frames: list[Frame] = []
        self.done = 0
        self.resets_done = 0
        """Rows and resets that are filled in; fewer than all if the environment raised `error`."""
        self.error: Exception | None = None

    @property
    def values(self) -> Values:
        """The values of all rows."""
        return Values(self.observations, self.rewards, self.terminated, self.truncated)

    def part(self, first: int, stride: int, rows: NDArray[np.bool_], resets: Sequence[int]) -> Results:
        """Return the results of one environment of a vector.

        Args:
            first: its number.
            stride: the number of environments.
        """
        part = Results.__new__(Results)
        for name in ("observations", "rewards", "terminated", "truncated"):
            setattr(part, name, getattr(self, name)[first::stride][rows])
        part.agents_terminated, part.agents_truncated = self.agents_terminated, self.agents_truncated
        part.first_observations = self.first_observations[list(resets)]
        is_drawn, part.error = first == self._drawn, self.error
        part.frames = [frame for frame, own in zip(self.frames, rows, strict=False) if own and is_drawn]
        part.first_frames = self.first_frames if is_drawn else []
        part.done = int(np.count_nonzero(rows[: self.done // stride]))
        part.resets_done = sum(number < self.resets_done for number in resets)
        return part


class Stepper(ABC):
    """An environment that is stepped through a recording of one like it."""

    env: Any

    def __init__(self, env: object, recording: Recording) -> None:
        self.env = env
        self.draws = False
        """Whether to draw a picture after each step and reset."""
        self.is_trusted = False
        """Whether `reset` may get options that name something."""
        self._recording = recording
        self.observation_space, self.action_space = self._spaces()
        self._learners = len(recording.agents)
        topics, after = recording.train.topics, "next_state" if recording.has_states else "next_observation"
        steps, resets = map(recording.layout.rows, (topics.steps, topics.resets))
        self.dtypes = Dtypes(steps[after], resets["observation"])

    @abstractmethod
    def _spaces(self) -> tuple[Space, Space]:
        """Return the spaces of observation and action."""

    @abstractmethod
    def run(self, rows: NDArray[np.void], resets: Sequence[tuple[int, RecordedReset]]) -> Results:
        """Do recorded steps again, until the environment raises an error.

        Args:
            resets: row and reset, in order; each comes before its row.
        """

    def check_spaces(self) -> None:
        """Check that the environment's spaces hold the recorded values.

        Raises:
            CannotRedo: one has other parts, shapes or numbers of values.
        """
        for name, space in (("observation", self.observation_space), ("action", self.action_space)):
            recorded, found = self._recording.spaces[name], describe_space(space)
            shapes = [
                [(leaf.path, leaf.dtype and leaf.dtype.shape) for leaf in recorded_leaves(each, name)]
                for each in (recorded, found)
            ]
            is_alike = all(recorded.get(key) == found.get(key) for key in ("n", "space"))
            if shapes[0] != shapes[1] or not is_alike:
                texts = [shortened(json.dumps(each), _MAX_TEXT) for each in (recorded, found)]
                raise CannotRedo(
                    f"The environment has another {name} space than recorded: found {texts[1]}, expected "
                    f"{texts[0]}. It is another environment, or another version."
                )

    def _decoded_actions(self, rows: NDArray[np.void]) -> Iterator[Value]:
        """Yield the actions of recorded steps whose size varies."""
        description, where = self._recording.spaces["action"], f"{self._recording.path}: an action"
        return (decode(description, data, where) for data in rows["action"])

    def _restore(self, state: ResetState, base: Any) -> int | None:
        """Bring random generators to a recorded state; return the seed that `reset` needs instead, if any."""
        if state.bit_generator is None and not state.ale_state:
            return state.np_random_seed
        if state.bit_generator is not None:
            base.np_random.bit_generator.state = state.bit_generator
        if state.ale_state:
            import ale_py

            base.ale.restoreState(ale_py.ALEState(state.ale_state))
        return None

    def _render(self) -> object:
        return self.env.render()

    def draw(self) -> Frame:
        """Return a picture of the environment, [height, width, 3].

        Raises:
            CannotRedo: it draws none.
        """
        try:
            picture = np.asarray(self._render())
        except (MemoryError, CannotRedo):
            raise
        except Exception as error:  # foreign code raises anything
            if getattr(error.__cause__ or error, "name", "") == "pygame":  # of its ImportError
                needed = missing("pygame", "film", "Drawing this environment")
                raise CannotRedo(str(needed)) from error
            raise CannotRedo(
                f"The environment cannot draw itself here: {type(error).__name__}: {error}. "
                "Where there is no display, drawing may need a library such as EGL or OSMesa."
            ) from error
        if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
            raise CannotRedo(
                f"The environment draws {picture.dtype} of shape {list(picture.shape)}, expected uint8 of "
                "[height, width, 3]."
            )
        return picture.copy()


class RowStepper(Stepper):
    """An environment that takes one step after the other."""

    @abstractmethod
    def _filler(self, column: Array, is_first: bool = False) -> Put:
        """Return a function that puts an observation into a row of a column; `is_first`: that of a reset."""

    @abstractmethod
    def actions(self, rows: NDArray[np.void]) -> Sequence[Value]:
        """Return the actions of recorded steps as the environment takes them."""

    @abstractmethod
    def take(self, actions: Sequence[Value], first: int, stop: int, results: Results, put: Put) -> None:
        """Take the steps of these rows, and fill them in; `results.done` counts them also if one fails."""

    def run(self, rows: NDArray[np.void], resets: Sequence[tuple[int, RecordedReset]]) -> Results:
        """Do recorded steps again, until the environment raises an error."""
        n = len(rows)
        results = Results(n, len(resets), self.dtypes, self._learners)
        put, actions, first = self._filler(results.observations), self.actions(rows), 0
        put_first = self._filler(results.first_observations, is_first=True)
        try:
            for number, (row, reset) in enumerate(resets):
                self.take(actions, first, row, results, put)
                first = row
                put_first(number, self._reset(reset))
                if self.draws:
                    results.first_frames.append(self.draw())
                results.resets_done += 1
            self.take(actions, first, n, results, put)
        except (MemoryError, CannotRedo):
            raise
        except Exception as error:  # foreign code raises anything
            raise_if_out_of_memory()
            results.error = error
        return results

    def _reset(self, reset: RecordedReset) -> Value:
        """Reset the environment as it was; return its observation."""
        seed = reset.seed
        if seed is None and reset.state is not None:
            seed = self._restore(reset.state, self.env.unwrapped)
        arguments = {"seed": seed, "options": reset.options}
        return self.env.reset(**{name: value for name, value in arguments.items() if value is not None})[0]


class EnvironmentStepper(RowStepper):
    """A Gymnasium environment."""

    ends_once = False
    """Whether an episode that terminated is not truncated too."""
    _endings: NDArray[np.void]
    """Rewards and ends of the rows, put down quickly, and copied to their columns at the end."""

    def run(self, rows: NDArray[np.void], resets: Sequence[tuple[int, RecordedReset]]) -> Results:
        """Do recorded steps again, until the environment raises an error."""
        self._endings = np.zeros(len(rows), _ENDING_DTYPE)
        results = super().run(rows, resets)
        results.rewards[:, 0] = self._endings["reward"]
        results.terminated[:] = self._endings["terminated"]
        results.truncated[:] = self._endings["truncated"]
        if self.ends_once:
            results.truncated &= ~results.terminated
        return results

    def _spaces(self) -> tuple[Space, Space]:
        return self.env.observation_space, self.env.action_space

    def _filler(self, column: Array, is_first: bool = False) -> Put:
        if self._recording.has_states:
            # States are counted from 0, the first observations are as they came.
            start = 0 if is_first else int(self.observation_space.start)  # type: ignore[attr-defined]

            def put_state(row: int, observation: object) -> None:
                if observation.__class__ is not int:
                    observation = int(np.asarray(observation).reshape(()))
                column[row] = observation - start

            return put_state
        return filler(leaves_of(self.observation_space, "observation"), column)

    def actions(self, rows: NDArray[np.void]) -> Sequence[Value]:
        """Return the actions of recorded steps as the environment takes them."""
        if self._recording.has_states:
            start = int(self.action_space.start)  # type: ignore[attr-defined]
            return (rows["action"].astype(np.int64) + start).tolist()  # type: ignore[no-any-return]
        if self._recording.train.steps.dtype is not None:
            return values_in(self.action_space, np.array(rows["action"]))
        return [keyed(self.action_space, action) for action in self._decoded_actions(rows)]

    def take(self, actions: Sequence[Value], first: int, stop: int, results: Results, put: Put) -> None:
        """Take the steps of these rows, and fill them in."""
        step, pack, frames = self.env.step, _ENDING.pack_into, results.frames
        data, size, draws = self._endings.view(np.uint8).data, _ENDING.size, self.draws
        row = first
        try:
            for row in range(first, stop):
                observation, reward, terminated, truncated, _ = step(actions[row])
                put(row, observation)
                try:
                    pack(data, row * size, reward, terminated, truncated)
                except (struct.error, TypeError):  # an array of one
                    number = float(np.asarray(reward).reshape(()))
                    pack(data, row * size, number, bool(terminated), bool(truncated))
                if draws:
                    frames.append(self.draw())
            row = stop
        finally:
            results.done = row


class GameStepper(RowStepper):
    """A PettingZoo parallel environment."""

    def _spaces(self) -> tuple[Space, Space]:
        agents = self.env.possible_agents
        if tuple(map(str, agents)) != self._recording.agents:
            raise CannotRedo(
                f"The environment has the agents {', '.join(map(str, agents))}, and the recording "
                f"{', '.join(self._recording.agents)}."
            )
        return game_spaces(self.env)

    def _filler(self, column: Array, is_first: bool = False) -> Put:  # noqa: ARG002
        return filler_by_agent(leaves_by_agent(self.observation_space, "observation"), column)

    def actions(self, rows: NDArray[np.void]) -> Sequence[Value]:
        """Return the actions of recorded steps as the environment takes them."""
        agents = self.env.possible_agents
        own: Any = self.action_space
        if self._recording.train.steps.dtype is None:
            return [
                {
                    agent: keyed(own[agent], action[str(agent)])
                    for i, agent in enumerate(agents)
                    if acted >> i & 1
                }
                for action, acted in zip(self._decoded_actions(rows), rows["acted"].tolist(), strict=True)
            ]
        columns = {agent: values_in(own[agent], np.array(rows["action"][str(agent)])) for agent in agents}
        return [
            {agent: columns[agent][row] for i, agent in enumerate(agents) if acted >> i & 1}
            for row, acted in enumerate(rows["acted"].tolist())
        ]

    def take(self, actions: Sequence[Value], first: int, stop: int, results: Results, put: Put) -> None:
        """Take the steps of these rows, and fill them in."""
        agents = self.env.possible_agents

        def mask(flags: Mapping[object, bool]) -> int:
            return sum(bool(flags.get(agent)) << i for i, agent in enumerate(agents))

        row = first
        try:
            for row in range(first, stop):
                observations, rewards, terminated, truncated, _ = self.env.step(actions[row])
                put(row, observations)
                over = not self.env.agents
                results.rewards[row] = [float(rewards.get(agent, 0.0)) for agent in agents]
                results.terminated[row] = over and any(terminated.values())
                results.truncated[row] = over and any(truncated.values())
                if len(results.agents_terminated):
                    results.agents_terminated[row] = mask(terminated)
                    results.agents_truncated[row] = mask(truncated)
                if self.draws:
                    results.frames.append(self.draw())
            row = stop
        finally:
            results.done = row


def game_spaces(env: Any) -> tuple[spaces.Dict, spaces.Dict]:
    """Return the spaces of the observations and actions of all agents of a game."""
    agents = env.possible_agents
    observations = spaces.Dict({agent: env.observation_space(agent) for agent in agents})
    return observations, spaces.Dict({agent: env.action_space(agent) for agent in agents})


def values_in(space: Space, column: NDArray[Any]) -> Sequence[Value]:
    """Return the values of a column, one by one, as an environment with this action space takes them."""
    if isinstance(space, spaces.Dict):
        parts = {key: values_in(part, np.array(column[str(key)])) for key, part in space.spaces.items()}
        return [{key: part[row] for key, part in parts.items()} for row in range(len(column))]
    if isinstance(space, spaces.Tuple):
        columns = [values_in(part, np.array(column[str(i)])) for i, part in enumerate(space.spaces)]
        return list(zip(*columns, strict=True))
    return list(column)  # whole numbers as NumPy's, for which `Discrete.contains` takes a third of the time


def batched(space: Space, values: Sequence[Value]) -> Value:
    """Return the values of many environments as a vector with this single action space takes them."""
    if isinstance(space, spaces.Dict):
        return {key: batched(part, [own[key] for own in values]) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(batched(part, [own[i] for own in values]) for i, part in enumerate(space.spaces))
    (part,) = parts_of(space, "the action space")
    return tuple(values) if part.dtype is None else np.array(values)


def keyed(space: Space, value: Value) -> Value:
    """Return a decoded value with the keys and types that its space has.

    Raises:
        CannotRedo: values of the space are recorded as text that does not give them back.
    """
    if isinstance(space, spaces.Dict):
        return {key: keyed(part, value[str(key)]) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(keyed(part, own) for part, own in zip(space.spaces, value, strict=True))
    if isinstance(value, str) and not isinstance(space, spaces.Text):
        try:
            return value_of(space, value)
        except ValueError as error:
            raise CannotRedo(
                f"Its actions are of the space {type(space).__name__}, and recorded as a text that is no "
                f"value of it ({error}). Those of a space of your own come back if it is registered by "
                "runner.register_space."
            ) from error
    return value.item() if isinstance(value, np.integer) else value
