"""Who sees what a run does while it does it."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from runner.environments.mdp import Mdp


class Observer(Protocol):
    """Is shown every step and metric as they come; must return at once, and copy what it keeps."""

    def begin(self, mdp: Mdp, learners: tuple[str, ...]) -> None:
        """See the environment, and whose tables are learned, before the first step."""

    def steps(self, phase: str, before: int, steps: NDArray[np.void]) -> None:
        """See new steps of a phase; `before` steps of both phases were executed before the first."""

    def metrics(self, phase: str, time: int, metrics: dict[str, Any]) -> None:
        """See new metrics of a phase, after `time` steps of both."""
