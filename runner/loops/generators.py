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
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, VectorEnv

from runner.environments.gym_types import AnyVectorEnv
from runner.loops.vec_env import mode_of
from runner.recording.messages import SEED_BYTES, STEPS_BETWEEN, ResetState
from runner.util.arrays import Flags

_SPARSE_STEPS_A_BYTE: Final = 2
"""An emulator's state takes some 14 kB, half of it after compression: a quarter of a byte for each step."""

States = dict[int, ResetState]
"""What resets depend on, by the index of the environment."""


class _Generator:
    """The generator of one environment: read at the resets at which its state is recorded.

    Args:
        sparse: whether the states of emulators, which take kilobytes, are recorded less often.
    """

    def __init__(self, env: object, sparse: bool) -> None:
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
        generator = getattr(self._base, self._name, None)
        last = self._generator
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
        generator = getattr(self._base, self._name, None)
        before = self._generator
        self._generator = generator
        if seed is None and generator is not before and (drawn := seed_of(generator)) is not None:
            return ResetState(np_random_seed=drawn)
        return state


class GeneratorWatch:
    """The generators of environments: read at the resets at which their states are recorded.

    Args:
        envs: the environments with generators that can be read, in their order; or a vector environment that
            has a single generator.
        sparse: whether the states of emulators, which take kilobytes, are recorded less often.
        resets_itself: whether a step may reset environments in place of stepping them.
        vector: an `AsyncVectorEnv`, which is asked for the seeds of its generators once, after its first
            reset without seeds.
    """

    def __init__(
        self,
        envs: Sequence[object],
        sparse: bool = False,
        resets_itself: bool = False,
        vector: AsyncVectorEnv | None = None,
    ) -> None:
        self._generators = [_Generator(env, sparse) for env in envs]
        self._vector = vector
        self._resets_itself = resets_itself
        self._seeded: set[int] = set()
        """The environments of `vector` whose generators come from the seed of a reset."""
        self.steps = 0
        """The steps of the environments, in which the time up to the next state is counted."""
        self.begin_phase()

    def begin_phase(self) -> None:
        """Record states at the next resets: the states of the phase so far are in another topic."""
        for generator in self._generators:
            generator.due = 0
        self.due: float = 0 if self._resets_itself else math.inf
        """The number of steps from which on `before_step` is to be called before each step."""

    def before_step(self, over: Flags) -> States:
        """Return what the resets that a step does in place of steps are going to depend on.

        Args:
            over: [N], the environments whose episodes are over.
        """
        states = self.before_reset(np.flatnonzero(over).tolist())
        self.due = min(generator.due for generator in self._generators)
        return states

    def before_reset(self, environments: Sequence[int], seeds: Sequence[int | None] = ()) -> States:
        """Return what a reset of some environments is going to depend on, where it has no seed.

        Args:
            seeds: of all environments; empty for none.
        """
        states: States = {}
        for i in environments:
            if i < len(self._generators) and not (seeds and seeds[i] is not None):
                state = self._generators[i].before(self.steps)
                if state is not None:
                    states[i] = state._replace(environment=i)
        return states

    def after_reset(self, states: States, environments: Sequence[int], seeds: Sequence[int | None]) -> States:
        """Return what a reset depended on; arguments as for `before_reset`, and what that returned."""
        after: States = {}
        if self._vector is None:
            for i in environments:
                if i < len(self._generators):
                    state = self._generators[i].after(states.get(i), seeds[i] if seeds else None)
                    if state is not None:
                        after[i] = state._replace(environment=i)
        else:
            unseeded = [i for i in environments if not seeds or seeds[i] is None]
            self._seeded.update(set(environments).difference(unseeded))
            if unseeded:
                generators: Any = self._vector.get_attr("_np_random")
                self._vector = None
                drawn = {i: seed_of(generators[i]) for i in environments if i not in self._seeded}
                after = {
                    i: ResetState(environment=i, np_random_seed=seed)
                    for i, seed in drawn.items()
                    if seed is not None
                }
        return after


def vector_watch(envs: AnyVectorEnv, first: object, autoreset: AutoresetMode, sparse: bool) -> GeneratorWatch:
    """Return the watch of a vector environment.

    The generators of a `SyncVectorEnv` are read, or the generator of a vector environment of its own class.

    Args:
        first: its first environment, or one made as that was; the vector itself if there is none.
    """
    base: Any = envs.unwrapped
    mode = mode_of(base)
    if mode == "sync":
        return GeneratorWatch(base.envs, sparse, resets_itself=autoreset == AutoresetMode.NEXT_STEP)
    if mode == "custom":
        return GeneratorWatch([base])
    # The seed of an Atari environment's generator does not determine its emulator.
    is_determined = not (isinstance(first, gymnasium.Env) and is_atari(first.unwrapped))
    return GeneratorWatch([], vector=base if is_determined else None)


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
