"""The last results of a loop, kept while it runs: what `ls` lists without opening the recording."""

from __future__ import annotations

import math
from collections import defaultdict
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.analysis.frames import RECENT_EPISODES, finite_mean, is_usable
from runner.environments.mdp import Mdp
from runner.recording import schema
from runner.recording.schema import Topic

MAX_NAMES: Final = 64
"""Names whose last logged value a summary carries."""


class Outcomes:
    """Returns and lengths of the last training episodes and of the last evaluation, and logged values.

    `summary` returns the same values as `runner.frames.loop_summary` computes from a whole recording.
    """

    def __init__(self, mdp: Mdp | None) -> None:
        self._has_success = mdp is not None and bool(mdp.success_events)
        self._has_penalties = mdp is not None and math.isfinite(mdp.penalty_below)
        self._trained = 0
        self._recent = np.empty((0, 2))
        """[episodes, 2]: returns and lengths of the last training episodes."""
        self._evaluated_after = -1
        self._trials: defaultdict[str, float] = defaultdict(float)
        """Sums over the trials of the last evaluation."""
        self._logged: dict[str, float | None] = {}

    def take_records(self, topic: Topic, records: NDArray[np.void]) -> None:
        """Take the episodes among the records that the recorder takes in."""
        if topic.name == schema.TRAIN_EPISODE.name:
            self._trained += len(records)
            last = records[-RECENT_EPISODES:]
            results = np.column_stack([last["returns"].sum(axis=1), last["length"]])
            self._recent = np.concatenate([self._recent, results])[-RECENT_EPISODES:]
        elif topic.name == schema.EVAL_EPISODE.name:
            if self._evaluated_after != self._trained:
                self._evaluated_after, self._trials = self._trained, defaultdict(float)
            returns = records["returns"].sum(axis=1)
            usable = returns[is_usable(returns)]
            self._trials["trials"] += len(records)
            self._trials["usable"] += len(usable)
            self._trials["return"] += float(usable.sum())
            for name in ("length", "success", "penalties"):
                self._trials[name] += int(records[name].sum(dtype=np.int64))

    def take_logged(self, name: str, value: float) -> None:
        """Take a logged value."""
        if name in self._logged or len(self._logged) < MAX_NAMES:
            self._logged[name] = value if math.isfinite(value) else None

    def summary(self) -> dict[str, Any]:
        """Return `last_evaluation`, `recent_training` and `logged`, as JSON can hold them."""
        returns, lengths = self._recent.T
        return {
            "last_evaluation": self._evaluation(),
            "recent_training": {
                "episodes": len(self._recent),
                "mean_length": finite_mean(lengths),
                "mean_return": finite_mean(returns),
            },
            "logged": self._logged,
        }

    def _evaluation(self) -> dict[str, Any] | None:
        sums, count = self._trials, int(self._trials["trials"])
        if not count:
            return None
        return {
            "episode": self._evaluated_after,
            "trials": count,
            "success_percent": 100 * sums["success"] / count if self._has_success else None,
            "mean_length": sums["length"] / count,
            "mean_penalties": sums["penalties"] / count if self._has_penalties else None,
            "mean_return": sums["return"] / sums["usable"] if sums["usable"] else None,
        }
