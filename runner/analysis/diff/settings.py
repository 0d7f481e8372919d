"""How configurations and environments of two runs differ, down to single transitions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import Mdp
from runner.environments.naming import actions_in_words, states_in_words
from runner.recording.reader import Recording
from runner.util.arrays import Array
from runner.util.values import flatten

_MAX_EXAMPLES: Final = 10
"""Differing transitions that are described."""


@dataclass(frozen=True)
class Change:
    """A value by its path, in both runs; None where one has none."""

    path: str
    a: object
    b: object


@dataclass(frozen=True)
class TransitionChange:
    """The names of a state and a joint action whose outcomes differ, and descriptions of the outcomes."""

    state: str
    action: str
    a: str
    b: str


@dataclass(frozen=True)
class EnvironmentDiff:
    """How two environments differ."""

    description: list[Change] = field(default_factory=list)
    transitions: int = 0
    """How many (state, action) pairs have other outcomes."""
    of: int = 0
    """How many pairs there are; 0 if the environments have other states or actions."""
    examples: list[TransitionChange] = field(default_factory=list)
    other_starts: bool = False
    """Whether episodes start elsewhere."""

    @property
    def same(self) -> bool:
        """Whether nothing differs."""
        return not (self.description or self.transitions or self.other_starts)


def changes_in(a: Mapping[str, object], b: Mapping[str, object]) -> list[Change]:
    """Return the differences of two nested mappings, by dotted path."""
    left, right = flatten(a, keep_empty=True), flatten(b, keep_empty=True)
    paths = dict.fromkeys([*left, *right])

    def filled(path: str) -> bool:
        """Return whether a mapping is empty in one, and the other's entries in it are listed anyway."""
        return {} in (left.get(path), right.get(path)) and any(p.startswith(f"{path}.") for p in paths)

    return [
        Change(path, left.get(path), right.get(path))
        for path in paths
        if ((path in left) != (path in right) or left.get(path) != right.get(path)) and not filled(path)
    ]


def equal_values(a: Mapping[str, object], b: Mapping[str, object]) -> dict[str, object]:
    """Return the values that two nested mappings share, by dotted path."""
    left, right = flatten(a, keep_empty=True), flatten(b, keep_empty=True)
    return {path: value for path, value in left.items() if path in right and right[path] == value}


def environment_diff(a: Mdp, b: Mdp) -> EnvironmentDiff:
    """Return how two environments differ, down to single transitions."""
    description = changes_in(a.description(), b.description())
    if a.next_state.shape[:2] != b.next_state.shape[:2]:
        sizes = Change("states x actions", a.next_state.shape[:2], b.next_state.shape[:2])
        return EnvironmentDiff(description=[sizes, *description])
    differs = np.zeros(a.next_state.shape[:2], np.bool_)  # padding does not count
    for k in range(max(a.next_state.shape[2], b.next_state.shape[2])):
        for left, right in zip(_outcome(a, k), _outcome(b, k), strict=True):
            differs |= left != right
    pairs = np.argwhere(differs)
    return EnvironmentDiff(
        description=description,
        transitions=len(pairs),
        of=differs.size,
        examples=_examples(a, b, pairs[:: max(1, len(pairs) // _MAX_EXAMPLES)][:_MAX_EXAMPLES]),
        other_starts=not np.array_equal(a.start, b.start),
    )


def loop_environment_diff(a: Recording, b: Recording) -> EnvironmentDiff:
    """Return how the descriptions of two environments and their spaces differ."""
    described = [{"spaces": recording.spaces, **recording.environment} for recording in (a, b)]
    return EnvironmentDiff(changes_in(*described))


def _outcome(mdp: Mdp, k: int) -> list[Array]:
    """Return outcome k of every pair: probability, next state, summed reward, terminated, events."""
    shape = mdp.next_state.shape
    if k >= shape[2]:
        return [np.zeros(shape[:2])] * 5
    real = mdp.probability[..., k] > 0
    columns: list[NDArray[Any]] = [mdp.next_state, mdp.summed_rewards, mdp.terminated, mdp.events]
    return [mdp.probability[..., k], *(np.where(real, column[..., k], 0) for column in columns)]


def _examples(a: Mdp, b: Mdp, pairs: NDArray[np.intp]) -> list[TransitionChange]:
    if not len(pairs):
        return []
    states, actions = states_in_words(a), actions_in_words(a)
    states_b = states_in_words(b)
    return [
        TransitionChange(
            state=str(states[s]),
            action=str(actions[j]),
            a=_outcomes_in_words(a, states, s, j),
            b=_outcomes_in_words(b, states_b, s, j),
        )
        for s, j in pairs.tolist()
    ]


def _outcomes_in_words(mdp: Mdp, states: NDArray[np.object_], s: int, j: int) -> str:
    outcomes = []
    for k in np.flatnonzero(mdp.probability[s, j] > 0):
        chance = mdp.probability[s, j, k]
        rewards = ", ".join(f"{reward:g}" for reward in mdp.rewards[s, j, k])
        end = ", the end" if mdp.terminated[s, j, k] else ""
        share = "" if chance == 1 else f"{chance:.3g}: "
        outcomes.append(f"{share}{states[mdp.next_state[s, j, k]]}; reward {rewards}{end}")
    return " | ".join(outcomes)
