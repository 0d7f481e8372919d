"""Branches of training over HTTP: jobs of the queue, whose runs are those that the command records."""

from __future__ import annotations

import re
import shutil
import time
from contextlib import closing

import pytest

import runner
from runner.runs.listing import list_runs
from runner.runs.resolve import find_run
from runner.runs.run import Run
from runner.service.jobs.checking import BranchQuestion, check_branch
from runner.service.jobs.store import JobStore
from runner.service.settings import ServiceSettings

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
        ({"at": "20:1", "policy": "random"}, 422, "policy"),
        ({}, 422, "at"),
    ],
)
def test_what_is_wrong_is_refused_before_it_is_queued(client, sent, status, message):
    answer = client.post(BRANCH, json=sent)
    assert answer.status_code == status, answer.text
    assert message in answer.json()["error"]["message"]
    assert client.get("/api/v1/jobs").json()["total"] == 0


def test_a_loop_is_refused(loops_client, loops):
    name = runner.runs.listing.list_runs(loops)[0].run_id
    own = {"Origin": str(loops_client.base_url)}
    answer = loops_client.post(f"/api/v1/runs/{name}/branch", json={"at": "0:0"}, headers=own)
    assert answer.status_code == 400
    assert "dualtaxi branch" in answer.json()["error"]["message"]


def test_the_replay_leads_to_the_form_which_queues_the_branch(client):
    replay = client.get("/runs/first/replay/train/20?t=1")
    (address,) = re.findall(r'data-to-branch href="([^"]+)"', replay.text)
    assert address.endswith("?at=20:1")
    form = client.get(address)
    assert 'value="20:1"' in form.text
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


def test_a_trial_offers_no_branch_of_training(client):
    assert "data-to-branch" not in client.get("/runs/first/replay/eval/10/0").text


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
