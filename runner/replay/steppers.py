"""Environments that take recorded actions and resets: one, a game of several agents, or a whole vector."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Any, Final, NamedTuple

import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import concatenate, create_empty_array
from numpy.typing import NDArray

from runner.environments.gym_types import Space
from runner.environments.interfaces import final_observations, game_spaces, spaces_of_one
from runner.errors import CannotRedo, shortened
from runner.recording.gym_spaces import recorded_space, value_of
from runner.recording.gym_values import LeafValues, SpaceValues, StateValues, element_of, filler
from runner.recording.reader import Recording
from runner.recording.spaces import Value, decode
from runner.recording.spaces import leaves_of as recorded_leaves
from runner.recording.steps import is_taken
from runner.replay.recorded import RecordedReset, calls
from runner.util.arrays import Array, Records
from runner.util.extras import missing
from runner.util.processes import raise_if_out_of_memory

_MAX_DESCRIPTION: Final = 300
_ENDS: Final = ("rewards", "terminated", "truncated")
Fill = Callable[[int, Any], None]
"""Puts down what the environment returned for a step."""
Frame = NDArray[np.uint8]
"""A picture, [height, width, 3]."""
PlacedReset = tuple[int, RecordedReset]
"""A reset, and the row that comes after it."""


class Start(NamedTuple):
    """A rerun reset."""

    row: int
    """The row that comes after it."""
    reset: RecordedReset
    got: Value
    """The first observation, as `RecordedReset.observation`."""
    frame: Frame | None = None
    """The picture after the reset, if pictures are drawn."""


@dataclass(eq=False)
class Returned:
    """What an environment returned for recorded actions and resets, until it raised an error."""

    rows: Records
    """The recorded steps."""
    resets: Sequence[PlacedReset]
    """In order; each comes before its row."""
    got: Records
    """Records with the fields of steps that come from the environment."""
    starts: list[Start] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)
    """A picture for each step; of a vector, of the environment that is drawn."""
    done: int = 0
    """The rows that are filled in."""
    error: Exception | None = None


class Stepper:
    """A Gymnasium environment that takes recorded actions.

    Raises:
        CannotRedo: it has other spaces than the recorded one.
    """

    n = 1
    """How many environments step at once."""
    is_game = False
    """Whether several agents act in it."""

    def __init__(self, env: Any, recording: Recording) -> None:
        self.env = env
        self.draws = False
        """Whether to draw a picture after each step and reset."""
        self.is_trusted = False
        """Whether `reset` may get options that name something."""
        self.ends_once = False
        """Whether an episode that terminated is not truncated too."""
        self._recording = recording
        self._has_states = recording.has_states
        self.observation_space, self.action_space = self._spaces()
        self._check_spaces()
        leaf = StateValues if self._has_states else LeafValues
        space = self.observation_space
        self._observation = SpaceValues(space, "observation", leaf=leaf, is_game=self.is_game)
        self._after = "next_state" if self._has_states else "next_observation"
        topics = recording.train.topics
        agents = recording.agents
        steps = recording.layout.row_dtype(topics.steps)
        resets = recording.layout.row_dtype(topics.resets)
        ends = [("rewards", "<f8", (len(agents),)), ("terminated", "?"), ("truncated", "?")]
        masks = [(f"agents_{name}", "<u4") for name in _ENDS[1:] if len(agents) > 1]
        self._dtype = np.dtype([(self._after, steps[self._after]), *ends, *masks])
        self._first_dtype = resets["observation"]

    def run(self, rows: Records, resets: Sequence[PlacedReset]) -> Returned:
        """Take recorded actions, until the environment raises an error.

        Args:
            rows: the recorded steps, [steps of each environment * n].
            resets: step of each environment, and reset, in order; each comes before its step.
        """
        got = np.zeros(len(rows), self._dtype)
        seen = np.zeros(len(rows), self._first_dtype) if self._has_states else got[self._after]
        self._actions, self._fill = self.actions(rows), self._filler(seen, got)
        self._firsts = np.zeros(len(resets), self._first_dtype)
        self._put_first = filler(self._observation, self._firsts)
        returned = Returned(rows, resets, got)
        try:
            for step, group in groupby(resets, key=lambda placed: placed[0]):
                self._take(step, returned)
                self._reset(step, [reset for _, reset in group], returned)
            self._take(len(self._actions), returned)
        except (MemoryError, CannotRedo):
            raise
        except Exception as error:  # foreign code raises anything
            raise_if_out_of_memory()
            returned.error = error
        if self._has_states:  # states are counted from 0, observations are as they came
            got[self._after] = seen - self.observation_space.start  # type: ignore[attr-defined]
        if self.ends_once:
            got["truncated"] &= ~got["terminated"]
        return returned

    def _take(self, stop: int, returned: Returned) -> None:
        """Take the steps up to `stop`; `returned.done` is right also if one fails."""
        step = self.env.step
        actions = self._actions
        fill = self._fill
        draws = self.draws
        first = k = returned.done // self.n
        try:
            for k in range(first, stop):
                fill(k, step(actions[k]))
                if draws:
                    returned.frames.append(self.draw())
            k = stop
        finally:
            returned.done = k * self.n

    def _reset(self, step: int, resets: Sequence[RecordedReset], returned: Returned) -> None:
        """Do the resets before a step."""
        for reset in resets:
            arguments = {"seed": self._seed(reset), "options": reset.given.options}
            given = {name: value for name, value in arguments.items() if value is not None}
            k = len(returned.starts)
            self._put_first(k, self.env.reset(**given)[0])
            frame = self.draw() if self.draws else None
            returned.starts.append(Start(step, reset, self._firsts[k], frame))

    def _seed(self, reset: RecordedReset) -> int | None:
        """Return the seed of a reset; if it has none, bring random generators to the recorded state."""
        state = reset.state
        if reset.seed is not None or state is None:
            return reset.seed
        if state.bit_generator is None and not state.ale_state:
            return state.np_random_seed
        base = self._base(reset.environment)
        if state.bit_generator is not None:
            base.np_random.bit_generator.state = state.bit_generator
        if state.ale_state:
            import ale_py

            base.ale.restoreState(ale_py.ALEState(state.ale_state))
        return None

    def _base(self, environment: int) -> Any:  # noqa: ARG002
        """Return an environment without wrappers."""
        return self.env.unwrapped

    def _spaces(self) -> tuple[Space, Space]:
        """Return the spaces of observation and action."""
        return self.env.observation_space, self.env.action_space

    def _filler(self, seen: Array, got: Records) -> Fill:
        """Return a function that puts down steps.

        Args:
            seen: [rows], for observations.
            got: [rows], for rewards and ends, and what games return besides.
        """
        put = filler(self._observation, seen)
        rewards, terminated, truncated = (got[name] for name in _ENDS)

        def fill(row: int, result: Any) -> None:
            observation, reward, is_terminated, is_truncated, _ = result
            put(row, observation)
            rewards[row] = reward
            terminated[row], truncated[row] = bool(is_terminated), bool(is_truncated)

        return fill

    def actions(self, rows: Records) -> Sequence[Value]:
        """Return the actions of recorded steps as the environment takes them."""
        column = rows["action"]
        if column.dtype.hasobject:
            return [keyed(self.action_space, action) for action in self._decoded(column)]
        if self._has_states:
            column = column.astype(np.int64) + int(self.action_space.start)  # type: ignore[attr-defined]
            return column.tolist()  # type: ignore[no-any-return]
        return values_in(self.action_space, np.array(column))

    def applicable(self, action: Any) -> Value | None:
        """Return an action as the environment takes it now; None if it takes none of that kind now."""
        return action

    def _decoded(self, actions: Array) -> Iterator[Value]:
        """Yield actions of varying size."""
        description = self._recording.spaces["action"]
        where = f"{self._recording.path}: an action"
        return (decode(description, data, where) for data in actions)

    def _check_spaces(self) -> None:
        """Check that the environment's spaces hold the recorded values.

        Raises:
            CannotRedo: one has other parts, shapes or numbers of values.
        """
        for name, space in (("observation", self.observation_space), ("action", self.action_space)):
            described = self._recording.spaces[name], recorded_space(space).describe()
            shapes = [
                [(leaf.path, leaf.dtype and leaf.dtype.shape) for leaf in recorded_leaves(description, name)]
                + [description.get("n"), description.get("space")]
                for description in described
            ]
            if shapes[0] != shapes[1]:
                texts = [shortened(json.dumps(description), _MAX_DESCRIPTION) for description in described]
                raise CannotRedo(
                    f"The environment has another {name} space than recorded: found {texts[1]}, expected "
                    f"{texts[0]}. It is another environment, or another version."
                )

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


class GameStepper(Stepper):
    """A PettingZoo parallel environment."""

    is_game = True

    def _spaces(self) -> tuple[Space, Space]:
        agents = self.env.possible_agents
        if tuple(map(str, agents)) != self._recording.agents:
            raise CannotRedo(
                f"The environment has the agents {', '.join(map(str, agents))}, and the recording "
                f"{', '.join(self._recording.agents)}."
            )
        return game_spaces(self.env)

    def _filler(self, seen: Array, got: Records) -> Fill:
        put = filler(self._observation, seen)
        agents = self.env.possible_agents
        ends = [got[name] for name in _ENDS]
        masks = [got[name] for name in got.dtype.names or () if name.startswith("agents_")]

        def fill(row: int, result: Any) -> None:
            observations, rewards, *flags, _ = result
            put(row, observations)
            over = not self.env.agents
            paid = [float(rewards.get(agent, 0.0)) for agent in agents]
            values = (paid, *(over and any(flag.values()) for flag in flags))
            for column, value in zip(ends, values, strict=True):
                column[row] = value
            for mask, flag in zip(masks, flags, strict=False):  # none if there is one agent
                mask[row] = sum(bool(flag.get(agent)) << i for i, agent in enumerate(agents))

        return fill

    def applicable(self, action: Any) -> Value | None:
        """Return the actions of the agents that are left; None if one of them has none."""
        agents = self.env.agents
        return {agent: action[agent] for agent in agents} if all(map(action.__contains__, agents)) else None

    def actions(self, rows: Records) -> Sequence[Value]:
        """Return the actions of recorded steps as the environment takes them."""
        agents = self.env.possible_agents
        column = rows["action"]
        by_agent: Any = self.action_space
        acting = [
            [agent for i, agent in enumerate(agents) if acted >> i & 1] for acted in rows["acted"].tolist()
        ]
        if column.dtype.hasobject:
            return [
                {agent: keyed(by_agent[agent], action[str(agent)]) for agent in some}
                for action, some in zip(self._decoded(column), acting, strict=True)
            ]
        values = values_in(by_agent, np.array(column))
        return [{agent: action[agent] for agent in some} for action, some in zip(values, acting, strict=True)]


class VectorStepper(Stepper):
    """All environments of a vector; rows are their steps in the order of the recording.

    Args:
        autoreset: `NextStep`, `SameStep` or `Disabled`; with `SameStep`, the picture after the last step of
            an episode shows the beginning of the next one.
        drawn: the environment that is drawn.
    """

    def __init__(self, env: Any, recording: Recording, autoreset: str, drawn: int = 0) -> None:
        self.n = recording.environments
        super().__init__(env, recording)
        self._autoreset = autoreset
        self._drawn = drawn
        self._observation = SpaceValues(self.observation_space, "observation")
        self._over = np.zeros(self.n, np.bool_)
        """[n]: whether the episode of an environment ended with the last step."""
        self._last: Array = np.zeros(self.n, self._first_dtype)
        """[n]: what the vector returned last."""

    def _spaces(self) -> tuple[Space, Space]:
        if self.env.num_envs != self.n:
            raise CannotRedo(f"The vector has {self.env.num_envs} environments, and the recording {self.n}.")
        return spaces_of_one(self.env)

    def _reset(self, step: int, resets: Sequence[RecordedReset], returned: Returned) -> None:
        are_steps = is_taken(returned.rows[step * self.n :][: self.n])
        explicit = []
        automatic = list[RecordedReset]()

        def add(reset: RecordedReset) -> None:
            frame = self.draw() if self.draws and reset.environment == self._drawn else None
            returned.starts.append(Start(step, reset, self._last[reset.environment], frame))

        for reset in resets:
            environment = reset.environment
            if len(are_steps) and not are_steps[environment]:
                if any(other.environment == environment for other in automatic):
                    raise CannotRedo(
                        f"Environment {environment} was reset before step {step:,} and again in place of it, "
                        "as AsyncVectorEnv does without shared memory; no other vector does."
                    )
                automatic.append(reset)  # the step does it
            elif self._autoreset == "SameStep" and self._over[environment]:
                self._over[environment] = False  # the step before did it
                add(reset)
            else:
                explicit.append(reset)
        for call in calls(explicit):
            observations = self.env.reset(**self._arguments(call))[0]
            self._last = self._observation.fitted(observations, (self.n,), self._first_dtype)
            for reset in call:
                add(reset)
        if automatic:
            self._take(step + 1, returned)
            for reset in automatic:
                add(reset)

    def _base(self, environment: int) -> Any:
        base = self.env.unwrapped
        return base.envs[environment].unwrapped if hasattr(base, "envs") else base

    def _arguments(self, call: Sequence[RecordedReset]) -> dict[str, object]:
        """Return the arguments of a call of `reset`."""
        environments = [reset.environment for reset in call]
        mask = np.isin(np.arange(self.n), environments)
        options = call[0].given.options
        if not mask.all():
            options = (options or {}) | {"reset_mask": mask}
        seeds = {reset.environment: self._seed(reset) for reset in call}
        first = seeds[environments[0]]
        arguments: dict[str, object] = {} if options is None else {"options": options}
        if all(seed is None for seed in seeds.values()):
            return arguments
        # Not every vector takes a list
        is_counted = list(seeds.values()) == list(range(first or 0, (first or 0) + self.n))
        is_one = is_counted or not hasattr(self.env.unwrapped, "envs")
        return arguments | {"seed": first if is_one else [seeds.get(i) for i in range(self.n)]}

    def _filler(self, seen: Array, got: Records) -> Fill:
        rows = seen.reshape(len(seen) // self.n, self.n, *seen.shape[1:])
        put = filler(self._observation, rows, (self.n,))
        put_last = filler(self._observation, seen)
        columns = [got[name].reshape(-1, self.n) for name in _ENDS]

        def fill(step: int, result: Any) -> None:
            observations, *values, infos = result
            put(step, observations)
            self._last = rows[step]
            for column, value in zip(columns, values, strict=True):
                column[step] = value
            self._over = columns[1][step] | columns[2][step]
            final = final_observations(infos) if self._autoreset == "SameStep" else None
            if final is not None and self._over.any():
                self._last = self._last.copy()
                for i in np.flatnonzero(self._over).tolist():
                    put_last(step * self.n + i, element_of(final, i))

        return fill

    def actions(self, rows: Records) -> Sequence[Value]:
        """Return the actions of all environments as the vector takes them, for each of its steps."""
        space = self.action_space
        n = self.n
        column = np.array(rows["action"])
        if column.dtype.hasobject:
            values = super().actions(rows)
            rooms: Any = (create_empty_array(space, n) for _ in range(0, len(values), n))
            return [concatenate(space, values[k * n : k * n + n], room) for k, room in enumerate(rooms)]
        if self._has_states:
            column = column.astype(np.int64) + int(space.start)  # type: ignore[attr-defined]
        return values_in(space, column.reshape(-1, n, *column.shape[1:]))

    def _render(self) -> Any:
        pictures = self.env.render()
        if pictures is None or len(pictures) != self.n:
            raise CannotRedo("The vector environment draws no pictures of its environments.")
        return pictures[self._drawn]


def values_in(space: Space, column: NDArray[Any]) -> Sequence[Value]:
    """Return the values of a column, one by one, as an environment with this action space takes them."""
    if isinstance(space, spaces.Dict):
        parts = {key: values_in(part, np.array(column[str(key)])) for key, part in space.spaces.items()}
        return [{key: part[row] for key, part in parts.items()} for row in range(len(column))]
    if isinstance(space, spaces.Tuple):
        columns = [values_in(part, np.array(column[str(i)])) for i, part in enumerate(space.spaces)]
        return list(zip(*columns, strict=True))
    return list(column)  # whole numbers as NumPy's, for which `Discrete.contains` takes a third of the time


def keyed(space: Space, value: Value) -> Value:
    """Return a decoded value with the keys and types that its space has.

    Raises:
        CannotRedo: values of the space are recorded as text that does not give them back.
    """
    if isinstance(space, spaces.Dict):
        return {key: keyed(part, value[str(key)]) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(keyed(*pair) for pair in zip(space.spaces, value, strict=True))
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
