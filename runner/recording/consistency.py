"""Whether the steps, resets and episodes of a loop's recording follow from one another.

Much of what a loop's recording holds is implied by the rest: how its episodes are numbered and how long they
are, their returns, the state before each step, the observation of a reset. All of it is computed again,
a block at a time, and compared.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import step_counts
from runner.recording import schema
from runner.recording.description import environment_count
from runner.recording.episode_log import Columns, EpisodeLog, Flags, Steps
from runner.recording.reader import Recording
from runner.recording.schema import RESET_ONLY
from runner.recording.spaces import least_number
from runner.recording.steps import Steps as WholeSteps
from runner.recording.steps import aligned
from runner.recording.topic_chunks import TopicChunks
from runner.util.arrays import Array, Ints

_MAX_STEPS: Final = 2**62
"""More steps than a recording has."""


class Inconsistent(Exception):
    """Something that does not follow from the rest: the message says what, and where."""


@dataclass
class Findings:
    """Facts about a consistent phase."""

    not_outcomes: int = 0
    """Steps that are no outcome of the environment's table."""
    rewards_off_table: int = 0
    """Steps whose reward the environment's table excludes."""
    first_off_table: int = 0
    begun_by_reset: int = 0
    """Episodes after one that terminated or was truncated which began with a reset."""
    begun_without: int = 0
    """Such episodes which began without one."""
    first_without: int = 0
    """The first step of the first of these."""
    last_time: int = 0
    """Logical time of the last step, in nanoseconds; 0 without steps."""


def check_phase(recording: Recording, phase: str, complete: bool) -> Findings:
    """Compare the steps, resets and episodes of a phase with one another; of actions alone, their numbers.

    Args:
        complete: whether the recording was completed; else it is checked up to its last reset, as later ones
            may not have been written.

    Raises:
        Inconsistent: something does not follow from the rest.
    """
    own = recording.phase(phase)
    for table in (own.resets, own.episodes):
        for _ in _numbered(table):
            pass
    if recording.leaves_out_steps:
        return Findings(last_time=_check_actions(own.steps))
    if own.steps.are_actions:
        raise Inconsistent(
            f"{own.steps.topic.name}: found actions alone, expected whole steps as in the configuration"
        )
    last = own.resets.last()
    stop = None if complete else 0 if last is None else int(last["step"])
    return _PhaseCheck(recording, phase, stop).check()


def _check_actions(steps: WholeSteps) -> int:
    """Check the numbers of steps of which only the actions were recorded; return the time of the last."""
    expected = last = 0
    for rows in steps.rows():
        if rows["step"][0] != expected or (np.diff(rows["log_time"].astype(np.int64)) <= 0).any():
            raise Inconsistent(
                f"{steps.actions.topic.name}: found step {rows['step'][0]:,}, expected {expected:,}"
            )
        expected, last = expected + len(rows), int(rows["log_time"][-1])
    return last


def check_extras(recording: Recording, phase: str, complete: bool) -> None:
    """Compare the extras of a phase with its steps: each belongs to a step, at its time, in their order.

    Args:
        complete: whether the recording was completed; else the steps of the last extras may be missing.

    Raises:
        Inconsistent: one does not.
    """
    extras, last = recording.phase(phase).extras, -1
    steps, topic = recording.phase(phase).steps, recording.phase(phase).topics.extras
    # Steps of varying size are not looked up: their extras are only counted, and compared with one another.
    total = recording.phase(phase).steps.total() if extras else 0
    if recording.leaves_out_steps and not recording.phase(phase).steps.are_known:
        total = recording.result.get(f"{phase}_steps", _MAX_STEPS)
    for block in extras.blocks(stop=None if complete else total):
        numbers, where = block["step"], f"{topic.name}, step {block['step'][0]} and later"
        if numbers[0] <= last or (np.diff(numbers) <= 0).any() or numbers[-1] >= total:
            raise Inconsistent(f"{where}: found steps out of order, or after the last of {total:,}")
        last = int(numbers[-1])
        for name in block["values"].dtype.names or ():
            given, values = block["given"][name], block["values"][name].reshape(len(block), -1)
            if (given.view(np.uint8) > 1).any() or values[~given].any():
                raise Inconsistent(f"{where}: {name}: found values where none were given")
        if steps and steps.dtype is not None:
            parts = steps.blocks(int(numbers[0]), last + 1)
            times = np.concatenate([part["log_time"][np.isin(part["step"], numbers)] for part in parts])
            if len(times) != len(block) or (times != block["log_time"]).any():
                raise Inconsistent(f"{where}: found other times than those of the steps")


