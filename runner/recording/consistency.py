"""Whether the steps, resets and episodes of a loop's recording follow from one another.

Much of what a loop's recording holds is implied by the rest: how its episodes are numbered and how long they
are, their returns, the state before each step, the observation of a reset. All of it is computed again,
a block at a time, and compared.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from runner.environments.mdp import step_counts
from runner.recording import schema
from runner.recording.description import environment_count
from runner.recording.episode_log import Columns, EpisodeLog, TurnBlock
from runner.recording.reader import Recording
from runner.recording.spaces import least_number
from runner.recording.steps import aligned, is_taken
from runner.recording.topic_chunks import TopicChunks
from runner.util.arrays import Array, Flags, Ints, Records, zeros
from runner.util.differences import first_differing_row

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
    """Episodes that a reset began after the episode before had terminated or was truncated."""
    begun_without: int = 0
    """Episodes that began without a reset after such an end."""
    first_without: int = 0
    """The first step of the first of these."""
    last_time: int = 0
    """Logical time of the last step, in nanoseconds; 0 without steps."""


def check_phase(recording: Recording, phase: str, complete: bool) -> Findings:
    """Compare the steps, resets and episodes of a phase with one another.

    Args:
        complete: whether the recording was completed; else it is checked up to its last reset, as later ones
            may not have been written.

    Raises:
        Inconsistent: something does not follow from the rest.
    """
    recorded = recording.phase(phase)
    for table in (recorded.resets, recorded.episodes):
        for _ in _numbered(table):
            pass
    if recording.leaves_out_steps and not recorded.steps.are_actions:
        return Findings()
    if recorded.steps.are_actions and not recording.leaves_out_steps:
        raise Inconsistent(
            f"{recorded.steps.topic.name}: found actions alone, expected whole steps as in the configuration"
        )
    last = recorded.resets.last()
    stop = 0 if last is None else int(last["step"])
    return _PhaseCheck(recording, phase, None if complete else stop).check()


def check_extras(recording: Recording, phase: str, complete: bool) -> None:
    """Compare the extras of a phase with its steps: each belongs to a step, at its time, in their order.

    Args:
        complete: whether the recording was completed; else the steps of the last extras may be missing.

    Raises:
        Inconsistent: one does not.
    """
    recorded = recording.phase(phase)
    steps = recorded.steps
    extras = recorded.extras
    topic = recorded.topics.extras
    last = -1
    # Steps of varying size are not looked up: their extras are only counted, and compared with one another.
    total = steps.total() if extras else 0
    if recording.leaves_out_steps and not steps.are_known:
        total = recording.result.get(f"{phase}_steps", _MAX_STEPS)
    for block in extras.blocks(stop=None if complete else total):
        numbers = block["step"]
        where = f"{topic.name}, step {block['step'][0]} and later"
        if numbers[0] <= last or (np.diff(numbers) <= 0).any() or numbers[-1] >= total:
            raise Inconsistent(f"{where}: found steps out of order, or after the last of {total:,}")
        last = int(numbers[-1])
        for name in block["values"].dtype.names or ():
            given, values = block["given"][name], block["values"][name]
            unknown = values[~given]
            is_any = any(map(len, unknown)) if values.dtype.hasobject else unknown.any()
            if (given.view(np.uint8) > 1).any() or is_any:
                raise Inconsistent(f"{where}: {name}: found values where none were given")
        if steps and steps.dtype is not None:
            parts = steps.blocks(int(numbers[0]), last + 1)
            times = np.concatenate([part["log_time"][np.isin(part["step"], numbers)] for part in parts])
            if len(times) != len(block) or (times != block["log_time"]).any():
                raise Inconsistent(f"{where}: found other times than those of the steps")


class _Resets:
    """The resets of a phase, taken once in their order: memory is bounded, however many there are."""

    def __init__(self, table: TopicChunks) -> None:
        self._blocks = table.rows()
        self.left = np.empty(0, table.row_dtype)
        """What was read and not yet taken."""

    def before(self, step: int) -> Iterator[Records]:
        """Yield the next resets in blocks, up to the first at this step or a later one."""
        while len(resets := self.left if len(self.left) else next(self._blocks, self.left)):
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
        self._recording = recording
        self._phase = recording.phase(phase)
        self._stop = stop
        self._n = recording.environments
        self._learners = len(recording.agents)
        self._is_whole = not self._phase.steps.are_actions
        """Whether steps have observations and rewards, and not their actions alone."""
        self._mdp = recording.mdp if recording.tabular and self._is_whole else None
        self._episodes = EpisodeLog(self._n, self._learners, self._mdp, recording.layout.has_turns)
        self._environments = np.arange(self._n)
        """The environments of the last round; the environments of shards follow one another."""
        self._over = np.zeros(self._n, np.bool_)
        """Whether the last step of each environment terminated or truncated its episode."""
        self._state = np.full(self._n, -1, np.int64)
        """The state after that step, -1 before any."""
        self._findings = Findings()
        self._resets, self._numbered_resets = _Resets(self._phase.resets), _Resets(self._phase.resets)
        """To find where environments were reset, and to compare with the episodes that follow from it."""
        self._endings = self._phase.episodes.blocks()
        self._silent_ends, self._last_end = np.empty(0, np.int64), -1
        """Of the last block of `_endings`: the steps that ended an episode silently, and its last step."""

    def check(self) -> Findings:
        """Check all steps, and what comes after the last."""
        steps = left = 0
        for rows, waiting in aligned(_numbered(self._phase.steps), self._n, self._stop):
            left = waiting
            if len(rows):
                self._check_block(steps, rows.reshape(-1, self._n))
                steps += len(rows)
        if self._stop is None:
            if left:
                raise Inconsistent(
                    f"{self._phase.steps.topic.name}: found {steps + left} steps, expected as many of each "
                    f"of the {self._n} environments"
                )
            self._finish(steps)
        return self._findings

    def _check_block(self, first: int, rows: Records) -> None:
        """Check steps of all environments, [steps of each, environments], and the resets before them.

        Args:
            first: the number of the first step.
        """
        numbers = range(first, first + rows.size)
        names = rows.dtype.names or ()
        self._check_times(numbers, rows)
        given, was_reset, environment = self._given(numbers, rows.shape)
        only_reset = ~is_taken(rows)
        if (wrong := np.flatnonzero(only_reset & ~was_reset)).size:
            raise self._wrong("step", numbers[wrong[0]], "taken", "no step", "a reset before it")
        ends = rows["terminated"], rows["truncated"]
        is_over, counts = self._is_over(numbers, rows), self._counts(first, rows)
        rewards = rows["rewards"] if self._is_whole else np.zeros((*rows.shape, self._learners))
        episodes = self._episodes.take(
            TurnBlock(first, rewards, *ends, was_reset, only_reset, is_over, counts, environment)
        )
        expected: Columns = {"t": episodes.t, "episode": episodes.number}
        if "environment" in names:
            expected["environment"] = environment
        if self._recording.has_states and self._is_whole:
            expected |= self._states(rows, given, was_reset, only_reset)
        elif only_reset.any() and "next_observation" in names:
            observed = rows["next_observation"][only_reset]
            if (row := first_differing_row(observed, given[only_reset], 0.0)) is not None:
                number = numbers[np.flatnonzero(only_reset)[row]]
                value = "that of the reset before it"
                raise self._wrong("step", number, "next_observation", "another value", value)
        if self._learners == 1 and "agents_terminated" in names:
            expected |= {
                f"agents_{name}": rows[name].astype(np.uint32) for name in ("terminated", "truncated")
            }
        self._compare("step", rows.ravel(), expected)
        for resets in self._numbered_resets.before(numbers.stop):
            self._compare("reset", resets, {"episode": episodes.number[self._places(first, resets)]})
        over = ends[0] | ends[1]
        began = ~only_reset & np.vstack([self._over, over[:-1]])
        self._count_beginnings(first, was_reset | (rows["t"] > 0), began)
        self._compare_episodes(episodes.ended)
        self._over = over[-1]

    def _given(self, numbers: range, shape: tuple[int, ...]) -> tuple[Array, Flags, Ints]:
        """Return what the last reset before each step observed, whether there was one, and the environment.

        They are [steps of each environment, environments].
        """
        first, resets = numbers.start, self._resets
        given = zeros(shape, resets.left.dtype["observation"])
        was_reset = np.zeros(shape, np.bool_)
        environment = np.broadcast_to(self._environments, shape).astype(np.int64)
        for block in resets.before(numbers.stop):
            step = block["step"]
            is_unknown = block["environment"] >= environment_count(self._recording)
            if (is_unknown | (step % self._n != 0) | (step < first)).any():
                raise self._out_of_order()
            at = self._places(first, block)  # of several resets before a step the last counts
            given[at] = block["observation"]
            was_reset[at] = True
            environment[at] = block["environment"]
        begins = np.where(was_reset, np.arange(len(given))[:, np.newaxis], 0)
        begins = np.maximum.accumulate(begins, axis=0)
        environment = np.take_along_axis(environment, begins, axis=0)
        self._environments = environment[-1]
        return given, was_reset, environment

    def _places(self, first: int, resets: Records) -> tuple[Ints, Ints]:
        """Return the places of resets among the rows of a block that begins with step `first`."""
        return (resets["step"] - first) // self._n, resets["environment"].astype(np.int64) % self._n

    def _check_times(self, numbers: range, rows: Records) -> None:
        """Compare the times of steps: each step of either phase takes one tick, so they increase."""
        times = rows["log_time"].astype(np.int64).ravel()
        before = np.concatenate([[self._findings.last_time], times[:-1]])
        wrong = np.flatnonzero((times <= before) | (times % schema.STEP_NANOSECONDS != 0))
        if wrong.size:
            k = wrong[0]
            raise self._wrong("step", numbers[k], "log_time", times[k], f"a later tick than {before[k]}")
        self._findings.last_time = int(times[-1])

    def _states(self, rows: Records, given: Array, was_reset: Flags, only_reset: Flags) -> Columns:
        """Return the states before and after steps, by the steps, or resets, before them."""
        least = least_number(self._recording.spaces["observation"])
        after = rows["next_state"].astype(np.int64)
        begun = given.reshape(rows.shape).astype(np.int64) - least
        state = np.where(was_reset & ~only_reset, begun, np.vstack([self._state, after[:-1]]))
        if only_reset.any():
            state = np.where(state < 0, rows["state"], state)  # unknown
        self._state = after[-1]
        return {"state": state, "next_state": np.where(only_reset, begun, after)}

    def _is_over(self, numbers: range, rows: Records) -> Flags:
        """Return where a game of several agents ended without the end of any: its episode record says so."""
        is_over = np.zeros(rows.shape, np.bool_)
        while self._learners > 1 and self._n == 1:
            begin, stop = np.searchsorted(self._silent_ends, [numbers.start, numbers.stop])
            is_over[self._silent_ends[begin:stop] - numbers.start] = True
            if self._last_end >= numbers.stop or (block := next(self._endings, None)) is None:
                break
            is_silent = ~(block["terminated"] | block["truncated"])
            self._silent_ends = np.sort(block["last_step"][is_silent].astype(np.int64))
            self._last_end = int(block["last_step"][-1])
        return is_over

    def _count_beginnings(self, first: int, explained: Flags, began: Flags) -> None:
        """Count the episodes after one that ended by itself, with a reset before them and without.

        Args:
            explained: where a reset came before a step, or its episode had begun.
            began: where a step came after such an end.
        """
        if first == 0 and (missing := np.flatnonzero(~explained[0])).size:
            raise self._wrong("step", missing[0], "reset", "none", "one before the first step")
        without = np.flatnonzero(began & ~explained)
        if without.size and not self._findings.begun_without:
            self._findings.first_without = first + int(without[0])
        self._findings.begun_without += len(without)
        self._findings.begun_by_reset += int(np.count_nonzero(began & explained))

    def _counts(self, first: int, steps: Records) -> Ints | None:
        """Return events and penalties of each step, if the environment's table determines them."""
        if self._mdp is None:
            return None
        rows = steps.ravel()
        transitions = rows["state"], rows["action"], rows["next_state"]
        counts, excluded = step_counts(self._mdp, rows["rewards"][:, 0], *transitions)
        outcomes = self._mdp.outcomes_to(*transitions)
        self._findings.not_outcomes += int(np.count_nonzero(~outcomes.any(axis=1)))
        if excluded.any():
            if not self._findings.rewards_off_table:
                self._findings.first_off_table = first + int(np.argmax(excluded))
            self._findings.rewards_off_table += int(np.count_nonzero(excluded))
        return counts.reshape(*steps.shape, -1)

    def _compare_episodes(self, expected: Columns) -> None:
        """Compare the next records of episodes with their expected fields."""
        if not (count := len(expected["episode"])):
            return
        first = int(expected["episode"][0])
        found = self._phase.episodes.array(first, first + count)
        have = len(found)
        if have < count and self._stop is None:
            raise Inconsistent(
                f"/{self._phase.name}/episode: found {first + have} episodes, expected one that ended at "
                f"step {expected['last_step'][have]}"
            )
        known = expected.keys() if self._is_whole else expected.keys() - {"returns"}
        self._compare("episode", found, {name: expected[name][:have] for name in sorted(known)})

    def _finish(self, steps: int) -> None:
        """Check the resets after the last step, and that there is nothing else."""
        for resets in self._resets.before(steps + 1):
            environment = resets["environment"].astype(np.int64)
            if (environment >= environment_count(self._recording)).any() or (resets["step"] != steps).any():
                raise self._out_of_order()
            environment %= self._n
            first_of_each = np.sort(np.unique(environment, return_index=True)[1])
            self._compare_episodes(self._episodes.interrupt(steps, environment[first_of_each]))
            self._compare("reset", resets, {"episode": self._episodes.episode[environment]})
        has_more = {
            "reset": len(self._resets.left) > 0,
            "episode": self._phase.episodes.count() > self._episodes.ended,
        }
        for name, found in has_more.items():
            if found:
                raise Inconsistent(
                    f"/{self._phase.name}/{name}: found more records than the steps account for"
                )

    def _compare(self, what: str, found: Records, expected: Columns) -> None:
        """Compare fields of steps, resets or episodes; `what` is the field with their number, too."""
        for name, values in expected.items():
            columns = found[name], values.reshape(found[name].shape)
            if (row := first_differing_row(*columns, 0.0)) is not None:
                was, should = (column[row] for column in columns)
                should = f"{should} by its steps" if what == "episode" else should
                raise self._wrong(what, found[what][row], name, was, should)

    def _out_of_order(self) -> Inconsistent:
        return Inconsistent(f"/{self._phase.name}/reset: found resets out of order, or of no environment")

    def _wrong(self, what: str, number: int, name: str, found: object, expected: object) -> Inconsistent:
        return Inconsistent(
            f"/{self._phase.name}/{what}, {what} {number}: {name}: found {found}, expected {expected}"
        )


def _numbered(table: TopicChunks) -> Iterator[Records]:
    """Yield the records of a topic in blocks, as `TopicChunks.rows` does.

    Raises:
        Inconsistent: messages are not numbered consecutively.
    """
    first = 0
    number = schema.NUMBERED_BY[table.topic.message]
    for block in table.rows():
        if (wrong := np.flatnonzero(block[number] != first + np.arange(len(block)))).size:
            found, expected = block[number][wrong[0]], first + wrong[0]
            raise Inconsistent(f"{table.topic.name}: found {number} {found}, expected {expected}")
        yield block
        first += len(block)
