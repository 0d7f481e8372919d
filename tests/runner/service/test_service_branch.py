"""Branches over HTTP: jobs of the queue, whose runs are those that the command records."""

from __future__ import annotations

import html
import re
import shutil
import time
from contextlib import closing

import gymnasium
import numpy
import pytest

import runner
from runner.client.jobs import RunProgress
from runner.runs.resolve import find_run
from runner.runs.run import Run, list_runs
from runner.service.jobs.checking import BranchQuestion, check_branch
from runner.service.jobs.store import JobStore
from runner.service.jobs.worker import JobChannel, JobSpec, do_job, run_episode_job
from runner.service.pages import jobs as pages
from runner.service.pages.jobs import _choices
from runner.service.settings import ServiceSettings
from tests.waiting import until

BRANCH = "/api/v1/runs/first/branch"


def finished(client, number):
    """Return a job when it is over."""
    deadline = time.monotonic() + 600
    while (job := client.get(f"/api/v1/jobs/{number}").json())["state"] in ("queued", "running"):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    return job


def test_a_branch_is_queued_and_is_what_the_command_records(client, recordings, tmp_path):
    sent = {"at": "20:1", "action": {"taxi_1": "north"}, "overrides": ["epsilon=0.5"], "name": "curious"}
    answer = client.post(BRANCH, json=sent)
    assert answer.status_code == 201, answer.text
    job = finished(client, answer.json()["number"])
    assert (job["state"], job["kind"], job["name"], job["error"]) == ("finished", "branch", "curious", "")
    (begun,) = job["begun"]
    own = find_run(begun["run_id"], recordings)
    parent = find_run("first", recordings)
    expected = runner.branch(
        parent, at="20:1", action={"taxi_1": "north"}, overrides=["epsilon=0.5"], recordings=tmp_path / "own"
    ).run
    assert isinstance(expected, Run)
    assert own.summary.content_digest == expected.summary.content_digest
    assert own.summary.content_digest != parent.summary.content_digest
    assert own.name == "curious"


@pytest.mark.parametrize(
    ("sent", "status", "message"),
    [
        ({"at": "9999:0"}, 404, "found no training episode 9,999"),
        ({"at": "20:1", "action": {"taxi_3": "north"}}, 422, "taxi_3"),
        ({"at": "20:1", "action": "norht + east"}, 422, "norht"),
        ({"at": "20:1", "overrides": ["seeds=[3]"]}, 422, "seeds: cannot change at a step"),
        ({"at": "20:1", "episodes": 3}, 422, "expected more than 20"),
        ({"at": "20:1", "episodes": 0}, 422, "episodes"),
        ({"at": "x"}, 400, "EPISODE:T"),
        ({"at": "20:1", "policy": "random"}, 422, "policy, seed and max_steps are for loops"),
        ({"at": "20:1"}, 422, "nothing is changed: found the recorded actions at 20:1"),
        ({"at": "20:1", "episodes": 60, "overrides": ["discount=0.99"]}, 422, "nothing is changed"),
        ({}, 422, "at"),
        ({"at": [1]}, 422, "body.at: found a list of 1, expected a step such as 120:5"),
        (
            {"at": "20:1", "overrides": {"epsilon": 0.5}},
            422,
            'epsilon, expected a list of KEY=VALUE, such as ["',
        ),
        (
            {"at": "20:1", "action": {"taxi_1": None}},
            422,
            "expected a number or a name, numbers in a list, or a",
        ),
        ({"at": "20:1", "seed": 10**30}, 422, "expected less than 4,294,967,296"),
    ],
)
def test_what_is_wrong_is_refused_before_it_is_queued(client, sent, status, message):
    answer = client.post(BRANCH, json=sent)
    assert answer.status_code == status, answer.text
    assert message in answer.json()["error"]["message"]
    assert client.get("/api/v1/jobs").json()["total"] == 0


@pytest.fixture
def loop(recordings):
    """Return a recorded loop among the recordings, of two episodes."""
    with runner.record(gymnasium.make("CartPole-v1"), recordings, name="pole") as rec:
        for seed in range(2):
            rec.reset(seed=seed)
            for step in range(9):
                rec.step(step % 2)
    return rec.run


def test_an_episode_of_a_loop_is_played_on_as_by_the_command(client, loop, recordings, tmp_path):
    sent = {"at": "1:4", "action": "right", "policy": "random", "seed": 3, "name": "pushed"}
    answer = client.post(f"/api/v1/runs/{loop.run_id}/branch", json=sent)
    assert answer.status_code == 201, answer.text
    job = finished(client, answer.json()["number"])
    assert (job["state"], job["kind"], job["name"], job["error"]) == ("finished", "episode", "pushed", "")
    (begun,) = job["begun"]
    own = find_run(begun["run_id"], recordings)
    expected = runner.branch(
        loop, at="1:4", action="right", policy="random", seed=3, recordings=tmp_path / "own"
    ).run
    assert own.summary.content_digest == expected.summary.content_digest
    assert own.name == "pushed"


