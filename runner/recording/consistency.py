"""Whether the steps, resets and episodes of a loop's recording follow from one another.

Much of what a loop's recording holds is implied by the rest: how its episodes are numbered and how long they
are, what they paid, the state before each step, which observation a reset gave. All of it is computed again
here, a block at a time, and compared.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import step_counts
from runner.recording import schema
from runner.recording.reader import Recording
from runner.recording.schema import NEVER

_ROWS: Final = 4096
"""Messages of varying size that are looked at together."""
_COUNTED: Final = ("penalties", "events", "success")


class Inconsistent(Exception):
    """Something that does not follow from the rest: the message says what, and where."""


@dataclass
class Findings:
    """What else is worth knowing of a phase that is consistent."""

    unpaid: int = 0
    """Steps whose reward the environment's table excludes."""
    first_unpaid: int = 0
    begun_by_reset: int = 0
    """Episodes after one that terminated or was truncated which began with a reset."""
    begun_without: int = 0
    first_without: int = 0
    """The first step of the first of those that did not."""
    last_time: int = 0
    """Logical time of the last step, in nanoseconds; 0 without steps."""


@dataclass
class _Carry:
    """How things stand in each environment between two blocks."""

    episode: NDArray[np.int64]
    """The number of the episode under way or to come."""
    length: NDArray[np.int64]
    """Steps of it so far."""
    returns: NDArray[np.float64]
    counts: NDArray[np.int64]
    """Events and penalties of it so far."""
    over: NDArray[np.bool_]
    """Whether the step before terminated or truncated its episode."""
    seen: NDArray[np.int64]
    """The state after the last step, -1 before any."""
    ended: int = 0
    """Episodes of all environments that have ended."""


def check_phase(recording: Recording, phase: str, complete: bool) -> Findings:
    """Compare the steps, resets and episodes of a phase with one another.

    Args:
        recording: of a loop.
        phase: `train` or `eval`.
        complete: whether the recording came to its end; else it is checked up to its last reset, behind which
            one may have been lost that was not yet written.

    Raises:
        Inconsistent: something does not follow from the rest.
        RecordingError: the recording cannot be read.
    """
    return _Phase(recording, phase, complete).check()


