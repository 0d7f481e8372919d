"""The compiled loops of planning. No fast-math: the same tables give the same bits."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from runner.learning.compiling import leave_out_scipy
from runner.util.arrays import Flags, Floats, Ints, Ints32

leave_out_scipy()


class Chain(NamedTuple):
    """The steps of a deterministic policy in a deterministic environment, one for each state, [S] each."""

    next_state: Ints
    rewards: Floats
    """[S, L]."""
    terminated: Flags
    success: Flags
    """Whether the step is a success."""
    penalty: Flags


class Paths(NamedTuple):
    """The path from every state of a chain."""

    length: Ints
    """[S]: steps to the end of the episode; 0 where there is none."""
    cycle: Ints
    """[S]: number of the cycle that the path enters; -1 where the episode ends."""
    away: Ints
    """[S]: steps until the cycle; 0 for its members."""
    entry: Ints
    """[S]: index in `members` of the state by which the path enters its cycle."""
    members: Ints
    """States of all cycles, cycle by cycle, in the order they are visited."""
    offsets: Ints
    """[cycles + 1]: index in `members` at which each cycle begins."""


@numba.njit(cache=True, nogil=True)
def iterate_values(
    next_state: Ints32,
    weight: Floats,
    reward: Floats,
    values: Floats,
    tolerance: float,
) -> int:
    """Improve `values` in place, state by state, until no sweep changes one by more than the tolerance.

    Args:
        next_state: [S, A, K].
        weight: [S, A, K]: discounted probability that the outcome occurs and the episode continues.
        reward: [S, A]: expected.
        values: [S].
        tolerance: largest change of the last sweep.

    Returns:
        The number of sweeps.
    """
    states, actions, outcomes = next_state.shape
    sweeps = 0
    change = np.inf
    while change > tolerance:
        change = 0.0
        sweeps += 1
        for i in range(states):
            state = i if sweeps & 1 else states - 1 - i
            best = -np.inf
            for action in range(actions):
                value = reward[state, action]
                for k in range(outcomes):
                    value += weight[state, action, k] * values[next_state[state, action, k]]
                best = max(best, value)
            change = max(change, abs(best - values[state]))
            values[state] = best
    return sweeps


@numba.njit(cache=True, nogil=True)
def find_paths(chain: Chain) -> Paths:
    """Follow every state to the end of its episode, or into a cycle; each state is visited once."""
    states = len(chain.next_state)
    length = np.zeros(states, np.int64)
    cycle = np.full(states, -1, np.int64)
    away = np.zeros(states, np.int64)
    entry = np.zeros(states, np.int64)
    members = np.empty(states, np.int64)
    offsets = np.zeros(states + 1, np.int64)
    place = np.full(states, -1, np.int64)  # on the present path
    seen = np.zeros(states, np.bool_)
    way = np.empty(states, np.int64)
    cycles = 0
    for root in range(states):
        steps, state = 0, root
        ends = False
        while not seen[state] and not ends:
            seen[state] = True
            place[state] = steps
            way[steps] = state
            steps += 1
            ends = chain.terminated[state]
            if not ends:
                state = chain.next_state[state]
        if not ends and place[state] >= 0:
            first = place[state]
            begin = offsets[cycles]
            for i in range(first, steps):
                members[begin + i - first] = way[i]
                cycle[way[i]] = cycles
                entry[way[i]] = begin + i - first
            cycles += 1
            offsets[cycles] = begin + steps - first
            for i in range(first, steps):
                place[way[i]] = -1
            steps = first
        for i in range(steps - 1, -1, -1):
            state = way[i]
            place[state] = -1
            after = chain.next_state[state]
            if chain.terminated[state]:
                length[state] = 1
            elif cycle[after] < 0:
                length[state] = length[after] + 1
            else:
                cycle[state] = cycle[after]
                away[state] = away[after] + 1
                entry[state] = entry[after]
    return Paths(length, cycle, away, entry, members[: offsets[cycles]], offsets[: cycles + 1])


@numba.njit(cache=True, nogil=True)
def walk(chain: Chain, state: int, steps: int, returns: Floats, counts: Ints, times: int) -> int:
    """Add up rewards and counts of some steps from a state, `times` over; return the state after them.

    Args:
        chain: the steps.
        state: the first state.
        steps: number of steps.
        returns: [L]: the sums to add to.
        counts: [2]: successes and penalties, to add to.
        times: number of times that the path is repeated.
    """
    for _ in range(steps):
        for i in range(len(returns)):
            returns[i] += times * chain.rewards[state, i]
        counts[0] += times * chain.success[state]
        counts[1] += times * chain.penalty[state]
        state = chain.next_state[state]
    return state


@numba.njit(cache=True, nogil=True)
def play_all(chain: Chain, paths: Paths, starts: Ints, limit: int) -> tuple[Ints, Floats, Ints]:
    """Return length [N], returns [N, L] and counts [N, (successes, penalties)] of an episode from each start.

    An episode is truncated after `limit` steps. One round of a cycle counts for every further round.
    """
    learners = chain.rewards.shape[1]
    lengths = np.empty(len(starts), np.int64)
    returns = np.zeros((len(starts), learners))
    counts = np.zeros((len(starts), 2), np.int64)
    for n in range(len(starts)):
        state = starts[n]
        number = paths.cycle[state]
        if number < 0 or paths.away[state] >= limit:
            lengths[n] = limit if number >= 0 else min(limit, paths.length[state])
            walk(chain, state, lengths[n], returns[n], counts[n], 1)
            continue
        lengths[n] = limit
        around = paths.offsets[number + 1] - paths.offsets[number]
        left = limit - paths.away[state]
        state = walk(chain, state, paths.away[state], returns[n], counts[n], 1)
        if left >= around:
            walk(chain, state, around, returns[n], counts[n], left // around)
        walk(chain, state, left % around, returns[n], counts[n], 1)
    return lengths, returns, counts


@numba.njit(cache=True, nogil=True)
def expect(
    next_state: Ints32,
    probability: Floats,
    terminated: Flags,
    success: Flags,
    gains: Floats,
    limit: int,
) -> tuple[Floats, Floats]:
    """Return the probabilities of success and termination [S, 2], and expected sums [S, G], of an episode.

    Args:
        next_state: [S, K].
        probability: [S, K].
        terminated: [S, K].
        success: [S, K].
        gains: [S, G]: the expected addition of a step from each state.
        limit: steps of an episode.
    """
    states, outcomes = next_state.shape
    chances, sums = np.zeros((states, 2)), np.zeros(gains.shape)
    chances_before, sums_before = np.zeros((states, 2)), np.zeros(gains.shape)
    for _ in range(limit):
        chances, chances_before, sums, sums_before = chances_before, chances, sums_before, sums
        for state in range(states):  # loops: array expressions take seconds to compile
            chances[state, 0] = chances[state, 1] = 0.0
            for i in range(gains.shape[1]):
                sums[state, i] = gains[state, i]
            for k in range(outcomes):
                p, after = probability[state, k], next_state[state, k]
                goes_on = not terminated[state, k]
                chances[state, 0] += p * (1.0 if success[state, k] else goes_on * chances_before[after, 0])
                chances[state, 1] += p * (goes_on * chances_before[after, 1] + (1.0 - goes_on))
                if goes_on:
                    for i in range(gains.shape[1]):
                        sums[state, i] += p * sums_before[after, i]
    return chances, sums


@numba.njit(cache=True, nogil=True)
def discounted(
    next_state: Ints32,
    weight: Floats,
    rewards: Floats,
    values: Floats,
    tolerance: float,
) -> None:
    """Improve the values [S, L] of a policy in place until no sweep changes one by more than the tolerance.

    Args:
        next_state: [S, K].
        weight: [S, K]: discounted probability that the outcome occurs and the episode continues.
        rewards: [S, L]: expected.
        values: [S, L].
        tolerance: largest change of the last sweep.
    """
    states, outcomes = next_state.shape
    change = np.inf
    sweep = 0
    while change > tolerance:
        change = 0.0
        sweep += 1
        for i in range(states):
            state = i if sweep & 1 else states - 1 - i
            for learner in range(rewards.shape[1]):
                value = rewards[state, learner]
                for k in range(outcomes):
                    value += weight[state, k] * values[next_state[state, k], learner]
                change = max(change, abs(value - values[state, learner]))
                values[state, learner] = value


@numba.njit(cache=True, nogil=True)
def discounted_paths(chain: Chain, paths: Paths, order: Ints, discount: float, values: Floats) -> None:
    """Fill the discounted values [S, L] of a chain: cycles in closed form, the rest backwards.

    Args:
        chain: the steps.
        paths: of the chain.
        order: states outside cycles, those nearer to the end or the cycle first.
        discount: below 1.
        values: [S, L], filled.
    """
    for number in range(len(paths.offsets) - 1):
        begin, end = paths.offsets[number], paths.offsets[number + 1]
        for learner in range(values.shape[1]):
            total, factor = 0.0, 1.0
            for i in range(begin, end):
                total += factor * chain.rewards[paths.members[i], learner]
                factor *= discount
            value = total / (1.0 - factor)
            for i in range(end - 1, begin - 1, -1):
                value = chain.rewards[paths.members[i], learner] + discount * value
                values[paths.members[i], learner] = value
    for state in order:
        for learner in range(values.shape[1]):
            value = chain.rewards[state, learner]
            if not chain.terminated[state]:
                value += discount * values[chain.next_state[state], learner]
            values[state, learner] = value
