"""The steps of one phase of a loop: put down as they come, completed and committed some thousands at a time.

What a step brings is put where it will be written from; what follows from the order of steps (their
numbers, the state before each, the lengths of episodes) is computed for a whole block at once.
"""

from __future__ import annotations

import struct
import warnings
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.mdp import Mdp
from runner.recording import schema
from runner.recording.messages import encode
from runner.recording.recorder import Recorder
from runner.recording.spaces import encode_text
from runner.wrappers.described import Described, Part, parts_of

_DISCRETE: Final = struct.Struct("<qqd??")
_DISCRETE_DTYPE: Final = np.dtype(
    [("action", "<i8"), ("next_state", "<i8"), ("reward", "<f8"), ("terminated", "?"), ("truncated", "?")]
)
_ENDING: Final = struct.Struct("<d??")
_ENDING_DTYPE: Final = np.dtype([("reward", "<f8"), ("terminated", "?"), ("truncated", "?")])
_VARIABLE_ROWS: Final = 4096
_LARGEST: Final = 2**32 - 1
Columns = Sequence[tuple[Part, NDArray[Any]]]


class Rows:
    """The rows of one phase of one environment that are not committed yet, and how its episodes stand.

    Not thread-safe: whoever calls holds the loop's lock.

    Args:
        recorder: takes them.
        described: the environment and its spaces.
        phase: `train` or `eval`.
    """

    def __init__(self, recorder: Recorder, described: Described, phase: str) -> None:
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
    def place(self) -> tuple[int, int]:
        """The steps of the phase so far, and the number of the episode that began last; 0 before any."""
        began = self._episode + len(self._begins)
        return self._recorder.steps[self._phase] + self.filled, max(began, 0)

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

    def _open_steps(self) -> tuple[int, int]:
        self._block = self._recorder.block(self._steps)
        self._reset_block = self._recorder.block(self._resets)
        return len(self._block), len(self._reset_block)

    def _take_steps(self, n: int, episode: NDArray[Any], t: NDArray[Any], before: int) -> None:
        block = self._block[:n]
        block["step"] = self._recorder.steps[self._phase] + np.arange(n)
        block["episode"] = episode
        block["t"] = t
        self._recorder.take(self._steps, np.arange(before + 1, before + n + 1, dtype=np.uint64))


class DiscreteRows(BlockRows):
    """Rows of `dualtaxi.Step`: both spaces are `Discrete`."""

    def __init__(self, recorder: Recorder, described: Described, phase: str) -> None:
        self._state_start = int(described.observation.start)  # type: ignore[attr-defined]
        self._action_start = int(described.action.start)  # type: ignore[attr-defined]
        self._state: int | None = None
        """The state before the first row; None before any reset."""
        self._scratch = np.zeros(0, _DISCRETE_DTYPE)
        super().__init__(recorder, described, phase)

    def _open_steps(self) -> tuple[int, int]:
        rooms = super()._open_steps()
        if len(self._scratch) < rooms[0]:
            self._scratch = np.zeros(rooms[0], _DISCRETE_DTYPE)
            self._bytes = self._scratch.view(np.uint8).data
        self._reset_column = self._reset_block["observation"]
        return rooms

    def take(self, action: Any, observation: Any, reward: Any, terminated: Any, truncated: Any) -> None:
        """Put down a step."""
        if self._state is None and not self._reset_rows:
            raise ResetNeeded("the recording has seen no reset of this environment yet: call reset() first")
        reward = float(reward)
        at = self.filled * 26
        try:
            _DISCRETE.pack_into(self._bytes, at, action, observation, reward, terminated, truncated)
        except (struct.error, TypeError):
            action, observation = _whole(action, "action"), _whole(observation, "observation")
            _DISCRETE.pack_into(self._bytes, at, action, observation, reward, terminated, truncated)
        self._count(reward, terminated, truncated)

    def _put_reset(self, observation: Any, seed: int | None) -> None:  # noqa: ARG002
        self._reset_column[len(self._reset_rows)] = _whole(observation, "observation")

    def _rewards(self, n: int) -> NDArray[np.float64]:
        return self._scratch["reward"][:n]

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
        block, rows = self._block[:n], self._scratch[:n]
        for name, values in zip(("state", "action", "next_state"), self._found, strict=True):
            if n and not 0 <= values.min() <= values.max() <= _LARGEST:
                raise RecordingError(
                    f"found {name} {values.min()} to {values.max()}, outside of its Discrete space."
                )
            block[name] = values
        block["rewards"] = rows["reward"][:, np.newaxis]
        for name in ("terminated", "truncated"):
            block[name] = rows[name]
        self._take_steps(n, episode, t, before)