class _Block(NamedTuple):
    """Steps of all environments, and the resets before them."""

    first: int
    """The number of the first step."""
    rows: NDArray[np.void]
    """[steps of each environment, environments]."""
    resets: NDArray[np.void]
    """[like `rows`]: the last reset before each step; zeros where there was none."""
    was_reset: Flags
    """[like `rows`]: whether a reset came before a step."""
    only_reset: Flags
    """[like `rows`]: whether the environment was reset instead of taking the step."""

    @property
    def numbers(self) -> range:
        """The numbers of the steps."""
        return range(self.first, self.first + self.rows.size)


class _Resets:
    """The resets of a phase, taken once in their order: memory is bounded, however many there are."""

    def __init__(self, table: TopicChunks) -> None:
        self._blocks = table.rows()
        self.left = np.empty(0, table.row_dtype)
        """What was read and not yet taken."""

    def before(self, step: int) -> Iterator[NDArray[np.void]]:
        """Yield the next resets in blocks, up to the first at this step or a later one."""
        while len(self.left) or len(block := next(self._blocks, self.left)):
            resets = self.left if len(self.left) else block
            stop = int(np.argmax(np.append(resets["step"] >= step, True)))
            self.left = resets[stop:]
            yield resets[:stop]
            if len(self.left):
                return


