"""The results of acting at random: the baseline of a learned policy."""

from __future__ import annotations

import contextlib
import math
from collections import OrderedDict
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from blake3 import blake3

from runner.environments.mdp import Mdp
from runner.util.files import cache_folder, read_object, write_object
from runner.util.values import finite

MAX_WORK: Final = 1_000_000_000
"""Outcomes of joint actions times the step limit; DualTaxi has a third of it, and takes about a second."""
_MAX_REMEMBERED: Final = 32
_MAX_BYTES: Final = 4096
_VERSION: Final = 2
"""Version of the computation; cached results of another version are not used."""
_remembered: OrderedDict[bytes, RandomBaseline] = OrderedDict()


@dataclass(frozen=True)
class RandomBaseline:
    """The results of the policy that takes every joint action with the same probability."""

    success_percent: float
    """Episodes with a success; nan if the environment does not define success."""
    mean_length: float
    mean_return: float
    """Undiscounted, summed over the agents."""
    step_limit: int

    @property
    def sentence(self) -> str:
        """The baseline as a sentence for people who read a success rate."""
        took = f"{self.mean_length:,.1f} steps on average"
        returned = f"{self.mean_return:,.1f}"
        if math.isnan(self.success_percent):
            return (
                f"A random policy's episodes take {took} and return {returned} "
                f"(step limit {self.step_limit:,})."
            )
        return (
            f"A random policy succeeds in {self.success_percent:.1f} % of episodes within the limit of "
            f"{self.step_limit:,} steps; its episodes take {took} and return {returned}."
        )


def random_baseline(mdp: Mdp) -> RandomBaseline | None:
    """Return the exact results of a random policy; None if they take too long to compute.

    They are None too without a step limit: some episodes might never end.
    """
    if not mdp.step_limit or mdp.next_state.size * mdp.step_limit > MAX_WORK:
        return None
    digest = blake3(str((mdp.step_limit, mdp.success_mask)).encode())
    for name in ("next_state", "probability", "rewards", "terminated", "events", "start"):
        digest.update(getattr(mdp, name).tobytes())
    key = digest.digest()
    if key not in _remembered:
        _remembered[key] = _cached(cache_folder() / "baselines" / f"{_VERSION}-{key.hex()}.json", mdp)
        if len(_remembered) > _MAX_REMEMBERED:
            _remembered.popitem(last=False)
    return _remembered[key]


def _cached(path: Path, mdp: Mdp) -> RandomBaseline:
    """Return the baseline from a file of the user's cache, which is written if it is missing."""
    with contextlib.suppress(OSError, ValueError):
        stored = read_object(path, _MAX_BYTES)
        percent, length, returned = (
            stored.get(name) for name in ("success_percent", "mean_length", "mean_return")
        )
        if isinstance(percent, float | None) and isinstance(length, float) and isinstance(returned, float):
            return RandomBaseline(math.nan if percent is None else percent, length, returned, mdp.step_limit)
    from runner.planning.exact import evaluate_stochastic_policy, random_policy  # loads Numba

    outcome = evaluate_stochastic_policy(mdp, random_policy(mdp), mdp.rewards.shape[-1], discount=1.0)
    baseline = RandomBaseline(
        float(outcome.success_percent),
        float(outcome.mean_length),
        float(sum(outcome.mean_returns)),
        mdp.step_limit,
    )
    with contextlib.suppress(OSError):  # a cache that cannot be written costs time only
        path.parent.mkdir(parents=True, exist_ok=True)
        write_object(path, finite(asdict(baseline)))
    return baseline
