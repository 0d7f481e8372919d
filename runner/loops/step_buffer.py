"""The steps of one phase of a loop: put down as they come, completed and committed some thousands at a time.

What a step brings is put where it will be written from; what follows from the order of steps (their
numbers, the state before each, the lengths of episodes) is computed for a whole block at once.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.loops.episode_events import Judge
from runner.loops.spaces import Described, parts_of
from runner.loops.values import filler, leaves, lone_number, require_reset, value_bytes, whole_number
from runner.recording import schema
from runner.recording.messages import encode
from runner.recording.recorder import Recorder

_DISCRETE: Final = struct.Struct("<qqd??")
_DISCRETE_DTYPE: Final = np.dtype(
    [("action", "<i8"), ("next_state", "<i8"), ("reward", "<f8"), ("terminated", "?"), ("truncated", "?")]
)
_ENDING: Final = struct.Struct("<d??")
_ENDING_DTYPE: Final = np.dtype([("reward", "<f8"), ("terminated", "?"), ("truncated", "?")])
_VARIABLE_ROWS: Final = 4096
_LARGEST: Final = 2**32 - 1


class Rows:
    """The rows of one phase of one environment that are not committed yet, and how its episodes stand.

    Not thread-safe: whoever calls holds the loop's lock.

    Args:
        recorder: takes them.
        described: the environment and its spaces.
        phase: `train` or `eval`.
        first_action: called with the first action of the phase before it is put down; may call `reshape`.
    """

    def __init__(
        self, recorder: Recorder, described: Described, phase: str, first_action: Callable[[Any], None]
    ) -> None:
        self._first_action = first_action
        self._set_leaves(described)
        topics = {topic.name: topic for topic in schema.KINDS[described.kind]}
        self._recorder = recorder
        self._phase = phase
        self._steps = topics[f"/{phase}/step"]
        self._episodes = topics[f"/{phase}/episode"]
        self._resets = topics[f"/{phase}/reset"]
        self._judge = Judge(described.mdp)
        self.filled = 0
        """Rows that are not committed."""
        self._room = 0
        self._begins: list[int] = []
        """Rows at which an episode begins."""
        self._ends: list[tuple[int, float, bool, bool]] = []
        """Rows at which one ends (-1: the last committed), its return, terminated, truncated."""
        self._reset_rows: list[int] = []
        self._seeds: list[int | None] = []
        self._fresh = True
        """Whether the next step begins an episode."""
        self._return = 0.0
        self._episode = -1
        """Number of the episode under way at the first row."""
        self._t = 0
        """Its steps before that row."""
        self._ended = 0
        self._were_reset = 0
        self._last_position = 0
        self.open()

    @property
    def off_table(self) -> int:
        """Steps so far whose reward the environment's table excludes; 0 without a table."""
        return self._judge.off_table

    @property
    def place(self) -> tuple[int, int]:
        """The steps of the phase so far, and the number of the episode that began last; 0 before any."""
        began = self._episode + len(self._begins)
        return self._recorder.steps[self._phase] + self.filled, began if began > 0 else 0

    @property
    def _coming(self) -> int:
        """The number of the episode that the next step belongs to."""
        return self._episode + len(self._begins) + self._fresh

    # --- what a loop does -----------------------------------------------------------------------------

    def take(self, action: Any, observation: Any, reward: Any, terminated: Any, truncated: Any) -> None:
        """Put down a step."""
        raise NotImplementedError

    def reset(self, observation: Any, seed: int | None) -> None:
        """Put down a reset; an episode under way ends by it, neither terminated nor truncated."""
        if not self._fresh:
            self._end(self.filled - 1, False, False)
        if seed is not None and not 0 <= seed < 2**64:
            seed = None
        self._put_reset(observation, seed)
        self._reset_rows.append(self.filled)
        self._seeds.append(seed)
        if len(self._reset_rows) >= self._reset_room or len(self._ends) >= self._episode_room:
            self.commit()
            self.open()

    def _count(self, reward: float, terminated: Any, truncated: Any) -> None:
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
        if self.filled == self._room or len(self._ends) == self._episode_room:
            self.commit()
            self.open()

    def _end(self, row: int, terminated: bool, truncated: bool) -> None:
        self._ends.append((row, self._return, terminated, truncated))
        self._fresh = True

    def _set_leaves(self, described: Described) -> None:
        self._action_leaves = leaves(parts_of(described.recorded_action, "the action space"), "action")
        self._observation_leaves = leaves(
            parts_of(described.observation, "the observation space"), "observation"
        )

    def reshape(self, described: Described) -> None:
        """Take blocks anew for actions of another dtype; no step was put down yet."""
        self._set_leaves(described)
        self.open()

    # --- blocks ---------------------------------------------------------------------------------------

    def open(self) -> None:
        """Take the free part of the recorder's blocks, to put rows into."""
        self._episode_room = len(self._recorder.block(self._episodes))
        self._room, self._reset_room = self._open_steps()

    def commit(self) -> None:
        """Complete what was put down and hand it to the recorder; then `open` again.

        Raises:
            StorageError: the disk is full or failing.
        """
        n, before = self.filled, sum(self._recorder.steps.values())
        if not (n or self._ends or self._reset_rows):
            return
        begins = np.array(self._begins, np.int64)
        rows = np.arange(n)
        started = np.searchsorted(begins, rows, side="right")
        starts = np.concatenate([[-self._t], begins])
        self._judge.judge(self._rewards(n), *self._transitions(n))
        if n:
            self._finish_steps(n, self._episode + started, rows - starts[started], before)
        self._finish_resets(before)
        if self._ends:
            self._finish_episodes(begins, starts, before)
        self._judge.carry(int(starts[-1]))
        self._episode += len(begins)
        self._t = n - int(starts[-1])
        self._recorder.steps[self._phase] += n
        if n:
            self._last_position = before + n
        self.filled = 0
        self._begins, self._ends, self._reset_rows, self._seeds = [], [], [], []

    def _finish_episodes(self, begins: NDArray[Any], starts: NDArray[Any], before: int) -> None:
        """Write the records of the episodes that ended."""
        rows = np.array([end[0] for end in self._ends], np.int64)
        first = starts[np.searchsorted(begins, rows, side="right")]
        n = len(rows)
        block = self._recorder.block(self._episodes)[:n]
        block["episode"] = self._ended + np.arange(n)
        block["last_step"] = self._recorder.steps[self._phase] + rows
        block["length"] = rows - first + 1
        block["returns"] = np.array([end[1] for end in self._ends])[:, np.newaxis]
        block["terminated"] = [end[2] for end in self._ends]
        block["truncated"] = [end[3] for end in self._ends]
        self._judge.fill(block, first, rows)
        positions = np.where(rows < 0, self._last_position, before + rows + 1)
        self._recorder.take(self._episodes, positions.astype(np.uint64))
        self._ended += n

    def _number_resets(self, block: NDArray[Any]) -> None:
        """Fill in all of the reset records but the observations."""
        n = len(self._reset_rows)
        rows = np.array(self._reset_rows, np.int64)
        began = np.searchsorted(np.array(self._begins, np.int64), rows, side="left")
        block["reset"] = self._were_reset + np.arange(n)
        block["episode"] = self._episode + 1 + began
        block["step"] = self._recorder.steps[self._phase] + rows
        block["seed"] = [seed or 0 for seed in self._seeds]
        block["seeded"] = [seed is not None for seed in self._seeds]

    def _finish_resets(self, before: int) -> None:
        """Complete the reset records and hand them to the recorder."""
        n = len(self._reset_rows)
        if not n:
            return
        self._number_resets(self._recorder.block(self._resets)[:n])
        self._recorder.take(self._resets, np.array(self._reset_rows, np.uint64) + np.uint64(before))
        self._were_reset += n

    # --- what differs by the kind of spaces -----------------------------------------------------------

    def _open_steps(self) -> tuple[int, int]:
        """Take blocks of steps and resets; return the room in each."""
        raise NotImplementedError

    def _put_reset(self, observation: Any, seed: int | None) -> None:
        """Put down the observation of a reset."""
        raise NotImplementedError

    def _rewards(self, n: int) -> NDArray[np.float64]:
        """Return the rewards of the first n rows."""
        raise NotImplementedError

    def _transitions(self, n: int) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:  # noqa: ARG002
        """Return state, action and next state of the first n rows; nothing where there are no states."""
        nothing = np.empty(0, np.int64)
        return nothing, nothing, nothing

    def _finish_steps(self, n: int, episode: NDArray[Any], t: NDArray[Any], before: int) -> None:
        """Complete the records of the first n rows and hand them to the recorder."""
        raise NotImplementedError


