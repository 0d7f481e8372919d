"""The training kernel filling step records, against a textbook loop over the same environment."""

from __future__ import annotations

import time
from typing import get_args

import gymnasium
import numpy as np

from benchmarks.figures import Figure, figure, seconds
from benchmarks.learners import train, tutorial_learner
from runner.config.model import Algorithm

ALGORITHMS = [name for name in get_args(Algorithm) if name != "random"]
EPSILON = 0.8
STEP_SIZE = 0.1
DISCOUNT = 0.7


def measure(quick: bool) -> list[Figure]:
    """Return steps per second of both, and their ratio, alternating between them."""
    repetitions, textbook_steps = (3, 20_000) if quick else (7, 100_000)
    train(tutorial_learner(), 100)  # compiles
    textbook, kernel = [], []
    for _ in range(repetitions):
        textbook.append(textbook_steps / seconds(lambda: textbook_q_learning(textbook_steps)))
        learner = tutorial_learner()
        elapsed = seconds(lambda: train(learner, learner.config.episodes))  # noqa: B023 - called at once
        kernel.append(learner.step / elapsed)
    ratios = [fast / slow for fast, slow in zip(kernel, textbook, strict=True)]
    return [
        figure(
            "training, records filled, against textbook",
            ratios,
            "x",
            (300, 400),
            detail="DualTaxi cooperative, one joint table, epsilon 0.8; the kernel does all of the tutorial",
        ),
        figure("  kernel", [value / 1e6 for value in kernel], "M steps/s"),
        figure(
            "  textbook loop",
            [value / 1e6 for value in textbook],
            "M steps/s",
            detail="gymnasium.make, env.step, NumPy argmax and max; records nothing",
        ),
        *algorithms(repetitions),
    ]


def algorithms(repetitions: int) -> list[Figure]:
    """Return steps per second of processor time of each algorithm, alternating between them."""
    cases = [("mode=cooperative", name) for name in ALGORITHMS if name != "hysteretic_q_learning"]
    cases += [("mode=competitive", name) for name in ALGORITHMS]
    speeds: dict[tuple[str, str], list[float]] = {case: [] for case in cases}
    for mode, name in cases:
        train(tutorial_learner(mode, f"algorithm={name}"), 100)  # compiles
    for _ in range(repetitions):
        for mode, name in cases:
            learner = tutorial_learner(mode, f"algorithm={name}", "episodes=1000")
            begun = time.process_time()
            train(learner, learner.config.episodes)
            speeds[mode, name].append(learner.step / (time.process_time() - begun) / 1e6)
    tables = {"mode=cooperative": "one table of 36 actions", "mode=competitive": "two tables of 6 actions"}
    return [
        figure(f"  {name}, {tables[mode]}", values, "M steps/s", detail="processor time")
        for (mode, name), values in speeds.items()
    ]


def textbook_q_learning(steps: int) -> None:
    """Textbook Q-learning: Sutton and Barto, 2nd edition, section 6.5."""
    env = gymnasium.make("dualtaxi:DualTaxi-v1")
    states, actions = env.observation_space.n, env.action_space.n  # type: ignore[attr-defined]
    q = np.zeros((states, actions))
    rng = np.random.default_rng(0)
    state, _ = env.reset(seed=0)
    for _ in range(steps):
        action = int(rng.integers(actions)) if rng.random() < EPSILON else int(np.argmax(q[state]))
        next_state, reward, terminated, truncated, _ = env.step(action)
        td_target = reward + DISCOUNT * np.max(q[next_state])
        q[state, action] += STEP_SIZE * (td_target - q[state, action])
        state = next_state
        if terminated or truncated:
            state, _ = env.reset()
    env.close()