class _Phase:
    """The check of one phase."""

    def __init__(self, recording: Recording, phase: str, complete: bool) -> None:
        self._recording, self._phase, self._complete = recording, phase, complete
        self._n = n = recording.environments
        learners = len(recording.agents)
        self._learners = learners
        self._mdp = recording.mdp if recording.tabular else None
        counted = 1 + (len(self._mdp.event_names) if self._mdp else 0)
        self._at = _Carry(
            np.zeros(n, np.int64),
            np.zeros(n, np.int64),
            np.zeros((n, learners)),
            np.zeros((n, counted), np.int64),
            np.zeros(n, np.bool_),
            np.full(n, -1, np.int64),
        )
        self._findings = Findings()
        self._states = recording.kind == "step"
        self._start = int(recording.spaces["observation"]["start"]) if self._states else 0
        self._resets = _Buffer(_records(recording, f"/{phase}/reset"))
        self._episodes = _Buffer(_records(recording, f"/{phase}/episode"))

    def check(self) -> Findings:
        """Check all steps, and what is behind the last."""
        first, stop = 0, None if self._complete else self._last_reset()
        for rows in self._aligned(stop):
            self._check_block(first, rows)
            first += len(rows)
        if self._complete:
            self._finish(first)
        return self._findings

    def _last_reset(self) -> int:
        """Return the number of the step that followed the last reset that is recorded."""
        last = 0
        for block in _records(self._recording, f"/{self._phase}/reset"):
            last = int(block["step"][-1])
        return last

    def _aligned(self, stop: int | None) -> Iterator[NDArray[np.void]]:
        """Yield the steps in blocks of whole steps of all environments."""
        left: NDArray[np.void] | None = None
        done = 0
        for block in _records(self._recording, f"/{self._phase}/step"):
            rows = block if left is None or not len(left) else np.concatenate([left, block])
            if stop is not None:
                rows = rows[: max(stop - done, 0)]
            whole = len(rows) - len(rows) % self._n
            left = rows[whole:]
            if whole:
                yield rows[:whole]
            done += whole
        if left is not None and len(left) and self._complete:
            raise Inconsistent(
                f"/{self._phase}/step: found {done + len(left)} steps, expected as many of each of the "
                f"{self._n} environments"
            )

    def _check_block(self, first: int, rows: NDArray[np.void]) -> None:
        """Check some steps of all environments, and the resets before each of them.

        Within, everything is ordered by environment, and by time within each.
        """
        self._check_times(first, rows["log_time"].astype(np.int64))
        n, times = self._n, len(rows) // self._n
        order = np.arange(len(rows)).reshape(times, n).T.ravel()
        rows = rows[order] if n > 1 else rows
        number = first + order
        environment = np.repeat(np.arange(n), times)
        opens = np.zeros(len(rows), np.bool_)
        opens[::times] = True  # the first row of each environment
        resets = self._resets.take_while("step", first + len(rows))
        was_reset, observed = self._place_resets(resets, first, times, len(rows))

        over = rows["terminated"] | rows["truncated"]
        ends = over | self._quiet_ends(first, len(rows))
        never = rows["t"] == NEVER
        after_end = np.where(opens, self._at.over[environment], np.roll(over, 1))
        starts = opens | np.where(opens, False, np.roll(ends, 1)) | was_reset
        if (wrong := np.flatnonzero(never & ~was_reset)).size:
            raise self._wrong(number[wrong[0]], "t", "that of a reset alone", "a reset before it")

        segment = np.cumsum(starts) - 1
        heads = np.flatnonzero(starts)
        tails = np.append(heads[1:], len(rows)) - 1
        goes_on = opens[heads] & ~was_reset[heads]
        own = environment[heads]
        counted = np.cumsum(~never)
        before = counted[heads] - ~never[heads]
        carried = np.where(goes_on, self._at.length[own], 0)
        expected_t = np.where(never, NEVER, counted - ~never - before[segment] + carried[segment])
        self._compare(number, "t", rows["t"], expected_t)

        lengths = counted[tails] - before + carried
        next_reset = np.append(was_reset[heads[1:]] & ~opens[heads[1:]], False)
        ended = ends[tails] | (next_reset & (lengths > 0))
        interrupted = opens[heads] & was_reset[heads] & (self._at.length[own] > 0)
        finished = np.cumsum(ended) - ended
        opening = opens[heads]
        base = np.maximum.accumulate(np.where(opening, np.arange(len(heads)), 0))
        numbers = self._at.episode[own] + finished - finished[base] + interrupted[base]
        self._compare(number, "episode", rows["episode"], numbers[segment])
        self._check_resets(resets, first, times, numbers, segment)
        self._check_observations(rows, number, opens, was_reset, never, observed, environment)
        self._count_beginnings(number, starts & ~never, after_end, was_reset | (rows["t"] > 0))

        returns = self._segment_sums(rows["rewards"], never, heads, tails, goes_on, own)
        counts = self._segment_counts(rows, number, heads, goes_on, own)
        self._check_episodes(
            first, times, number, rows, heads, tails, lengths, returns, counts, ended, ends, interrupted
        )
        self._carry(tails, ended, lengths, returns, counts, numbers, over, rows, times)

    def _check_times(self, first: int, times: NDArray[np.int64]) -> None:
        """Compare the times of steps: each step of either phase takes one tick, so they increase."""
        before = np.concatenate([[self._findings.last_time], times[:-1]])
        wrong = np.flatnonzero((times <= before) | (times % schema.STEP_NANOSECONDS != 0))
        if wrong.size:
            k = wrong[0]
            raise self._wrong(first + k, "log_time", times[k], f"a later tick than {before[k]}")
        self._findings.last_time = int(times[-1])

    def _place_resets(
        self, resets: NDArray[np.void] | None, first: int, times: int, count: int
    ) -> tuple[NDArray[np.bool_], NDArray[Any] | None]:
        """Return before which rows there was a reset, and what the last of them gave for each row."""
        was_reset = np.zeros(count, np.bool_)
        if resets is None or not len(resets):
            return was_reset, None
        step, environment = resets["step"], resets["environment"].astype(np.int64)
        if ((environment >= self._n) | (step % self._n != 0) | (step < first)).any():
            raise Inconsistent(f"/{self._phase}/reset: found resets out of order, or of no environment")
        at = environment * times + (step - first) // self._n
        was_reset[at] = True
        if "observation" not in (resets.dtype.names or ()):
            return was_reset, None
        observed = np.zeros(count, resets.dtype["observation"])
        observed[at] = resets["observation"]  # of several at one place the last counts
        return was_reset, observed

    def _quiet_ends(self, first: int, count: int) -> NDArray[np.bool_]:
        """Return the rows at which a game ended though no agent's end was recorded: its episodes say so."""
        quiet = np.zeros(count, np.bool_)
        if self._learners > 1 and self._n == 1:
            for block in self._episodes.peek_while("last_step", first + count):
                silent = ~(block["terminated"] | block["truncated"]) & (block["last_step"] >= first)
                quiet[block["last_step"][silent] - first] = True
        return quiet

    def _check_resets(
        self,
        resets: NDArray[np.void] | None,
        first: int,
        times: int,
        numbers: NDArray[Any],
        segment: NDArray[Any],
    ) -> None:
        if resets is None or not len(resets):
            return
        at = resets["environment"].astype(np.int64) * times + (resets["step"] - first) // self._n
        expected = numbers[segment[at]]
        if (wrong := np.flatnonzero(resets["episode"] != expected)).size:
            k = wrong[0]
            raise Inconsistent(
                f"/{self._phase}/reset, reset {resets['reset'][k]}: episode: found {resets['episode'][k]}, "
                f"expected {expected[k]}"
            )

    def _check_observations(
        self,
        rows: NDArray[np.void],
        number: NDArray[Any],
        opens: NDArray[np.bool_],
        was_reset: NDArray[np.bool_],
        never: NDArray[np.bool_],
        observed: NDArray[Any] | None,
        environment: NDArray[Any],
    ) -> None:
        """Compare the states before steps with those after the steps, or resets, before them."""
        if self._states:
            after = rows["next_state"].astype(np.int64)
            given = np.zeros(len(rows), np.int64)
            if observed is not None:
                given = observed.astype(np.int64).reshape(-1) - self._start
            before = np.where(opens, self._at.seen[environment], np.roll(after, 1))
            expected = np.where(was_reset & ~never, given, before)
            known = expected >= 0 if never.any() else np.ones(len(rows), np.bool_)
            self._compare(number, "state", np.where(known, rows["state"], expected), expected)
            self._compare(number, "next_state", np.where(never, after, 0), np.where(never, given, 0))
        elif observed is not None and never.any():
            names = rows.dtype.names or ()
            if "next_observation" in names:
                same = _equal(rows["next_observation"][never], observed[never])
                if not same.all():
                    at = np.flatnonzero(never)[np.flatnonzero(~same)[0]]
                    raise self._wrong(
                        number[at], "next_observation", "another value", "what the reset before it gave"
                    )
        if self._learners == 1 and "agents_terminated" in (rows.dtype.names or ()):
            for name in ("terminated", "truncated"):
                self._compare(number, f"agents_{name}", rows[f"agents_{name}"], rows[name].astype(np.uint32))

    def _count_beginnings(
        self, number: NDArray[Any], starts: NDArray[Any], after_end: NDArray[Any], explained: NDArray[Any]
    ) -> None:
        """Count the episodes that follow one that ended by itself, with a reset before them and without."""
        if (missing := np.flatnonzero((number < self._n) & ~explained)).size:
            raise self._wrong(number[missing[0]], "reset", "none", "one before the first step")
        began = starts & after_end
        without = np.flatnonzero(began & ~explained)
        if without.size and not self._findings.begun_without:
            self._findings.first_without = int(number[without].min())
        self._findings.begun_without += len(without)
        self._findings.begun_by_reset += int(np.count_nonzero(began & explained))

    def _segment_sums(
        self,
        rewards: NDArray[np.float64],
        never: NDArray[np.bool_],
        heads: NDArray[Any],
        tails: NDArray[Any],
        goes_on: NDArray[np.bool_],
        own: NDArray[Any],
    ) -> NDArray[np.float64]:
        """Return what each stretch of steps paid, added in their order as the recorder adds it."""
        rewards = np.where(never[:, np.newaxis], 0.0, rewards) if never.any() else rewards
        sums = np.add.reduceat(rewards, heads, axis=0)
        with np.errstate(invalid="ignore", over="ignore"):
            whole = (np.abs(rewards) < 2**31).all() and (rewards == np.rint(rewards)).all()
            if whole:  # sums of whole numbers are the same in any order
                return sums + np.where(goes_on[:, np.newaxis], self._at.returns[own], 0.0)
            for k, (head, tail) in enumerate(zip(heads.tolist(), tails.tolist(), strict=True)):
                part = rewards[head : tail + 1]
                if goes_on[k]:
                    part = np.concatenate([self._at.returns[own[k]][np.newaxis], part])
                sums[k] = np.add.accumulate(part, axis=0)[-1]
        return sums

    def _segment_counts(
        self,
        rows: NDArray[np.void],
        number: NDArray[Any],
        heads: NDArray[Any],
        goes_on: NDArray[np.bool_],
        own: NDArray[Any],
    ) -> NDArray[np.int64] | None:
        """Return events and penalties of each stretch of steps, where the environment's table tells them."""
        if self._mdp is None:
            return None
        paid = rows["rewards"][:, 0]
        counts, excluded = step_counts(self._mdp, paid, rows["state"], rows["action"], rows["next_state"])
        if excluded.any():
            if not self._findings.unpaid:
                self._findings.first_unpaid = int(number[excluded].min())
            self._findings.unpaid += int(np.count_nonzero(excluded))
        sums: NDArray[np.int64] = np.add.reduceat(counts, heads, axis=0)
        return sums + np.where(goes_on[:, np.newaxis], self._at.counts[own], 0)

    def _check_episodes(
        self,
        first: int,
        times: int,
        number: NDArray[Any],
        rows: NDArray[np.void],
        heads: NDArray[Any],
        tails: NDArray[Any],
        lengths: NDArray[Any],
        returns: NDArray[np.float64],
        counts: NDArray[np.int64] | None,
        ended: NDArray[np.bool_],
        ends: NDArray[np.bool_],
        interrupted: NDArray[np.bool_],
    ) -> None:
        """Compare the episodes that ended in a block with their records."""
        n, at = self._n, self._at
        cut = np.flatnonzero(interrupted)
        done = np.flatnonzero(ended)
        owners = heads[cut] // times
        last = np.concatenate([first - n + owners, number[tails[done]]])
        by_reset = np.concatenate([np.ones(len(cut), np.bool_), ~ends[tails[done]]])
        flags = {
            name: np.concatenate(
                [np.zeros(len(cut), np.bool_), rows[name][tails[done]] & ~by_reset[len(cut) :]]
            )
            for name in ("terminated", "truncated")
        }
        expected = {
            "last_step": last,
            "length": np.concatenate([at.length[owners], lengths[done]]),
            "returns": np.concatenate([at.returns[owners], returns[done]]),
            **flags,
        }
        if counts is not None:
            expected |= self._counted(np.concatenate([at.counts[owners], counts[done]]))
        order = np.lexsort([last % n, by_reset, last // n])
        self._compare_episodes({name: values[order] for name, values in expected.items()}, len(order))

    def _counted(self, counts: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
        """Return what the records of episodes say of their events and penalties."""
        assert self._mdp is not None
        wanted = [self._mdp.event_names.index(name) for name in self._mdp.success_events]
        success = np.asarray((counts[:, wanted] > 0).any(axis=1))
        return {"penalties": counts[:, -1], "events": counts[:, :-1], "success": success}

    def _compare_episodes(self, expected: dict[str, NDArray[Any]], count: int) -> None:
        """Compare the next records of episodes with what they must be."""
        found = self._episodes.take(count)
        have = 0 if found is None else len(found)
        if have < count and self._complete:
            raise Inconsistent(
                f"/{self._phase}/episode: found {self._at.ended + have} episodes, expected one that ended at "
                f"step {expected['last_step'][have]}"
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
        self._at.ended += count

    def _carry(
        self,
        tails: NDArray[Any],
        ended: NDArray[np.bool_],
        lengths: NDArray[Any],
        returns: NDArray[np.float64],
        counts: NDArray[np.int64] | None,
        numbers: NDArray[Any],
        over: NDArray[np.bool_],
        rows: NDArray[np.void],
        times: int,
    ) -> None:
        """Keep how things stand after the last step of each environment."""
        final = np.flatnonzero((tails + 1) % times == 0)
        at, closed = self._at, ended[final]
        at.episode = numbers[final] + closed
        at.length = np.where(closed, 0, lengths[final])
        at.returns = np.where(closed[:, np.newaxis], 0.0, returns[final])
        if counts is not None:
            at.counts = np.where(closed[:, np.newaxis], 0, counts[final])
        at.over = over[tails[final]]
        if self._states:
            at.seen = rows["next_state"][tails[final]].astype(np.int64)

    def _finish(self, steps: int) -> None:
        """Check the resets after the last step, and that there is nothing else."""
        rest = self._resets.take_while("step", steps + 1)
        if rest is not None and len(rest):
            environment = rest["environment"].astype(np.int64)
            if (environment >= self._n).any() or (rest["step"] != steps).any():
                raise Inconsistent(f"/{self._phase}/reset: found resets out of order, or of no environment")
            cut = np.array([e for e in dict.fromkeys(environment.tolist()) if self._at.length[e]], np.int64)
            if len(cut):
                false = np.zeros(len(cut), np.bool_)
                expected = {
                    "last_step": steps - self._n + cut,
                    "length": self._at.length[cut],
                    "returns": self._at.returns[cut],
                    "terminated": false,
                    "truncated": false,
                }
                if self._mdp is not None:
                    expected |= self._counted(self._at.counts[cut])
                self._compare_episodes(expected, len(cut))
                self._at.episode[cut] += 1
            if (wrong := np.flatnonzero(rest["episode"] != self._at.episode[environment])).size:
                raise Inconsistent(
                    f"/{self._phase}/reset, reset {rest['reset'][wrong[0]]}: episode: found "
                    f"{rest['episode'][wrong[0]]}, expected {self._at.episode[environment[wrong[0]]]}"
                )
        for name, buffer in (("reset", self._resets), ("episode", self._episodes)):
            more = buffer.take(1)
            if more is not None and len(more):
                raise Inconsistent(f"/{self._phase}/{name}: found more records than the steps account for")

    def _compare(self, number: NDArray[Any], name: str, found: NDArray[Any], expected: NDArray[Any]) -> None:
        if (wrong := np.flatnonzero(found != expected)).size:
            k = wrong[np.argmin(number[wrong])]
            raise self._wrong(number[k], name, found[k], expected[k])

    def _wrong(self, step: int, name: str, found: object, expected: object) -> Inconsistent:
        return Inconsistent(f"/{self._phase}/step, step {step}: {name}: found {found}, expected {expected}")


class _Buffer:
    """Records of a topic in order, taken off as they are needed."""

    def __init__(self, blocks: Iterator[NDArray[np.void]]) -> None:
        self._blocks = blocks
        self._held: list[NDArray[np.void]] = []

    def take(self, count: int) -> NDArray[np.void] | None:
        """Return the next records, at most `count`; None if there are none."""
        while sum(map(len, self._held)) < count and self._more():
            continue
        if not self._held:
            return None
        whole = np.concatenate(self._held)
        self._held = [whole[count:]] if len(whole) > count else []
        return whole[:count]

    def take_while(self, name: str, stop: int) -> NDArray[np.void] | None:
        """Return the next records whose field is below `stop`; the field never decreases."""
        return self.take(sum(len(part) for part in self.peek_while(name, stop)))

    def peek_while(self, name: str, stop: int) -> list[NDArray[np.void]]:
        """Return the same, and leave them."""
        while not self._held or self._held[-1][name][-1] < stop:
            if not self._more():
                break
        parts = []
        for part in self._held:
            behind = np.flatnonzero(part[name] >= stop)
            parts.append(part[: behind[0]] if behind.size else part)
            if behind.size:
                break
        return parts

    def _more(self) -> bool:
        block = next((block for block in self._blocks if len(block)), None)
        if block is not None:
            self._held.append(block)
        return block is not None


def _records(recording: Recording, name: str) -> Iterator[NDArray[np.void]]:
    """Yield the records of a topic in blocks; of messages that vary in size all but their values.

    Raises:
        Inconsistent: messages of varying size are misnumbered, or have not one reward for each learner.
    """
    topic = recording.topic(name)
    if topic in recording.dtypes:
        yield from recording.blocks(topic)
        return
    learners = len(recording.agents)
    kinds = {"rewards": ("f8", (learners,)), "terminated": "?", "truncated": "?"}
    fields = [
        (each.name, kinds.get(each.name, "i8"))
        for each in topic.message.fields
        if each.name not in ("action", "observation", "next_observation", "seed", "seeded")
    ]
    fields.append(("log_time", "u8"))
    rows: list[tuple[Any, ...]] = []
    number = schema.NUMBERED_BY[topic.message]
    for expected, message in enumerate(recording.decoded(topic)):
        if message[number] != expected:
            raise Inconsistent(f"{name}: found {number} {message[number]}, expected {expected}")
        if len(message.get("rewards", [None] * learners)) != learners:
            raise Inconsistent(
                f"{name}, {number} {expected}: found {len(message['rewards'])} rewards, expected {learners}"
            )
        values = (message[field] for field, _ in fields)
        rows.append(tuple(tuple(value) if isinstance(value, list) else value for value in values))
        if len(rows) == _ROWS:
            yield np.array(rows, np.dtype(fields))
            rows = []
    if rows:
        yield np.array(rows, np.dtype(fields))


def _equal(found: NDArray[Any], expected: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which rows are the same, byte for byte; of numbers NaN equals NaN."""
    if found.dtype.kind == "f":
        same = (found == expected) | (np.isnan(found) & np.isnan(expected))
    elif found.dtype.names or found.dtype.kind == "V":
        left, right = (
            np.ascontiguousarray(part).view(np.uint8).reshape(len(part), -1) for part in (found, expected)
        )
        same = left == right
    else:
        same = found == expected
    return np.asarray(same.reshape(len(found), -1).all(axis=1))
