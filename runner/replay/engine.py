"""A loop's recording rerun: its environments take the recorded actions, and what they return is compared."""

from __future__ import annotations

import contextlib
import json
import struct
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import dropwhile, groupby
from typing import Any, Final, NamedTuple, Self

import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import concatenate, create_empty_array
from numpy.typing import NDArray

from runner.environments.games import as_parallel, game_spaces, is_game
from runner.environments.gym_types import Space
from runner.environments.layers import final_observations, spaces_of_one
from runner.errors import CannotRedo, shortened
from runner.recording import schema
from runner.recording.gym_spaces import recorded_space, value_of
from runner.recording.gym_values import LeafValues, SpaceValues, StateValues, element_of, filler
from runner.recording.maker import EnvironmentMaker
from runner.recording.reader import Recording
from runner.recording.spaces import Value, decode
from runner.recording.spaces import leaves_of as recorded_leaves
from runner.recording.steps import EpisodeDigests, after_step, is_of_environment, is_taken
from runner.replay.makers import ALL, environments_of, make_environment, make_vector, using, why_not_made
from runner.replay.recorded import (
    Piece,
    RecordedReset,
    are_separate,
    calls,
    ended_episode,
    last_step_time,
    pieces,
)
from runner.replay.trust import require_plain, trusting
from runner.util.arrays import Array, Ints, Records
from runner.util.differences import differing_part, first_difference, first_differing_row
from runner.util.extras import missing
from runner.util.processes import Report, raise_if_out_of_memory

BLOCK_SECONDS: Final = 0.2
"""Blocks of steps take about this long, so that progress and a hanging environment can be seen."""
_MAX_ROWS: Final = 16_384
_MAX_PICTURES: Final = 32
"""The most steps in a block with pictures."""
_MAX_PICTURE_BYTES: Final = 8 << 20
"""The most bytes of the pictures in a block of several steps."""
_MAX_TEXT: Final = 200
_MAX_DESCRIPTION: Final = 300
_ENDING: Final = struct.Struct("<d??")
_ENDS: Final = ("rewards", "terminated", "truncated")

Fill = Callable[[int, Any], None]
"""Puts down what the environment returned for a step."""
Frame = NDArray[np.uint8]
"""A picture, [height, width, 3]."""
PlacedReset = tuple[int, RecordedReset]
"""A reset, and the row that comes after it."""
_Key = tuple[str, int]
_Steps = tuple[Records, list[PlacedReset]]


@dataclass(frozen=True)
class Difference:
    """The first value in which an environment differs from a recording."""

    phase: str
    """`train` or `eval`."""
    episode: int | None
    """The number of the episode; None if it never ended, in one of several environments."""
    t: int
    """The step of the episode, from 0."""
    step: int
    """The step of the phase, from 0."""
    environment: int
    """Which environment of a vector."""
    field: str
    """`observation[2]`, `reward`, `terminated`, ...; `first observation[2]` after a reset."""
    recorded: object
    """The value, as JSON can hold it."""
    got: object

    def __str__(self) -> str:
        """Describe the difference in a line."""
        episode = f"episode {self.episode:,}" if self.episode is not None else f"step {self.step:,}"
        return (
            f"{self.phase} {episode}, t {self.t:,}: {self.field}: recorded {_short(self.recorded)}, "
            f"got {_short(self.got)}"
        )


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


@dataclass(frozen=True, eq=False)
class RerunSteps:
    """Consecutive steps of one environment, rerun; of one or more episodes."""

    phase: str
    environment: int
    """Which environment of a vector; 0 for a single one."""
    recorded: Records
    """The recorded steps, as `Steps.rows` yields them; each environment of a vector counts its episodes."""
    got: Records
    """What the environment returned: the fields `next_state` or `next_observation`, `rewards`, `terminated`,
    `truncated`, and of games `agents_terminated` and `agents_truncated`, each as in a recording."""
    starts: Sequence[Start] = ()
    """The resets in the block, in order."""
    frames: Sequence[Frame] = ()
    """The picture after each step, if pictures are drawn."""
    difference: Difference | None = None
    """The first difference, in the last row, or at the reset after it; the last block has it, if any has."""

    def __len__(self) -> int:
        return len(self.recorded)

    def require_equal(self) -> Self:
        """Return these steps.

        Raises:
            CannotRedo: they differ from the recorded ones.
        """
        if self.difference is not None:
            raise CannotRedo(f"The environment is not the recorded one: {self.difference}.")
        return self


