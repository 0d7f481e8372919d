"""The identity of a job: equal for equal content, whatever the name."""

from __future__ import annotations

import pytest

from runner.config import ExperimentConfig, from_mapping
from runner.config.model import Job, jobs_of

BASE = {"episodes": 100, "epsilon": {"schedule": "linear", "start": 1.0, "end": 0.1, "over": 50}}

SAME = {
    "name": {"name": "another"},
    "other seeds": {"seeds": [3, 4]},
    "packing": {"recording": {"compression": "lz4", "index": "chunk", "chunk_steps": 512}},
    "no steps recorded": {"recording": {"steps": "none"}},
    "defaults spelled out": {"mode": "cooperative", "discount": 0.95, "exploration": "shared"},
    "tables for mode": {"tables": "joint", "rewards": "team"},
}
OTHER = {
    "episodes": {"episodes": 101},
    "environment": {"env": {"id": "Taxi-v4"}},
    "its arguments": {"env": {"kwargs": {"slip": 0.1}}},
    "learners": {"mode": "competitive"},
    "algorithm": {"algorithm": "random"},
    "step size": {"step_size": 0.2},
    "discount": {"discount": 0.9500000000000001},
    "epsilon": {"epsilon": 0.1},
    "exploration": {"exploration": "independent"},
    "initial values": {"initial_q": "random"},
    "evaluation": {"evaluation": None},
    "log": {"log": {"every_steps": 10}},
    "snapshots": {"snapshots": {"every": 10}},
    "a quirk": {"quirks": {"bootstrap_after_termination": True}},
    "a branch": {"branches": [{"run": "k3v9m2xq", "step": 7, "settings": {"epsilon": 0.5}}]},
}
OF_ONE_ALGORITHM = {
    "hysteretic": ("hysteretic_q_learning", {"decrease": 0.01}, {"decrease": 0.02}),
    "wolf_phc": ("wolf_phc", {"win": 0.05}, {"win": 0.04}),
    "sarsa_lambda": ("sarsa_lambda", {"trace_decay": 0.9}, {"trace_decay": 0.8}),
    "n_step": ("n_step_q_learning", {"n": 4}, {"n": 5}),
}


def job(seed: int = 3, **values) -> Job:
    return Job(from_mapping(BASE | values), seed)


@pytest.mark.parametrize("values", SAME.values(), ids=SAME)
def test_the_identity_ignores_keys_that_do_not_change_the_content(values):
    assert job(**values).identity == job().identity


@pytest.mark.parametrize("values", OTHER.values(), ids=OTHER)
def test_keys_that_change_the_content_change_the_identity(values):
    assert job(**values).identity != job().identity


def test_the_seed_changes_the_identity():
    assert len({job(seed).identity for seed in (0, 1, 3, 2**64 - 1)}) == 4


@pytest.mark.parametrize("key", OF_ONE_ALGORITHM)
def test_a_section_of_one_algorithm_counts_by_its_values(key):
    algorithm, default, other = OF_ONE_ALGORITHM[key]
    bare = {"mode": "competitive", "algorithm": algorithm}
    assert job(**bare, **{key: default}).identity == job(**bare).identity
    assert job(**bare, **{key: other}).identity != job(**bare).identity


def test_every_key_is_covered_by_a_test_of_identity():
    tried = {key for values in (*SAME.values(), *OTHER.values()) for key in values} - {"mode"}
    assert tried | set(OF_ONE_ALGORITHM) == set(ExperimentConfig.model_fields)


def test_an_experiment_has_one_job_per_seed_in_order():
    config = from_mapping(BASE | {"seeds": {"first": 5, "count": 3}})
    assert [(each.seed, each.config) for each in jobs_of(config)] == [(5, config), (6, config), (7, config)]
