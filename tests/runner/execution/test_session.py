"""Running a job: what is done in which order, what is written of it, and how it can end."""

from __future__ import annotations

import json
import os
import signal
import threading

import numpy as np
import pytest
from mcap.reader import make_reader

import runner
from runner.config import ConfigError
from runner.config.model import Job, jobs_of
from runner.environments.loading import load_mdp
from runner.errors import EnvironmentNotUsable, RunnerError, RunNotFound
from runner.execution.session import run_job
from runner.recording import schema
from runner.recording.description import recorded_facts
from runner.recording.integrity import check_integrity
from runner.recording.messages import message_class
from runner.recording.reader import open_recording
from runner.runs.resolve import find_run
from runner.runs.run import create_run, list_runs
from tests.runner.learning.twin import Twin
from tests.runner.recording.making import LAKE, TAXIS, experiment, make_run, stopping_after


def positions(run) -> dict[str, list[tuple[int, int]]]:
    """Return at how many (episodes, steps) of training each kind of measure was taken."""
    with open_recording(run.recording) as recording:
        return {
            "evaluation": [(each["episode"], each["step"]) for each in recording.eval.all_metrics()],
            "log": [(each["episode"], each["step"]) for each in recording.train.all_metrics()],
            "snapshot": [(each.episode, each.step) for each in recording.snapshots()],
        }


@pytest.mark.parametrize(
    ("episodes", "every", "expected"),
    [
        (12, 5, [0, 5, 10, 12]),
        (12, 6, [0, 6, 12]),
        (12, 1, list(range(13))),
        (12, 12, [0, 12]),
        (12, 100, [0, 12]),
        (1, 1, [0, 1]),
        (0, 1, [0]),
    ],
)
def test_evaluations_and_snapshots_come_before_training_after_every_n_episodes_and_at_the_end(
    episodes, every, expected, tmp_path
):
    plan = {"evaluation": {"every": every, "trials": 1}, "snapshots": {"every": every}}
    taken = positions(make_run(tmp_path, LAKE, plan, episodes=episodes))
    assert [episode for episode, _ in taken["evaluation"]] == expected
    assert taken["snapshot"] == taken["evaluation"]


def test_without_evaluation_log_and_snapshots_only_the_first_and_last_tables_are_left(tmp_path):
    taken = positions(make_run(tmp_path, LAKE, evaluation=None, log=None, snapshots={"every": None}))
    assert taken["evaluation"] == taken["log"] == []
    assert [episode for episode, _ in taken["snapshot"]] == [0, 12]


def test_measures_of_training_are_taken_every_n_steps_and_at_no_other(tmp_path):
    """Nor where training pauses one step before, or at, the n-th."""
    often = {"evaluation": {"every": 1, "trials": 1}}
    pauses = [step for _, step in positions(make_run(tmp_path, LAKE, often, log=None))["evaluation"]]
    assert len(pauses) == 13
    for n in {pauses[2] + 1, pauses[5], pauses[7] - 1}:
        run = make_run(tmp_path, LAKE, often, log={"every_steps": n})
        assert [step for _, step in positions(run)["log"]] == list(range(n, pauses[-1] + 1, n))


