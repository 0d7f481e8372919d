"""Random numbers as pure functions of (seed, stream, episode, index).

A draw is an output of SplitMix64 (Steele, Lea and Flood, "Fast splittable pseudorandom number
generators", OOPSLA 2014) whose state is keyed by seed, stream and episode. Nothing about randomness has
to be saved: any draw of a run can be computed on its own, no stream can disturb another, and two runs
of one seed see the same start states and the same exploration draws.

These are functions of numbers alone, which LLVM inlines at no cost.
"""

from __future__ import annotations

from typing import Final

import numba
import numpy as np

START: Final = 0
EXPLORATION: Final = 1
OUTCOME: Final = 2
UPDATE: Final = 3
EVALUATION_START: Final = 4
EVALUATION_OUTCOME: Final = 5
EVALUATION_ACTION: Final = 6
INITIAL_Q: Final = 7
POLICY: Final = 8

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_LOW_32 = np.uint64(0xFFFFFFFF)


@numba.njit(cache=True)
def _finalize(z: np.uint64) -> np.uint64:
    """Return SplitMix64's output function of the state `z`."""
    z = (z ^ (z >> np.uint64(30))) * _MIX_1
    z = (z ^ (z >> np.uint64(27))) * _MIX_2
    return z ^ (z >> np.uint64(31))


@numba.njit(cache=True)
def key(seed: np.uint64, stream: int, episode: int) -> np.uint64:
    """Return the generator state that seed, stream and episode fix."""
    z = _finalize(np.uint64(seed) + _GOLDEN)
    z = _finalize(z + np.uint64(stream) + _GOLDEN)
    return _finalize(z + np.uint64(episode) + _GOLDEN)


@numba.njit(cache=True)
def draw(state: np.uint64, index: int) -> np.uint64:
    """Return 64 random bits: output `index` (from 0) of the generator with this state."""
    return _finalize(state + (np.uint64(index) + np.uint64(1)) * _GOLDEN)


@numba.njit(cache=True)
def uniform(bits: np.uint64) -> float:
    """Return a float64 in [0, 1) from the upper 53 bits."""
    return np.float64(bits >> np.uint64(11)) * 2.0**-53


@numba.njit(cache=True)
def coin(bits: np.uint64) -> float:
    """Return a float64 in [0, 1) from the upper 32 bits; the lower 32 stay free for `below`."""
    return np.float64(bits >> np.uint64(32)) * 2.0**-32


@numba.njit(cache=True)
def below(bits: np.uint64, n: int) -> int:
    """Return an integer in [0, n) from the lower 32 bits; its bias is at most n / 2**32."""
    return np.int64(((bits & _LOW_32) * np.uint64(n)) >> np.uint64(32))
