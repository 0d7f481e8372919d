"""The steps of a vector environment: whole batches copied as they come, records made for many steps at once.

A vector environment steps N environments at once: record number n of a phase belongs to environment n modulo
N. A step copies five arrays. What follows from the order of steps (their numbers, the lengths and returns of
episodes, the resets that environments do by themselves) is computed for a block of steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from runner.loops.description import Described
from runner.loops.generators import States
from runner.loops.rows import MAX_SEED, Rows
from runner.loops.values import require_reset, warn_user
from runner.recording import schema
from runner.recording.episode_log import Columns, EpisodeLog, Episodes, Flags, Steps
from runner.recording.gym_values import element_of, filler, fitted, leaves_of
from runner.recording.recorder import BLOCK_BYTES, Recorder
from runner.recording.reset_states import ResetState
from runner.recording.schema import Topic
from runner.replay.stepping_vector import final_observations
from runner.util.arrays import Array, Ints

_TRUE: Final = b"\1"
_MAX_STEPS: Final = 2048
"""The most steps of the vector environment in a block; fewer if the recorder's blocks hold fewer records."""


class ResetsBetween(NamedTuple):
    """Resets of environments whose episodes had ended, by the user or within a step (`SAME_STEP`)."""

    row: NDArray[np.intp]
    """The row of the block that comes after each."""
    which: NDArray[np.intp]
    observation: Array
    seeds: Sequence[int | None]
    states: Sequence[ResetState | None]
    """What each depended on, where that is to be recorded."""


