"""What is known because the environment is: exact evaluation, the optimum, best responses.

optimum = optimal_values(mdp, discount)                 the most that all agents together can get
outcome = evaluate_policy(mdp, policy, learners, 0.9)   what a policy gets, from every start, without sampling
best_response(mdp, policy, learner, learners, 0.9)      the most that one agent gets while the others stay
"""

from runner.planning.baseline import RandomBaseline, random_baseline
from runner.planning.evaluation import (
    Cycle,
    Outcome,
    evaluate_policy,
    evaluate_stochastic_policy,
    random_policy,
)
from runner.planning.optimality import Yardstick
from runner.planning.optimum import (
    best_response,
    best_response_to_stochastic,
    greedy_policy,
    optimal_values,
)

__all__ = [
    "Cycle",
    "Outcome",
    "RandomBaseline",
    "Yardstick",
    "best_response",
    "best_response_to_stochastic",
    "evaluate_policy",
    "evaluate_stochastic_policy",
    "greedy_policy",
    "optimal_values",
    "random_baseline",
    "random_policy",
]
