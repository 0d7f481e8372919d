"""The steps of one phase of a loop: put down as they come, completed and committed some thousands at a time.

What a step brings is written to its final place; what follows from the order of steps (their numbers, the
state before each, the lengths of episodes) is computed for a whole block at once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import Mdp, step_counts
from runner.loops.description import Described
from runner.loops.values import warn_user
from runner.recording import schema
from runner.recording.gym_values import leaves_of
from runner.recording.recorder import Recorder
from runner.util.arrays import Ints

MAX_SEED: Final = 2**64 - 1
"""The largest seed that the record of a reset holds."""


class Rows:
    """The rows of one phase of one environment that are not committed yet, and the state of its episodes.

    Args:
        first_action: called with the first action of the phase before it is put down; may call `reshape`.
    """

    def __init__(
        self, recorder: Recorder, described: Described, phase: str, first_action: Callable[[object], None]
    ) -> None:
        self._first_action = first_action
        self._set_leaves(described)
        topics = {topic.name: topic for topic in schema.KINDS[described.kind]}
        self._recorder = recorder
        self._phase = phase
        self._steps = topics[f"/{phase}/step"]
        self._episodes = topics[f"/{phase}/episode"]
        self._resets = topics[f"/{phase}/reset"]
        self._counter = EpisodeCounter(described.mdp)
        self.filled = 0
        """Rows that are not committed."""
        self._room = 0
        self._begins: list[int] = []
        """Rows at which an episode begins."""
        self._ends: list[tuple[int, float | NDArray[np.float64], bool, bool]] = []
        """Rows at which one ends (-1: the last committed), its return, terminated, truncated."""
        self._reset_rows: list[int] = []
        self._seeds: list[int | None] = []
        self._fresh = True
        """Whether the next step begins an episode."""
        self._return: float | NDArray[np.float64] = 0.0
        self._episode = -1
        """The number of the episode in progress at the first row."""
        self._t = 0
        """The steps of that episode before that row."""
        self._ended = 0
        self._reset_count = 0
        self._last_position = 0

    @property
    def off_table(self) -> int:
        """Steps so far whose reward the environment's table excludes; 0 without a table."""
        return self._counter.off_table

    @property
    def place(self) -> tuple[int, int]:
        """The steps of the phase so far, and the number of the episode that began last; 0 before any."""
        began = self._episode + len(self._begins)
        return self._recorder.steps[self._phase] + self.filled, began if began > 0 else 0

    # --- what a loop does -----------------------------------------------------------------------------

    def take(
        self,
        action: object,
        observation: object,
        reward: SupportsFloat,
        terminated: object,
        truncated: object,
    ) -> None:
        """Put down a step."""
        raise NotImplementedError

    @property
    def resets(self) -> int:
        """The number of resets so far."""
        return self._reset_count + len(self._reset_rows)

    def reset(self, observation: object, seed: int | None) -> None:
        """Put down a reset; it ends an episode in progress, neither terminated nor truncated."""
        if not self._room:  # it is the first one
            self.open()
        if not self._fresh:
            self._end(self.filled - 1, False, False)
        if seed is not None and not 0 <= seed <= MAX_SEED:
            seed = None
        self._put_reset(observation, seed)
        self._reset_rows.append(self.filled)
        self._seeds.append(seed)
        if len(self._reset_rows) >= self._reset_room or len(self._ends) >= self._episode_room:
            self.commit()
            self.open()

    def _count(self, reward: float | NDArray[np.float64], terminated: object, truncated: object) -> None:
        """Count the row that was just put down."""
        row = self.filled
        if self._fresh:
            self._begins.append(row)
            self._fresh = False
            self._return = reward
        else:
            self._return += reward
        self.filled = row + 1
        if terminated or truncated:
            self._end(row, bool(terminated), bool(truncated))
        if self.filled == self._room or len(self._ends) >= self._episode_room:
            self.commit()
            self.open()

    def _end(self, row: int, terminated: bool, truncated: bool) -> None:
        self._ends.append((row, self._return, terminated, truncated))
        self._fresh = True

    def _set_leaves(self, described: Described) -> None:
        self._action_leaves = leaves_of(described.recorded_action, "action", on_rounded=warn_user)
        self._observation_leaves = leaves_of(described.observation, "observation", on_rounded=warn_user)

    def reshape(self, described: Described) -> None:
        """Take new blocks for actions of another dtype, before the first step."""
        self._set_leaves(described)
        self.open()

    # --- blocks ---------------------------------------------------------------------------------------

    def open(self) -> None:
        """Take the free part of the recorder's blocks, to put rows into."""
        self._episode_room = len(self._recorder.block(self._episodes))
        self._room, self._reset_room = self._open_steps()

    def commit(self) -> None:
        """Complete what was put down and hand it to the recorder; then `open` again."""
        n, before = self.filled, sum(self._recorder.steps.values())
        if not (n or self._ends or self._reset_rows):
            return
        begins = np.array(self._begins, np.int64)
        rows = np.arange(n)
        started = np.searchsorted(begins, rows, side="right")
        starts = np.concatenate([[-self._t], begins])
        self._counter.count(self._rewards(n), *self._transitions(n))
        if n:
            self._finish_steps(n, self._episode + started, rows - starts[started], before)
        if self._reset_rows:
            self._finish_resets(begins, before)
        if self._ends:
            self._finish_episodes(begins, starts, before)
        self._counter.carry(int(starts[-1]))
        self._episode += len(begins)
        self._t = n - int(starts[-1])
        self._recorder.steps[self._phase] += n
        if n:
            self._last_position = before + n
        self.filled = 0
        self._begins, self._ends, self._reset_rows, self._seeds = [], [], [], []

    def _finish_episodes(self, begins: Ints, starts: Ints, before: int) -> None:
        rows = np.array([end[0] for end in self._ends], np.int64)
        first = starts[np.searchsorted(begins, rows, side="right")]
        n = len(rows)
        block = self._recorder.block(self._episodes)[:n]
        block["episode"] = self._ended + np.arange(n)
        block["last_step"] = self._recorder.steps[self._phase] + rows
        block["length"] = rows - first + 1
        block["returns"] = np.array([end[1] for end in self._ends]).reshape(n, -1)
        block["terminated"] = [end[2] for end in self._ends]
        block["truncated"] = [end[3] for end in self._ends]
        self._counter.fill(block, first, rows)
        positions = np.where(rows < 0, self._last_position, before + rows + 1)
        self._recorder.take(self._episodes, positions.astype(np.uint64))
        self._ended += n

    def _finish_resets(self, begins: Ints, before: int) -> None:
        n = len(self._reset_rows)
        rows = np.array(self._reset_rows, np.int64)
        block = self._recorder.block(self._resets)[:n]
        block["reset"] = self._reset_count + np.arange(n)
        block["episode"] = self._episode + 1 + np.searchsorted(begins, rows, side="left")
        block["step"] = self._recorder.steps[self._phase] + rows
        block["seed"] = [seed or 0 for seed in self._seeds]
        block["seeded"] = [seed is not None for seed in self._seeds]
        self._recorder.take(self._resets, (rows + before).astype(np.uint64))
        self._reset_count += n

    # --- what differs by the kind of spaces -----------------------------------------------------------

    def _open_steps(self) -> tuple[int, int]:
        """Take blocks of steps and resets; return the room in each."""
        raise NotImplementedError

    def _put_reset(self, observation: object, seed: int | None) -> None:
        raise NotImplementedError

    def _rewards(self, n: int) -> NDArray[np.float64]:
        raise NotImplementedError

    def _transitions(self, n: int) -> tuple[Ints, Ints, Ints]:  # noqa: ARG002
        """Return state, action and next state of the first n rows; empty arrays without states."""
        nothing = np.empty(0, np.int64)
        return nothing, nothing, nothing

    def _finish_steps(self, n: int, episode: Ints, t: Ints, before: int) -> None:
        """Complete the records of the first n rows and hand them to the recorder."""
        raise NotImplementedError