def test_a_resumed_job_plays_an_episode_on_only_once(connect, loop, recordings, tmp_path):
    with closing(JobStore(recordings)) as store:
        job = store.add(check_branch(loop, BranchQuestion(at="1:4", action="1")), "")
    settings = ServiceSettings(recordings=(recordings,), tokens=tmp_path / "tokens.json")
    client = connect(settings)
    (begun,) = finished(client, job.number)["begun"]
    before = len(list_runs(recordings))
    spec = JobSpec(recordings / ".jobs" / str(job.number), client.app.state.jobs.store.job(job.number))
    events = []
    run_episode_job(spec, JobChannel(events.append, lambda: False))
    assert [event.run_id for event in events] == [begun["run_id"]]
    assert len(list_runs(recordings)) == before


@pytest.mark.parametrize(
    ("sent", "status", "message"),
    [
        ({"at": "2:0"}, 404, "training episode 2"),
        ({"at": "1:9"}, 404, "has 9 steps, from 0; found no step 9"),
        ({"at": "step:3"}, 422, "expected EPISODE:T"),
        ({"at": "1:4", "overrides": ["lr=3"]}, 422, "overrides and episodes are for runs that were trained"),
        ({"at": "1:4", "policy": "agent:act"}, 422, "policy"),
        ({"at": "1:4", "name": "-"}, 422, "name"),
        ({"at": "1:4", "action": "up"}, 422, "found 'up'"),
        ({"at": "1:4", "action": 7}, 422, "found 7"),
        ({"at": "1:4", "action": [0.5]}, 422, "found [0.5]"),
        ({"at": "1:4", "action": True}, 422, "action"),
        ({"at": "1:4"}, 422, "nothing is changed: found the recorded action at 1:4"),
        ({"at": "1:4", "action": "left", "seed": 3}, 422, "policy: random or constant"),
    ],
)
def test_what_is_wrong_for_a_loop_is_refused_before_it_is_queued(client, loop, sent, status, message):
    answer = client.post(f"/api/v1/runs/{loop.run_id}/branch", json=sent)
    assert answer.status_code == status, answer.text
    assert message in answer.json()["error"]["message"]
    assert client.get("/api/v1/jobs").json()["total"] == 0


def test_the_replay_of_a_loop_leads_to_the_form_which_queues_the_job(client, loop):
    replay = client.get(f"/runs/{loop.run_id}/replay/train/1?t=4")
    (address,) = re.findall(r'href="(/runs/\w+/branch[^"]+)"', replay.text)
    assert address.endswith("?at=1:4")
    form = client.get(address)
    assert ">as recorded: left</option>" in form.text
    assert ">right</option>" in form.text
    unchanged = client.post(f"/runs/{loop.run_id}/branch", data={"at": "1:4", "policy": "recorded"})
    assert "Nothing is changed: found the recorded action at 1:4" in unchanged.text
    sent = {"at": "1:4", "action.": "right", "policy": "constant", "seed": "x"}
    refused = client.post(f"/runs/{loop.run_id}/branch", data=sent)
    assert refused.status_code == 422
    assert "<option selected>right</option>" in refused.text
    crafted = client.post(f"/runs/{loop.run_id}/branch", data=sent | {"seed": "", "policy": "agent:act"})
    assert crafted.status_code == 422
    huge = client.post(f"/runs/{loop.run_id}/branch", data=sent | {"seed": "9" * 30})
    assert "expected less than 4,294,967,296" in huge.text
    assert "<option selected>right</option>" in huge.text
    queued = client.post(f"/runs/{loop.run_id}/branch", data=sent | {"seed": ""}, follow_redirects=False)
    assert queued.status_code == 303, queued.text
    assert finished(client, queued.headers["location"].rpartition("/")[2])["state"] == "finished"


def test_a_loop_that_another_user_recorded_has_no_form_and_no_job(client, loop):
    (loop.folder / "trust.json").unlink()
    page = client.get(f"/runs/{loop.run_id}/branch?at=1:4")
    assert "was not recorded by the user who runs this server" in page.text
    assert "<form class" not in page.text
    answer = client.post(f"/api/v1/runs/{loop.run_id}/branch", json={"at": "1:4"})
    assert answer.status_code >= 400
    assert client.get("/api/v1/jobs").json()["total"] == 0


