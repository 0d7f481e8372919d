"""Random draws in plain Python: SplitMix64 in integers, and the numbers derived from its bits."""

from __future__ import annotations

START, EXPLORATION, OUTCOME, UPDATE = range(4)
EVALUATION_START, EVALUATION_OUTCOME, EVALUATION_ACTION, INITIAL_Q, POLICY = range(4, 9)

BITS_64 = 2**64 - 1


def splitmix64(state: int, index: int) -> int:
    """Return output number `index`, from 0, of the generator that starts at `state`."""
    z = (state + (index + 1) * 0x9E3779B97F4A7C15) & BITS_64
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9 & BITS_64
    z = (z ^ (z >> 27)) * 0x94D049BB133111EB & BITS_64
    return z ^ (z >> 31)


def key(seed: int, stream: int, episode: int) -> int:
    """Return a generator's state: seed, stream and episode mixed in, one after the other."""
    state = 0
    for part in (seed, stream, episode):
        state = splitmix64((state + part) & BITS_64, 0)
    return state


def draw(seed: int, stream: int, episode: int, index: int) -> int:
    """Return 64 random bits."""
    return splitmix64(key(seed, stream, episode), index)


def uniform(bits: int) -> float:
    """Return a number in [0, 1) of the upper 53 bits."""
    return (bits >> 11) / 2**53


def coin(bits: int) -> float:
    """Return a number in [0, 1) of the upper 32 bits."""
    return (bits >> 32) / 2**32


def below(bits: int, n: int) -> int:
    """Return a whole number below n of the lower 32 bits."""
    return (bits % 2**32) * n // 2**32


def pick(chances: list[tuple[int, float]], u: float) -> int:
    """Return the first of (item, probability) at which the running sum of probabilities exceeds u."""
    total = 0.0
    for item, probability in chances:
        total += probability
        if u < total:
            return item
    return [item for item, probability in chances if probability > 0][-1]
