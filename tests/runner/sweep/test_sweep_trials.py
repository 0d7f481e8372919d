"""A sweep gives the same results with any workers and after any interruption."""

from __future__ import annotations

import shutil
from dataclasses import replace

import pytest
from sweeping import Here, described, digests, swept

from runner.config import from_mapping
from runner.config.model import Job
from runner.errors import RunnerError
from runner.execution.rerecord import rerecord
from runner.execution.session import run_job
from runner.recording.labels import read_labels
from runner.runs import provenance
from runner.runs.resolve import find_run
from runner.runs.run import create_run, list_runs
from runner.sweep import state
from runner.sweep.model import Objective, Range, from_values
from runner.sweep.results import ranking, results_of
from runner.sweep.running import plan_of, run_sweep
from runner.sweep.task import Task, move_files
from runner.sweep.workers import LocalWorkers, _SweepWorker


def test_each_run_is_tagged_with_the_sweep(done):
    folder, trials, status = done
    assert (status.done, status.failed, status.stopped) == (12, 0, "")
    for trial in trials.done:
        for seed, result in trial.results.items():
            run = find_run(result.run_id, folder)
            assert (run.status, run.name, run.seed) == ("finished", "small", seed)
            assert run.tags == ("sweep=small", f"trial={trial.number}")


def test_a_run_equals_one_outside_of_the_sweep_and_can_be_rerecorded(done, tmp_path):
    folder, trials, _ = done
    trial = trials.done[3]
    config = from_mapping(trial.config, ["recording.steps=all"])
    alone = run_job(Job(config, 1), create_run(tmp_path, config, 1))
    assert alone.summary["content_digest"] == trial.results[1].digest
    again = rerecord(find_run(trial.results[1].run_id, folder))
    assert again.summary["content_digest"] == trial.results[1].digest


@pytest.mark.parametrize("count", [1, 2])
def test_the_number_of_workers_changes_nothing(count, done, sweep, tmp_path):
    with LocalWorkers(count) as workers:
        trials, _ = swept(tmp_path, sweep, workers)
    assert digests(trials) == digests(done[1])


def test_a_sweep_interrupted_twice_ends_like_an_undisturbed_one(done, sweep, tmp_path):
    first = Here(most=3)
    _, status = swept(tmp_path, sweep, first, stop=lambda: first.done > 3)
    assert status.stopped == "interrupted"
    assert status.best is not None, "a trial that is over counts before its batch is"
    second = Here(most=4)
    swept(tmp_path, sweep, second, stop=lambda: second.done > 4)
    third = Here()
    trials, status = swept(tmp_path, sweep, third)
    assert digests(trials) == digests(done[1])
    assert third.done == 12 - 3 - 4
    assert len(list_runs(tmp_path)) == 12


def test_runs_whose_values_were_added_up_in_floating_point_belong_to_their_sweep(tmp_path, monkeypatch):
    """0.7000000000000001 was recorded where 0.7 is tried now."""
    parameters = {"epsilon": {"low": 0.1, "high": 0.7, "step": 0.2}}
    sweep = from_values(described(strategy="random", trials=6, parameters=parameters))
    with monkeypatch.context() as patched:
        patched.setattr(Range, "nearest", lambda _, value: value)
        before, _ = swept(tmp_path, sweep)
    decimals = {0.1, 0.3, 0.5, 0.7}
    assert not {run.file.config["epsilon"] for run in list_runs(tmp_path)} <= decimals
    workers = Here()
    trials, status = swept(tmp_path, sweep, workers)
    assert (workers.done, status.failed) == (0, 0)
    assert [own[1:] for own in digests(trials)] == [own[1:] for own in digests(before)]
    assert {trial.values["epsilon"] for trial in trials.done} <= decimals


def test_resuming_a_run_of_other_code_is_refused(done, sweep, tmp_path, monkeypatch):
    first = Here(most=3)
    swept(tmp_path, sweep, first, stop=lambda: first.done > 3)
    before = len(list_runs(tmp_path))
    here = provenance.provenance()
    monkeypatch.setattr(provenance, "provenance", lambda: here | {"dualtaxi": "another"})
    with pytest.raises(RunnerError, match=r"dualtaxi: \S* then, another now"):
        swept(tmp_path, sweep)
    assert len(list_runs(tmp_path)) == before
    state.begin(sweep, tmp_path, resume=True, accept_changes=True)
    trials, _ = run_sweep(sweep, tmp_path, Here(), accept_changes=True)
    assert digests(trials) == digests(done[1])
    assert len(list_runs(tmp_path)) == 12


