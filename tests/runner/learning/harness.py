"""Runs the compiled learner block by block, and compares its records and tables with the twin's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from runner.config import ExperimentConfig, from_mapping
from runner.learning.learner import Learner
from runner.mdp import Mdp, load_mdp
from runner.recording import schema
from tests.runner.learning.oracle import Twin

SMALL_MAP = ["+---+", "|A: |", "| |B|", "+---+"]
SMALL = {"env": {"kwargs": {"map": SMALL_MAP, "max_episode_steps": 90}}}
"""DualTaxi on 2 x 2 cells: 128 states, short episodes, some cut off."""


class Played(NamedTuple):
    """The records of a phase."""

    steps: NDArray[np.void]
    episodes: NDArray[np.void]


def experiment(*parts: dict[str, Any], **values: Any) -> tuple[ExperimentConfig, Mdp]:
    """Return the experiment that these parts describe together, and its environment."""
    merged: dict[str, Any] = {"episodes": 10**6}
    for part in (*parts, values):
        merged |= part
    config = from_mapping(merged)
    return config, load_mdp(config.env.id, config.env.kwargs, config.rewards)


def train(learner: Learner, until_episode: int, until_step: int, block: int) -> Played:
    """Train in blocks of that many records."""
    steps, episodes = blank_blocks(learner, block)
    blocks = [(steps[:0], episodes[:0])]
    while learner.episode < until_episode and learner.step < until_step:
        filled, ended = learner.train(steps, episodes, until_episode, until_step)
        assert filled
        blocks.append((steps[:filled].copy(), episodes[:ended].copy()))
    return _joined(blocks)


def evaluate(learner: Learner, first: int, trials: int, block: int) -> Played:
    """Play the trials number `first` and on in blocks of that many records."""
    learner.begin_evaluation()
    steps, episodes = blank_blocks(learner, block)
    blocks, done = [(steps[:0], episodes[:0])], first
    while done < first + trials:
        filled, ended = learner.evaluate(steps, episodes, first + trials)
        assert filled
        blocks.append((steps[:filled].copy(), episodes[:ended].copy()))
        done += ended
    return _joined(blocks)


def blank_blocks(learner: Learner, n: int) -> tuple[Any, ...]:
    """Return n step records and n episode records to fill, such as the recorder hands out."""
    learners, events = len(learner.agents), len(learner.mdp.event_names)
    return tuple(
        schema.blank_records(topic, schema.block_counts(topic, learners, events), n).view(np.recarray)
        for topic in (schema.TRAIN_STEP, schema.TRAIN_EPISODE)
    )


def _joined(blocks: list[tuple[Any, Any]]) -> Played:
    steps, episodes = zip(*blocks, strict=True)
    return Played(np.concatenate(steps), np.concatenate(episodes))


def assert_same_records(records: NDArray[np.void], expected: Sequence[NamedTuple], kind: type) -> None:
    """Compare every field of every record, floats by their value to the last bit."""
    assert len(records) == len(expected)
    if not expected:
        return
    for name, column in zip(kind._fields, zip(*expected, strict=True), strict=False):
        assert records[name].tolist() == list(column), name


def assert_same_tables(learner: Learner, twin: Twin) -> None:
    """Compare every cell of every table, bit for bit."""
    for i, table in enumerate(twin.tables):
        assert learner.table(i).tobytes() == np.array(table).tobytes(), f"table {i}"
