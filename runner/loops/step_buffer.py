"""The steps of one phase of a loop: put down as they come, completed and recorded some thousands at a time.

N environments step at once, in turn, and one alone is N = 1. What follows from the order of steps (their
numbers, the state before each, the lengths and returns of episodes) is computed for a whole block at once.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, SupportsFloat

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode

from runner.environments.interfaces import final_observations
from runner.environments.mdp import step_counts
from runner.errors import RecordingError
from runner.loops.description import Copied, Described
from runner.loops.generators import States
from runner.loops.values import as_given, warn_user
from runner.recording import schema
from runner.recording.episode_log import Columns, EpisodeLog, TurnBlock
from runner.recording.gym_values import (
    Change,
    LeafValues,
    Put,
    PutStep,
    SpaceValues,
    StateValues,
    element_of,
    filler,
    only_number,
    step_filler,
)
from runner.recording.messages import MAX_DIGITS, MAX_LARGE_SEED, ResetOptions, ResetState
from runner.recording.recorder import BLOCK_BYTES, Recorder
from runner.recording.spaces import Value, least_number
from runner.util.arrays import Array, Flags, Floats, Ints, Records, zeros

MAX_SEED: Final = 2**64 - 1
"""The largest seed that the record of a reset holds."""
_MAX_STATE: Final = 2**32 - 1
_RESET: Final = [("row", "<i8"), ("environment", "<i8"), ("seed", "<u8"), ("seeded", "?")]
"""What is kept of a reset until it is recorded, besides its observation: the row that comes after it."""
_OF_AGENTS: Final = ("acted", "agents_terminated", "agents_truncated")
"""The columns that have a bit for each agent; steps of one environment alone have none of them."""
_TRUE: Final = b"\1"
_NO_STATES: Final[States] = {}


class StepBuffer:
    """The steps of one phase that are not committed yet, and the state of its episodes.

    Not thread-safe: the caller holds the loop's lock.

    Args:
        described: the environments; or, for steps that are copied, what to know of the recording.
        first_action: called with the first action of the phase before it is put down; may call `reshape`.
        mode: how the environments of a vector reset themselves; None for one environment, alone.
    """

    is_reset_twice = False
    """Whether a step after the end of an episode is a reset though the environment was reset since."""

    def __init__(  # noqa: PLR0915 - the state, with a docstring each
        self,
        recorder: Recorder,
        described: Described | Copied,
        phase: str,
        first_action: Callable[[object], None] = lambda _: None,
        mode: AutoresetMode | None = None,
    ) -> None:
        self._recorder = recorder
        self._first_action = first_action
        self._mode = mode
        self._phase = phase
        self._topics = schema.topics_of(phase)
        self._mdp = described.mdp
        self._n = described.environments
        self._has_turns = described.layout.has_turns
        self._batch = () if mode is None else (self._n,)
        self._of_agents: tuple[str, ...] = tuple(
            name for name in _OF_AGENTS if name in (recorder.dtype(self._topics.steps).names or ())
        )
        self._learners = recorder.dtype(self._topics.episodes)["returns"].shape[0]
        self._log = EpisodeLog(self._n, self._learners, self._mdp, self._has_turns, zero=-0.0)
        self._dtype = recorder.dtype(self._topics.resets)["observation"]
        """The dtype of an observation, with its shape; of objects, where values vary in size."""
        self.off_table = 0
        """Committed steps whose reward the environment's table excludes; 0 without a table."""
        self.filled = 0
        """Rows of the block that are in use."""
        self._room = 0
        """Rows of the block; 0 before the first step."""
        self._full_at = 0
        """Rows in use with which the block is full: fewer where values take much memory."""
        self._held = 0
        """Bytes of values of varying size in the block, and in resets."""
        self.resets = 0
        """The number of resets so far."""
        room = max(recorder.capacity(self._topics.resets), self._n)
        self._resets = np.zeros(room, [*_RESET, ("observation", self._dtype)])
        self._waiting = 0
        """Resets that are not committed."""
        self._seen: Any = zeros((1, self._n), self._dtype)
        """[1, N]: the observations after the last reset or batch."""
        self._attached: dict[int, list[ResetOptions | ResetState]] = defaultdict(list)
        """The options and states of those resets, by number in `_resets`, where there are some."""
        spaces = described.recorded_spaces if described.layout.has_states else {}
        self._starts = tuple(least_number(spaces[name]) for name in sorted(spaces, reverse=True))
        """The least observation and action, where both spaces are discrete."""
        self._state = np.zeros(self._n, np.int64)
        """The observations before the first row, where both spaces are discrete."""
        self._ends: Flags = np.zeros((0, 2, self._n), np.bool_)
        """[rows, 2, N]: whether each row terminated, and truncated, the episodes."""
        self._over: Flags = np.zeros(self._n, np.bool_)
        """[N]: whether the episode of an environment was over before the block."""
        self._ended = 0
        """Ends of episodes in the block; in a vector, in the rows counted so far."""
        self._counted = 0
        """Rows of the block whose ends are in `_ended`; of a vector."""
        self._idle_at = 0
        """The last row before which no episode is in progress; -1 for none in the block."""
        self._last_position = 0
        """Steps of the run up to the last committed row of this phase; in a vector, of either phase."""
        self._autoreset_states: dict[int, States] = {}
        """Rows with resets in place of steps, and what those depended on."""
        self._bytes: memoryview | None = None
        """The block, where it has the bytes of an action as `keep` returns them."""
        self._put: PutStep = self._put_parts
        self.keep: Change = self._copied
        """Returns an action, of one environment alone, in a form that the step cannot change."""
        self._is_copied = isinstance(described, Copied)
        if isinstance(described, Described):
            self._observation = self._values(described.observation, "observation")
            self._put_seen = self._filler(self._observation, self._seen)
            self.reshape(described)

    def reshape(self, described: Described) -> None:
        """Prepare for actions of another dtype, before the first step."""
        self._action = self._values(described.recorded_action, "action")

    def _values(self, space: Any, what: str) -> SpaceValues:
        leaf = StateValues if self._starts and not self._batch else LeafValues
        return SpaceValues(space, what, warn_user, leaf, bool(self._of_agents))

    def _filler(self, values: SpaceValues, column: Any) -> Put:
        """Return a function that puts values of all environments into a row of a column, [rows, N]."""
        return filler(values, column if self._batch else column[:, 0], self._batch)

    @property
    def pending(self) -> int:
        """Rows of single environments that the recorder does not have yet, with rows that only reset."""
        return self.filled * self._n

    @property
    def progress(self) -> tuple[int, int]:
        """The steps of the phase so far, and the number of an episode.

        Of one environment alone, the episode of the last step; else the next episode to end.
        """
        if self._batch and self._counted < self.filled:
            self._ended += int(np.count_nonzero(self._ends[self._counted : self.filled].any(axis=1)))
            self._counted = self.filled
        episode = self._log.ended + self._ended
        if not self._batch and not self._of_agents and self._idle_at == self.filled:
            episode = max(episode - 1, 0)
        return self._recorder.steps[self._phase] + self.filled * self._n, episode

    @property
    def is_any_over(self) -> bool:
        """Whether `over` may be true of an environment; this takes less time."""
        if not self.filled:
            return bool(self._over.any())
        return _TRUE in self._ends[self.filled - 1].tobytes()

    @property
    def over(self) -> Flags:
        """[N]: the environments whose episode ended with the last step and that were not reset since.

        With `is_reset_twice` also those that were.
        """
        over: Flags = self._ends[self.filled - 1].any(axis=0) if self.filled else self._over.copy()
        resets = self._resets[: self._waiting]
        if not self.is_reset_twice:
            over[resets["environment"][resets["row"] == self.filled] % self._n] = False
        return over

    @over.setter
    def over(self, over: Flags) -> None:
        self.commit()
        self._over = over

    # --- steps ----------------------------------------------------------------------------------------

    def take(
        self,
        action: object,
        observation: object,
        reward: SupportsFloat,
        terminated: object,
        truncated: object,
    ) -> None:
        """Put down a step of one environment alone; the action is as `keep` returned it."""
        if not self._room:
            self._begin(action)
        row = self.filled
        self._put(row, action, observation, reward, terminated, truncated)
        self.filled = row = row + 1
        if terminated or truncated:
            self._ended += 1
            self._idle_at = row
        if row >= self._full_at:
            self._commit_full()

    def take_game(
        self,
        actions: Mapping[Any, object],
        observations: Mapping[Any, object],
        rewards: Mapping[Any, float],
        terminated: Mapping[Any, bool],
        truncated: Mapping[Any, bool],
        over: bool,
    ) -> None:
        """Put down a step of a game; agents that are missing took no part in it."""
        if not self._room:
            self._begin(actions)
        agents = self._action.agents
        paid = [float(rewards.get(agent, 0.0)) for agent in agents]
        ended = [over and any(ends.values()) for ends in (terminated, truncated)]
        row = self.filled
        self._put_parts(row, actions, observations, paid, *ended)
        flags = dict.fromkeys(actions, True), terminated, truncated
        masks = [sum(bool(ends.get(agent)) << i for i, agent in enumerate(agents)) for ends in flags]
        self._marks[row] = (*masks, 0, over, False)
        self.filled = row = row + 1
        if over:
            self._ended += 1
            self._idle_at = row
        if row >= self._full_at:
            self._commit_full()

    def take_vector(
        self,
        actions: object,
        observations: object,
        rewards: object,
        terminated: object,
        truncated: object,
        infos: object,
        states: States | None = None,
    ) -> None:
        """Put down a step of all environments.

        `rewards`, `terminated` and `truncated`: [N].

        Args:
            infos: what has the last observations of episodes that ended, where `observations` are already of
                the next ones; None where they are not.
            states: what the resets in place of steps depended on, if it is to be recorded.
        """
        if not self._room:
            self._begin(actions)
        row = self.filled
        if rewards.__class__ is not np.ndarray or rewards.shape != self._batch:
            rewards = np.asarray(rewards, np.float64).reshape(self._batch)
        held = self._put_action(row, actions) + self._put_observation(row, observations)
        self._rewards[row] = rewards
        ends = self._ends[row]
        ends[0], ends[1] = terminated, truncated
        if infos is not None and _TRUE in ends.tobytes() and (final := final_observations(infos)) is not None:
            environments = (ends[0] | ends[1]).nonzero()[0]  # `any` takes five times as long
            firsts = self._observations[row, environments]
            for i in environments.tolist():
                held += self._put_last(row * self._n + i, element_of(final, i))
            self._add_resets(row + 1, environments, firsts)
        if held:
            self._hold(held)
        if states:
            self._autoreset_states[row] = states
        self.filled = row = row + 1
        if row >= self._full_at:
            self._commit_full()

    def take_batch(
        self,
        observations: object,
        actions: object,
        rewards: Floats,
        terminated: Flags,
        truncated: Flags,
        finals: object,
    ) -> None:
        """Put down T steps of all environments; all or nothing of them.

        Args:
            observations: [T, N, ...], nested as their space: what the steps returned.
            actions: [T, N, ...], nested as their space. `rewards`, `terminated` and `truncated`: [T, N].
            finals: [T, N, ...], the last observations of episodes that ended, where `observations` are
                already of the next ones; None if they are unknown.

        Raises:
            ResetNeeded: the phase has no reset yet.
        """
        if not self._room:
            self._begin(actions)
        of_one = np.dtype((self._actions.dtype, self._actions.shape[2:]))
        given = self._action.fitted(actions, rewards.shape, of_one)
        seen = after = self._fitted(observations, *rewards.shape)
        last = None if finals is None else self._fitted(finals, *rewards.shape)
        ended = terminated | truncated
        firsts = None
        if self._mode == AutoresetMode.DISABLED:
            over = np.vstack([self.over, ended[:-1]])
            if over.any():
                step, environment = np.argwhere(over)[0]
                raise RecordingError(
                    f"found step {step} of a batch in environment {environment} after the end of an episode, "
                    'expected a reset; another autoreset_mode than "Disabled" states that there was one.'
                )
        elif self._mode == AutoresetMode.SAME_STEP and ended.any():
            firsts = seen
            after = seen.copy()
            after[ended] = self._observation.unknown(self._dtype) if last is None else last[ended]
        self._extend(given, after, rewards, np.stack([terminated, truncated], axis=1), firsts=firsts)
        self._seen[0] = seen[-1]

    def copy(self, rows: Records, environment: int) -> None:
        """Put down recorded steps, with new numbers, of the environment that was reset last."""
        if not self._room:
            self._begin(None)
        action = rows["action"]
        after = rows["next_state" if self._starts else "next_observation"]
        if self._starts:
            least_state, least_action = self._starts
            action, after = action.astype(np.int64) + least_action, after.astype(np.int64) + least_state
        marks = np.zeros(len(rows), self._marks.dtype)
        marks["environment"] = environment
        marks["begins"] = rows["t"] == 0  # also after a game that ended without the end of any agent
        for name in self._of_agents:
            marks[name] = rows[name]
        ends = np.stack([rows["terminated"], rows["truncated"]], axis=1)[..., np.newaxis]
        self._extend(action[:, np.newaxis], after[:, np.newaxis], rows["rewards"], ends, marks)

    def _extend(self, *arrays: Array, firsts: Array | None = None) -> None:
        """Put down T steps of all environments.

        Args:
            arrays: what `_block` holds, [T, ...]; of one environment alone with the marks.
            firsts: the observations after resets by the steps that ended episodes, where there were such.
        """
        steps = len(arrays[0])
        done = 0
        while done < steps:
            row = self.filled
            count = min(self._room - self.filled, steps - done)
            rows, part = slice(row, row + count), slice(done, done + count)
            for column, values in zip(self._block, arrays, strict=False):
                column[rows] = values[part]
            if firsts is not None:
                at, environments = np.nonzero(self._ends[rows].any(axis=1))
                self._add_resets(row + at + 1, environments, firsts[done + at, environments])
            if self._dtype.hasobject:
                self._hold(sum(map(len, (*self._actions[rows].flat, *self._observations[rows].flat))))
            done += count
            self.filled = rows.stop
            if self.filled >= self._full_at:
                self._commit_full()

    def continues_with(self, observations: object) -> bool:
        """Return whether these are the observations [N, ...] after the last batch or reset of the phase."""
        given = self._fitted(observations, self._n)
        now = self._seen[0]
        return bool((given == now).all()) if now.dtype.hasobject else given.tobytes() == now.tobytes()

    # --- resets ---------------------------------------------------------------------------------------

    def reset(
        self,
        observations: object,
        seeds: Sequence[int | None],
        environments: Sequence[int] = (0,),
        states: States = _NO_STATES,
        options: str = "",
    ) -> None:
        """Put down a reset of some environments, or of one alone; it ends episodes in progress in them.

        Args:
            observations: of all environments.
            seeds: of all environments; empty for none.
            environments: their numbers.
            states: what the reset depended on, by environment, as far as it is to be recorded.
            options: of the reset, as JSON; empty for none.

        Raises:
            RecordingError: an observation is none of the space, or a seed has too many digits.
        """
        if any(seed is not None and seed > MAX_LARGE_SEED for seed in seeds):
            raise RecordingError(f"found a seed with more digits than {MAX_DIGITS:,}, expected fewer.")
        if self._batch:
            self._seen[0] = self._fitted(observations, self._n)  # all or nothing of them
        else:
            self._put_seen(0, observations)
        seen = self._seen[0] if len(environments) == self._n else self._seen[0, environments]
        must_commit = bool(self._batch) and not self.over[environments].all()
        self._ended += not self._batch and self._idle_at != self.filled
        self._idle_at = self.filled
        if len(seeds):
            seeds = [seeds[i] for i in environments]
        self._add_resets(self.filled, environments, seen, seeds, options, states)
        if must_commit or self._is_full_of_resets:
            self.commit()

    def copy_reset(self, reset: np.void, environment: int) -> None:
        """Put down a recorded reset, as one of this environment."""
        self._seen[0] = reset["observation"]
        seed = int(reset["seed"]) if reset["seeded"] else None
        self._add_resets(self.filled, [environment], self._seen[0], [seed])
        if self._is_full_of_resets:
            self.commit()

    @property
    def _is_full_of_resets(self) -> bool:
        return self._waiting >= len(self._resets) or self._held > BLOCK_BYTES

    def _add_resets(
        self,
        rows: Ints | int,
        environments: Ints | Sequence[int],
        observations: Array,
        seeds: Sequence[int | None] = (),
        options: str = "",
        states: States = _NO_STATES,
    ) -> None:
        """Put down resets of environments before these rows.

        Args:
            environments: their numbers.
            seeds: of these resets; none have seeds and options unless given.
            states: what they depended on, by environment.
        """
        if self._dtype.hasobject:
            self._hold(sum(map(len, observations)))
        start, self._waiting = self._waiting, self._waiting + len(environments)
        while self._waiting > len(self._resets):
            self._resets = np.concatenate([self._resets, np.zeros_like(self._resets)])
        added = self._resets[start : self._waiting]
        added["row"], added["environment"], added["observation"] = rows, environments, observations
        large: dict[int, int] = {}
        for k, seed in enumerate(seeds):
            if seed is not None and seed > MAX_SEED:
                large[k] = seed
            elif seed is not None and seed >= 0:
                added["seed"][k] = seed
                added["seeded"][k] = True
        if options and not large:
            self._attached[start].append(ResetOptions(json=options, resets=len(environments)))
        elif large:
            for k in range(len(environments)):
                if options or k in large:
                    self._attached[start + k].append(ResetOptions(json=options, large_seed=large.get(k)))
        if states:
            for k, environment in enumerate(environments):
                if environment in states:
                    self._attached[start + k].append(states[environment])
        self.resets += len(environments)

    def _fitted(self, observations: object, *batch: int) -> Array:
        """Return a batch of observations as they are recorded."""
        return self._observation.fitted(observations, batch, self._dtype)

    # --- the block ------------------------------------------------------------------------------------

    def _begin(self, action: object) -> None:
        """Allocate the block before the first step: with its action, the dtype of all is known.

        Raises:
            ResetNeeded: there was no reset.
        """
        if not self.resets:  # the state before the step would be unknown
            raise ResetNeeded(
                f"phase {self._phase!r}: the recording has seen no reset of this environment yet: call "
                "reset() first"
            )
        self._first_action(action)
        room = max(1, self._recorder.capacity(self._topics.steps) // self._n)
        n = self._n
        self._room = self._full_at = room
        masks = [(name, "<u4") for name in (*_OF_AGENTS, "environment")]
        self._marks = np.zeros(room, [*masks, ("over", "?"), ("begins", "?")])
        action = self._recorder.dtype(self._topics.steps)["action"]
        dtypes = {"action": np.dtype(np.int64) if self._starts else action, "observation": self._dtype}
        if self._batch:
            self._actions, self._observations = (zeros((room, n), dtype) for dtype in dtypes.values())
            self._rewards = np.zeros((room, n))
            self._ends = np.zeros((room, 2, n), np.bool_)
            places = self._observations.reshape(room * n, *self._dtype.shape)
            self._put_last = filler(self._observation, places)
        else:
            ends = [("rewards", "<f8", (self._learners,)), ("ends", "?", (2, 1))]
            rows: Records = np.zeros(room, [*dtypes.items(), *ends])
            self._actions, self._observations = (rows[name][:, np.newaxis] for name in dtypes)
            self._rewards = rows["rewards"]
            self._ends = rows["ends"]
        self._block = self._actions, self._observations, self._rewards, self._ends, self._marks
        if self._is_copied:
            return
        self._put_action = self._filler(self._action, self._actions)
        self._put_observation = self._filler(self._observation, self._observations)
        if not (self._batch or self._of_agents or self._dtype.hasobject):
            self._bytes = None if self._starts else rows.view(np.uint8).data
            self._put, self.keep = step_filler(
                self._action, self._observation, rows, self._put_parts, self._copied
            )

    def _copied(self, action: Value) -> Value:
        """Return a copy of an action; not as bytes, which are what `step_filler` makes of actions."""
        given = as_given(action)
        looks_like_kept = isinstance(given, bytes | bytearray) and not (self._dtype.hasobject or self._starts)
        return np.array(given) if looks_like_kept else given

    def _put_parts(
        self,
        row: int,
        action: Value,
        observation: Value,
        rewards: Any,
        terminated: object,
        truncated: object,
    ) -> None:
        """Put down a step of a game, or of one environment alone if a value is not as expected."""
        if self._bytes is not None and action.__class__ is bytes:
            start = row * (len(self._bytes) // len(self._ends))
            self._bytes[start : start + len(action)] = action
        else:
            self._hold(self._put_action(row, action))
        self._hold(self._put_observation(row, observation))
        try:
            self._rewards[row] = rewards if self._of_agents else float(rewards)
        except (TypeError, ValueError):
            self._rewards[row] = only_number(rewards, "reward")
        self._ends[row] = [[bool(terminated)], [bool(truncated)]]

    def _hold(self, size: int) -> None:
        """Count bytes of values of varying size; with many of them, the block is full."""
        self._held += size
        if self._held > BLOCK_BYTES:
            self._full_at = 0

    def _commit_full(self) -> None:
        self.commit()
        self._recorder.write_if_full()

    # --- records --------------------------------------------------------------------------------------

    def commit(self) -> None:
        """Make the records of what was put down and hand them to the recorder."""
        rows = self.filled
        before = self._recorder.position
        first = self._recorder.steps[self._phase]
        if self._batch:
            self._last_position = before
        if not (rows or self._waiting):
            return
        over = self.over
        is_idle = self._idle_at == rows
        episode = self._put_steps(first, before) if rows else np.empty((0, self._n), np.int64)
        if self._waiting:
            self._put_resets(episode, first, before)
        self._recorder.advance(self._phase, rows * self._n)
        if rows:
            self._last_position = before + rows * self._n
        self._over = over
        self._idle_at = 0 if is_idle else -1
        self._autoreset_states = {}
        self.filled = self._waiting = self._held = self._ended = self._counted = 0
        self._full_at = self._room

    def _put_steps(self, first: int, before: int) -> Ints:
        """Record the steps, and the ends of episodes; return the episode of each step, [rows, N].

        Args:
            first: the number of the first step within the phase.
            before: the steps of the run before it.
        """
        rows = self.filled
        n = self._n
        resets = self._resets[: self._waiting]
        was_reset = np.zeros((rows + 1, n), np.bool_)
        was_reset[resets["row"], resets["environment"] % n] = True
        begins, only_reset, is_over = self._turns(was_reset[:-1])
        rewards = self._rewards[:rows].reshape(rows, n, self._learners)
        terminated, truncated = self._ends[:rows, 0], self._ends[:rows, 1]
        columns = self._columns(rows, resets, only_reset)
        columns |= {"rewards": rewards, "terminated": terminated, "truncated": truncated}
        counts = None
        if self._mdp is not None:
            names = ("state", "action", "next_state")
            transitions = (columns[name].ravel().astype(np.int64, copy=False) for name in names)
            counts, excluded = step_counts(self._mdp, self._rewards[:rows, 0], *transitions)
            counts = counts[:, np.newaxis]
            self.off_table += int(np.count_nonzero(excluded))
        environment = self._marks["environment"][:rows, np.newaxis] if self._is_copied else None
        ends = rewards, terminated, truncated
        steps = TurnBlock(first, *ends, begins, only_reset, is_over, counts, environment)
        episodes = self._log.take(steps)
        columns["step"] = first + np.arange(rows * n).reshape(rows, n)
        columns |= {"episode": episodes.number, "t": episodes.t}
        if self._has_turns:
            numbers = np.arange(n) if environment is None else environment
            columns["environment"] = np.broadcast_to(numbers, (rows, n))
            columns["taken"] = np.broadcast_to(np.logical_not(only_reset), (rows, n))
        flat = {name: values.reshape(rows * n, *values.shape[2:]) for name, values in columns.items()}
        self._recorder.put(self._topics.steps, flat, np.arange(before + 1, before + 1 + rows * n))
        self._put_ends(episodes.ended, first, before)
        return episodes.number

    def _turns(self, was_reset: Flags) -> tuple[Flags, Flags | bool, Flags | bool]:
        """Return `was_reset`, `only_reset` and `is_over` of the `TurnBlock`; put down the resets among these.

        Args:
            was_reset: [rows, N], where resets were put down so far.
        """
        if not self._batch:
            marks = self._marks[: len(was_reset), np.newaxis]
            return was_reset | marks["begins"], False, marks["over"]
        over = np.vstack([self._over, self._ends[: self.filled - 1].any(axis=1)])
        waits = over if self.is_reset_twice else over & ~was_reset
        only_reset: Flags = waits & (self._mode == AutoresetMode.NEXT_STEP)
        if (only_reset & self._ends[: self.filled].any(axis=1)).any():
            warn_user(
                "An episode ended in the step after another end, which only resets its environment with "
                'autoreset_mode="NextStep" (pass "SameStep" if the step that ends an episode does). The '
                "steps are recorded, and this end is not counted."
            )
        # They come after the resets that the user's loop called before the step.
        rows, environments = np.nonzero(only_reset)
        start = self._waiting
        self._add_resets(rows, environments, self._observations[rows, environments])
        for row, states in self._autoreset_states.items():
            for k in np.flatnonzero(rows == row).tolist():
                if (i := int(environments[k])) in states:
                    self._attached[start + k].append(states[i])
        begins = was_reset | only_reset
        begins[0] |= self._over  # they ended among the steps of another phase, and were not reset since
        return begins, only_reset, False

    def _columns(self, rows: int, resets: Records, only_reset: Flags | bool) -> Columns:
        """Return the fields of the records that follow from the values of the spaces, [rows, N, ...].

        Args:
            resets: those besides `only_reset`.
        """
        actions, after = self._actions[:rows], self._observations[:rows]
        if not self._starts:
            marks = {name: self._marks[name][:rows, np.newaxis] for name in self._of_agents}
            return {"action": actions, "next_observation": after, **marks}
        least_state, least_action = self._starts
        state = np.vstack([self._state, after])
        self._state = state[-1].copy()
        state[resets["row"], resets["environment"] % self._n] = resets["observation"]
        columns = {
            "state": state[:-1] - least_state,
            "action": actions - least_action,
            "next_state": after - least_state,
        }
        for name, values in columns.items():
            known = values if only_reset is False else values[~only_reset]
            if known.size and not 0 <= known.min() <= known.max() <= _MAX_STATE:
                raise RecordingError(
                    f"found {name} {known.min()} to {known.max()}, outside of its Discrete space."
                )
        return columns

    def _put_ends(self, ended: Columns, first: int, before: int) -> None:
        """Record the ends of episodes, each at the time of its last step, which may be committed already."""
        rows = ended["last_step"].astype(np.int64) - first
        positions = np.where(rows < 0, self._last_position, before) + rows + 1
        self._recorder.put(self._topics.episodes, ended, positions)

    def _put_resets(self, episode: Ints, first: int, before: int) -> None:
        """Record the resets in their order, and the ends of the episodes that they cut off.

        `episode` is the episode of each step, [rows, N]; `first` and `before` are as for `_put_steps`.
        """
        resets = self._resets[: self._waiting]
        last = resets[resets["row"] == self.filled]
        environments = last["environment"] % self._n
        if self._starts:
            self._state[environments] = last["observation"]
        cut = np.array(list(dict.fromkeys(environments.tolist())), np.int64)
        self._put_ends(self._log.interrupt(first + self.filled * self._n, cut), first, before)
        episode = np.vstack([episode, self._log.episode])
        order = np.argsort(resets["row"], kind="stable")
        ordered = resets[order]
        steps = ordered["row"] * self._n
        number = self.resets - self._waiting
        columns = {name: ordered[name] for name in ("environment", "seed", "seeded", "observation")}
        columns["episode"] = episode[ordered["row"], ordered["environment"] % self._n]
        columns |= {"reset": number + np.arange(len(order)), "step": first + steps}
        self._recorder.put(self._topics.resets, columns, before + steps)
        for offset, k in enumerate(order.tolist() if self._attached else ()):
            for attached in self._attached.get(k, ()):
                is_state = isinstance(attached, ResetState)
                topic = self._topics.reset_states if is_state else self._topics.reset_options
                payload = attached._replace(reset=number + offset).to_payload()
                self._recorder.append(topic, payload, before + int(steps[offset]))
        self._attached.clear()
        resets["seed"] = 0
        resets["seeded"] = False