class VectorRows:
    """The steps of one phase of a vector environment that are not committed yet.

    Not thread-safe: the caller holds the loop's lock.

    Args:
        first_action: called with the first action of the phase before it is recorded; may call `reshape`.
        next_step: whether an environment whose episode is over ignores its next action and is reset.
    """

    off_table = 0

    def __init__(
        self,
        recorder: Recorder,
        described: Described,
        phase: str,
        first_action: Callable[[object], None],
        next_step: bool,
    ) -> None:
        self._recorder, self._phase, self._first_action = recorder, phase, first_action
        self._topics = schema.topics_of(described.kind, phase)
        self._discrete = described.kind == "step"
        self._next_step = next_step
        self._state_start, self._action_start = (
            int(space.start) if self._discrete else 0  # type: ignore[attr-defined]
            for space in (described.observation, described.action)
        )
        n = described.environments
        self._n = n
        self._log = EpisodeLog(n, 1, None)
        self._reset_count = 0
        self._observation_dtype = recorder.dtype(self._topics.resets)["observation"]
        self._current = np.zeros(n, self._observation_dtype)
        """The observations before the first row of the block."""
        self._room = 0
        self._filled = 0
        """Rows of the block that are in use, of `_room`."""
        self._held = 0
        """The bytes of the block's values of varying size."""
        self._over = np.zeros(n, np.bool_)
        self._state = np.full(n, -self._state_start)
        """The states before the first row, where both spaces are discrete."""
        self._block_resets: list[ResetsBetween] = []
        self._finals: list[tuple[NDArray[np.intp], NDArray[np.intp], Array]] = []
        """Rows whose observations are of the next episodes; environments, and the last ones of the ended."""
        self._ended: list[tuple[int, int]] = []
        """Rows and environments of which `_last` has the last observations; not in `_finals` yet."""
        self._autoreset_states: dict[int, States] = {}
        """Rows with resets in place of steps, and what those depended on."""
        self._counted, self._ended_here = 0, 0
        """Rows of the block of which `place` has counted the ends of episodes, and those ends."""
        self.reshape(described)

    def open(self) -> None:
        """Do nothing: `commit` takes blocks from the recorder."""

    def reshape(self, described: Described) -> None:
        """Prepare for actions of another dtype, before the first step."""
        self._observation_leaves = leaves_of(described.observation, "observation", on_rounded=warn_user)
        self._action_leaves = leaves_of(described.recorded_action, "action", on_rounded=warn_user)

    def _make_room(self) -> None:
        """Allocate the block; the dtype of actions is known."""
        n = self._n
        rows = max(1, min(_MAX_STEPS, self._recorder.capacity(self._topics.steps) // n))
        self._room = rows
        records = self._recorder.dtype(self._topics.steps)
        self._action_dtype = self._action_leaves[0].base if self._discrete else records["action"]
        self._actions = np.empty((rows, n), self._action_dtype)
        self._observations = np.empty((rows, n), self._observation_dtype)
        self._rewards = np.empty((rows, n))
        self._ends = np.empty((rows, 2, n), np.bool_)
        self._terminated, self._truncated = self._ends[:, 0], self._ends[:, 1]
        self._last = np.empty(n + rows * n // 8, self._observation_dtype)
        self._put_action = filler(self._action_leaves, self._actions, (n,))
        self._put_observation = filler(self._observation_leaves, self._observations, (n,))
        self._put_last = filler(self._observation_leaves, self._last)

    @property
    def filled(self) -> int:
        """Steps of single environments that the recorder does not have yet."""
        return self._filled * self._n

    @property
    def place(self) -> tuple[int, int]:
        """The steps of the phase so far, and the number of episodes that have ended."""
        if self._counted < self._filled:
            new = slice(self._counted, self._filled)
            self._ended_here += int(np.count_nonzero(self._terminated[new] | self._truncated[new]))
            self._counted = self._filled
        return self._recorder.steps[self._phase] + self.filled, self._log.ended + self._ended_here

    @property
    def is_any_over(self) -> bool:
        """Whether `over` may be true of an environment; this takes less time."""
        row = self._filled - 1
        if row < 0:
            return bool(self._over.any())
        return _TRUE in self._ends[row].tobytes()

    @property
    def over(self) -> Flags:
        """[N]: the environments whose episode ended with the last step and that were not reset since."""
        if not self._filled:
            return self._over
        self._gather()
        over: Flags = self._terminated[self._filled - 1] | self._truncated[self._filled - 1]
        for reset in self._block_resets:
            over[reset.which[reset.row == self._filled]] = False
        return over

    @over.setter
    def over(self, over: Flags) -> None:
        self.commit()
        self._over = over

    def take(
        self,
        actions: object,
        observations: object,
        rewards: object,
        terminated: object,
        truncated: object,
        infos: object,
        states: States | None = None,
    ) -> None:
        """Record a step of all environments.

        `rewards`, `terminated` and `truncated`: [N].

        Args:
            infos: what has the last observations of episodes that ended, where `observations` are already of
                the next ones; None where they are not.
            states: what the resets in place of steps depended on, if it is to be recorded.
        """
        if not self._room:
            self._first_action(actions)
            self._make_room()
        row = self._filled
        if not row:
            require_reset(self._reset_count, self._phase)
            # They ended among the steps of another phase, and were not reset since.
            self._abandon(np.flatnonzero(self._over))
        self._put_action(row, actions)
        self._put_observation(row, observations)
        if rewards.__class__ is not np.ndarray or rewards.shape != (self._n,):
            rewards = np.asarray(rewards, np.float64).reshape(self._n)
        self._rewards[row] = rewards
        ends = self._ends[row]
        ends[0], ends[1] = terminated, truncated
        is_full = row + 1 == self._room
        if infos is not None and _TRUE in ends.tobytes() and (final := final_observations(infos)) is not None:
            for i in (ends[0] | ends[1]).nonzero()[0].tolist():
                self._put_last(len(self._ended), element_of(final, i))
                self._ended.append((row, i))
            is_full |= len(self._ended) + self._n > len(self._last)
        if states:
            self._autoreset_states[row] = states
        self._filled = row + 1
        if self._observations.dtype.hasobject:
            self._held += sum(map(len, [*self._actions[row], *self._observations[row]]))
            is_full |= self._held > BLOCK_BYTES
        if is_full:
            self.commit()
            self._recorder.write_if_full()

    def _gather(self) -> None:
        """Put the ends of episodes in `_ended`, and the resets that followed them, with the block's."""
        if self._ended:
            row, which = np.array(self._ended, np.intp).T
            none, after = [None] * len(row), self._observations[row, which]
            self._finals.append((row, which, self._last[: len(row)].copy()))
            self._block_resets.append(ResetsBetween(row + 1, which, after, none, none))
            self._ended = []

    def _fitted(self, observations: object, *batch: int) -> Array:
        """Return a batch of observations as they are recorded."""
        return fitted(self._observation_leaves, observations, batch, self._observation_dtype)

    def _now(self) -> Array:
        """Return the observations [N] after the last step or reset of each environment."""
        if not self._filled:
            return self._current
        now: Array = self._observations[self._filled - 1].copy()
        for reset in self._block_resets:
            here = reset.row == self._filled
            now[reset.which[here]] = reset.observation[here]
        return now

    def reset(self, observation: object, seeds: Sequence[int | None], which: Flags, states: States) -> None:
        """Record a reset of some environments; it ends episodes in progress in them.

        Args:
            seeds: of all environments; empty for none.
            which: [N], the environments.
            states: what the reset depended on, if it is to be recorded.
        """
        chosen = np.flatnonzero(which)
        own_seeds = [seeds[i] if len(seeds) else None for i in chosen.tolist()]
        own_states = [states.get(i) for i in chosen.tolist()]
        now = self._fitted(observation, self._n)
        over = self.over
        if self._filled and over[chosen].all():
            after = np.full(len(chosen), self._filled)
            self._block_resets.append(ResetsBetween(after, chosen, now[chosen], own_seeds, own_states))
            return
        self.commit()
        self._abandon(chosen)
        self._over = self._over & ~which
        self._current[chosen] = now[chosen]
        if self._discrete:
            self._state[chosen] = now[chosen].astype(np.int64) - self._state_start
        steps = np.full(len(chosen), self._recorder.steps[self._phase])
        self._put_resets(chosen, now[chosen], own_seeds, own_states, self._log.episode[chosen], steps)

    def _abandon(self, which: NDArray[np.intp]) -> None:
        """End the episodes in progress of these environments, neither terminated nor truncated."""
        self._put_ends(self._log.interrupt(self._recorder.steps[self._phase], which))

    def commit(self) -> None:
        """Make the records of the block and hand them to the recorder."""
        rows = self._filled
        if not rows:
            return
        first, over_after = self._recorder.steps[self._phase], self.over  # which gathers the ends
        terminated, truncated = self._terminated[:rows], self._truncated[:rows]
        was_reset, only_reset = np.zeros((2, rows, self._n), np.bool_)
        for reset in self._block_resets:
            inside = reset.row < rows
            was_reset[reset.row[inside], reset.which[inside]] = True
        if self._next_step:
            only_reset[0], only_reset[1:] = self._over, (terminated | truncated)[:-1]
            only_reset &= ~was_reset
        rewards = self._rewards[:rows, :, np.newaxis]
        episodes = self._log.take(
            Steps(first, rewards, terminated, truncated, was_reset | only_reset, only_reset)
        )
        self._current = self._now()
        self._put_records(episodes, first)
        self._recorder.steps[self._phase] += rows * self._n
        self._put_ends(episodes.ended)
        self._put_block_resets(np.vstack([episodes.number, self._log.episode]), only_reset, first)
        self._over = over_after
        self._filled = self._held = self._counted = self._ended_here = 0
        self._block_resets, self._finals, self._autoreset_states = [], [], {}

    def _put_records(self, episodes: Episodes, first: int) -> None:
        rows, n = self._filled, self._n
        terminated, truncated = self._terminated[:rows], self._truncated[:rows]
        last = self._observations[:rows]
        if self._finals:
            last = last.copy()
            for row, which, observation in self._finals:
                last[row, which] = observation
        columns: Columns = {
            "rewards": self._rewards[:rows, :, np.newaxis],
            "step": first + np.arange(rows * n).reshape(rows, n),
            "episode": episodes.number,
            "t": episodes.t,
            "terminated": terminated,
            "truncated": truncated,
        }
        if self._discrete:
            states = np.vstack([self._state, self._observations[:rows].astype(np.int64)])
            states[1:] -= self._state_start
            for reset in self._block_resets:
                states[reset.row, reset.which] = reset.observation.astype(np.int64) - self._state_start
            self._state = states[-1].copy()
            columns["state"] = states[:-1]
            columns["action"] = self._actions[:rows].astype(np.int64) - self._action_start
            columns["next_state"] = last.astype(np.int64) - self._state_start
        else:
            columns["action"], columns["next_observation"] = self._actions[:rows], last
            columns["acted"] = np.ones((rows, n), np.uint32)
            columns["agents_terminated"], columns["agents_truncated"] = terminated, truncated
        flat = {name: values.reshape(rows * n, *values.shape[2:]) for name, values in columns.items()}
        self._record(self._topics.steps, flat, first + np.arange(1, rows * n + 1))

    def _put_block_resets(self, episode: Ints, only_reset: Flags, first: int) -> None:
        """Record the resets between and within the steps of the block, in their order.

        Args:
            episode: [rows + 1, N], the number of the episode that each belongs to, and of the next one.
        """
        # NEXT_STEP: resets in place of a step come after those that the user called before it.
        only_rows, only = np.nonzero(only_reset)
        own = zip(only_rows.tolist(), only.tolist(), strict=True)
        own_states = [self._autoreset_states.get(row, {}).get(i) for row, i in own]
        observed = self._observations[only_rows, only]
        resets = [
            *self._block_resets,
            ResetsBetween(only_rows, only, observed, [None] * len(only), own_states),
        ]
        rows = np.concatenate([reset.row for reset in resets])
        if not len(rows):
            return
        order = np.argsort(rows, kind="stable")
        which = np.concatenate([reset.which for reset in resets])[order]
        observation = np.concatenate([reset.observation for reset in resets])[order]
        pairs = [pair for reset in resets for pair in zip(reset.seeds, reset.states, strict=True)]
        seeds, states = zip(*(pairs[k] for k in order.tolist()), strict=True)
        at = rows[order]
        self._put_resets(which, observation, seeds, states, episode[at, which], first + at * self._n)

    def _put_ends(self, ended: Columns) -> None:
        """Record the ends of episodes, in the order in which they ended."""
        self._record(self._topics.episodes, ended, ended["last_step"] + 1)

    def _put_resets(
        self,
        which: NDArray[np.intp],
        observation: Array,
        seeds: Sequence[int | None],
        states: Sequence[ResetState | None],
        episode: Ints,
        steps: Array,
    ) -> None:
        """Record resets in their order; `steps` are the steps of the phase before each."""
        valid = [seed if seed is not None and 0 <= seed <= MAX_SEED else None for seed in seeds]
        columns = {
            "observation": observation,
            "reset": self._reset_count + np.arange(len(which)),
            "episode": episode,
            "step": steps,
            "environment": which,
            "seed": np.array([seed or 0 for seed in valid], np.uint64),
            "seeded": np.array([seed is not None for seed in valid], np.bool_),
        }
        self._record(self._topics.resets, columns, steps)
        other = self._recorder.position - self._recorder.steps[self._phase]
        for k, state in enumerate(states):
            if state is not None:
                payload = state._replace(reset=self._reset_count + k).to_payload()
                self._recorder.append(self._topics.reset_states, payload, other + int(steps[k]))
        self._reset_count += len(which)

    def _record(self, topic: Topic, columns: Columns, steps: Array) -> None:
        """Hand records, given by field, to the recorder; `steps` are the steps of the phase at each."""
        other = self._recorder.position - self._recorder.steps[self._phase]
        self._recorder.put(topic, columns, steps + other)


PhaseRows = Rows | VectorRows
"""The steps of one phase, as a loop uses them. Not thread-safe: the caller holds the loop's lock."""
