"""Runs the compiled learner block by block, and compares its records and tables with the twin's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from runner.config import ExperimentConfig, from_mapping
from runner.environments.loading import load_mdp
from runner.environments.mdp import Mdp
from runner.learning import kernel
from runner.learning.learner import Learner
from runner.recording import schema
from runner.recording.layout import blank_records, layout_of
from runner.replay.tables import NO_PROBE, NO_ROWS, NO_TRACE
from tests.runner.learning.twin import Twin

SMALL_MAP = ["+---+", "|A: |", "| |B|", "+---+"]
SMALL = {"env": {"kwargs": {"map": SMALL_MAP, "max_episode_steps": 90}}}
"""DualTaxi on 2 x 2 cells: 128 states, short episodes, some cut off."""
COMPETITIVE = {"mode": "competitive"}
INDEPENDENT_LEARNERS = {"tables": "per_agent", "rewards": "team"}
LINEAR = {"schedule": "linear", "start": 0.9, "end": 0.1}
EXPONENTIAL = {"schedule": "exponential", "start": 0.97, "floor": 0.05}
PIECEWISE = {"schedule": "piecewise"}

GAMES = {
    "published cooperative": {},
    "published competitive": COMPETITIVE,
    "published team of learners": INDEPENDENT_LEARNERS,
    "slipping": {"env": {"kwargs": {"slip": 0.2}}} | COMPETITIVE,
    "frozen lake": {"env": {"id": "FrozenLake-v1", "kwargs": {"is_slippery": True}}},
    "taxi": {"env": {"id": "Taxi-v4"}},
    "taxi in the rain": {"env": {"id": "Taxi-v4", "kwargs": {"is_rainy": True}}},
    "cliff": {"env": {"id": "CliffWalking-v1", "kwargs": {"max_episode_steps": 70}}},
}
RULES = {
    "cooperative": {},
    "competitive": COMPETITIVE,
    "team of learners": INDEPENDENT_LEARNERS,
    "slipping": {"env": {"kwargs": {"map": SMALL_MAP, "slip": 0.2, "max_episode_steps": 90}}},
    "each explores alone": COMPETITIVE | {"exploration": "independent"},
    "one table explores alone": {"exploration": "independent"},
    "epsilon exploits": {"quirks": {"epsilon_exploits": True}, "epsilon": 0.2},
    "second table by first action": COMPETITIVE | {"quirks": {"second_table_uses_first_action": True}},
    "bootstrap after the end": {"quirks": {"bootstrap_after_termination": True}, "initial_q": 3.0},
    "every quirk": COMPETITIVE
    | {
        "exploration": "independent",
        "epsilon": LINEAR | {"over": 70},
        "quirks": {
            "epsilon_exploits": True,
            "second_table_uses_first_action": True,
            "bootstrap_after_termination": True,
        },
    },
    "optimistic": {"initial_q": 100.5, "epsilon": 0.0},
    "initially random": COMPETITIVE | {"initial_q": {"random": {"low": -1.25, "high": 0.7}}},
    "random agents": {"algorithm": "random"},
    "random agents alone": COMPETITIVE
    | {"algorithm": "random", "exploration": "independent", "quirks": {"epsilon_exploits": True}},
    "full steps, no discount": {"step_size": 1.0, "discount": 1.0},
    "short-sighted": {"discount": 0.0},
    "linear": {"epsilon": LINEAR | {"over": 61}, "step_size": LINEAR | {"over": 300, "by": "step"}},
    "exponential": {
        "epsilon": EXPONENTIAL | {"factor": 0.93},
        "discount": EXPONENTIAL | {"factor": 0.9997, "by": "step"},
        "step_size": EXPONENTIAL | {"factor": 0.99},
    },
    "piecewise": {
        "epsilon": PIECEWISE | {"points": [[0, 1.0], [7, 0.3], [8, 0.9], [90, 0.05]], "floor": 0.1},
        "discount": PIECEWISE | {"points": [[0, 0.7], [1000, 0.99]], "by": "step"},
        "step_size": PIECEWISE | {"points": [[0, 0.3]]},
    },
}
ALGORITHMS = {
    "sarsa": {"algorithm": "sarsa"},
    "sarsa of two": COMPETITIVE | {"algorithm": "sarsa"},
    "sarsa, each alone, by step": COMPETITIVE
    | {"algorithm": "sarsa", "exploration": "independent", "epsilon": LINEAR | {"over": 900, "by": "step"}},
    "sarsa that bootstraps at the end": {
        "algorithm": "sarsa",
        "initial_q": 3.0,
        "quirks": {"bootstrap_after_termination": True},
    },
    "expected sarsa": {"algorithm": "expected_sarsa"},
    "expected sarsa of two": COMPETITIVE
    | {"algorithm": "expected_sarsa", "epsilon": EXPONENTIAL | {"factor": 0.999, "by": "step"}},
    "expected sarsa, epsilon exploits": {
        "algorithm": "expected_sarsa",
        "quirks": {"epsilon_exploits": True},
        "epsilon": 0.3,
    },
    "double": {"algorithm": "double_q_learning"},
    "double of two, random": COMPETITIVE | {"algorithm": "double_q_learning", "initial_q": "random"},
    "hysteretic": INDEPENDENT_LEARNERS | {"algorithm": "hysteretic_q_learning"},
    "hysteretic, changing": COMPETITIVE
    | {
        "algorithm": "hysteretic_q_learning",
        "exploration": "independent",
        "hysteretic": {"decrease": LINEAR | {"over": 400, "by": "step"}},
    },
    "distributed": INDEPENDENT_LEARNERS
    | {"algorithm": "hysteretic_q_learning", "hysteretic": {"decrease": 0.0}},
    "wolf": {"algorithm": "wolf_phc"},
    "wolf of two": COMPETITIVE | {"algorithm": "wolf_phc", "initial_q": "random"},
    "wolf, changing": INDEPENDENT_LEARNERS
    | {
        "algorithm": "wolf_phc",
        "exploration": "independent",
        "epsilon": 0.1,
        "wolf_phc": {"win": EXPONENTIAL | {"factor": 0.99}, "lose": 1.0},
    },
    "sarsa lambda": {"algorithm": "sarsa_lambda"},
    "sarsa lambda of two, changing": COMPETITIVE
    | {
        "algorithm": "sarsa_lambda",
        "exploration": "independent",
        "discount": EXPONENTIAL | {"factor": 0.9997, "by": "step"},
        "sarsa_lambda": {"trace_decay": LINEAR | {"over": 700, "by": "step"}},
    },
    "sarsa lambda, traces without decay": {
        "algorithm": "sarsa_lambda",
        "discount": 1.0,
        "step_size": 0.01,
        "sarsa_lambda": {"trace_decay": 1.0},
        "quirks": {"bootstrap_after_termination": True},
        "initial_q": 3.0,
    },
    "n-step": {"algorithm": "n_step_q_learning"},
    "n-step of two, changing": COMPETITIVE
    | {
        "algorithm": "n_step_q_learning",
        "initial_q": "random",
        "discount": EXPONENTIAL | {"factor": 0.9997, "by": "step"},
        "step_size": LINEAR | {"over": 300, "by": "step"},
        "n_step": {"n": 3},
    },
    "whole episodes of a team": INDEPENDENT_LEARNERS
    | {
        "algorithm": "n_step_q_learning",
        "quirks": {"bootstrap_after_termination": True},
        "initial_q": 3.0,
        "n_step": {"n": 500},
    },
}
"""Every algorithm besides Q-learning, with what is special to it."""
FOLLOWED = {
    name: rules
    for name, rules in ALGORITHMS.items()
    if rules["algorithm"] not in ("sarsa_lambda", "n_step_q_learning")
}
"""Those where a step changes one value of a learner, and `why` can follow it."""


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


def replay(
    learner: Learner, steps: NDArray[np.void], updates: NDArray[np.void] = NO_TRACE.updates, i: int = 0
) -> None:
    """Apply the updates of recorded steps to a learner's tables; fill what decides learner i's weights."""
    records = steps.view(np.recarray)
    records.flags.writeable = False  # as `StepReplay` passes them: the kernel is compiled once
    state = learner.seed, learner.model, learner.tables, learner.rules
    kernel.replay(*state, records, NO_ROWS, updates, i, NO_PROBE)


def recall(learner: Learner, steps: NDArray[np.void]) -> None:
    """Let a learner remember recorded steps."""
    records = steps.view(np.recarray)
    records.flags.writeable = False
    kernel.recall(learner.seed, learner.model, learner.tables, learner.rules, records)


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
        blank_records(topic, layout_of("job", learners, events).message(topic), n).view(np.recarray)
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
    """Compare every cell of all that each learner holds, bit for bit."""
    for i in range(twin.learners):
        held, expected = learner.named_tables(i), twin.named_tables(i)
        assert held.keys() == expected.keys()
        for name, table in expected.items():
            assert held[name].tobytes() == np.array(table).tobytes(), f"{name} of learner {i}"