class _PhaseCheck:
    """The check of one phase.

    Args:
        stop: the number of the step before which the check ends; None to check all.
    """

    def __init__(self, recording: Recording, phase: str, stop: int | None) -> None:
        self._recording, self._phase, self._stop = recording, phase, stop
        self._own = recording.phase(phase)
        self._n = recording.environments
        self._learners = len(recording.agents)
        self._mdp = recording.mdp if recording.tabular else None
        self._episodes = EpisodeLog(self._n, self._learners, self._mdp)
        self._over = np.zeros(self._n, np.bool_)
        """Whether the last step of each environment terminated or truncated its episode."""
        self._observed = np.full(self._n, -1, np.int64)
        """The state after that step, -1 before any."""
        self._findings = Findings()
        self._has_states = recording.has_states
        self._start = least_number(recording.spaces["observation"]) if self._has_states else 0
        self._resets, self._numbered_resets = _Resets(self._own.resets), _Resets(self._own.resets)
        """To find where environments were reset, and to compare with the episodes that follow from it."""
        self._endings = self._own.episodes.blocks()
        self._silent_ends, self._last_end = np.empty(0, np.int64), -1
        """Of the last block of `_endings`: the steps that ended an episode silently, and its last step."""

    def check(self) -> Findings:
        """Check all steps, and what comes after the last."""
        steps = left = 0
        for rows, waiting in aligned(_numbered(self._own.steps), self._n, self._stop):
            left = waiting
            if len(rows):
                self._check_block(self._block(steps, rows.reshape(-1, self._n)))
                steps += len(rows)
        if self._stop is None:
            if left:
                raise Inconsistent(
                    f"{self._own.steps.topic.name}: found {steps + left} steps, expected as many of each of "
                    f"the {self._n} environments"
                )
            self._finish(steps)
        return self._findings

    def _block(self, first: int, rows: NDArray[np.void]) -> _Block:
        resets, was_reset = np.zeros(rows.shape, self._resets.left.dtype), np.zeros(rows.shape, np.bool_)
        for own in self._resets.before(first + rows.size):
            step, is_unknown = own["step"], own["environment"] >= environment_count(self._recording)
            if (is_unknown | (step % self._n != 0) | (step < first)).any():
                raise self._out_of_order()
            at = self._places(first, own)
            resets[at], was_reset[at] = own, True  # of several resets at one place the last counts
        return _Block(first, rows, resets, was_reset, rows["t"] == RESET_ONLY)

    def _places(self, first: int, resets: NDArray[np.void]) -> tuple[Ints, Ints]:
        """Return the places of resets among the rows of a block that begins with step `first`."""
        return (resets["step"] - first) // self._n, resets["environment"].astype(np.int64) % self._n

    def _check_times(self, b: _Block) -> None:
        """Compare the times of steps: each step of either phase takes one tick, so they increase."""
        times = b.rows["log_time"].astype(np.int64).ravel()
        before = np.concatenate([[self._findings.last_time], times[:-1]])
        wrong = np.flatnonzero((times <= before) | (times % schema.STEP_NANOSECONDS != 0))
        if wrong.size:
            k = wrong[0]
            raise self._wrong("step", b.numbers[k], "log_time", times[k], f"a later tick than {before[k]}")
        self._findings.last_time = int(times[-1])

    def _check_block(self, b: _Block) -> None:
        """Check some steps of all environments, and the resets before each of them."""
        self._check_times(b)
        rows = b.rows
        if (wrong := np.flatnonzero(b.only_reset & ~b.was_reset)).size:
            raise self._wrong("step", b.numbers[wrong[0]], "t", "that of a reset alone", "a reset before it")
        over = rows["terminated"] | rows["truncated"]
        episodes = self._episodes.take(
            Steps(
                b.first,
                rows["rewards"],
                rows["terminated"],
                rows["truncated"],
                b.was_reset,
                b.only_reset,
                self._is_over(b),
                self._counts(b),
            )
        )
        self._compare("step", b.numbers, "t", rows["t"], episodes.t)
        self._compare("step", b.numbers, "episode", rows["episode"], episodes.number)
        for resets in self._numbered_resets.before(b.numbers.stop):
            expected = episodes.number[self._places(b.first, resets)]
            self._compare("reset", resets["reset"], "episode", resets["episode"], expected)
        self._check_observations(b)
        self._count_beginnings(b, np.vstack([self._over, over[:-1]]))
        self._compare_episodes(episodes.ended)
        self._over = over[-1]
        if self._has_states:
            self._observed = rows["next_state"][-1].astype(np.int64)

    def _is_over(self, b: _Block) -> Flags:
        """Return where a game of several agents ended without the end of any: its episode record says so."""
        is_over = np.zeros(b.rows.shape, np.bool_)
        while self._learners > 1 and self._n == 1:
            begin, stop = np.searchsorted(self._silent_ends, [b.first, b.numbers.stop])
            is_over[self._silent_ends[begin:stop] - b.first] = True
            if self._last_end >= b.numbers.stop or (block := next(self._endings, None)) is None:
                break
            is_silent = ~(block["terminated"] | block["truncated"])
            self._silent_ends = np.sort(block["last_step"][is_silent].astype(np.int64))
            self._last_end = int(block["last_step"][-1])
        return is_over

    def _check_observations(self, b: _Block) -> None:
        """Compare the states before steps with those after the steps, or resets, before them."""
        rows, names = b.rows, b.rows.dtype.names or ()
        if self._has_states:
            after, given = rows["next_state"].astype(np.int64), np.zeros(rows.shape, np.int64)
            given[b.was_reset] = (
                b.resets["observation"][b.was_reset].reshape(-1).astype(np.int64) - self._start
            )
            before = np.vstack([self._observed, after[:-1]])
            expected = np.where(b.was_reset & ~b.only_reset, given, before)
            if b.only_reset.any():
                expected = np.where(expected < 0, rows["state"], expected)  # unknown
            self._compare("step", b.numbers, "state", rows["state"], expected)
            self._compare("step", b.numbers, "next_state", after, np.where(b.only_reset, given, after))
        elif b.only_reset.any() and "next_observation" in names:
            same = _equal(rows["next_observation"][b.only_reset], b.resets["observation"][b.only_reset])
            if not same.all():
                number = b.numbers[np.flatnonzero(b.only_reset)[np.argmin(same)]]
                expected_value = "that of the reset before it"
                raise self._wrong("step", number, "next_observation", "another value", expected_value)
        if self._learners == 1 and "agents_terminated" in names:
            for name in ("terminated", "truncated"):
                self._compare(
                    "step", b.numbers, f"agents_{name}", rows[f"agents_{name}"], rows[name].astype(np.uint32)
                )

    def _count_beginnings(self, b: _Block, after_end: Flags) -> None:
        """Count the episodes after one that ended by itself, with a reset before them and without."""
        explained = b.was_reset | (b.rows["t"] > 0)
        if b.first == 0 and (missing := np.flatnonzero(~explained[0])).size:
            raise self._wrong("step", missing[0], "reset", "none", "one before the first step")
        began = ~b.only_reset & after_end
        without = np.flatnonzero(began & ~explained)
        if without.size and not self._findings.begun_without:
            self._findings.first_without = b.first + int(without[0])
        self._findings.begun_without += len(without)
        self._findings.begun_by_reset += int(np.count_nonzero(began & explained))

    def _counts(self, b: _Block) -> Ints | None:
        """Return events and penalties of each step, if the environment's table determines them."""
        if self._mdp is None:
            return None
        rows = b.rows.ravel()
        paid = rows["rewards"][:, 0]
        counts, excluded = step_counts(self._mdp, paid, rows["state"], rows["action"], rows["next_state"])
        outcomes = self._mdp.outcomes_to(rows["state"], rows["action"], rows["next_state"])
        self._findings.not_outcomes += int(np.count_nonzero(~outcomes.any(axis=1)))
        if excluded.any():
            if not self._findings.rewards_off_table:
                self._findings.first_off_table = b.first + int(np.argmax(excluded))
            self._findings.rewards_off_table += int(np.count_nonzero(excluded))
        return counts.reshape(*b.rows.shape, -1)

    def _compare_episodes(self, expected: Columns) -> None:
        """Compare the next records of episodes with their expected fields."""
        if not (count := len(expected["episode"])):
            return
        first = int(expected["episode"][0])
        found = self._own.episodes.array(first, first + count)
        have = len(found)
        if have < count and self._stop is None:
            raise Inconsistent(
                f"/{self._phase}/episode: found {first + have} episodes, expected one that ended at step "
                f"{expected['last_step'][have]}"
            )
        for name, values in expected.items() if have else ():
            same = _equal(found[name], values[:have].astype(found[name].dtype))
            if not same.all():
                k = int(np.argmin(same))
                expected_value = f"{values[k]} by its steps"
                raise self._wrong("episode", found["episode"][k], name, found[name][k], expected_value)

    def _finish(self, steps: int) -> None:
        """Check the resets after the last step, and that there is nothing else."""
        for resets in self._resets.before(steps + 1):
            environment = resets["environment"].astype(np.int64)
            if (environment >= environment_count(self._recording)).any() or (resets["step"] != steps).any():
                raise self._out_of_order()
            environment %= self._n
            first_of_each = np.sort(np.unique(environment, return_index=True)[1])
            self._compare_episodes(self._episodes.interrupt(steps, environment[first_of_each]))
            expected = self._episodes.episode[environment]
            self._compare("reset", resets["reset"], "episode", resets["episode"], expected)
        has_more = {
            "reset": len(self._resets.left) > 0,
            "episode": self._own.episodes.count() > self._episodes.ended,
        }
        for name, found in has_more.items():
            if found:
                raise Inconsistent(f"/{self._phase}/{name}: found more records than the steps account for")

    def _compare(self, what: str, numbers: range | Ints, name: str, found: Array, expected: Array) -> None:
        """Compare a field of steps, resets or episodes, which have these numbers."""
        if (wrong := np.flatnonzero(found != expected)).size:
            k = wrong[0]
            raise self._wrong(what, numbers[k], name, found.flat[k], expected.flat[k])

    def _out_of_order(self) -> Inconsistent:
        return Inconsistent(f"/{self._phase}/reset: found resets out of order, or of no environment")

    def _wrong(self, what: str, number: int, name: str, found: object, expected: object) -> Inconsistent:
        return Inconsistent(
            f"/{self._phase}/{what}, {what} {number}: {name}: found {found}, expected {expected}"
        )


def _numbered(table: TopicChunks) -> Iterator[NDArray[np.void]]:
    """Yield the records of a topic in blocks, as `TopicChunks.rows` does.

    Raises:
        Inconsistent: messages are not numbered consecutively.
    """
    first, number = 0, schema.NUMBERED_BY[table.topic.message]
    for block in table.rows():
        if (wrong := np.flatnonzero(block[number] != first + np.arange(len(block)))).size:
            found, expected = block[number][wrong[0]], first + wrong[0]
            raise Inconsistent(f"{table.topic.name}: found {number} {found}, expected {expected}")
        yield block
        first += len(block)


def _equal(found: Array, expected: Array) -> Flags:
    """Return which rows are the same, byte for byte; of numbers NaN equals NaN."""
    if found.dtype.names or found.dtype.kind == "V":
        found, expected = (
            np.ascontiguousarray(part).view(np.uint8).reshape(len(part), -1) for part in (found, expected)
        )
    same = found == expected
    if found.dtype.kind == "f":
        same |= np.isnan(found) & np.isnan(expected)
    return np.asarray(same.reshape(len(found), -1).all(axis=1))
