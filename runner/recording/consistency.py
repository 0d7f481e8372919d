"""Whether the steps, resets and episodes of a loop's recording follow from one another.

Much of what a loop's recording holds is implied by the rest: how its episodes are numbered and how long they
are, their returns, the state before each step, the observation of a reset. All of it is computed again,
a block at a time, and compared.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import step_counts
from runner.recording import schema
from runner.recording.episode_log import Columns, EpisodeLog, Flags, Steps
from runner.recording.loop_blocks import Block, Blocks, Inconsistent, OnBlock
from runner.recording.reader import Recording
from runner.recording.schema import RESET_ONLY
from runner.recording.spaces import least_number
from runner.util.arrays import Array, Ints

_MAX_STEPS: Final = 2**62
"""More steps than a recording has."""


@dataclass
class Findings:
    """Facts about a consistent phase."""

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


def check_phase(recording: Recording, phase: str, complete: bool, on_block: OnBlock) -> Findings:
    """Compare the steps, resets and episodes of a phase with one another; each block is read once.

    Args:
        complete: whether the recording was completed; else it is checked up to its last reset, as later ones
            may not have been written.
        on_block: called with each block of a fixed-width topic, also of what is not compared.

    Raises:
        Inconsistent: something does not follow from the rest.
    """
    return _Phase(recording, phase, complete, on_block).check()


def check_extras(recording: Recording, phase: str, complete: bool, on_block: OnBlock) -> None:
    """Compare the extras of a phase with its steps: each belongs to a step, at its time, in their order.

    Args:
        complete: whether the recording was completed; else the steps of the last extras may be missing.

    Raises:
        Inconsistent: one does not.
    """
    extras, last = recording.phase(phase).extras, -1
    steps, topic = recording.phase(phase).steps, schema.topics_of(recording.kind, phase).extras
    # Steps of varying size are not looked up: their extras are only counted, and compared with one another.
    total = recording.phase(phase).steps.total() if extras else 0
    if recording.leaves_out_steps and not recording.phase(phase).steps.are_known:
        total = recording.result.get(f"{phase}_steps", _MAX_STEPS)
    for block in extras.blocks(stop=None if complete else total):
        on_block(topic, block)
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


class _Phase:
    """The check of one phase."""

    def __init__(self, recording: Recording, phase: str, complete: bool, on_block: OnBlock) -> None:
        self._recording, self._phase, self._complete = recording, phase, complete
        n = recording.environments
        self._n = n
        self._learners = len(recording.agents)
        self._mdp = recording.mdp if recording.tabular else None
        self._episodes = EpisodeLog(n, self._learners, self._mdp)
        self._over = np.zeros(n, np.bool_)
        """Whether the last step of each environment terminated or truncated its episode."""
        self._observed = np.full(n, -1, np.int64)
        """The state after that step, -1 before any."""
        self._findings = Findings()
        self._has_states = recording.has_states
        self._start = least_number(recording.spaces["observation"]) if self._has_states else 0
        self._blocks = Blocks(recording, phase, complete, on_block)

    def check(self) -> Findings:
        """Check all steps, and what comes after the last."""
        for block in self._blocks:
            self._check_times(block)
            self._check_block(block)
        if self._complete:
            self._finish(self._blocks.steps)
        self._blocks.resets.drain()
        self._blocks.episodes.drain()
        return self._findings

    def _check_times(self, b: Block) -> None:
        """Compare the times of steps: each step of either phase takes one tick, so they increase."""
        times = b.rows["log_time"].astype(np.int64).ravel()
        before = np.concatenate([[self._findings.last_time], times[:-1]])
        wrong = np.flatnonzero((times <= before) | (times % schema.STEP_NANOSECONDS != 0))
        if wrong.size:
            k = wrong[0]
            raise self._wrong(b.first + k, "log_time", times[k], f"a later tick than {before[k]}")
        self._findings.last_time = int(times[-1])

    def _check_block(self, b: Block) -> None:
        """Check some steps of all environments, and the resets before each of them."""
        rows, was_reset, only_reset = b.rows, b.was_reset, b.rows["t"] == RESET_ONLY
        if (wrong := np.flatnonzero(only_reset & ~was_reset)).size:
            raise self._wrong(b.first + wrong[0], "t", "that of a reset alone", "a reset before it")
        over = rows["terminated"] | rows["truncated"]
        episodes = self._episodes.take(
            Steps(
                b.first,
                rows["rewards"],
                rows["terminated"],
                rows["truncated"],
                was_reset,
                only_reset,
                b.is_over,
                self._counts(b),
            )
        )
        self._compare(b.first, "t", rows["t"], episodes.t)
        self._compare(b.first, "episode", rows["episode"], episodes.number)
        if b.resets is not None:
            self._check_reset_episodes(b.resets, episodes.number[b.reset_at])
        self._check_observations(b, was_reset, only_reset)
        self._count_beginnings(b, was_reset, only_reset, np.vstack([self._over, over[:-1]]))
        self._compare_episodes(episodes.ended)
        self._over = over[-1]
        if self._has_states:
            self._observed = rows["next_state"][-1].astype(np.int64)

    def _check_reset_episodes(self, resets: NDArray[np.void], expected: Ints) -> None:
        if (wrong := np.flatnonzero(resets["episode"] != expected)).size:
            k = wrong[0]
            raise Inconsistent(
                f"/{self._phase}/reset, reset {resets['reset'][k]}: episode: found {resets['episode'][k]}, "
                f"expected {expected[k]}"
            )

    def _check_observations(self, b: Block, was_reset: Flags, only_reset: Flags) -> None:
        """Compare the states before steps with those after the steps, or resets, before them."""
        rows, names = b.rows, b.rows.dtype.names or ()
        observed: Array | None = None
        if b.resets is not None:
            observed = np.zeros(rows.shape, b.resets.dtype["observation"])
            observed[b.reset_at] = b.resets["observation"]  # of several at one place the last counts
        if self._has_states:
            after, given = rows["next_state"].astype(np.int64), np.zeros(rows.shape, np.int64)
            if observed is not None:
                given = observed.astype(np.int64).reshape(rows.shape) - self._start
            before = np.vstack([self._observed, after[:-1]])
            expected = np.where(was_reset & ~only_reset, given, before)
            is_known = expected >= 0 if only_reset.any() else np.ones(rows.shape, np.bool_)
            self._compare(b.first, "state", np.where(is_known, rows["state"], expected), expected)
            self._compare(
                b.first, "next_state", np.where(only_reset, after, 0), np.where(only_reset, given, 0)
            )
        elif observed is not None and only_reset.any() and "next_observation" in names:
            same = _equal(rows["next_observation"][only_reset], observed[only_reset])
            if not same.all():
                number = b.first + np.flatnonzero(only_reset)[np.flatnonzero(~same)[0]]
                expected_value = "that of the reset before it"
                raise self._wrong(number, "next_observation", "another value", expected_value)
        if self._learners == 1 and "agents_terminated" in names:
            for name in ("terminated", "truncated"):
                self._compare(b.first, f"agents_{name}", rows[f"agents_{name}"], rows[name].astype(np.uint32))

    def _count_beginnings(self, b: Block, was_reset: Flags, only_reset: Flags, after_end: Flags) -> None:
        """Count the episodes after one that ended by itself, with a reset before them and without."""
        explained = was_reset | (b.rows["t"] > 0)
        if b.first == 0 and (missing := np.flatnonzero(~explained[0])).size:
            raise self._wrong(missing[0], "reset", "none", "one before the first step")
        began = ~only_reset & after_end
        without = np.flatnonzero(began & ~explained)
        if without.size and not self._findings.begun_without:
            self._findings.first_without = b.first + int(without[0])
        self._findings.begun_without += len(without)
        self._findings.begun_by_reset += int(np.count_nonzero(began & explained))

    def _counts(self, b: Block) -> Ints | None:
        """Return events and penalties of each step, if the environment's table determines them."""
        if self._mdp is None:
            return None
        rows = b.rows.ravel()
        paid = rows["rewards"][:, 0]
        counts, excluded = step_counts(self._mdp, paid, rows["state"], rows["action"], rows["next_state"])
        if excluded.any():
            if not self._findings.rewards_off_table:
                self._findings.first_off_table = b.first + int(np.argmax(excluded))
            self._findings.rewards_off_table += int(np.count_nonzero(excluded))
        return counts.reshape(*b.rows.shape, -1)

    def _compare_episodes(self, expected: Columns) -> None:
        """Compare the next records of episodes with their expected fields."""
        count = len(expected["length"])
        found = self._blocks.episodes.take(count)
        have = 0 if found is None else len(found)
        if have < count and self._complete:
            raise Inconsistent(
                f"/{self._phase}/episode: found {expected['episode'][have]} episodes, expected one that "
                f"ended at step {expected['last_step'][have]}"
            )
        for name, values in expected.items():
            if found is None or not have:
                break
            same = _equal(found[name], values[:have].astype(found[name].dtype))
            if not same.all():
                k = int(np.flatnonzero(~same)[0])
                raise Inconsistent(
                    f"/{self._phase}/episode, episode {found['episode'][k]}: {name}: found "
                    f"{found[name][k]}, expected {values[k]} by its steps"
                )

    def _finish(self, steps: int) -> None:
        """Check the resets after the last step, and that there is nothing else."""
        rest = self._blocks.resets.take_while("step", steps + 1)
        if rest is not None and len(rest):
            environment = rest["environment"].astype(np.int64)
            is_known = environment < self._recording.own_environments
            if not is_known.all() or (rest["step"] != steps).any():
                raise Inconsistent(f"/{self._phase}/reset: found resets out of order, or of no environment")
            environment %= self._n
            own = np.array(list(dict.fromkeys(environment.tolist())), np.int64)
            self._compare_episodes(self._episodes.interrupt(steps, own))
            self._check_reset_episodes(rest, self._episodes.episode[environment])
        for name, records in (("reset", self._blocks.resets), ("episode", self._blocks.episodes)):
            more = records.take(1)
            if more is not None and len(more):
                raise Inconsistent(f"/{self._phase}/{name}: found more records than the steps account for")

    def _compare(self, first: int, name: str, found: Array, expected: Array) -> None:
        if (wrong := np.flatnonzero(found != expected)).size:
            k = wrong[0]
            raise self._wrong(first + k, name, found.flat[k], expected.flat[k])

    def _wrong(self, step: int, name: str, found: object, expected: object) -> Inconsistent:
        return Inconsistent(f"/{self._phase}/step, step {step}: {name}: found {found}, expected {expected}")


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
