"""Shares of a difference among the settings that make it, and the smallest set of settings that makes it.

A mixture is a number whose bit i is 1 if setting i has the value of B, and 0 if it has that of A: mixture 0
is A, and mixture 2^k - 1 is B.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from runner.util.arrays import Floats

T = TypeVar("T")


def shapley_values(values: Floats) -> Floats:
    """Return the share of each setting: its effect, averaged over all orders in which settings change.

    L. S. Shapley, "A value for n-person games", 1953. The shares of all settings, [k, columns], add up to the
    difference between the last mixture and the first, of values [2^k, columns].
    """
    return np.array([_effect(values, (i,)) for i in range(len(values).bit_length() - 1)])


def shapley_interactions(values: Floats) -> dict[tuple[int, int], Floats]:
    """Return for each pair of settings (i, j), i < j, what both do beyond each, averaged over the others.

    The Shapley interaction index of M. Grabisch and M. Roubens, "An axiomatic approach to the concept of
    interaction among players in cooperative games", 1999, [columns] of values [2^k, columns]. It is 0 for
    settings whose effects add up.
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
    `holds` takes some of the items, in their order; it is so of all of them, and not of none.
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
