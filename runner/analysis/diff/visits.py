"""How often the training of two runs acted in each state, and where that differs most."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import Mdp
from runner.environments.naming import states_in_words

MOST = 5
"""So many states are named."""


@dataclass(frozen=True)
class StateVisits:
    """How often two runs acted in a state, which is told in words."""

    state: str
    a: int
    b: int


@dataclass(frozen=True)
class VisitsDiff:
    """How the training steps of two runs spread over the states."""

    states_a: int
    """States that A acted in at all."""
    states_b: int
    alike: float
    """Overlap of the two distributions over states, 0 to 1: the sum of the lower share of each state."""
    most_apart: list[StateVisits]
    """The states whose shares of all steps differ most."""


def visits_diff(mdp: Mdp, a: NDArray[np.int64], b: NDArray[np.int64]) -> VisitsDiff:
    """Return how two runs' visits to states differ.

    Args:
        mdp: what says of a state what it is, in words.
        a: how often the one acted in each state, [S].
        b: the other.
    """
    shares = [visits / max(visits.sum(), 1) for visits in (a, b)]
    apart = np.abs(shares[0] - shares[1])
    words = states_in_words(mdp)
    most = [int(state) for state in np.argsort(-apart, kind="stable")[:MOST] if apart[state] > 0]
    return VisitsDiff(
        states_a=int(np.count_nonzero(a)),
        states_b=int(np.count_nonzero(b)),
        alike=float(np.minimum(*shares).sum()),
        most_apart=[StateVisits(str(words[state]), int(a[state]), int(b[state])) for state in most],
    )
