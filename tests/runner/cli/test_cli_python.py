"""`runner.run` and `runner.run_all`, and the public names."""

import os
import signal
import subprocess
import sys
import threading

import pytest
import yaml

import runner
from runner.api import experiment_of
from runner.errors import ConfigError, EnvironmentNotUsable
from runner.execution.rerecord import rerecord
from runner.runs.run import list_runs


def test_the_public_names():
    assert runner.__all__ == [
        "ExperimentConfig",
        "Recording",
        "Run",
        "RunnerError",
        "__version__",
        "branch",
        "evaluate",
        "explain",
        "find",
        "find_run",
        "frames",
        "integrations",
        "label",
        "list_runs",
        "mark",
        "open_recording",
        "plot",
        "record",
        "record_aec",
        "record_batches",
        "record_parallel",
        "record_vector",
        "register_space",
        "report",
        "rerecord",
        "resume",
        "run",
        "run_all",
        "sql",
        "unmark",
        "verify",
        "what_if",
        "when",
        "why",
    ]
    for name in runner.__all__:
        assert getattr(runner, name) is not None
        assert name in dir(runner)
    with pytest.raises(AttributeError, match="has no attribute 'walk'"):
        runner.walk  # noqa: B018


def test_importing_it_imports_nothing_heavy():
    program = "import sys, runner; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert not {"numpy", "numba", "gymnasium", "pydantic", "click"} & set(done.stdout.split())


@pytest.mark.parametrize("kind", ["path", "text", "mapping", "config"])
def test_a_configuration_may_be_a_path_text_mapping_or_object(tiny, tmp_path, recorded_run, kind):
    config = {
        "path": tiny,
        "text": str(tiny),
        "mapping": yaml.safe_load(tiny.read_text()),
        "config": experiment_of(tiny),
    }[kind]
    run = runner.run(config, recordings=tmp_path / "runs")
    assert run.summary["content_digest"] == recorded_run.summary["content_digest"]
    assert (run.status, run.seed, run.name) == ("finished", 3, "tiny")


def test_seed_name_and_overrides(tiny, tmp_path):
    run = runner.run(tiny, seed=9, name="mine", overrides=["episodes=5"], recordings=tmp_path / "runs")
    assert (run.seed, run.name, run.summary["episodes"]) == (9, "mine", 5)
    assert run.facts["config"]["seeds"] == [9]
    assert runner.find_run("mine", tmp_path / "runs").run_id == run.run_id
    with runner.open_recording(run.recording) as recording:
        assert recording.run["name"] == "mine"


def test_the_seed_of_an_object_may_be_changed(tiny, tmp_path):
    config = experiment_of(tiny)
    assert runner.run(config, seed=4, recordings=tmp_path / "runs").seed == 4
    assert config.seeds == (3,)


def test_run_refuses_several_seeds(tiny, tmp_path):
    several = ["seeds=[1, 2]"]
    with pytest.raises(ConfigError, match="found 2 seeds"):
        runner.run(tiny, overrides=several, recordings=tmp_path / "runs")
    assert not (tmp_path / "runs").exists()
    runs = runner.run_all(tiny, overrides=several, recordings=tmp_path / "runs")
    assert next(runs).seed == 1
    assert len(list_runs(tmp_path / "runs")) == 1
    assert [run.seed for run in runs] == [2]


@pytest.mark.parametrize("workers", [1, 2])
def test_each_of_several_seeds_has_the_name_and_reports(tiny, tmp_path, workers):
    values = []
    several = ["seeds=[1, 2]", "recording.steps=none"]
    runs = runner.run_all(
        tiny, overrides=several, name="both", recordings=tmp_path, report=values.append, workers=workers
    )
    assert [(run.seed, run.name) for run in runs] == [(1, "both"), (2, "both")]
    assert {progress.episodes for progress in values} == {30}
    assert len({id(progress) for progress in values}) == 2


def test_parallel_seeds_record_what_each_records_alone(tiny, tmp_path):
    several = ["seeds=[1, 2, 3, 4, 5]", "recording.steps=none"]
    parallel = list(runner.run_all(tiny, overrides=several, recordings=tmp_path / "parallel", workers=3))
    alone = list(runner.run_all(tiny, overrides=several, recordings=tmp_path / "alone"))
    digests = [run.summary["content_digest"] for run in alone]
    assert [run.seed for run in parallel] == [1, 2, 3, 4, 5]
    assert [run.summary["content_digest"] for run in parallel] == digests
    assert rerecord(parallel[3]).summary["content_digest"] == digests[3]


def test_interrupted_or_abandoned_parallel_seeds_are_closed(tiny, tmp_path):
    long = ["seeds={count: 50}", "episodes=100000", "recording.steps=none"]
    runs = runner.run_all(tiny, overrides=long, recordings=tmp_path, workers=2)
    threading.Timer(0.5, lambda: os.kill(os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        next(runs)
    short = runner.run_all(tiny, overrides=["seeds={count: 50}"], recordings=tmp_path / "left", workers=2)
    next(short)
    short.close()
    for folder in (tmp_path, tmp_path / "left"):
        begun = list_runs(folder)
        assert 0 < len(begun) <= 8
        assert {run.status for run in begun} <= {"interrupted", "finished"}


def test_workers_is_one_or_more(tiny, tmp_path):
    with pytest.raises(ConfigError, match="workers: found 0"):
        runner.run_all(tiny, recordings=tmp_path, workers=0)


def test_progress_is_reported(tiny, tmp_path):
    seen = []
    run = runner.run(
        tiny, recordings=tmp_path / "runs", report=lambda progress: seen.append(progress.episode)
    )
    assert seen == sorted(seen)
    assert seen[-1] == run.summary["episodes"]


def test_the_variable_sets_the_recordings_folder(tiny, tmp_path, monkeypatch):
    monkeypatch.setenv("DUALTAXI_RECORDINGS", str(tmp_path / "there"))
    assert runner.run(tiny).folder.parent == tmp_path / "there"


def test_errors_belong_to_the_error_family(tiny, tmp_path):
    with pytest.raises(ConfigError, match="name: found"):
        runner.run(tiny, name="/", recordings=tmp_path / "runs")
    with pytest.raises(EnvironmentNotUsable) as caught:
        runner.run(tiny, overrides=["env={id: Nothing-v1}"], recordings=tmp_path / "runs")
    assert "was removed" in caught.value.__notes__[0]
    assert list_runs(tmp_path / "runs") == []
