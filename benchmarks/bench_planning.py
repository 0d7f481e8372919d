"""Planning: value iteration, and the exact evaluation of a policy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import Figure, figure, seconds
from benchmarks.learners import train, tutorial_learner
from runner.environments.mdp import Mdp
from runner.planning.exact import evaluate_policy, greedy_policy, optimal_values

DISCOUNT = 0.99


def measure(quick: bool) -> list[Figure]:
    """Return the time of value iteration to 1e-10 and of exact evaluations."""
    learner = tutorial_learner()
    mdp = learner.mdp
    train(learner, learner.config.episodes)
    learner.begin_evaluation()
    policy = learner.policy.copy()
    best = greedy_policy(mdp, DISCOUNT, optimal_values(mdp, DISCOUNT))  # compiles
    evaluate_policy(mdp, policy, 1, DISCOUNT)
    repetitions = 5 if quick else 25
    return [
        figure(
            "value iteration to 1e-10, DualTaxi",
            [seconds(lambda: optimal_values(mdp, DISCOUNT)) for _ in range(repetitions)],
            "s",
            (1, 0.2),
            higher_is_better=False,
            detail=f"discount {DISCOUNT}; 6,144 states, 36 joint actions",
        ),
        _exactly("the tutorial's policy", mdp, policy, repetitions),
        _exactly("an optimal policy", mdp, best, repetitions),
    ]


def _exactly(policy_name: str, mdp: Mdp, policy: NDArray[np.int32], repetitions: int) -> Figure:
    return figure(
        f"exact evaluation of {policy_name}",
        [1e3 * seconds(lambda: evaluate_policy(mdp, policy, 1, DISCOUNT)) for _ in range(repetitions)],
        "ms",
        (5, 1),
        higher_is_better=False,
        detail="over all 2,880 start states",
    )
