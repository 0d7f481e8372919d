"""What resets without a seed depend on, read from environments without changing them.

Gymnasium's property `np_random` makes a generator where there is none, so only the attribute behind it is
read. Nothing here takes the `__dict__` of an environment: in Python 3.11 this makes its attributes, and so
its steps, slower for good.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from runner.environments.gym_types import AnyVectorEnv
from runner.loops.vec_env import mode_of
from runner.recording.reset_states import SEED_BYTES, STEPS_BETWEEN, ResetState

_SPARSE_STEPS_A_BYTE: Final = 2
"""An emulator's state takes some 14 kB, half of it after compression: a quarter of a byte for each step."""

States = dict[int, ResetState]
"""What resets depend on, by the index of the environment."""


class GeneratorWatch:
    """The generator of one environment: read at the resets at which its state is recorded.

    Args:
        sparse: whether the states of emulators, which take kilobytes, are recorded less often.
    """

    def __init__(self, env: object, sparse: bool = False) -> None:
        self._steps_a_byte = _SPARSE_STEPS_A_BYTE if sparse else 0
        self._base: Any = getattr(env, "unwrapped", env)
        self._ale: Any = self._base.ale if is_atari(self._base) else None
        has_private = isinstance(self._base, gymnasium.Env | VectorEnv)
        is_computed = isinstance(getattr(type(self._base), "np_random", None), property)
        self._name = "_np_random" if has_private or is_computed else "np_random"
        self._generator: object = None
        """The generator at the last reset."""
        self.due: float = 0
        """The number of steps from which on a state is recorded again."""

    def before(self, steps: int) -> ResetState | None:
        """Return what a reset without a seed is going to depend on; None if it is not to be recorded."""
        generator, last = getattr(self._base, self._name, None), self._generator
        self._generator = generator
        if steps < self.due and generator is last:
            return None
        ale_state = b"" if self._ale is None else self._ale.cloneState(include_rng=True).serialize()
        bits = getattr(generator, "bit_generator", None)
        state = bits.state if type(bits) is np.random.PCG64 else None
        self.due = steps + max(STEPS_BETWEEN, self._steps_a_byte * len(ale_state))
        if state is None and not ale_state:
            return None
        return ResetState(bit_generator=state, ale_state=ale_state)

    def after(self, state: ResetState | None, seed: int | None) -> ResetState | None:
        """Return what a reset depended on; None if it is not to be recorded.

        Args:
            state: what `before` returned; None for a reset with a seed.
            seed: the seed of the reset.
        """
        generator, before = getattr(self._base, self._name, None), self._generator
        self._generator = generator
        if seed is None and generator is not before and (drawn := seed_of(generator)) is not None:
            return ResetState(np_random_seed=drawn)
        return state


class VectorWatch:
    """The generators of a vector environment.

    Those of a `SyncVectorEnv` are read, or that of a vector environment of its own class. An `AsyncVectorEnv`
    is asked for the seeds of its generators once, after its first reset without seeds.

    Args:
        first: its first environment, or one made as that was; the vector itself if there is none.
    """

    def __init__(
        self, envs: AnyVectorEnv, first: object, autoreset: AutoresetMode, sparse: bool = False
    ) -> None:
        base: Any = envs.unwrapped
        self._watches: list[GeneratorWatch] = []
        self._async: Any = None
        self._seeded: set[int] = set()
        """The environments of an `AsyncVectorEnv` whose generators come from the seed of a reset."""
        mode = mode_of(base)
        self._resets_itself = mode == "sync" and autoreset == AutoresetMode.NEXT_STEP
        if mode == "sync":
            self._watches = [GeneratorWatch(env, sparse) for env in base.envs]
        elif mode == "custom":
            self._watches = [GeneratorWatch(base)]
        elif not (isinstance(first, gymnasium.Env) and is_atari(first.unwrapped)):
            self._async = base  # the seed of an Atari environment's generator does not determine its emulator
        self.steps = 0
        """The steps of the vector."""
        self.due: float = 0 if self._resets_itself else math.inf
        """The number of steps from which on `before_step` is to be called before each step."""

    def phase_began(self) -> None:
        """Record states at the next resets: those of the phase so far are in another topic."""
        for watch in self._watches:
            watch.due = 0
        self.due = 0 if self._resets_itself else math.inf

    def before_step(self, over: NDArray[np.bool_]) -> States:
        """Return what the resets that a step does in place of steps are going to depend on.

        Args:
            over: [N], the environments whose episodes are over.
        """
        states = self._before(np.flatnonzero(over).tolist())
        self.due = min(watch.due for watch in self._watches)
        return states

    def before_reset(self, which: NDArray[np.bool_], seeds: Sequence[int | None]) -> States:
        """Return what a reset is going to depend on, where it has no seed.

        Args:
            which: [N], the environments that are reset.
            seeds: of all environments; empty for none.
        """
        unseeded = [i for i in np.flatnonzero(which).tolist() if not seeds or seeds[i] is None]
        return self._before(unseeded)

    def _before(self, which: Sequence[int]) -> States:
        states: States = {}
        for i in which:
            if i < len(self._watches) and (state := self._watches[i].before(self.steps)) is not None:
                states[i] = state._replace(environment=i)
        return states

    def after_reset(self, states: States, which: NDArray[np.bool_], seeds: Sequence[int | None]) -> States:
        """Return what a reset depended on; arguments as for `before_reset`, and what that returned."""
        chosen = {i: seeds[i] if seeds else None for i in np.flatnonzero(which).tolist()}
        if self._async is not None:
            self._seeded.update(i for i, seed in chosen.items() if seed is not None)
        if self._async is not None and None in chosen.values():
            generators = self._async.get_attr("_np_random")
            self._async = None
            drawn = {i: seed_of(generators[i]) for i in chosen if i not in self._seeded}
            return {i: ResetState(environment=i, np_random_seed=s) for i, s in drawn.items() if s is not None}
        by_environment = {
            i: self._watches[i].after(states.get(i), seed)
            for i, seed in chosen.items()
            if i < len(self._watches)
        }
        return {i: state._replace(environment=i) for i, state in by_environment.items() if state is not None}


def is_atari(base: object) -> bool:
    """Return whether an environment, without its wrappers, is one of the Arcade Learning Environment."""
    modules = (kind.__module__.partition(".")[0] for kind in type(base).__mro__)
    return "ale_py" in modules and hasattr(base, "ale")


def seed_of(generator: object) -> int | None:
    """Return the seed that a generator was made from; None if it is unknown."""
    sequence = getattr(getattr(generator, "bit_generator", None), "seed_seq", None)
    entropy = getattr(sequence, "entropy", None)
    is_seed = isinstance(entropy, int) and 0 <= entropy < 256**SEED_BYTES
    return entropy if is_seed and not getattr(sequence, "spawn_key", ()) else None