# --- environments that take recorded actions ----------------------------------------------------------


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
        steps = recording.layout.rows(topics.steps)
        resets = recording.layout.rows(topics.resets)
        ends = [("rewards", "<f8", (len(agents),)), ("terminated", "?"), ("truncated", "?")]
        masks = [(f"agents_{name}", "<u4") for name in _ENDS[1:] if len(agents) > 1]
        self._ends_dtype = np.dtype(ends)
        self._dtype = np.dtype([(self._after, steps[self._after]), *ends, *masks])
        self._first_dtype = resets["observation"]

    def run(self, rows: Records, resets: Sequence[PlacedReset]) -> Returned:
        """Take recorded actions, until the environment raises an error.

        Args:
            rows: the recorded steps, [steps of each environment * n].
            resets: step of each environment, and reset, in order; each comes before its step.
        """
        got, ends = np.zeros(len(rows), self._dtype), np.zeros(len(rows), self._ends_dtype)
        seen = np.zeros(len(rows), self._first_dtype) if self._has_states else got[self._after]
        self._actions, self._fill = self.actions(rows), self._filler(seen, ends, got)
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
        for name in _ENDS:
            got[name] = ends[name]
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

    def _filler(self, seen: Array, ends: Records, got: Records) -> Fill:  # noqa: ARG002
        """Return a function that puts down steps.

        Args:
            seen: [rows], for observations.
            ends: [rows], for rewards and ends.
            got: [rows], for what games return besides.
        """
        put = filler(self._observation, seen)
        pack = _ENDING.pack_into
        data = ends.view(np.uint8).data
        size = _ENDING.size

        def fill(row: int, result: Any) -> None:
            observation, reward, terminated, truncated, _ = result
            put(row, observation)
            try:
                pack(data, row * size, reward, terminated, truncated)
            except (struct.error, TypeError):  # an array of one
                number = float(np.asarray(reward).reshape(()))
                pack(data, row * size, number, bool(terminated), bool(truncated))

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

    def _filler(self, seen: Array, ends: Records, got: Records) -> Fill:
        put = filler(self._observation, seen)
        agents = self.env.possible_agents
        masks = [got[name] for name in got.dtype.names or () if name.startswith("agents_")]

        def fill(row: int, result: Any) -> None:
            observations, rewards, *flags, _ = result
            put(row, observations)
            over = not self.env.agents
            paid = [float(rewards.get(agent, 0.0)) for agent in agents]
            ends[row] = (paid, *(over and any(flag.values()) for flag in flags))
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

    def _filler(self, seen: Array, ends: Records, got: Records) -> Fill:  # noqa: ARG002
        rows = seen.reshape(len(seen) // self.n, self.n, *seen.shape[1:])
        put = filler(self._observation, rows, (self.n,))
        put_last = filler(self._observation, seen)
        columns = [ends[name].reshape(-1, self.n) for name in _ENDS]

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


# --- the recording, rerun -----------------------------------------------------------------------------


class Replay:
    """A replay of a recording, from its beginning or from a reset; runs foreign code in this process.

    Args:
        trust: whether what the recording names may be imported, see `runner.replay.trust`.
        tolerance: absolute and relative, for floating-point observations and rewards; 0 compares bytes.
        make: returns the environment, instead of making it as the recording describes.
    """

    def __init__(
        self,
        recording: Recording,
        trust: bool = False,
        tolerance: float = 0.0,
        report: Report = lambda _: None,
        render: bool = False,
        make: Callable[[], object] | None = None,
        draw_from: int = 0,
    ) -> None:
        self.draw_from = draw_from
        """The number of the first step after which pictures are drawn."""
        self.drawn = 0
        """The environment that is drawn, of a vector that is stepped as a whole."""
        self._recording = recording
        self._trust = trust
        self._make = make
        self._tolerance = tolerance or None
        self._digests = {phase: EpisodeDigests() for phase in schema.PHASES}
        self._report = report
        self.render = render
        self._last_step_time = last_step_time(recording)
        """When the steps end that were recorded: later resets came after steps that were lost."""
        self._steppers: dict[_Key, Stepper] = {}
        self._known: set[_Key] = set()
        """The environments whose random generators are in the recorded state."""
        self._is_separate = are_separate(recording)
        """Whether training and evaluation have environments of their own."""
        self.environments = environments_of(recording)
        self._max_rows = 1 if render else 256
        self.taken = 0
        """Steps taken so far."""
        self.skipped = 0
        """Steps left out, as the state of the random generators at their beginning is not known."""

    def close(self) -> None:
        """Close the environments; what they raise then changes no result."""
        for stepper in self._steppers.values():
            with contextlib.suppress(Exception):
                stepper.env.close()

    def all(self) -> Iterator[RerunSteps]:
        """Yield all steps of both phases in the order of time, up to the first difference."""
        for piece in pieces(self._recording, schema.PHASES):
            for environment in self.environments:
                for steps in self.steps(piece, environment, draws=self.render):
                    yield steps
                    if steps.difference is not None:
                        return

    def steps(
        self, piece: Piece, environment: int, draws: bool, start: RecordedReset | None = None
    ) -> Iterator[RerunSteps]:
        """Yield the steps of one environment in a piece, in blocks, up to the first difference.

        Args:
            environment: one of `environments`; `ALL` yields the steps of each in turn.
            start: where to begin if it was not rerun before; None for the first reset that is known.
        """
        phase = piece.phase
        n = self._recording.environments if environment == ALL else 1
        rows, resets = self.recorded_steps(piece, environment)
        begin = 0
        if not self.is_known(phase, environment):
            resets = list(dropwhile(lambda placed: not placed[1].may_begin(start), resets))
            if not resets:
                self.skipped += len(rows)
                return
            self._known.add(self._key(phase, environment))
            begin = resets[0][0]
            self.skipped += begin * n
        stepper = self.stepper(phase, environment)
        stop = len(rows) // n
        drawn = (
            int(np.searchsorted(rows["step"].astype(np.int64), self.draw_from)) // n if draws else stop + 1
        )
        stepper.draws = False
        end = begin
        while end < stop or resets:
            if end >= drawn and not stepper.draws:
                stepper.draws, self._max_rows = True, 1  # the first picture is to come at once
            begin, end = end, min(end + max(self._max_rows // n, 1), stop)
            if begin < drawn < end:
                end = drawn
            block = rows[begin * n : end * n]
            here = [(row - begin, reset) for row, reset in resets if row < end or end == stop]
            resets = resets[len(here) :]
            if not stepper.is_trusted:
                for _, reset in here:
                    require_plain("option of a reset,", reset.given.options or {}, {})
            started = time.monotonic()
            returned = stepper.run(block, here)
            self._adapt(time.monotonic() - started, returned.frames if stepper.draws else None)
            self.taken += returned.done
            self._report(self.taken)
            for number in range(n) if environment == ALL else [environment]:
                part = self._part(returned, number) if environment == ALL else returned
                steps = self._compared(phase, number, part)
                yield steps
                if steps.difference is not None:
                    return

    def recorded_steps(self, piece: Piece, environment: int) -> _Steps:
        """Return the steps of one environment, or of `ALL`, and its resets with the step that each precedes.

        Steps at which a vector only reset the environment are left out: the reset stands for them.
        """
        n = self._recording.environments
        rows = piece.rows
        first = piece.first
        resets = [reset for reset in piece.resets if environment in (ALL, reset.environment)]
        resets = [reset for reset in resets if reset.time <= self._last_step_time]
        if environment == ALL:
            return rows, [((reset.step - first) // n, reset) for reset in resets]
        index, places = _of_environment(rows, [reset.step - first for reset in resets], environment)
        return rows if len(index) == len(rows) else rows[index], list(zip(places, resets, strict=True))

    def _part(self, whole: Returned, environment: int) -> Returned:
        """Return the part of one environment of what came of all."""
        n = self._recording.environments
        resets = [placed for placed in whole.resets if placed[1].environment == environment]
        starts = [start for start in whole.starts if start.reset.environment == environment]
        index, places = _of_environment(whole.rows, [n * step for step, _ in resets], environment)
        done = int(np.searchsorted(index, whole.done))
        pictures = index[:done].tolist() if environment == self.drawn and whole.frames else ()
        return Returned(
            whole.rows[index],
            [(row, reset) for row, (_, reset) in zip(places, resets, strict=True)],
            whole.got[index],
            [Start(row, *start[1:]) for row, start in zip(places, starts, strict=False)],
            [whole.frames[row // n] for row in pictures],
            done,
            whole.error,
        )

    def is_known(self, phase: str, environment: int) -> bool:
        """Return whether an environment's random generators are in the recorded state."""
        return self._key(phase, environment) in self._known

    def _key(self, phase: str, environment: int) -> _Key:
        """Return a key of an environment, the same for both phases if both use it."""
        return (phase if self._is_separate else "", environment)

    def _adapt(self, seconds: float, frames: Sequence[Frame] | None) -> None:
        """Adapt the size of blocks to the time that one takes, and to its pictures if it has any."""
        if seconds < BLOCK_SECONDS / 2:
            limit = _MAX_ROWS
            if frames is not None:
                size = max((frame.nbytes for frame in frames), default=0)
                limit = min(_MAX_PICTURES, max(_MAX_PICTURE_BYTES // size, 1) if size else 1)
            self._max_rows = min(2 * self._max_rows, limit)
        elif seconds > 2 * BLOCK_SECONDS:
            self._max_rows = max(self._max_rows // 2, 1)

    def stepper(self, phase: str, environment: int) -> Stepper:
        """Return an environment, made when it is first needed.

        Raises:
            CannotRedo: it cannot be made, or has other spaces.
        """
        key = self._key(phase, environment)
        maker = self._recording.phase(phase).maker_of(environment)
        if key in self._steppers:
            return self._steppers[key]
        env, is_trusted = self._environment(maker, environment)
        with using("The environment cannot be used"):
            vector = None if maker is None else maker.vector
            if environment == ALL and vector is not None:
                stepper: Stepper = VectorStepper(env, self._recording, vector.autoreset, self.drawn)
            elif is_game(env):
                stepper = GameStepper(as_parallel(env), self._recording)
            else:
                stepper = Stepper(env, self._recording)
                stepper.ends_once = vector is not None and vector.is_vec_env
            stepper.is_trusted = is_trusted
        self._steppers[key] = stepper
        return stepper

    def _environment(self, maker: EnvironmentMaker | None, environment: int) -> tuple[object, bool]:
        """Return an environment, and whether it may get all that is recorded."""
        if self._make is not None:
            return self._make(), True
        if maker is None:
            raise CannotRedo(why_not_made(maker, self._trust))
        with trusting(self._recording.path, maker, self._trust) as trust:
            make = make_vector if environment == ALL else make_environment
            return make(maker, trust, self.render), trust

    def _compared(self, phase: str, environment: int, returned: Returned) -> RerunSteps:
        """Return the steps of an environment up to the first difference."""
        rows, got, starts, done = returned.rows, returned.got, returned.starts, returned.done
        first = self._first_row(phase, environment, rows[:done], got[:done])
        failed = self._first_start(starts)
        differing = None
        if first is not None and (failed is None or starts[failed].row > first[0]):
            row, name = first
            done = row + 1
            starts = [start for start in starts if start.row <= row]
            differing = _place_of(rows[row]), self._values(name, rows[row], got[row])
        elif failed is not None:
            done = starts[failed].row
            starts = starts[: failed + 1]
            _, reset, value, _ = starts[failed]
            part, was, now = self._observation(reset.observation, value)
            differing = _place_of_reset(reset), (f"first {part}", was, now)
        elif returned.error is not None:
            text = f"{type(returned.error).__name__}: {returned.error}"
            differing = _failed_at(returned, text), ("error", None, text)
        difference = None
        if differing is not None:
            (episode, t, step), values = differing
            number: int | None = episode
            if self._recording.environments > 1:
                number = ended_episode(self._recording, phase, environment, step)
            difference = Difference(phase, number, t, step, environment, *values)
        frames = returned.frames[:done]
        return RerunSteps(phase, environment, rows[:done], got[:done], starts, frames, difference)

    def _first_row(self, phase: str, environment: int, rows: Records, got: Records) -> tuple[int, str] | None:
        """Return the first row that differs, and its first field that does; None if none does."""
        names = [name for name in got.dtype.names or () if name in (rows.dtype.names or ())]
        first = first_difference(rows, got, names, self._tolerance)
        digest = self._first_digest(phase, environment, rows, got)
        return (digest, "digest") if digest is not None and (first is None or digest < first[0]) else first

    def _first_start(self, starts: Sequence[Start]) -> int | None:
        """Return the number of the first reset with another observation; None if all are equal."""
        if not starts:
            return None
        values = np.empty((2, len(starts)), self._recording.train.resets.row_dtype["observation"])
        for k, start in enumerate(starts):
            values[0, k] = start.reset.observation
            values[1, k] = start.got
        return first_differing_row(values[0], values[1], self._tolerance)

    def _first_digest(self, phase: str, environment: int, rows: Records, got: Records) -> int | None:
        """Return the first row at which the episode so far has another digest than was recorded."""
        if not len(rows) or "digest" not in (rows.dtype.names or ()):
            return None
        after = got[after_step(got.dtype)]
        t = rows["t"]
        recorded = np.ascontiguousarray(rows["digest"])
        marked = set(np.flatnonzero(recorded.view(np.uint8).reshape(len(rows), -1).any(axis=1)).tolist())
        ends = got["terminated"], got["truncated"]
        digests = self._digests[phase].add(environment, t, after, got["rewards"], *ends, marked)
        wrong = (row for row, digest in digests if row in marked and digest != recorded[row].tobytes())
        return next(wrong, None)

    def _values(self, name: str, recorded: np.void, got: np.void) -> tuple[str, object, object]:
        """Return a field that differs, such as `observation[2]`, and its values."""
        if name == "digest":
            return "digest of the episode so far", recorded[name].tobytes().hex(), "another one"
        if name == after_step(got.dtype):
            return self._observation(recorded[name], got[name])
        if name != "rewards":
            return name, recorded[name].item(), got[name].item()
        agents = self._recording.agents
        paid, pays = (dict(zip(agents, row[name], strict=True)) for row in (recorded, got))
        agent, was, now = differing_part(paid, pays, self._tolerance)
        return f"reward{agent if len(agents) > 1 else ''}", was, now

    def _observation(self, recorded: Value, got: Value) -> tuple[str, object, object]:
        if isinstance(recorded, bytes):
            space = self._recording.spaces["observation"]
            recorded, got = (decode(space, data, "an observation") for data in (recorded, got))
        path, was, now = differing_part(recorded, got, self._tolerance)
        return f"observation{path}", was, now


def _of_environment(rows: Records, places: Sequence[int], environment: int) -> tuple[Ints, list[int]]:
    """Return which of the rows of all environments are steps that one took, and places among these.

    Args:
        places: numbers of rows.
    """
    index = np.flatnonzero(is_of_environment(rows, environment))
    return index, np.searchsorted(index, places).tolist()


def _place_of(row: np.void) -> tuple[int, int, int]:
    """Return episode, step of the episode, and step of the phase."""
    return int(row["episode"]), int(row["t"]), int(row["step"])


def _place_of_reset(reset: RecordedReset) -> tuple[int, int, int]:
    return reset.episode, 0, reset.step


def _failed_at(returned: Returned, text: str) -> tuple[int, int, int]:
    """Return where an environment raised an error: in the first row or reset that it did not return from."""
    rows = returned.rows
    done = returned.done
    waiting = returned.resets[len(returned.starts) :]
    if waiting and (waiting[0][0] <= done or done >= len(rows)):
        return _place_of_reset(waiting[0][1])
    if not len(rows):  # another environment of the vector raised it
        raise CannotRedo(f"The vector environment fails: {text}")
    return _place_of(rows[min(done, len(rows) - 1)])


def _short(value: object) -> str:
    text = repr(value) if isinstance(value, str) else str(value)
    return shortened(text, _MAX_TEXT)