def test_runs_recorded_elsewhere_are_moved_and_resumed(done, sweep, tmp_path):
    class Elsewhere(Here):
        def submit(self, task):
            super().submit(replace(task, on_own_disk=True))

    first = Elsewhere(most=3)
    _, status = swept(tmp_path, sweep, first, stop=lambda: first.done > 3)
    assert status.stopped
    begun = {run.run_id for run in list_runs(tmp_path)}
    assert {run.status for run in list_runs(tmp_path)} == {"finished", "interrupted"}
    trials, _ = swept(tmp_path, sweep, Elsewhere())
    assert digests(trials) == digests(done[1])
    assert begun < {run.run_id for run in list_runs(tmp_path)}
    assert len(list_runs(tmp_path)) == 12
    assert [path.name for path in tmp_path.glob(".*")] == [".sweeps"]


def test_a_finished_sweep_runs_nothing(done, sweep):
    folder, trials, _ = done
    nobody = Here()
    again, status = swept(folder, sweep, nobody)
    assert (nobody.done, status.done) == (0, 12)
    assert digests(again) == digests(trials)


def test_the_task_of_a_dead_worker_is_retried(done, sweep, tmp_path):
    trials, status = swept(tmp_path, sweep, Here(dying={2, 5}))
    assert status.failed == 0
    assert digests(trials) == digests(done[1])


def test_a_task_whose_worker_dies_twice_fails_and_the_sweep_continues(tmp_path):
    sweep = from_values(described(strategy="random", seeds=[0]))
    trials, status = swept(tmp_path, sweep, Here(dying={1, 2}))
    assert (status.done, status.failed) == (5, 1)
    assert [trial.state for trial in trials.done] == ["failed", *["finished"] * 5]
    assert trials.done[0].errors == ["seed 0: its worker died twice"]
    again, status = swept(tmp_path, sweep)
    assert (status.started, digests(again)) == (0, digests(trials))
    assert len(results_of(sweep.name, tmp_path).ranking) == 6
    state.forget_failures("small", tmp_path)
    _, status = swept(tmp_path, sweep)
    assert (status.done, status.failed, status.started) == (6, 0, 1)


def test_a_process_that_dies_before_its_task_is_replaced(done, monkeypatch):
    real, gone = _SweepWorker.send, []

    def send(worker, task):
        if not gone:
            gone.append(worker)
            worker._process.kill()
            worker._process.join()
        return real(worker, task)

    monkeypatch.setattr(_SweepWorker, "send", send)
    folder, trials, _ = done
    expected = trials.done[0].results[0]
    objective = Objective(metric="mean_length")
    task = Task("", 0, {}, 0, str(folder), objective, run_id=expected.run_id)
    with LocalWorkers(1) as workers:
        workers.submit(task)
        assert workers.collect(30) == [(task, None)]
        workers.submit(task)
        ((_, result),) = workers.collect(30)
    assert (result.status, result.digest) == ("finished", expected.digest)


def test_a_run_that_cannot_be_moved_leaves_the_old_copy(done, monkeypatch, tmp_path):
    run = list_runs(done[0])[0].folder
    shutil.copytree(run, tmp_path / run.name)
    before = {path.name: path.read_bytes() for path in run.iterdir()}

    def copyfile(path, to):
        to.write_bytes(b"half of it")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shutil, "copyfile", copyfile)
    with pytest.raises(OSError, match="No space left"):
        move_files(run, tmp_path / run.name)
    assert {path.name: path.read_bytes() for path in (tmp_path / run.name).iterdir()} == before


