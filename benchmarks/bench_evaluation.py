"""The evaluation kernel, filling step records, with the tables of the trained tutorial."""

from __future__ import annotations

from benchmarks.figures import Figure, figure, seconds
from benchmarks.learners import NO_LIMIT, blocks, train, tutorial_learner


def measure(quick: bool) -> list[Figure]:
    """Return evaluation steps per second on one core."""
    repetitions, wanted = (3, 2_000_000) if quick else (9, 20_000_000)
    learner = tutorial_learner()
    train(learner, learner.config.episodes)
    learner.begin_evaluation()
    steps, episodes = blocks(learner, "eval")
    learner.evaluate(steps, episodes, NO_LIMIT)  # compiles

    def play() -> int:
        taken = 0
        while taken < wanted:
            taken += learner.evaluate(steps, episodes, NO_LIMIT)[0]
        return taken

    rates = [wanted / seconds(play) / 1e6 for _ in range(repetitions)]
    return [
        figure(
            "evaluation, records filled, one core",
            rates,
            "M steps/s",
            (80, 120),
            detail=f"the greedy policy after {learner.episode:,} episodes of the cooperative tutorial",
        )
    ]