class BlockRows(Rows):
    """Rows whose steps have one size: put down in place."""

    _brought: np.dtype[np.void]
    """What a step brings that waits until its block is completed."""

    def __init__(
        self, recorder: Recorder, described: Described, phase: str, first_action: Callable[[Any], None]
    ) -> None:
        self._scratch = np.zeros(0, self._brought)
        super().__init__(recorder, described, phase, first_action)

    def _open_steps(self) -> tuple[int, int]:
        self._block = self._recorder.block(self._steps)
        self._reset_block = self._recorder.block(self._resets)
        room = len(self._block)
        if len(self._scratch) < room:
            self._scratch = np.zeros(room, self._brought)
            self._bytes = self._scratch.view(np.uint8).data
        return room, len(self._reset_block)

    def _rewards(self, n: int) -> NDArray[np.float64]:
        return self._scratch["reward"][:n]

    def _take_steps(self, n: int, episode: NDArray[Any], t: NDArray[Any], before: int) -> None:
        block, rows = self._block[:n], self._scratch[:n]
        block["rewards"] = rows["reward"][:, np.newaxis]
        block["terminated"], block["truncated"] = rows["terminated"], rows["truncated"]
        block["step"] = self._recorder.steps[self._phase] + np.arange(n)
        block["episode"] = episode
        block["t"] = t
        self._recorder.take(self._steps, np.arange(before + 1, before + n + 1, dtype=np.uint64))