def test_one_run_is_what_the_twin_does_from_beginning_to_end(tmp_path):
    """Every measure of both phases, at its moment, and every table."""
    config = experiment(TAXIS)
    run = make_run(tmp_path, TAXIS)
    with open_recording(run.recording) as recording:
        mdp = recording.mdp
        twin, logged, evaluated, tables = Twin(config, mdp, 0), [], [], []
        for pause in (0, 20, 30, 40, 60):
            while len(twin.training.episodes) < pause:
                next_log = (len(twin.training.steps) // 500 + 1) * 500
                twin.train(pause, next_log)
                if len(twin.training.steps) == next_log:
                    logged.append(twin.training_metrics())
            if pause % 30 == 0:
                tables += [np.array(table).tobytes() for table in twin.tables]
            if pause % 20 == 0:
                twin.evaluate(3)
                evaluated.append(twin.training_metrics())
        assert len(logged) == 5
        for found, expected in zip(recording.train.all_metrics(), logged, strict=True):
            assert {key: found[key] for key in expected} == expected
        for number, (found, expected) in enumerate(zip(recording.eval.all_metrics(), evaluated, strict=True)):
            trials = twin.evaluation.episodes[3 * number : 3 * number + 3]
            expected |= {
                "evaluation": number,
                "trials": 3,
                "successes": sum(trial.success for trial in trials),
                "terminations": sum(trial.terminated for trial in trials),
                "success_percent": 100 * sum(trial.success for trial in trials) / 3,
                "eval_mean_length": sum(trial.length for trial in trials) / 3,
                "mean_penalties": sum(trial.penalties for trial in trials) / 3,
                "mean_returns": [sum(trial.returns[i] for trial in trials) / 3 for i in range(2)],
                "events": [sum(counts) for counts in zip(*(trial.events for trial in trials), strict=True)],
            }
            if expected["mean_length"] is None:
                del expected["mean_length"]
            assert {key: found[key] for key in expected} == expected
        assert [table.values.tobytes() for table in recording.snapshots()] == tables
        assert [table.agent for table in recording.snapshots()] == ["taxi_1", "taxi_2"] * 3


@pytest.mark.parametrize(
    ("made_of", "agents"), [(TAXIS | {"mode": "cooperative"}, ["agency"]), (LAKE, ["player"])]
)
def test_one_table_belongs_to_the_agency_or_to_the_only_agent(made_of, agents, tmp_path):
    with open_recording(make_run(tmp_path, made_of, snapshots={"every": None}).recording) as recording:
        assert [table.agent for table in recording.snapshots()] == agents * 2
        assert json.loads(recording.run["agents"]) == agents


def test_run_json_says_what_was_done(tmp_path):
    run = make_run(tmp_path, TAXIS, seed=9)
    stored = json.loads((run.folder / "run.json").read_text())
    assert stored == run.facts
    assert (stored["name"], stored["seed"], stored["status"]) == ("taxis", 9, "finished")
    assert stored["config"] == experiment(TAXIS).to_mapping()
    assert stored["owner"]["pid"] == os.getpid()
    summary = stored["summary"]
    with open_recording(run.recording) as recording:
        for topic in schema.JOB_TOPICS:
            assert summary["messages"][topic.name] == recording.table(topic).count()
        last = recording.eval.all_metrics()[-1]
        assert summary["train_steps"] == recording.train.steps.count() == last["step"]
        assert summary["eval_steps"] == recording.eval.steps.count()
        assert recording.run["job"] == Job(experiment(TAXIS), 9).identity
    assert summary["episodes"] == last["episode"] == 60
    assert summary["last_evaluation"] == {
        "episode": 60,
        "success_percent": last["success_percent"],
        "mean_length": last["eval_mean_length"],
        "mean_penalties": last["mean_penalties"],
        "mean_return": pytest.approx(sum(last["mean_returns"])),
    }
    assert summary["bytes"] == run.recording.stat().st_size
    assert 0 < summary["seconds"] < 300
    assert [each.run_id for each in list_runs(tmp_path)] == [run.run_id]
    assert find_run("taxis", tmp_path).facts == run.facts


def test_an_environment_that_names_no_success_reports_none(tmp_path):
    """Not 0 %: that nothing is known is another thing than that nothing was achieved."""
    import gymnasium
    from gymnasium.envs.toy_text.frozen_lake import FrozenLakeEnv

    class Pond(FrozenLakeEnv):
        """A lake that nobody has described."""

    if "Pond-v0" not in gymnasium.registry:
        gymnasium.register("Pond-v0", Pond, max_episode_steps=20)
    run = make_run(tmp_path, LAKE, env={"id": "Pond-v0"})
    assert run.summary["last_evaluation"]["success_percent"] is None
    with open_recording(run.recording) as recording:
        metrics = recording.eval.all_metrics()[-1]
    assert metrics["successes"] == -1
    assert np.isnan(metrics["success_percent"])


def test_the_same_job_twice_is_the_same_content_and_every_seed_another(tmp_path):
    config = experiment(LAKE, seeds=[3, 4, 5])
    first, second = (
        [run_job(job, create_run(tmp_path, config, job.seed)) for job in jobs_of(config)] for _ in range(2)
    )
    digests = [run.summary["content_digest"] for run in first]
    assert digests == [run.summary["content_digest"] for run in second]
    assert len(set(digests)) == 3
    assert len({run.run_id for run in first + second}) == 6
    assert [run.seed for run in first] == [3, 4, 5]


@pytest.mark.parametrize("parts", [{}, {"recording": {"steps": "none"}}])
def test_recorded_without_threads_a_run_is_the_same_to_the_byte(parts, tmp_path):
    before = set(threading.enumerate())
    config = experiment(TAXIS, parts)
    threaded, alone = (
        run_job(Job(config, 0), create_run(tmp_path, config, 0), threads=threads) for threads in (True, False)
    )
    assert alone.summary["content_digest"] == threaded.summary["content_digest"]
    with open_recording(alone.recording) as one, open_recording(threaded.recording) as other:
        for topic in set(schema.ALL_TOPICS) - set(schema.MACHINE_TOPICS):
            assert list(one.table(topic).messages()) == list(other.table(topic).messages())
    assert set(threading.enumerate()) <= before, "no thread is left"


def test_progress_is_reported_after_every_evaluation(tmp_path):
    config = experiment(TAXIS)
    reports = []
    run = run_job(
        Job(config, 0),
        create_run(tmp_path, config, 0),
        report=lambda progress: reports.append(
            (progress.episode, progress.train_steps, len(progress.evaluations))
        ),
    )
    assert reports == sorted(reports)
    assert {evaluations for _, _, evaluations in reports} >= {1, 2, 3, 4}
    assert reports[-1] == (60, run.summary["train_steps"], 4)


@pytest.mark.parametrize("asked", [1, 2, 3, 5, 9])
def test_a_stopped_run_is_interrupted_and_closed_properly(asked, tmp_path):
    config = experiment(TAXIS, recording={"chunk_steps": 256})
    whole = run_job(Job(config, 0), create_run(tmp_path, config, 0))
    run = run_job(Job(config, 0), create_run(tmp_path, config, 0), stop=stopping_after(asked))
    assert run.status == "interrupted"
    assert find_run(run.run_id, tmp_path).facts == run.facts
    check_integrity(run.recording)
    with run.recording.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        times = [message.log_time for _, _, message in make_reader(stream).iter_messages()]
    assert summary.statistics.message_end_time == max(times)
    with open_recording(run.recording) as recording, open_recording(whole.recording) as complete:
        assert recording.file.finished
        assert recording.result["status"] == recorded_facts(recording)["status"] == "interrupted"
        for topic in set(schema.JOB_TOPICS) - {schema.LOG_TOPIC}:
            messages = list(recording.table(topic).messages())
            assert messages == list(complete.table(topic).messages())[: len(messages)], topic.name
        assert sum(recording.table(topic).count() for topic in schema.BLOCK_TOPICS) < sum(
            complete.table(topic).count() for topic in schema.BLOCK_TOPICS
        )
        lines = [
            message_class(schema.LOG).FromString(line)
            for _, line in recording.table(schema.LOG_TOPIC).messages()
        ]
        assert (lines[-1].message, lines[-1].level) == ("interrupted", schema.LOG_LEVELS.index("WARNING"))


def test_a_keyboard_interrupt_leaves_an_interrupted_run_with_what_was_done(tmp_path):
    config = experiment(TAXIS)
    run = create_run(tmp_path, config, 0)

    def report(progress):
        if len(progress.evaluations) == 2:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run_job(Job(config, 0), run, report=report)
    assert find_run(run.run_id, tmp_path).status == "interrupted"
    with open_recording(run.recording) as recording:
        assert recorded_facts(recording)["status"] == "interrupted"
        assert [each["episode"] for each in recording.eval.all_metrics()] == [0, 20]
        assert recording.file.finished


def test_an_error_in_a_callback_ends_the_run_as_failed(tmp_path):
    config = experiment(LAKE)
    run = create_run(tmp_path, config, 0)

    def report(_):
        raise ZeroDivisionError("by the listener")

    with pytest.raises(ZeroDivisionError):
        run_job(Job(config, 0), run, report=report)
    failed = find_run(run.run_id, tmp_path)
    assert (failed.status, failed.summary["error"]) == ("failed", "by the listener")


@pytest.mark.parametrize("threads", [True, False])
def test_an_error_in_a_callback_loses_no_step(threads, tmp_path):
    config = experiment(TAXIS, recording={"chunk_steps": 65_536})  # no chunk is full when it ends
    run = create_run(tmp_path, config, 0)
    taken = []

    def report(progress):
        taken.append((progress.train_steps, progress.eval_steps))
        if len(progress.evaluations) == 2:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run_job(Job(config, 0), run, report=report, threads=threads)
    with open_recording(run.recording) as recording:
        assert (recording.train.steps.count(), recording.eval.steps.count()) == taken[-1]
        assert min(taken[-1]) > 0


@pytest.mark.parametrize(
    ("broken", "error"),
    [
        ({"env": {"id": "Nowhere-v0"}}, EnvironmentNotUsable),
        ({"env": {"id": "CartPole-v1"}}, EnvironmentNotUsable),
        ({"env": {"id": "CliffWalking-v1"}}, EnvironmentNotUsable),
        ({"mode": "competitive"}, EnvironmentNotUsable),
        ({"evaluation": {"every": 1, "trials": 1, "start": 16}}, ConfigError),
        ({"initial_q": {"run": "nobody"}}, RunNotFound),
    ],
)
def test_a_job_that_cannot_be_done_leaves_a_failed_run_that_says_why(broken, error, tmp_path):
    config = experiment(LAKE, broken)
    run = create_run(tmp_path, config, 0)
    with pytest.raises(error) as caught:
        run_job(Job(config, 0), run)
    failed = find_run(run.run_id, tmp_path)
    assert failed.status == "failed"
    assert failed.summary == {"error": str(caught.value)}
    assert not failed.recording.exists()


def test_learning_continues_from_a_recorded_run(tmp_path):
    first = make_run(tmp_path, TAXIS)
    with open_recording(first.recording) as recording:
        tables = {step: [] for step in sorted({table.step for table in recording.snapshots()})}
        for table in recording.snapshots():
            tables[table.step].append(table.values.tobytes())
    origins = {None: max(tables), **{step: step for step in tables}}
    for asked, step in origins.items():
        start = {"run": first.run_id} | ({} if asked is None else {"step": asked})
        run = make_run(tmp_path, TAXIS, name="second", initial_q=start)
        with open_recording(run.recording) as recording:
            assert [table.values.tobytes() for table in recording.snapshots()][:2] == tables[step]
            assert recording.eval.all_metrics()[0]["step"] == 0, "counting starts again"


def test_learning_continues_from_any_step_of_a_recorded_run(tmp_path):
    first = make_run(tmp_path, TAXIS)
    run = make_run(tmp_path, TAXIS, name="second", initial_q={"run": "taxis", "step": 777})
    with open_recording(run.recording) as recording, open_recording(first.recording) as origin:
        twin = Twin(experiment(TAXIS), origin.mdp, 0)
        twin.train(10**6, 777)
        begun = [table.values.tobytes() for table in recording.snapshots()][:2]
    assert begun == [np.array(table).tobytes() for table in twin.tables]


@pytest.mark.parametrize(
    ("start", "message"),
    [
        ({"run": "lake"}, r"of shape \[\(16, 4\)\], expected \[\(128, 6\), \(128, 6\)\]"),
        ({"run": "taxis", "step": 10**9}, r"1,000,000,000"),
    ],
)
def test_tables_that_do_not_fit_or_are_not_there_are_refused(start, message, tmp_path):
    make_run(tmp_path, LAKE)
    make_run(tmp_path, TAXIS)
    with pytest.raises(RunnerError, match=message):
        make_run(tmp_path, TAXIS, name="second", initial_q=start)


def test_the_newest_run_of_a_name_is_never_the_run_itself(tmp_path):
    """A configuration that goes on from its own last run can be run again and again."""
    first = make_run(tmp_path, LAKE)
    second = make_run(tmp_path, LAKE, initial_q={"run": "lake@latest"})
    with open_recording(first.recording) as before, open_recording(second.recording) as after:
        assert next(after.snapshots()).values.tobytes() == list(before.snapshots())[-1].values.tobytes()
    make_run(tmp_path, LAKE, initial_q={"run": "@latest"})


@pytest.mark.parametrize("start", [{"run": "lake"}, {"run": "lake@latest", "step": 3}])
def test_the_run_that_a_table_comes_from_is_resolved_when_the_job_is_created(start, tmp_path):
    """The name may answer to another run by the time that the job is looked at again."""
    first = make_run(tmp_path, LAKE)
    second = make_run(tmp_path, LAKE, name="second", initial_q=start)
    origin = {"run": first.run_id, "step": start.get("step", first.summary["train_steps"])}
    assert find_run(second.run_id, tmp_path).facts["config"]["initial_q"] == origin
    with open_recording(second.recording) as recording:
        assert recording.config["initial_q"] == origin


def test_every_seed_begins_with_the_same_table(tmp_path):
    first = make_run(tmp_path, LAKE)
    config = experiment(LAKE, initial_q={"run": "lake@latest"}, seeds=[1, 2])
    runs = list(runner.run_all(config, recordings=tmp_path))
    assert [run.facts["config"]["initial_q"]["run"] for run in runs] == [first.run_id] * 2


@pytest.mark.parametrize("mode", ["cooperative", "competitive"])
def test_exact_measures_are_those_of_a_trial_from_every_start(tmp_path, mode):
    small = {"map": [*TAXIS["env"]["kwargs"]["map"]], "max_episode_steps": 40}
    config = experiment(TAXIS, mode=mode, env={"kwargs": small}, episodes=200, epsilon=0.5)
    starts = int((load_mdp(config.env.id, config.env.kwargs, config.rewards).start > 0).sum())
    plan = {"every": 100, "trials": starts, "start": "each", "exact": True}
    run = make_run(tmp_path, config.to_mapping(), evaluation=plan)
    with open_recording(run.recording) as recording:
        sampled, exact = (
            recording.eval.all_metrics(),
            list(recording.table(schema.OPTIMALITY_TOPIC).decoded()),
        )
    assert [each["episode"] for each in exact] == [0, 100, 200]
    for trials, measures in zip(sampled, exact, strict=True):
        assert measures["starts"] == starts
        assert measures["success_percent"] == pytest.approx(trials["success_percent"])
        assert measures["timeout_percent"] == pytest.approx(100 * (1 - trials["terminations"] / starts))
        assert measures["mean_length"] == pytest.approx(trials["eval_mean_length"])
        assert measures["mean_penalties"] == pytest.approx(trials["mean_penalties"])
        assert measures["mean_returns"] == pytest.approx(list(trials["mean_returns"]))
        assert sum(measures["values"]) <= measures["optimal_value"] + 1e-9
        for own, best in zip(measures["values"], measures["best_responses"], strict=True):
            assert best >= own - 1e-9