def test_pruned_runs_stay_pruned(tmp_path):
    objective = {"metric": "training.percent_filled", "at": "last"}
    pruning = {"after": 20, "trials": 2, "percentile": 20}
    parameters = {"epsilon": [0.0, 1.0], "step_size": {"low": 0.1, "high": 1.0}}
    changes = {"trials": 12, "pruning": pruning, "objective": objective, "parameters": parameters}
    sweep = from_values(described(strategy="random", seeds=[0], **changes))
    trials, status = swept(tmp_path / "a", sweep)
    given_up = [trial for trial in trials.done if trial.state == "pruned"]
    assert 0 < status.pruned == len(given_up) < 12
    run = find_run(given_up[0].results[0].run_id, tmp_path / "a")
    assert run.status == "interrupted"
    assert "pruned" in read_labels(run.folder).tags
    with LocalWorkers(2) as workers:
        others, _ = swept(tmp_path / "b", sweep, workers)
    states = [(trial.values, trial.state, trial.value) for trial in trials.done]
    assert states == [(trial.values, trial.state, trial.value) for trial in others.done]
    assert {entry.state for entry in ranking(sweep, trials.done)[-len(given_up) :]} == {"pruned"}


def test_two_trials_of_one_job_share_its_run(tmp_path):
    sweep = from_values(described(strategy="random", trials=8, parameters={"discount": [0.5, 0.9]}))
    workers = Here()
    _, status = swept(tmp_path, sweep, workers)
    assert workers.done == 4
    assert status.done == 16
    assert status.bytes == sum(run.recording.stat().st_size for run in list_runs(tmp_path))


def test_contradictory_values_are_excluded(tmp_path):
    base = described()["base"] | {"env": {"id": "dualtaxi:DualTaxi-v1"}, "mode": "competitive", "episodes": 2}
    parameters = {
        "mode": ["competitive", "cooperative"],
        "quirks.second_table_uses_first_action": [False, True],
    }
    sweep = from_values(
        described(strategy="grid", trials=None, seeds=[0], base=base, parameters=parameters, objective={})
    )
    trials, status = swept(tmp_path, sweep)
    assert [trial.state for trial in trials.done] == ["finished", "finished", "finished", "excluded"]
    assert "found tables: joint" in trials.done[3].errors[0]
    assert (status.runs, status.done, status.failed, status.excluded) == (3, 3, 0, 1)
    assert plan_of(sweep).excluded == 1
    assert "found tables: joint" in str(results_of(sweep.name, tmp_path).sections())


def test_a_changed_sweep_is_refused_with_its_changes(sweep, tmp_path):
    state.begin(sweep, tmp_path, resume=False, accept_changes=False)
    changed = from_values(described(trials=9, seeds=[0, 2], limits={"runs": 3}))
    with pytest.raises(RunnerError, match="trials: 6, now 9") as caught:
        state.begin(changed, tmp_path, resume=True, accept_changes=False)
    assert "limits" not in str(caught.value)
    assert str(caught.value).count("seeds") == 1
    state.begin(changed, tmp_path, resume=True, accept_changes=True)
    assert state.read_sweep("small", tmp_path) == changed


def test_a_sweep_is_read_without_its_environment(sweep, tmp_path):
    state.begin(sweep, tmp_path, resume=False, accept_changes=False)
    path = state.folder_of("small", tmp_path) / "sweep.yaml"
    text = path.read_text()
    changed = text.replace(sweep.base.env.id, "gone:Gone-v0")
    assert changed != text
    path.write_text(changed)
    assert state.read_sweep("small", tmp_path).base.env.id == "gone:Gone-v0"


def test_a_second_sweep_of_a_name_and_a_second_process_are_refused(sweep, tmp_path):
    state.begin(sweep, tmp_path, resume=False, accept_changes=False)
    with pytest.raises(RunnerError, match="--resume continues it"):
        state.begin(sweep, tmp_path, resume=False, accept_changes=False)
    one, other = state.locked("small", tmp_path), state.locked("small", tmp_path)
    with one, pytest.raises(RunnerError, match="by another process"), other:
        pass


def test_results_rank_by_the_objective_with_intervals(tmp_path):
    sweep = from_values(described(seeds=[0, 1, 2, 3, 4]))
    _, status = swept(tmp_path, sweep)
    results = results_of(sweep.name, tmp_path)
    medians = [entry.median for entry in results.ranking]
    assert medians == sorted(medians, reverse=True)
    assert results.best.number == status.best.number == results.ranking[0].number
    top = results.ranking[0].iqm
    assert top.low <= top.value <= top.high
