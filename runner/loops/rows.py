"""The steps of one phase of a loop: put down as they come, completed and recorded some thousands at a time.

N environments step at once, in turn, and one alone is N = 1. What follows from the order of steps (their
numbers, the state before each, the lengths and returns of episodes) is computed for a whole block at once.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from runner.environments.mdp import Mdp, step_counts
from runner.errors import RecordingError
from runner.loops.description import Described
from runner.loops.values import require_reset, warn_user
from runner.recording import schema
from runner.recording.episode_log import Columns, EpisodeLog, Flags, Steps
from runner.recording.gym_values import Put, leaves_of
from runner.recording.recorder import BLOCK_BYTES, Recorder
from runner.recording.reset_options import ResetOptions
from runner.recording.reset_states import ResetState
from runner.util.arrays import Array, Ints, Records, zeros

MAX_SEED: Final = 2**64 - 1
"""The largest seed that the record of a reset holds."""
_MAX_STATE: Final = 2**32 - 1
_RESET: Final = [("row", "<i8"), ("environment", "<i8"), ("seed", "<u8"), ("seeded", "?")]
"""What is kept of a reset until it is recorded, besides its observation: the row that comes after it."""


class Rows:
    """The rows of one phase that are not committed yet, and the state of its episodes.

    Not thread-safe: the caller holds the loop's lock.

    Args:
        first_action: called with the first action of the phase before it is put down; may call `reshape`.
    """

    def __init__(
        self, recorder: Recorder, described: Described, phase: str, first_action: Callable[[object], None]
    ) -> None:
        # Python reads attributes slower if there are more than 30, and some are read at each step.
        self._recorder, self._first_action = recorder, first_action
        self._topics = schema.topics_of(phase)
        self._mdp, self._n = described.mdp, described.environments
        learners = recorder.dtype(self._topics.episodes)["returns"].shape[0]
        self._log = EpisodeLog(self._n, learners, self._mdp, described.layout.has_turns, zero=-0.0)
        observation = recorder.dtype(self._topics.resets)["observation"]
        self._are_bytes = observation.hasobject
        """Whether values vary in size."""
        self._held = 0
        """The bytes of such values in the block."""
        self.off_table = 0
        """Committed steps whose reward the environment's table excludes; 0 without a table."""
        self._filled, self._room = 0, 0
        """Rows of the block that are in use, and with how many it is full."""
        self._scratch: Records = np.zeros(
            0, [("rewards", "<f8", (self._n, learners)), ("ends", "?", (2, self._n))]
        )
        """The rewards of each row, and whether it terminated or truncated the episodes."""
        self.resets = 0
        """The number of resets so far."""
        room = max(recorder.capacity(self._topics.resets), self._n)
        self._resets = np.zeros(room, [*_RESET, ("observation", observation)])
        self._waiting, self._reset_room = 0, room
        """Resets that are not committed, and the most of them."""
        self._attached: dict[int, list[ResetOptions | ResetState]] = defaultdict(list)
        """The options and states of those resets, by their place, where there are some."""
        self._state = np.zeros(self._n, np.int64)
        """The observations before the first row, where both spaces are discrete."""
        self._last_position = 0
        """The steps of the run up to the last committed row: of this phase, in a vector of either."""
        self._starts: tuple[int, ...] = ()
        """The least observation and action, where both spaces are discrete."""
        self.reshape(described)

    def reshape(self, described: Described) -> None:
        """Prepare for actions of another dtype, before the first step."""
        if described.layout.has_states:
            spaces = described.observation, described.action
            self._starts = tuple(int(space.start) for space in spaces)  # type: ignore[attr-defined]
        self._leaves: tuple[Any, Any] = (
            leaves_of(described.observation, "observation", on_rounded=warn_user),
            leaves_of(described.recorded_action, "action", on_rounded=warn_user),
        )

    @property
    def _phase(self) -> str:
        return self._topics.steps.phase

    @property
    def filled(self) -> int:
        """Rows of single environments that the recorder does not have yet, also those that only reset one."""
        return self._filled * self._n

    @property
    def place(self) -> tuple[int, int]:
        """The steps of the phase so far, and the number of an episode."""
        raise NotImplementedError

    # --- the block ------------------------------------------------------------------------------------

    def _begin(self, action: object) -> None:
        """Allocate the block before the first step: with its action, the dtype of all is known.

        Raises:
            ResetNeeded: there was no reset.
        """
        require_reset(self.resets, self._phase)
        self._first_action(action)
        self._room = max(1, self._recorder.capacity(self._topics.steps) // self._n)
        self._allocate()

    def _allocate(self) -> None:
        """Make room for rows: actions and observations [rows, N, ...], and what else a step brings."""
        shape, steps = (self._room, self._n), self._recorder.dtype(self._topics.steps)
        self._actions = zeros(shape, np.dtype(np.int64) if self._starts else steps["action"])
        self._observations = zeros(shape, self._resets.dtype["observation"])
        self._scratch = np.zeros(self._room, self._scratch.dtype)
        self._put_observation, self._put_action = map(
            self._filler, self._leaves, (self._observations, self._actions)
        )

    def _filler(self, leaves: Any, column: Array) -> Put:
        """Return a function that puts a value of all environments into a row of a column [rows, N, ...]."""
        raise NotImplementedError

    def _hold(self, *values: bytes) -> None:
        """Count the bytes of values of varying size; with many of them, the block is full."""
        self._held += sum(map(len, values))
        if self._held > BLOCK_BYTES:
            self._room = min(self._room, self._filled + 1)  # still 0 before the first step
            self._reset_room = self._waiting + 1

    def _put_seed(self, k: int, seed: int | None, options: str) -> None:
        """Put down the seed and the options, as JSON, of the reset in a place."""
        is_large = seed is not None and seed > MAX_SEED
        if seed is not None and 0 <= seed <= MAX_SEED:
            self._resets["seed"][k], self._resets["seeded"][k] = seed, True
        if options or is_large:
            self._attached[k].append(ResetOptions(json=options, large_seed=seed if is_large else None))

    # --- records --------------------------------------------------------------------------------------

    def commit(self) -> None:
        """Make the records of what was put down and hand them to the recorder."""
        rows, n, before = self._filled, self._n, self._recorder.position
        first = self._recorder.steps[self._phase]
        if not (rows or self._waiting):
            return
        resets = self._resets[: self._waiting]
        was_reset = np.zeros((rows + 1, n), np.bool_)
        was_reset[resets["row"], resets["environment"] % n] = True
        number = np.empty((0, n), np.int64)
        if rows:
            begins, only_reset, is_over = self._turns(was_reset[:-1])
            rewards, both = self._scratch["rewards"][:rows], self._scratch["ends"][:rows]
            terminated, truncated = both[:, 0], both[:, 1]
            columns = self._values(rows, resets, only_reset)
            columns |= {"rewards": rewards, "terminated": terminated, "truncated": truncated}
            ends = rewards, terminated, truncated
            counts = None if self._mdp is None else self._counts(self._mdp, columns)
            environment = columns.get("environment")
            steps = Steps(first, *ends, begins, only_reset, is_over, counts, environment)
            episodes = self._log.take(steps)
            number = episodes.number
            columns["step"] = first + np.arange(rows * n).reshape(rows, n)
            columns |= {"episode": number, "t": episodes.t}
            if "taken" in (self._recorder.dtype(self._topics.steps).names or ()):
                columns.setdefault("environment", np.broadcast_to(np.arange(n), (rows, n)))
                columns["taken"] = np.broadcast_to(np.logical_not(only_reset), (rows, n))
            flat = {name: values.reshape(rows * n, *values.shape[2:]) for name, values in columns.items()}
            self._recorder.put(self._topics.steps, flat, np.arange(before + 1, before + 1 + rows * n))
            self._put_ends(episodes.ended, first, before)
        if self._waiting:
            resets = self._resets[: self._waiting]
            last = resets[resets["row"] == rows]
            cut = list(dict.fromkeys((last["environment"] % n).tolist()))
            if self._starts:
                self._state[last["environment"] % n] = last["observation"]
            ended = self._log.interrupt(first + rows * n, np.array(cut, np.int64))
            self._put_ends(ended, first, before)
            self._put_resets(np.vstack([number, self._log.episode]), first, before)
            resets["seed"], resets["seeded"] = 0, False
        self._recorder.steps[self._phase] += rows * n
        if rows:
            self._last_position = before + rows * n
        self._filled = self._waiting = self._held = 0
        self._room, self._reset_room = len(self._scratch), len(self._resets)

    def _turns(self, was_reset: Flags) -> tuple[Flags, Flags | bool, Flags | bool]:
        """Return `was_reset`, `only_reset` and `is_over` of the `Steps`; put down the resets among these.

        Args:
            was_reset: [rows, N], where resets were put down so far.
        """
        return was_reset, False, False

    def _values(self, rows: int, resets: Records, only_reset: Flags | bool) -> Columns:
        """Return the fields of the records that follow from the values of the spaces, [rows, N, ...].

        Args:
            resets: those besides `only_reset`.
        """
        actions, after = self._actions[:rows], self._observations[:rows]
        if not self._starts:
            return {"action": actions, "next_observation": after}
        least_state, least_action = self._starts
        state = np.vstack([self._state, after])
        self._state = state[-1].copy()
        state[resets["row"], resets["environment"]] = resets["observation"]
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

    def _counts(self, mdp: Mdp, columns: Columns) -> Ints:
        """Return the events and penalties of each step, and count those that the table excludes."""
        names = ("state", "action", "next_state")
        transitions = (columns[name].ravel().astype(np.int64, copy=False) for name in names)
        counts, excluded = step_counts(mdp, self._scratch["rewards"][: self._filled, 0, 0], *transitions)
        self.off_table += int(np.count_nonzero(excluded))
        return counts[:, np.newaxis]

    def _put_ends(self, ended: Columns, first: int, before: int) -> None:
        """Record the ends of episodes, each at the time of its last step, which may be committed already."""
        rows = ended["last_step"].astype(np.int64) - first
        positions = np.where(rows < 0, self._last_position, before) + rows + 1
        self._recorder.put(self._topics.episodes, ended, positions)

    def _put_resets(self, episode: Ints, first: int, before: int) -> None:
        """Record the resets in their order; `episode` is [rows + 1, N]."""
        order = np.argsort(self._resets["row"][: self._waiting], kind="stable")
        resets = self._resets[order]
        steps, number = resets["row"] * self._n, self.resets - self._waiting
        columns = {name: resets[name] for name in ("environment", "seed", "seeded", "observation")}
        columns["episode"] = episode[resets["row"], resets["environment"] % self._n]
        columns |= {"reset": number + np.arange(len(order)), "step": first + steps}
        self._recorder.put(self._topics.resets, columns, before + steps)
        for place, k in enumerate(order.tolist() if self._attached else ()):
            for attached in self._attached.get(k, ()):
                is_state = isinstance(attached, ResetState)
                topic = self._topics.reset_states if is_state else self._topics.reset_options
                payload = attached._replace(reset=number + place).to_payload()
                self._recorder.append(topic, payload, before + int(steps[place]))
        self._attached.clear()
