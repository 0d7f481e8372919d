"""The settings of an explanation as players of a cooperative game, whose coalitions are mixtures.

A mixture is a number whose bit i is 1 if setting i has the value of B, and 0 if it has that of A: mixture 0
is A, and mixture 2^k - 1 is B. The game gives the share of each setting in the difference, and the smallest
set of settings that makes it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

import numpy as np

from runner.analysis.statistics import Estimate, bootstrap_means
from runner.debugging.explanation import ENOUGH, Interaction, Mixture, Setting
from runner.debugging.mixtures import MAX_ALL, Mixtures
from runner.util.arrays import Floats

T = TypeVar("T")
_START_SECONDS: Final = 10.0
"""About the time to start workers, load kernels in them, and record the two short runs of the first step."""


def shapley_values(values: Floats) -> Floats:
    """Return the share of each setting: its effect, averaged over all orders in which settings change.

    L. S. Shapley, "A value for n-person games", 1953. The shares of all settings, [k, columns], add up to the
    difference between the last mixture and the first, of values [2^k, columns].
    """
    return np.array([_effect(values, (i,)) for i in range(len(values).bit_length() - 1)])


def shapley_interactions(values: Floats) -> dict[tuple[int, int], Floats]:
    """Return what each pair of settings (i, j), i < j, does together beyond the effect of each.

    The Shapley interaction index of M. Grabisch and M. Roubens, "An axiomatic approach to the concept of
    interaction among players in cooperative games", 1999: an average over the other settings, [columns] of
    values [2^k, columns]. It is 0 for settings whose effects add up.
    """
    pairs = itertools.combinations(range(len(values).bit_length() - 1), 2)
    return {pair: _effect(values, pair) for pair in pairs}


def _effect(values: Floats, settings: Sequence[int]) -> Floats:
    """Return what settings do together beyond what fewer of them do, averaged over the others, [columns]."""
    count = len(values).bit_length() - 1
    beyond = values.reshape(*[2] * count, -1)  # bit i of a mixture is axis count - 1 - i
    for i in settings:
        beyond = np.diff(beyond, axis=count - 1 - i)
    beyond = beyond.reshape(-1, values.shape[1])
    sizes = np.bitwise_count(np.arange(len(beyond)))
    n = count + 1 - len(settings)
    factorial = math.factorial
    # The share of the orders of n settings in which s given ones come before a given one.
    weights = np.array([factorial(s) * factorial(n - s - 1) / factorial(n) for s in range(n)])
    averaged: Floats = weights[sizes] @ beyond
    return averaged


def minimal_set(items: Sequence[T], holds: Callable[[Sequence[T]], bool]) -> list[T]:
    """Return items for which a property holds, and of which none can be left out.

    Delta debugging (A. Zeller and R. Hildebrandt, "Simplifying and isolating failure-inducing input", 2002).
    `holds` takes some of the items, in their order; it must hold for all of them, and not for none.
    """
    left = list(items)
    parts = 2
    while len(left) > 1:
        chunks = [chunk.tolist() for chunk in np.array_split(np.arange(len(left)), parts)]
        subsets = [[left[k] for k in chunk] for chunk in chunks]
        smaller = next((subset for subset in subsets if holds(subset)), None)
        if smaller is not None:
            left = smaller
            parts = 2
            continue
        rests = [[item for k, item in enumerate(left) if k not in chunk] for chunk in chunks]
        smaller = next((rest for rest in rests if parts > 2 and holds(rest)), None)
        if smaller is not None:
            left = smaller
            parts = max(parts - 1, 2)
        elif parts < len(left):
            parts = min(2 * parts, len(left))
        else:
            break
    return left


# --- the game of an explanation ---------------------------------------------------------------------------


@dataclass(frozen=True)
class SamplingPlan:
    """What an explanation will train."""

    settings: int
    mixtures: int
    """The mixtures that will be run, at least."""
    most_mixtures: int
    """The same, at most; delta debugging depends on what it finds."""
    seeds: int
    known: int
    """Runs that were trained before; delta debugging need not use all of them."""
    run_seconds: float
    """The time that one run takes of a worker; 0 if all are known."""
    workers: int
    seconds: float
    """The estimated time of the whole, at least; 0 if all runs are known."""
    most_seconds: float
    """The same, at most."""


def mixture_bounds(settings: int) -> tuple[int, int]:
    """Return how many mixtures of some settings are run, at least and at most."""
    if settings <= MAX_ALL:
        return 2**settings, 2**settings
    return 2 + math.ceil(math.log2(settings)), 2 + 3 * settings + settings**2 + 2**MAX_ALL


class Game:
    """The values of mixtures, measured when they are needed: settings are players, mixtures coalitions."""

    def __init__(self, mixtures: Mixtures, metric: str) -> None:
        self.mixing = mixtures.mixing
        self.metric = metric
        self._mixtures = mixtures
        self._count = len(self.mixing.factors)

    def plan(self) -> SamplingPlan:
        """Return what will be trained."""
        count = self._count
        mixtures = self._mixtures
        seeds = len(self._mixtures.seeds)
        least, most = mixture_bounds(count)
        known = mixtures.known(range(least)) if least == most else mixtures.in_file
        run_seconds = mixtures.seconds
        workers = max(1, mixtures.workers.idle)
        left = (number * seeds - known for number in (least, most))
        times = [_START_SECONDS + runs * run_seconds / workers if runs > 0 else 0.0 for runs in left]
        return SamplingPlan(count, least, most, seeds, known, run_seconds, workers, times[0], times[1])

    def players(self) -> list[int]:
        """Return the numbers of the settings among which the difference is shared; measure their mixtures.

        These are all of them, or those of a minimal set; none if there is no difference to look for, or if
        too many are needed.
        """
        players = list(range(self._count))
        if self._count > MAX_ALL:
            self._mixtures.measure((0, self.mixing.everything))
            players = minimal_set(players, self._makes_enough) if self.difference.excludes_zero else []
        if len(players) <= MAX_ALL:
            self._mixtures.measure(coalitions(players))
        return players

    def _makes_enough(self, players: Sequence[int]) -> bool:
        number = sum(1 << i for i in players)
        self._mixtures.measure([number])
        return self._part(number) >= ENOUGH

    def _part(self, number: int) -> float:
        """Return the part of the difference that a mixture makes."""
        low, value, high = self.values((0, number, self.mixing.everything)).mean(axis=1).tolist()
        return float((value - low) / (high - low)) if high != low else math.nan

    def values(self, numbers: Sequence[int]) -> Floats:
        """Return the values of mixtures that were measured, [mixtures, seeds]."""
        return self._mixtures.values(numbers, self.metric)

    def mean(self, number: int) -> Estimate:
        """Return the mean of a mixture over the seeds."""
        return bootstrap_means(self.values([number]))[0]

    @property
    def difference(self) -> Estimate:
        """B less A."""
        low, high = self.values((0, self.mixing.everything))
        return bootstrap_means((high - low)[np.newaxis])[0]

    def ordered(self) -> list[int]:
        """Return the numbers of the mixtures that were measured, by the number of settings of B."""
        return sorted(self._mixtures.complete(), key=lambda number: (number.bit_count(), number))

    def mixture(self, number: int) -> Mixture:
        """Return a mixture that was measured."""
        names = tuple(factor.name for factor in self.mixing.chosen(number))
        return Mixture(names, self.mean(number), tuple(self.values([number])[0].tolist()))

    def smallest(self, players: Sequence[int]) -> Mixture | None:
        """Return the fewest settings that make `ENOUGH` of the difference, of several the most of it."""
        if not players or not self.difference.excludes_zero:
            return None
        if self._count > MAX_ALL:
            return self.mixture(sum(1 << i for i in players))
        enough = [number for number in self.ordered() if self._part(number) >= ENOUGH]
        return self.mixture(min(enough, key=lambda number: (number.bit_count(), -self._part(number))))


def coalitions(players: Sequence[int]) -> list[int]:
    """Return the mixtures of some settings: bit j of a position stands for the j-th of them."""
    return [
        sum(1 << i for j, i in enumerate(players) if position >> j & 1)
        for position in range(2 ** len(players))
    ]


def settings_of(game: Game, players: Sequence[int]) -> tuple[Setting, ...]:
    """Return the settings, those with a share first, the largest first."""
    factors = game.mixing.factors
    shares: dict[int, tuple[Estimate, Estimate, Estimate]] = {}
    if players and len(players) <= MAX_ALL:
        values = game.values(coalitions(players))
        bits = [1 << j for j in range(len(players))]
        shapley = shapley_values(values)
        alone = values[bits] - values[0]
        last = values[-1] - values[[len(values) - 1 - bit for bit in bits]]
        rows = zip(*map(bootstrap_means, (shapley, alone, last)), strict=True)
        shares = dict(zip(players, rows, strict=True))
    order = sorted(shares, key=lambda i: -abs(shares[i][0].value))
    order += [i for i in range(len(factors)) if i not in shares]
    return tuple(
        Setting(factors[i].name, factors[i].a, factors[i].b, *shares.get(i, (None, None, None)))
        for i in order
    )


def interactions_of(game: Game, players: Sequence[int]) -> tuple[Interaction, ...]:
    """Return the interactions of settings in pairs, the largest first."""
    if not 2 <= len(players) <= MAX_ALL:
        return ()
    names = [game.mixing.factors[i].name for i in players]
    beyond = shapley_interactions(game.values(coalitions(players)))
    estimates = bootstrap_means(np.array(list(beyond.values())))
    pairs = [
        Interaction((names[i], names[j]), estimate)
        for (i, j), estimate in zip(beyond, estimates, strict=True)
    ]
    return tuple(sorted(pairs, key=lambda pair: -abs(pair.beyond.value)))