class ArrayRows(BlockRows):
    """Rows of `dualtaxi.Transition` in spaces of fixed width."""

    def __init__(self, recorder: Recorder, described: Described, phase: str) -> None:
        self._action_parts = parts_of(described.action, "the action space")
        self._observation_parts = parts_of(described.observation, "the observation space")
        self._scratch = np.zeros(0, _ENDING_DTYPE)
        super().__init__(recorder, described, phase)

    def _open_steps(self) -> tuple[int, int]:
        rooms = super()._open_steps()
        if len(self._scratch) < rooms[0]:
            self._scratch = np.zeros(rooms[0], _ENDING_DTYPE)
            self._bytes = self._scratch.view(np.uint8).data
        self._action = filler(self._action_parts, self._block["action"], "action")
        self._next = filler(self._observation_parts, self._block["next_observation"], "observation")
        self._first = filler(self._observation_parts, self._reset_block["observation"], "observation")
        return rooms

    def take(self, action: Any, observation: Any, reward: Any, terminated: Any, truncated: Any) -> None:
        """Put down a step."""
        row, reward = self.filled, float(reward)
        self._action(row, action)
        self._next(row, observation)
        _ENDING.pack_into(self._bytes, row * 10, reward, terminated, truncated)
        self._count(reward, terminated, truncated)

    def _put_reset(self, observation: Any, seed: int | None) -> None:  # noqa: ARG002
        check_value(self._observation_parts, observation)
        self._first(len(self._reset_rows), observation)

    def _rewards(self, n: int) -> NDArray[np.float64]:
        return self._scratch["reward"][:n]

    def _finish_steps(self, n: int, episode: NDArray[Any], t: NDArray[Any], before: int) -> None:
        block, rows = self._block[:n], self._scratch[:n]
        block["rewards"] = rows["reward"][:, np.newaxis]
        for name in ("terminated", "truncated"):
            block[name] = rows[name]
        block["acted"] = 1
        block["agents_terminated"], block["agents_truncated"] = rows["terminated"], rows["truncated"]
        self._take_steps(n, episode, t, before)


