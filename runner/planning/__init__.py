"""Exact measures from an environment's transition table: policy evaluation, the optimum, best responses.

optimum = optimal_values(mdp, discount)                 the highest value of all agents together
outcome = evaluate_policy(mdp, policy, learners, 0.9)   a policy's results from every start, without sampling
best_response(mdp, policy, learner, learners, 0.9)      one agent's highest value against the others' policies
"""

from runner.planning.baseline import RandomBaseline, random_baseline
from runner.planning.evaluation import (
    Cycle,
    Outcome,
    action_values,
    evaluate_policy,
    evaluate_stochastic_policy,
    policy_values,
    random_policy,
)
from runner.planning.optimality import ExactEvaluator
from runner.planning.optimum import best_response, best_response_to_stochastic, greedy_policy, optimal_values

__all__ = [
    "Cycle",
    "ExactEvaluator",
    "Outcome",
    "RandomBaseline",
    "action_values",
    "best_response",
    "best_response_to_stochastic",
    "evaluate_policy",
    "evaluate_stochastic_policy",
    "greedy_policy",
    "optimal_values",
    "policy_values",
    "random_baseline",
    "random_policy",
]
