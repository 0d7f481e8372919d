"""The exact measures of a policy next to those of the optimum, named as in the recording."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from runner.environments.mdp import Mdp
from runner.planning.evaluation import PolicyOutcome, evaluate_policy, evaluate_stochastic_policy, start_mean
from runner.planning.optimum import best_response, best_response_to_stochastic, greedy_policy, optimal_values
from runner.util.arrays import Floats, Ints32

Policy = Ints32 | Sequence[Floats]
"""The joint action of each state; or for each learner the probabilities of its own actions."""


class ExactEvaluator:
    """Evaluates policies exactly in one environment; the optimum is computed once for each discount."""

    def __init__(self, mdp: Mdp, learners: int) -> None:
        self._mdp = mdp
        self._learners = learners
        self._best: dict[float, tuple[float, PolicyOutcome]] = {}

    def measure(self, policy: Policy, discount: float) -> dict[str, object]:
        """Return the exact measures of a policy, named as in the recording.

        With a discount of 1 the values are nan: those of a process without end are not defined.

        Args:
            policy: [S]: the joint action of each state; or, for learners that draw, an array for each, [S,
                n]: the probability of each of its own actions.
        """
        if isinstance(policy, np.ndarray):
            outcome = evaluate_policy(self._mdp, policy, self._learners, discount)
        else:
            outcome = evaluate_stochastic_policy(self._mdp, policy, self._learners, discount)
        undiscounted = discount >= 1
        optimal_value, optimum = (np.nan, None) if undiscounted else self._optimum(discount)
        return {
            "starts": outcome.starts,
            "success_percent": outcome.success_percent,
            "timeout_percent": outcome.timeout_percent,
            "mean_length": outcome.mean_length,
            "mean_penalties": outcome.mean_penalties,
            "mean_returns": list(outcome.mean_returns),
            "values": list(outcome.values),
            "best_responses": [
                np.nan if undiscounted else self._best_response(policy, learner, discount)
                for learner in range(self._learners)
            ],
            "optimal_value": optimal_value,
            "optimal_success_percent": optimum.success_percent if optimum else np.nan,
            "optimal_mean_length": optimum.mean_length if optimum else np.nan,
            "cycle_states": [cycle.states[0] for cycle in outcome.cycles],
            "cycle_lengths": [len(cycle.states) for cycle in outcome.cycles],
            "cycle_percents": [cycle.percent for cycle in outcome.cycles],
        }

    def _best_response(self, policy: Policy, learner: int, discount: float) -> float:
        if isinstance(policy, np.ndarray):
            values = best_response(self._mdp, policy, learner, self._learners, discount)
        else:
            values = best_response_to_stochastic(self._mdp, policy, learner, discount)
        return start_mean(self._mdp, values)

    def _optimum(self, discount: float) -> tuple[float, PolicyOutcome]:
        if discount not in self._best:
            values = optimal_values(self._mdp, discount)
            policy = greedy_policy(self._mdp, discount, values)
            outcome = evaluate_policy(self._mdp, policy, self._learners, discount)
            self._best[discount] = start_mean(self._mdp, values), outcome
        return self._best[discount]