class EpisodeCounter:
    """Counts penalties and events of episodes, where the environment's arrays define them."""

    def __init__(self, mdp: Mdp | None) -> None:
        self._mdp = mdp
        self.off_table = 0
        """Steps whose reward the environment's table excludes: a wrapper changed it, or a rule of its own."""
        self._counts = np.zeros((1, 1), np.int64)
        """[rows + 1, events + 1]: events and penalties before each row, counted from the first."""
        self._carried = np.zeros(1 + (len(mdp.event_names) if mdp else 0), np.int64)
        """Those of the episode in progress, before the first row."""

    def count(self, rewards: NDArray[np.float64], state: Ints, action: Ints, next_state: Ints) -> None:
        """Count the events of rows."""
        if self._mdp is not None:
            bits = np.zeros((len(rewards) + 1, len(self._carried)), np.int64)
            bits[1:], excluded = step_counts(self._mdp, rewards, state, action, next_state)
            self.off_table += int(np.count_nonzero(excluded))
            self._counts = bits.cumsum(axis=0)

    def fill(self, episodes: NDArray[np.void], first: Ints, last: Ints) -> None:
        """Fill in the counts of episodes from their first and last rows; rows below 0 are carried."""
        if self._mdp is None:
            return
        counts = self._counts[last + 1] - self._counts[np.maximum(first, 0)]
        counts[first < 0] += self._carried
        episodes["penalties"] = counts[:, -1]
        episodes["events"] = counts[:, :-1]
        success = [self._mdp.event_names.index(name) for name in self._mdp.success_events]
        episodes["success"] = (counts[:, success] > 0).any(axis=1)

    def carry(self, start: int) -> None:
        """Keep the counts of the episode that began at this row for the rows to come."""
        if self._mdp is not None:
            before = self._carried if start < 0 else 0
            self._carried = self._counts[-1] - self._counts[max(start, 0)] + before