class DiscreteRows(BlockRows):
    """Rows of `dualtaxi.Step`: both spaces are `Discrete`."""

    _brought = _DISCRETE_DTYPE

    def __init__(
        self, recorder: Recorder, described: Described, phase: str, first_action: Callable[[Any], None]
    ) -> None:
        self._state_start = int(described.observation.start)  # type: ignore[attr-defined]
        self._action_start = int(described.action.start)  # type: ignore[attr-defined]
        self._state: int | None = None
        """The state before the first row; None before any reset."""
        super().__init__(recorder, described, phase, first_action)

    def _open_steps(self) -> tuple[int, int]:
        rooms = super()._open_steps()
        self._reset_column = self._reset_block["observation"]
        return rooms

    def take(self, action: Any, observation: Any, reward: Any, terminated: Any, truncated: Any) -> None:
        """Put down a step."""
        if self._state is None:
            require_reset(len(self._reset_rows), self._phase)
        try:
            reward = float(reward)
        except (TypeError, ValueError):
            reward = lone_number(reward, "reward")
        at = self.filled * 26
        try:
            _DISCRETE.pack_into(self._bytes, at, action, observation, reward, terminated, truncated)
        except (struct.error, TypeError):
            action, observation = whole_number(action, "action"), whole_number(observation, "observation")
            _DISCRETE.pack_into(self._bytes, at, action, observation, reward, terminated, truncated)
        self._count(reward, terminated, truncated)

    def _put_reset(self, observation: Any, seed: int | None) -> None:  # noqa: ARG002
        self._reset_column[len(self._reset_rows)] = whole_number(observation, "observation")

    def _transitions(self, n: int) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        rows = self._scratch[:n]
        next_state = rows["next_state"] - self._state_start
        state = np.empty(n + 1, np.int64)
        state[0] = -1 if self._state is None else self._state
        state[1:] = next_state
        if self._reset_rows:
            seen = self._reset_column[: len(self._reset_rows)] - self._state_start
            state[self._reset_rows] = seen
        self._state = int(state[n])
        self._found = state[:n], rows["action"] - self._action_start, next_state
        return self._found

    def _finish_steps(self, n: int, episode: NDArray[Any], t: NDArray[Any], before: int) -> None:
        block = self._block[:n]
        for name, values in zip(("state", "action", "next_state"), self._found, strict=True):
            if n and not 0 <= values.min() <= values.max() <= _LARGEST:
                raise RecordingError(
                    f"found {name} {values.min()} to {values.max()}, outside of its Discrete space."
                )
            block[name] = values
        self._take_steps(n, episode, t, before)


