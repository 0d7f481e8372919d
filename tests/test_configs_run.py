"""Every shipped experiment runs, shortened where it is long, and gives a finished recording."""

from __future__ import annotations

from pathlib import Path

import pytest

from runner.config import load
from runner.config.model import jobs_of
from runner.execution.session import run_job
from runner.recording import schema
from runner.recording.integrity import check_integrity
from runner.recording.reader import open_recording
from runner.runs.run import create_run

CONFIGS = sorted((Path(__file__).parents[1] / "configs").glob("*.yaml"))
SHORT = ["episodes=30", "evaluation.every=15", "evaluation.trials=3", "log.every_steps=1000"]


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_a_shipped_experiment_runs(path, tmp_path):
    config = load(path, SHORT)
    job = next(jobs_of(config))
    run = run_job(job, create_run(tmp_path, config, job.seed))
    assert (run.status, run.name) == ("finished", path.stem)
    check_integrity(run.recording)
    with open_recording(run.recording) as recording:
        assert recording.file.finished
        assert recording.train.episodes.count() == 30
        assert recording.eval.episodes.count() == 9
        assert recording.train.steps.count() >= 30
        assert {table.episode for table in recording.snapshots()} >= {0, 30}


def test_what_is_shipped_is_found():
    assert {"quick", "cooperative", "competitive", "tutorial_cooperative"} <= {path.stem for path in CONFIGS}


def test_the_optimum_is_learned_to_the_last_bit_that_counts(tmp_path):
    config = load(CONFIGS[0].with_name("optimal.yaml"), ["recording.steps=none", "evaluation.every=1000"])
    run = run_job(next(jobs_of(config)), create_run(tmp_path, config, config.seeds[0]))
    with open_recording(run.recording) as recording:
        last = list(recording.table(schema.OPTIMALITY_TOPIC).decoded())[-1]
    assert (last["starts"], last["success_percent"]) == (2880, 100.0)
    assert last["mean_length"] == last["optimal_mean_length"] == pytest.approx(9.172916666666667)
    assert sum(last["values"]) == pytest.approx(last["optimal_value"], abs=1e-9)
