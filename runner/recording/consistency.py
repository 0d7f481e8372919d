"""Whether the steps, resets and episodes of a loop's recording follow from one another.

Much of what a loop's recording holds is implied by the rest: how its episodes are numbered and how long they
are, their returns, the state before each step, the observation of a reset. All of it is computed again here,
a block at a time, and compared.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import step_counts
from runner.recording import schema
from runner.recording.loop_blocks import Block, Blocks, Bools, Inconsistent, Ints, OnBlock
from runner.recording.reader import Recording
from runner.recording.schema import RESET_ONLY
from runner.util.arrays import Array

Floats = NDArray[np.float64]
Expected = dict[str, Array]


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


@dataclass
class _State:
    """The state of each environment between two blocks."""

    episode: Ints
    """The number of the current or next episode."""
    length: Ints
    """Its steps so far."""
    returns: Floats
    counts: Ints
    """Its events and penalties so far."""
    over: Bools
    """Whether the last step terminated or truncated its episode."""
    observed: Ints
    """The state after the last step, -1 before any."""
    ended: int = 0
    """Episodes of all environments that have ended."""


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
    extras, last = recording.extras(phase), -1
    steps, topic = recording.topic(f"/{phase}/step"), recording.topic(f"/{phase}/extra")
    # Steps of varying size are not looked up: their extras are only counted, and compared with one another.
    total = recording.step_count(phase) if extras else 0
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
        if steps in recording.dtypes and recording.has_messages(steps.name):
            parts = recording.blocks(steps, int(numbers[0]), last + 1)
            found = np.concatenate([part["log_time"][np.isin(part["step"], numbers)] for part in parts])
            if len(found) != len(block) or (found != block["log_time"]).any():
                raise Inconsistent(f"{where}: found other times than those of the steps")


class _Phase:
    """The check of one phase."""

    def __init__(self, recording: Recording, phase: str, complete: bool, on_block: OnBlock) -> None:
        self._recording, self._phase, self._complete = recording, phase, complete
        self._n = n = recording.environments
        self._learners = len(recording.agents)
        self._mdp = recording.mdp if recording.tabular else None
        counters = 1 + (len(self._mdp.event_names) if self._mdp else 0)
        self._state = _State(
            np.zeros(n, np.int64),
            np.zeros(n, np.int64),
            np.zeros((n, self._learners)),
            np.zeros((n, counters), np.int64),
            np.zeros(n, np.bool_),
            np.full(n, -1, np.int64),
        )
        self._findings = Findings()
        self._has_states = recording.kind == "step"
        self._start = int(recording.spaces["observation"]["start"]) if self._has_states else 0
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
        times = b.rows["log_time"].astype(np.int64).reshape(self._n, b.times).T.ravel()
        before = np.concatenate([[self._findings.last_time], times[:-1]])
        wrong = np.flatnonzero((times <= before) | (times % schema.STEP_NANOSECONDS != 0))
        if wrong.size:
            k = wrong[0]
            raise self._wrong(b.first + k, "log_time", times[k], f"a later tick than {before[k]}")
        self._findings.last_time = int(times[-1])

    def _check_block(self, b: Block) -> None:
        """Check some steps of all environments, and the resets before each of them."""
        state, reset_only, opening = self._state, b.reset_only, b.opening
        if (wrong := np.flatnonzero(reset_only & ~b.was_reset)).size:
            raise self._wrong(b.number[wrong[0]], "t", "that of a reset alone", "a reset before it")
        # A step's `t` is the number of steps before it in its episode, of which a reset alone is none.
        counted = np.cumsum(~reset_only)
        before = counted[b.heads] - ~reset_only[b.heads]
        carried = np.where(b.continues, state.length[b.owner], 0)
        t = np.where(reset_only, RESET_ONLY, counted - ~reset_only - before[b.segment] + carried[b.segment])
        self._compare(b.number, "t", b.rows["t"], t)

        lengths = counted[b.tails] - before + carried
        # A segment's episode ends by its last step, or by a reset before the next segment; a reset before the
        # first segment of an environment ends the episode that the block before left open.
        next_reset = np.append(b.was_reset[b.heads[1:]] & ~b.opens[b.heads[1:]], False)
        ended = b.ends[b.tails] | (next_reset & (lengths > 0))
        interrupted = opening & b.was_reset[b.heads] & (state.length[b.owner] > 0)
        # The number of a segment's episode: that of its environment's first, and the episodes ended since.
        finished = np.cumsum(ended) - ended
        base = np.maximum.accumulate(np.where(opening, np.arange(len(b.heads)), 0))
        episodes = state.episode[b.owner] + finished - finished[base] + interrupted[base]
        self._compare(b.number, "episode", b.rows["episode"], episodes[b.segment])
        if b.resets is not None:
            self._check_reset_episodes(b.resets, episodes[b.segment[b.reset_rows]])
        self._check_observations(b)
        self._count_beginnings(b)

        returns, counts = self._returns(b), self._counts(b)
        self._check_episodes(b, lengths, returns, counts, ended, interrupted)
        self._carry_over(b, episodes, lengths, returns, counts, ended)

    def _carry_over(
        self, b: Block, episodes: Ints, lengths: Ints, returns: Floats, counts: Ints | None, ended: Bools
    ) -> None:
        """Keep the state of each environment after its last step of the block."""
        state = self._state
        final = np.flatnonzero((b.tails + 1) % b.times == 0)  # the last segment of each environment
        closed = ended[final]
        state.episode = episodes[final] + closed
        state.length = np.where(closed, 0, lengths[final])
        state.returns = np.where(closed[:, np.newaxis], 0.0, returns[final])
        if counts is not None:
            state.counts = np.where(closed[:, np.newaxis], 0, counts[final])
        state.over = b.over[b.tails[final]]
        if self._has_states:
            state.observed = b.rows["next_state"][b.tails[final]].astype(np.int64)

    def _check_reset_episodes(self, resets: NDArray[np.void], expected: Ints) -> None:
        if (wrong := np.flatnonzero(resets["episode"] != expected)).size:
            k = wrong[0]
            raise Inconsistent(
                f"/{self._phase}/reset, reset {resets['reset'][k]}: episode: found {resets['episode'][k]}, "
                f"expected {expected[k]}"
            )

    def _check_observations(self, b: Block) -> None:
        """Compare the states before steps with those after the steps, or resets, before them."""
        rows, number, reset_only, names = b.rows, b.number, b.reset_only, b.rows.dtype.names or ()
        observed: Array | None = None
        if b.resets is not None:
            observed = np.zeros(len(rows), b.resets.dtype["observation"])
            observed[b.reset_rows] = b.resets["observation"]  # of several at one place the last counts
        if self._has_states:
            after, given = rows["next_state"].astype(np.int64), np.zeros(len(rows), np.int64)
            if observed is not None:
                given = observed.astype(np.int64).reshape(-1) - self._start
            before = np.where(b.opens, self._state.observed[b.environment], np.roll(after, 1))
            expected = np.where(b.was_reset & ~reset_only, given, before)
            known = expected >= 0 if reset_only.any() else np.ones(len(rows), np.bool_)
            self._compare(number, "state", np.where(known, rows["state"], expected), expected)
            self._compare(
                number, "next_state", np.where(reset_only, after, 0), np.where(reset_only, given, 0)
            )
        elif observed is not None and reset_only.any() and "next_observation" in names:
            same = _equal(rows["next_observation"][reset_only], observed[reset_only])
            if not same.all():
                at = np.flatnonzero(reset_only)[np.flatnonzero(~same)[0]]
                expected_value = "that of the reset before it"
                raise self._wrong(number[at], "next_observation", "another value", expected_value)
        if self._learners == 1 and "agents_terminated" in names:
            for name in ("terminated", "truncated"):
                self._compare(
                    b.number, f"agents_{name}", rows[f"agents_{name}"], rows[name].astype(np.uint32)
                )

    def _count_beginnings(self, b: Block) -> None:
        """Count the episodes after one that ended by itself, with a reset before them and without."""
        explained = b.was_reset | (b.rows["t"] > 0)
        if (missing := np.flatnonzero((b.number < self._n) & ~explained)).size:
            raise self._wrong(b.number[missing[0]], "reset", "none", "one before the first step")
        after_end = np.where(b.opens, self._state.over[b.environment], np.roll(b.over, 1))
        began = b.starts & ~b.reset_only & after_end
        without = np.flatnonzero(began & ~explained)
        if without.size and not self._findings.begun_without:
            self._findings.first_without = int(b.number[without].min())
        self._findings.begun_without += len(without)
        self._findings.begun_by_reset += int(np.count_nonzero(began & explained))

    def _returns(self, b: Block) -> Floats:
        """Return the summed rewards of each segment, added in their order as the recorder adds them."""
        rewards, carried = b.rows["rewards"], self._state.returns[b.owner]
        if b.reset_only.any():
            rewards = np.where(b.reset_only[:, np.newaxis], 0.0, rewards)
        sums: Floats = np.add.reduceat(rewards, b.heads, axis=0)
        with np.errstate(invalid="ignore", over="ignore"):
            if (np.abs(rewards) < 2**31).all() and (rewards == np.rint(rewards)).all():
                # Sums of whole numbers are the same in any order.
                return sums + np.where(b.continues[:, np.newaxis], carried, 0.0)
            for k, (head, tail) in enumerate(zip(b.heads.tolist(), b.tails.tolist(), strict=True)):
                part = rewards[head : tail + 1]
                if b.continues[k]:
                    part = np.concatenate([carried[k][np.newaxis], part])
                sums[k] = np.add.accumulate(part, axis=0)[-1]
        return sums

    def _counts(self, b: Block) -> Ints | None:
        """Return events and penalties of each segment, if the environment's table determines them."""
        if self._mdp is None:
            return None
        rows = b.rows
        paid = rows["rewards"][:, 0]
        counts, excluded = step_counts(self._mdp, paid, rows["state"], rows["action"], rows["next_state"])
        if excluded.any():
            if not self._findings.rewards_off_table:
                self._findings.first_off_table = int(b.number[excluded].min())
            self._findings.rewards_off_table += int(np.count_nonzero(excluded))
        sums: Ints = np.add.reduceat(counts, b.heads, axis=0)
        return sums + np.where(b.continues[:, np.newaxis], self._state.counts[b.owner], 0)

    def _check_episodes(
        self, b: Block, lengths: Ints, returns: Floats, counts: Ints | None, ended: Bools, interrupted: Bools
    ) -> None:
        """Compare the records of the episodes that ended in a block with its steps.

        Args:
            ended: whether each segment's episode ended in the block.
            interrupted: whether a reset before the segment ended the episode of the block before.
        """
        n, state, done = self._n, self._state, np.flatnonzero(ended)
        owners = b.heads[np.flatnonzero(interrupted)] // b.times
        last = np.concatenate([b.first - n + owners, b.number[b.tails[done]]])
        by_reset = np.concatenate([np.ones(len(owners), np.bool_), ~b.ends[b.tails[done]]])
        no_end = np.zeros(len(owners), np.bool_)
        expected: Expected = {
            "last_step": last,
            "length": np.concatenate([state.length[owners], lengths[done]]),
            "returns": np.concatenate([state.returns[owners], returns[done]]),
            **{
                name: np.concatenate([no_end, b.rows[name][b.tails[done]]]) & ~by_reset
                for name in ("terminated", "truncated")
            },
        }
        if counts is not None:
            expected |= self._counted(np.concatenate([state.counts[owners], counts[done]]))
        order = np.lexsort([last % n, by_reset, last // n])
        self._compare_episodes({name: values[order] for name, values in expected.items()}, len(order))

    def _counted(self, counts: Ints) -> Expected:
        """Return the fields of episode records for their events and penalties."""
        assert self._mdp is not None
        wanted = [self._mdp.event_names.index(name) for name in self._mdp.success_events]
        success = np.asarray((counts[:, wanted] > 0).any(axis=1))
        return {"penalties": counts[:, -1], "events": counts[:, :-1], "success": success}

    def _compare_episodes(self, expected: Expected, count: int) -> None:
        """Compare the next records of episodes with their expected fields."""
        found = self._blocks.episodes.take(count)
        have = 0 if found is None else len(found)
        if have < count and self._complete:
            raise Inconsistent(
                f"/{self._phase}/episode: found {self._state.ended + have} episodes, expected one that ended "
                f"at step {expected['last_step'][have]}"
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
        self._state.ended += count

    def _finish(self, steps: int) -> None:
        """Check the resets after the last step, and that there is nothing else."""
        state, rest = self._state, self._blocks.resets.take_while("step", steps + 1)
        if rest is not None and len(rest):
            environment = rest["environment"].astype(np.int64)
            is_known = environment < self._recording.own_environments
            if not is_known.all() or (rest["step"] != steps).any():
                raise Inconsistent(f"/{self._phase}/reset: found resets out of order, or of no environment")
            environment %= self._n
            cut = np.array([e for e in dict.fromkeys(environment.tolist()) if state.length[e]], np.int64)
            if len(cut):
                expected: Expected = {
                    "last_step": steps - self._n + cut,
                    "length": state.length[cut],
                    "returns": state.returns[cut],
                    "terminated": np.zeros(len(cut), np.bool_),
                    "truncated": np.zeros(len(cut), np.bool_),
                }
                if self._mdp is not None:
                    expected |= self._counted(state.counts[cut])
                self._compare_episodes(expected, len(cut))
                state.episode[cut] += 1
            self._check_reset_episodes(rest, state.episode[environment])
        for name, records in (("reset", self._blocks.resets), ("episode", self._blocks.episodes)):
            more = records.take(1)
            if more is not None and len(more):
                raise Inconsistent(f"/{self._phase}/{name}: found more records than the steps account for")

    def _compare(self, number: Ints, name: str, found: Array, expected: Array) -> None:
        if (wrong := np.flatnonzero(found != expected)).size:
            k = wrong[np.argmin(number[wrong])]
            raise self._wrong(number[k], name, found[k], expected[k])

    def _wrong(self, step: int, name: str, found: object, expected: object) -> Inconsistent:
        return Inconsistent(f"/{self._phase}/step, step {step}: {name}: found {found}, expected {expected}")


def _equal(found: Array, expected: Array) -> Bools:
    """Return which rows are the same, byte for byte; of numbers NaN equals NaN."""
    if found.dtype.names or found.dtype.kind == "V":
        found, expected = (
            np.ascontiguousarray(part).view(np.uint8).reshape(len(part), -1) for part in (found, expected)
        )
    same = found == expected
    if found.dtype.kind == "f":
        same |= np.isnan(found) & np.isnan(expected)
    return np.asarray(same.reshape(len(found), -1).all(axis=1))