class ArrayRows(BlockRows):
    """Rows of `dualtaxi.Transition` in spaces of fixed width."""

    _brought = _ENDING_DTYPE

    _is_settled = False
    """Whether the dtype of actions is known: an action was put down."""

    def _open_steps(self) -> tuple[int, int]:
        rooms = super()._open_steps()
        put_action = filler(self._action_leaves, self._block["action"])
        self._action = put_action if self._is_settled else self._settle
        self._next = filler(self._observation_leaves, self._block["next_observation"])
        self._first = filler(self._observation_leaves, self._reset_block["observation"])
        return rooms

    def _settle(self, row: int, action: Any) -> None:
        """Put down the first action, whose dtype is the one that all are recorded in."""
        self._is_settled = True
        self._first_action(action)
        self._action = filler(self._action_leaves, self._block["action"])
        self._action(row, action)

    def take(self, action: Any, observation: Any, reward: Any, terminated: Any, truncated: Any) -> None:
        """Put down a step."""
        row = self.filled
        if not row:
            require_reset(self._were_reset + len(self._reset_rows), self._phase)
        try:
            reward = float(reward)
        except (TypeError, ValueError):
            reward = lone_number(reward, "reward")
        self._action(row, action)
        self._next(row, observation)
        _ENDING.pack_into(self._bytes, row * 10, reward, terminated, truncated)
        self._count(reward, terminated, truncated)

    def _put_reset(self, observation: Any, seed: int | None) -> None:  # noqa: ARG002
        self._first(len(self._reset_rows), observation)

    def _finish_steps(self, n: int, episode: NDArray[Any], t: NDArray[Any], before: int) -> None:
        block, rows = self._block[:n], self._scratch[:n]
        block["acted"] = 1
        block["agents_terminated"], block["agents_truncated"] = rows["terminated"], rows["truncated"]
        self._take_steps(n, episode, t, before)


class VariableRows(Rows):
    """Rows of `dualtaxi.Transition` where a space has texts: each message is made when it comes."""

    def __init__(
        self, recorder: Recorder, described: Described, phase: str, first_action: Callable[[Any], None]
    ) -> None:
        self._paid = np.zeros(_VARIABLE_ROWS)
        self._is_settled = False
        super().__init__(recorder, described, phase, first_action)

    def _open_steps(self) -> tuple[int, int]:
        return _VARIABLE_ROWS, _VARIABLE_ROWS

    def take(self, action: Any, observation: Any, reward: Any, terminated: Any, truncated: Any) -> None:
        """Put down a step."""
        row, reward = self.filled, lone_number(reward, "reward")
        require_reset(self._were_reset, self._phase)
        if not self._is_settled:
            self._is_settled = True
            self._first_action(action)
        step, episode = self.place[0], self._coming
        began = row if self._fresh else self._begins[-1] if self._begins else -self._t
        payload = encode(
            schema.TRANSITION,
            {
                "action": value_bytes(self._action_leaves, action),
                "next_observation": value_bytes(self._observation_leaves, observation),
                "rewards": [reward],
                "step": step,
                "episode": episode,
                "t": row - began,
                "terminated": bool(terminated),
                "truncated": bool(truncated),
                "acted": 1,
                "agents_terminated": int(bool(terminated)),
                "agents_truncated": int(bool(truncated)),
            },
        )
        before = sum(self._recorder.steps.values())
        self._recorder.append(self._steps, payload, before + row + 1)
        self._paid[row] = reward
        self._count(reward, terminated, truncated)

    def _put_reset(self, observation: Any, seed: int | None) -> None:
        step, episode = self.place[0], self._coming
        payload = encode(
            schema.RESET,
            {
                "observation": value_bytes(self._observation_leaves, observation),
                "reset": self._were_reset,
                "episode": episode,
                "step": step,
                "seed": seed or 0,
                "seeded": seed is not None,
            },
        )
        self._recorder.append(self._resets, payload, sum(self._recorder.steps.values()) + self.filled)
        self._were_reset += 1

    def _rewards(self, n: int) -> NDArray[np.float64]:
        return self._paid[:n]

    def _finish_steps(self, n: int, episode: NDArray[Any], t: NDArray[Any], before: int) -> None:
        pass

    def _finish_resets(self, before: int) -> None:
        pass


ROWS: Final[dict[str, type[Rows]]] = {
    "step": DiscreteRows,
    "transition": ArrayRows,
    "variable": VariableRows,
}
"""Kind of a recording -> how its rows are put down."""