def test_the_replay_leads_to_the_form_which_queues_the_branch(client):
    replay = client.get("/runs/first/replay/train/20?t=1")
    (address,) = re.findall(r'href="(/runs/\w+/branch[^"]+)"', replay.text)
    assert address.endswith("?at=20:1")
    form = client.get(address)
    assert 'value="20:1"' in form.text
    assert len(re.findall(r">as recorded: [a-z-]+</option>", form.text)) == 2
    assert ">north</option>" in form.text
    wrong = {"at": "20:1", "action.taxi_1": "north", "overrides": "epsilon=<b>"}
    refused = client.post("/runs/first/branch", data=wrong)
    assert refused.status_code == 422
    assert "epsilon=&lt;b&gt;" in refused.text
    assert "<option selected>north</option>" in refused.text
    right = wrong | {"overrides": "epsilon=0.5\n", "episodes": "40"}
    queued = client.post("/runs/first/branch", data=right, follow_redirects=False)
    assert queued.status_code == 303, queued.text
    number = queued.headers["location"].rpartition("/")[2]
    assert finished(client, number)["state"] == "finished"
    assert ">The run</a>" in client.get(queued.headers["location"]).text
    until(lambda page: "taxi 1 north, epsilon 0.5" in page, lambda: client.get("/runs?group=none").text)


def test_a_trial_offers_no_branch_of_training(client):
    assert "/branch?" not in client.get("/runs/first/replay/eval/10/0").text


def test_a_branch_whose_parent_was_removed_fails_and_leaves_no_run(connect, recordings, tmp_path):
    with closing(JobStore(recordings)) as store:
        parent = find_run("first", recordings)
        checked = check_branch(parent, BranchQuestion(at="20:1", overrides=("epsilon=0.5",), name="orphan"))
        job = store.add(checked, "")
    before = {run.run_id for run in list_runs(recordings)} - {parent.run_id}
    shutil.rmtree(parent.folder)
    client = connect(ServiceSettings(recordings=(recordings,), tokens=tmp_path / "tokens.json"))
    for _ in range(2):
        ended = finished(client, job.number)
        assert (ended["state"], ended["begun"]) == ("failed", [])
        assert f"{parent.run_id}, the parent of this branch, is no longer there" in ended["error"]
        assert {run.run_id for run in list_runs(recordings)} == before
        client.post(f"/api/v1/jobs/{job.number}/resume")


def test_the_form_shows_the_numbers_of_an_action(client, recordings):
    with runner.record(gymnasium.make("Pendulum-v1"), recordings, name="pendulum") as rec:
        rec.reset(seed=1)
        rec.step(numpy.array([0.25], numpy.float32))
    form = client.get(f"/runs/{rec.run.run_id}/branch?at=0:0")
    assert 'placeholder="as recorded: [0.25]"' in form.text
    assert re.search(r"<label>Action, -2 to 2\s", form.text)
    wrong = client.post(f"/runs/{rec.run.run_id}/branch", data={"at": "0:0", "action.": "left"})
    assert "action: found 'left', expected -2 to 2." in html.unescape(wrong.text)


def test_a_run_in_a_folder_that_is_only_read_has_no_form(connect, loop, recordings, tmp_path):
    client = connect(
        ServiceSettings(recordings=(tmp_path / "own", recordings), tokens=tmp_path / "tokens.json")
    )
    for run in (loop.run_id, "first"):
        page = client.get(f"/runs/{run}/branch?at=0:1")
        assert "is in a folder that this service only reads; branch it where it was recorded" in page.text
        assert "<form class" not in page.text
        assert client.post(f"/api/v1/runs/{run}/branch", json={"at": "0:1"}).status_code == 409


def test_a_branch_reports_that_it_prepares(loop, recordings):
    questions = [
        (find_run("first", recordings), BranchQuestion(at="20:1", overrides=("epsilon=0.5",))),
        (loop, BranchQuestion(at="1:4", action="right")),
    ]
    said = []
    for run, question in questions:
        with closing(JobStore(recordings)) as store:
            job = store.add(check_branch(run, question), "")
        events = []
        do_job(JobSpec(recordings / ".jobs" / str(job.number), job), JobChannel(events.append, lambda: False))
        said.append([event.text for event in events if isinstance(event, RunProgress)])
    (trained, *_, whole), (played, *_) = said
    assert trained == played == "preparing"
    assert whole == "60 of 60 episodes"
    assert all(text.endswith(" steps") for text in said[1][1:])


@pytest.mark.parametrize("stated", [{}, {"n": "3"}, {"n": 3.0}, {"n": -1, "start": 0}, {"n": 10**12}])
def test_a_form_offers_no_actions_of_a_space_that_is_not_sound(stated):
    assert _choices({"type": "Discrete", **stated}, ()) == ([], "")


def test_a_form_offers_the_actions_of_a_discrete_space(monkeypatch):
    space = {"type": "Discrete", "n": 3, "start": 1}
    assert _choices(space, ()) == (["1", "2", "3"], "1 to 3")
    assert _choices(space | {"start": "1"}, ()) == (["0", "1", "2"], "1 to 3")
    assert _choices(space, ("left", "stay", "right"))[0] == ["left", "stay", "right"]
    monkeypatch.setattr(pages, "MAX_CHOICES", 2)
    assert _choices(space, ()) == ([], "1 to 3")
