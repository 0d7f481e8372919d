"""The last results of a loop while it runs, which `ls` lists without opening the recording."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from runner.environments.mdp import Mdp
from runner.recording.metrics import METRICS, RECENT_EPISODES, defined_metrics, finite_mean
from runner.recording.schema import Topic
from runner.util.arrays import Floats, Records
from runner.util.values import Json

MAX_NAMES: Final = 64
"""The most names with their last logged value in a summary."""
MAX_TRIALS: Final = 1 << 17
"""The most trials of an evaluation that are in a summary, the last ones."""


class Outcomes:
    """Returns and lengths of the last training episodes and of the last evaluation, and logged values.

    `summary` returns what `runner.analysis.evaluations.loop_summary` computes from a whole recording.
    """

    def __init__(self, mdp: Mdp | None) -> None:
        has_success = mdp is not None and bool(mdp.success_events)
        has_penalties = mdp is not None and math.isfinite(mdp.penalty_below)
        self._defined = defined_metrics(has_success, has_penalties)
        self._trained = 0
        self._recent = np.empty((0, 2))
        """[episodes, 2]: returns and lengths of the last training episodes."""
        self._evaluated_after = -1
        self._trials = 0
        """Number of trials of the last evaluation."""
        self._values: dict[str, Floats] = {}
        """Values of those trials, summed over agents, by metric."""
        self._logged: dict[str, float | None] = {}

    def take_episodes(self, topic: Topic, records: Records) -> None:
        """Add episodes that the recorder gets."""
        if topic.phase == "train":
            self._trained += len(records)
            last = records[-RECENT_EPISODES:]
            results = np.column_stack([last["returns"].sum(axis=1), last["length"]])
            self._recent = np.concatenate([self._recent, results])[-RECENT_EPISODES:]
        else:
            if self._evaluated_after != self._trained:
                self._evaluated_after = self._trained
                self._trials = 0
                self._values = {}
            self._trials += len(records)
            for metric in self._defined:
                values = metric.of_trials(records).astype(np.float64)
                values = values.sum(axis=1) if metric.per_agent else values
                before = self._values.get(metric.name, np.empty(0))
                self._values[metric.name] = np.concatenate([before, values])[-MAX_TRIALS:]

    def take_logged(self, name: str, value: float) -> None:
        """Add a logged value."""
        if name in self._logged or len(self._logged) < MAX_NAMES:
            self._logged[name] = value if math.isfinite(value) else None

    def summary(self) -> Json:
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

    def _evaluation(self) -> Json | None:
        if not self._trials:
            return None
        unknown = np.empty(0)
        values = {metric.name: metric.of_usable(self._values.get(metric.name, unknown)) for metric in METRICS}
        return {"episode": self._evaluated_after, "trials": self._trials, **values}
