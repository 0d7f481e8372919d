"""The steps of one phase of a loop: put down as they come, completed and committed some thousands at a time.

What a step brings is written to its final place; what follows from the order of steps (their numbers, the
state before each, the lengths of episodes) is computed for a whole block at once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import step_counts
from runner.loops.description import Described
from runner.loops.values import warn_user
from runner.recording import schema
from runner.recording.episode_log import Columns, EpisodeLog, Flags, Steps
from runner.recording.gym_values import leaves_of
from runner.recording.recorder import BLOCK_BYTES, Recorder
from runner.util.arrays import Ints

MAX_SEED: Final = 2**64 - 1
"""The largest seed that the record of a reset holds."""


class Rows:
    """The rows of one phase of one environment that are not committed yet, and the state of its episodes.

    Args:
        first_action: called with the first action of the phase before it is put down; may call `reshape`.
    """

    _scratch_dtype: np.dtype[np.void]
    """What a step brings that waits until its block is completed: `rewards`, `terminated`, `truncated`."""
    _scratch: NDArray[np.void] = np.zeros(0, "V1")

    def __init__(
        self, recorder: Recorder, described: Described, phase: str, first_action: Callable[[object], None]
    ) -> None:
        self._first_action = first_action
        self._set_leaves(described)
        self._topics = schema.topics_of(described.kind, phase)
        self._recorder = recorder
        self._phase = phase
        self._mdp = described.mdp
        self._log = EpisodeLog(
            1, recorder.dtype(self._topics.episodes)["returns"].shape[0], self._mdp, zero=-0.0
        )
        self.off_table = 0
        """Committed steps whose reward the environment's table excludes; 0 without a table."""
        self.filled = 0
        """Rows that are not committed."""
        self._room = 0
        self._reset_rows: list[int] = []
        self._seeds: list[int | None] = []
        self._fresh = True
        """Whether the next step begins an episode."""
        self._begun = 0
        """Episodes that have begun."""
        self._reset_count = 0
        self._last_position = 0

    @property
    def place(self) -> tuple[int, int]:
        """The steps of the phase so far, and the number of the episode that began last; 0 before any."""
        return self._recorder.steps[self._phase] + self.filled, max(self._begun - 1, 0)

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
        if seed is not None and not 0 <= seed <= MAX_SEED:
            seed = None
        self._put_reset(observation, seed)
        self._fresh = True
        self._reset_rows.append(self.filled)
        self._seeds.append(seed)
        if len(self._reset_rows) >= self._reset_room:
            self.commit()
            self.open()

    def _count(self, is_over: object) -> None:
        """Count the row that was just put down; `is_over` is whether the episode ended with it."""
        self._begun += self._fresh
        self._fresh = bool(is_over)
        self.filled += 1
        if self.filled == self._room:
            self.commit()
            self._recorder.write_if_full()
            self.open()

    def _set_leaves(self, described: Described) -> None:
        self._action_leaves = leaves_of(described.recorded_action, "action", on_rounded=warn_user)
        self._observation_leaves = leaves_of(described.observation, "observation", on_rounded=warn_user)

    def reshape(self, described: Described) -> None:
        """Take new blocks for actions of another dtype, before the first step."""
        self._set_leaves(described)
        self.open()

    def _hold(self, *values: bytes) -> None:
        """Count the bytes of values of varying size; with many of them, the block is full."""
        self._held += sum(map(len, values))
        if self._held > BLOCK_BYTES:
            self._room, self._reset_room = self.filled + 1, len(self._reset_rows) + 1

    # --- blocks ---------------------------------------------------------------------------------------

    def open(self) -> None:
        """Take the free part of the recorder's blocks, to put rows into."""
        self._room, self._reset_room = self._open_steps()

    def commit(self) -> None:
        """Complete what was put down and hand it to the recorder; then `open` again."""
        n, before, first = self.filled, self._recorder.position, self._recorder.steps[self._phase]
        if not (n or self._reset_rows):
            return
        resets, transitions = np.array(self._reset_rows, np.int64), self._transitions(n)
        numbers = np.empty(0, np.int64)
        if n:
            episodes = self._log.take(self._as_steps(n, first, resets, transitions))
            numbers = episodes.number[:, 0]
            self._finish_steps(n, numbers, episodes.t[:, 0], before)
            self._put_ends(episodes.ended, first, before)
        if len(resets):
            if resets[-1] == n:
                self._put_ends(self._log.interrupt(first + n, np.zeros(1, np.int64)), first, before)
            self._finish_resets(np.append(numbers, self._log.episode)[resets], resets + first, before - first)
            self._reset_count += len(resets)
        self._recorder.steps[self._phase] += n
        if n:
            self._last_position = before + n
        self.filled = 0
        self._reset_rows, self._seeds = [], []

    def _as_steps(self, n: int, first: int, resets: Ints, transitions: tuple[Ints, Ints, Ints]) -> Steps:
        """Return the first n rows as steps of one environment; `resets` are the rows after resets."""
        rows, is_over = self._outcomes(n)
        rewards, was_reset = rows["rewards"].reshape(n, 1, -1), self._begins(n)
        was_reset[resets[resets < n]] = True
        counts = None
        if self._mdp is not None:
            counts, excluded = step_counts(self._mdp, rewards[:, 0, 0], *transitions)
            self.off_table += int(np.count_nonzero(excluded))
            counts = counts[:, np.newaxis]
        ends = rows["terminated"][:, np.newaxis], rows["truncated"][:, np.newaxis]
        return Steps(first, rewards, *ends, was_reset[:, np.newaxis], is_over=is_over, counts=counts)

    def _put_ends(self, ended: Columns, first: int, before: int) -> None:
        """Record the ends of episodes, each at the time of its last step, which may be committed already."""
        rows = ended["last_step"].astype(np.int64) - first
        self._recorder.put(
            self._topics.episodes, ended, np.where(rows < 0, self._last_position, before + rows + 1)
        )

    def _finish_resets(self, episode: Ints, step: Ints, other: int) -> None:
        """Complete the records of resets; `other` are the steps of the other phase before them."""
        n = len(step)
        block = self._recorder.block(self._topics.resets)[:n]
        block["reset"] = self._reset_count + np.arange(n)
        block["episode"], block["step"] = episode, step
        block["seed"] = [seed or 0 for seed in self._seeds]
        block["seeded"] = [seed is not None for seed in self._seeds]
        self._recorder.take(self._topics.resets, (step + other).astype(np.uint64))

    # --- what differs by the kind of spaces -----------------------------------------------------------

    def _open_steps(self) -> tuple[int, int]:
        """Take blocks of steps and resets; return the room in each."""
        self._block = self._recorder.block(self._topics.steps)
        self._reset_block = self._recorder.block(self._topics.resets)
        self._are_bytes, self._held = self._block.dtype.hasobject, 0
        room = len(self._block)
        if len(self._scratch) < room:
            self._scratch = np.zeros(room, self._scratch_dtype)
            self._bytes = self._scratch.view(np.uint8).data
        return room, len(self._reset_block)

    def _put_reset(self, observation: object, seed: int | None) -> None:
        raise NotImplementedError

    def _outcomes(self, n: int) -> tuple[NDArray[np.void], Flags | bool]:
        """Return what the first n steps brought, and where a game ended without the end of any agent."""
        return self._scratch[:n], False

    def _begins(self, n: int) -> Flags:
        """Return before which of the first n rows an episode begins in any case, besides resets."""
        return np.zeros(n, np.bool_)

    def _transitions(self, n: int) -> tuple[Ints, Ints, Ints]:  # noqa: ARG002
        """Return state, action and next state of the first n rows; empty arrays without states."""
        nothing = np.empty(0, np.int64)
        return nothing, nothing, nothing

    def _finish_steps(self, n: int, episode: Ints, t: Ints, before: int) -> None:
        """Complete the records of the first n rows and hand them to the recorder."""
        block, rows = self._block[:n], self._scratch[:n]
        block["rewards"] = rows["rewards"].reshape(n, -1)
        block["terminated"], block["truncated"] = rows["terminated"], rows["truncated"]
        block["step"] = self._recorder.steps[self._phase] + np.arange(n)
        block["episode"] = episode
        block["t"] = t
        self._recorder.take(self._topics.steps, np.arange(before + 1, before + n + 1, dtype=np.uint64))