class VariableRows(Rows):
    """Rows of `dualtaxi.Transition` where a space has texts: each message is made when it comes."""

    def __init__(self, recorder: Recorder, described: Described, phase: str) -> None:
        self._action_parts = parts_of(described.action, "the action space")
        self._observation_parts = parts_of(described.observation, "the observation space")
        self._paid = np.zeros(_VARIABLE_ROWS)
        super().__init__(recorder, described, phase)

    def _open_steps(self) -> tuple[int, int]:
        return _VARIABLE_ROWS, schema.NEVER

    def take(self, action: Any, observation: Any, reward: Any, terminated: Any, truncated: Any) -> None:
        """Put down a step."""
        row, reward = self.filled, float(reward)
        step, episode = self.place[0], self._coming
        began = row if self._fresh else self._begins[-1] if self._begins else -self._t
        payload = encode(
            schema.TRANSITION,
            {
                "action": value_bytes(self._action_parts, action),
                "next_observation": value_bytes(self._observation_parts, observation),
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
                "observation": value_bytes(self._observation_parts, observation),
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


class Judge:
    """Counts the penalties and events of episodes, where the environment's arrays say what they are."""

    def __init__(self, mdp: Mdp | None) -> None:
        self._mdp = mdp
        self._counts = np.zeros((1, 1), np.int64)
        """[rows + 1, events + 1]: events and penalties before each row, counted from the first."""
        self._carried = np.zeros(1 + (len(mdp.event_names) if mdp else 0), np.int64)
        """Those of the episode under way, before the first row."""

    def judge(
        self,
        rewards: NDArray[np.float64],
        state: NDArray[Any],
        action: NDArray[Any],
        next_state: NDArray[Any],
    ) -> None:
        """Look at rows."""
        mdp = self._mdp
        if mdp is None:
            return
        bits = np.zeros((len(rewards) + 1, len(self._carried)), np.int64)
        bits[1:, -1] = rewards < mdp.penalty_below
        if mdp.event_names:
            names = np.arange(len(mdp.event_names), dtype=np.uint32)
            bits[1:, :-1] = (_events(mdp, rewards, state, action, next_state)[:, np.newaxis] >> names) & 1
        self._counts = bits.cumsum(axis=0)

    def fill(self, episodes: NDArray[np.void], first: NDArray[Any], last: NDArray[Any]) -> None:
        """Fill in the counts of episodes from their first and last rows; those before 0 are carried."""
        mdp = self._mdp
        if mdp is None:
            return
        counts = self._counts[last + 1] - self._counts[np.maximum(first, 0)]
        counts[first < 0] += self._carried
        episodes["penalties"] = counts[:, -1]
        episodes["events"] = counts[:, :-1]
        wanted = [mdp.event_names.index(name) for name in mdp.success_events]
        episodes["success"] = (counts[:, wanted] > 0).any(axis=1)

    def carry(self, start: int) -> None:
        """Keep what the episode that began at this row has counted, for the rows to come."""
        if self._mdp is not None:
            kept = self._carried if start < 0 else 0
            self._carried = self._counts[-1] - self._counts[max(start, 0)] + kept


def _events(
    mdp: Mdp,
    rewards: NDArray[np.float64],
    state: NDArray[Any],
    action: NDArray[Any],
    next_state: NDArray[Any],
) -> NDArray[np.uint32]:
    """Return the events of steps: those of the outcome that has their next state, and their reward if any."""
    known = (state >= 0) & (state < mdp.states) & (action >= 0) & (action < mdp.joint_actions)
    state, action = np.where(known, state, 0), np.where(known, action, 0)
    likely = (mdp.next_state[state, action] == next_state[:, np.newaxis]) & (
        mdp.probability[state, action] > 0
    )
    paid = mdp.rewards[state, action].sum(axis=-1) == rewards[:, np.newaxis]
    outcome = np.argmax(likely * 2 + (likely & paid), axis=1)
    found = known & likely.any(axis=1)
    return np.where(found, mdp.events[state, action, outcome], np.uint32(0))


# --- values --------------------------------------------------------------------------------------------


def filler(parts: Sequence[Part], column: NDArray[Any], what: str) -> Callable[[int, Any], None]:
    """Return what puts a value of a space into a row of a column.

    Raises:
        RecordingError: (what is returned) a value is not of its space.
    """
    if not parts:
        return lambda _row, _value: None
    columns = [(part.keys, _within(column, part)) for part in parts]

    def put_one(row: int, value: Any) -> None:
        try:
            only[row] = value
        except (TypeError, ValueError) as error:
            raise _no_value(what, error) from error

    def put(row: int, value: Any) -> None:
        try:
            for keys, own in columns:
                inside = value
                for key in keys:
                    inside = inside[key]
                own[row] = inside
        except (TypeError, ValueError, LookupError) as error:
            raise _no_value(what, error) from error

    if len(columns) == 1 and not columns[0][0]:
        only = columns[0][1]
        return put_one
    return put


def _within(column: NDArray[Any], part: Part) -> NDArray[Any]:
    for name in part.fields:
        column = column[name]
    return column


def _no_value(what: str, error: Exception) -> RecordingError:
    return RecordingError(f"found an {what} that is not of the environment's {what} space ({error}).")


def check_value(parts: Sequence[Part], value: Any) -> None:
    """Refuse a value of another shape; warn of numbers that the space's dtype cannot hold exactly.

    Raises:
        RecordingError: it is one.
    """
    for part in parts:
        inside = value
        try:
            for key in part.keys:
                inside = inside[key]
        except (TypeError, LookupError) as error:
            raise _no_value("observation", error) from error
        if part.dtype is None:
            continue
        found, expected = np.asarray(inside), part.dtype
        name = "".join(f"[{key!r}]" for key in part.keys)
        if found.shape != expected.shape:
            raise RecordingError(
                f"found observation{name} of shape {found.shape}, expected {expected.shape} by its space."
            )
        with np.errstate(all="ignore"):
            kept = found.astype(expected.base)
        if not np.array_equal(kept, found, equal_nan=found.dtype.kind == "f"):
            warnings.warn(
                f"observation{name} comes as {found.dtype} and is recorded, rounded, as the {expected.base} "
                "of its space",
                RuntimeWarning,
                stacklevel=6,
            )


def value_bytes(parts: Sequence[Part], value: Any) -> bytes:
    """Return a value of a space as it stands in a recording.

    Raises:
        RecordingError: it is not of the space.
    """
    pieces = []
    try:
        for part in parts:
            inside = value
            for key in part.keys:
                inside = inside[key]
            if part.dtype is None:
                pieces.append(encode_text(inside))
            else:
                array = np.empty(part.dtype.shape, part.dtype.base)
                array[...] = inside
                pieces.append(array.tobytes())
    except (TypeError, ValueError, LookupError, AttributeError) as error:
        raise _no_value("observation or action", error) from error
    return b"".join(pieces)


def _whole(value: Any, what: str) -> int:
    """Return a whole number that may stand in an array of one.

    Raises:
        RecordingError: it is none.
    """
    array = np.asarray(value)
    if array.size != 1 or array.dtype.kind not in "iub":
        raise RecordingError(f"found the {what} {value!r}, expected a whole number of its Discrete space.")
    return int(array.reshape(()))


ROWS: Final[dict[str, type[Rows]]] = {
    "step": DiscreteRows,
    "transition": ArrayRows,
    "variable": VariableRows,
}
"""Kind of a recording -> how its rows are put down."""
