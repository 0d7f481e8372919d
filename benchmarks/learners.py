"""The tutorial's cooperative learner and blocks to fill, for benchmarks of the kernels."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.processes import ROOT
from runner.config import load
from runner.environments.loading import load_mdp
from runner.learning.learner import Learner
from runner.recording import schema
from runner.recording.layout import blank_records, layout_of

BLOCK_STEPS = 16_384
"""The default of `recording.chunk_steps`."""
BLOCK_EPISODES = 2_048
NO_LIMIT = 2**62


def tutorial_learner(*overrides: str) -> Learner:
    """Return an untrained learner of the cooperative tutorial: one joint table, epsilon 0.8."""
    config = load(ROOT / "configs" / "tutorial_cooperative.yaml", overrides)
    return Learner(config, load_mdp(config.env.id, config.env.kwargs, config.rewards), seed=0)


def blocks(learner: Learner, phase: str, steps: int = BLOCK_STEPS) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return an empty block of step records and one of episode records, as the recorder provides them."""
    topics = [topic for topic in schema.BLOCK_TOPICS if topic.phase == phase]
    learners, events = len(learner.agents), len(learner.mdp.event_names)
    step_block, episode_block = (
        blank_records(topic, layout_of("job", learners, events).message(topic), n).view(np.recarray)
        for topic, n in zip(topics, (steps, BLOCK_EPISODES), strict=True)
    )
    return step_block, episode_block


def train(learner: Learner, until_episode: int) -> int:
    """Train up to an episode, reusing one block of records; return the steps taken."""
    steps, episodes = blocks(learner, "train")
    while learner.episode < until_episode:
        learner.train(steps, episodes, until_episode, NO_LIMIT)
    return learner.step
