"""Explanations over HTTP: jobs of the queue, with the results that the command computes."""

from __future__ import annotations

import contextlib
import re

import pytest
from loop_replays import serving
from test_service_branch import finished

import runner
from runner.debugging.explain import ask
from runner.debugging.explanation import FOLDER, LOCK
from runner.errors import RunnerError
from runner.runs.resolve import find_run
from runner.runs.run import acquired
from tests.waiting import until

EXPLAIN = "/api/v1/explanations"


@pytest.fixture
def changed(recordings):
    """Return the id of a run that differs from `first` in two settings."""
    run = find_run("first", recordings)
    config = run.file.config | {"name": "changed", "discount": 0.5, "step_size": 0.2}
    return runner.run(config, seed=run.seed, recordings=recordings).run_id


def test_an_explanation_is_queued_and_is_what_python_computes(client, recordings, changed):
    sent = {"a": "first", "b": changed, "metric": "mean_length", "at": 30, "seeds": 2}
    answer = client.post(EXPLAIN, json=sent)
    assert answer.status_code == 201, answer.text
    job = finished(client, answer.json()["number"])
    assert (job["state"], job["kind"], job["error"], job["runs"]) == ("finished", "explain", "", 8)
    expected = runner.explain(
        "first", changed, metric="mean_length", at=30, seeds=2, workers=1, recordings=recordings
    )
    assert expected.trained == 0  # the job has trained all of it
    found = client.get(f"/api/v1/explanations/{expected.name}").json()
    assert found["difference"]["value"] == expected.difference.value
    assert [each["name"] for each in found["settings"]] == [each.name for each in expected.settings]
    page = client.get(f"/queue/{job['number']}").text
    (address,) = re.findall(r'href="(/sweeps/explanations/[^"]+)"', page)
    assert client.get(address).status_code == 200


@pytest.mark.parametrize(
    ("sent", "status", "message"),
    [
        ({"a": "first", "b": "nothing"}, 404, "nothing"),
        ({"a": "first", "b": "../configs/quick.yaml"}, 422, "found the path"),
        ({"a": "first", "b": "first"}, 400, "differ in no setting"),
        ({"a": "first", "b": "CHANGED", "at": 10**6}, 400, "choose an episode that both reach"),
        ({"a": "first", "b": "CHANGED", "metric": "sucess_percent"}, 400, "Did you mean 'success_percent'"),
        ({"a": "first", "b": "CHANGED", "seeds": 9999}, 422, "expected at most 10,000 in a job"),
        ({"a": "first"}, 422, "b"),
        ({"a": "first", "b": "CHANGED", "at": 0}, 400, "at: found 0"),
    ],
)
def test_what_is_wrong_is_refused_before_it_is_queued(client, changed, sent, status, message):
    answer = client.post(
        EXPLAIN, json={key: changed if text == "CHANGED" else text for key, text in sent.items()}
    )
    assert answer.status_code == status, answer.text
    assert message in answer.json()["error"]["message"]
    assert client.get("/api/v1/jobs").json()["total"] == 0


def test_a_comparison_leads_to_the_form_and_a_cancelled_explanation_stops(client, changed):
    compared = client.get(f"/compare?run=first&run={changed}").text
    (address,) = re.findall(r'href="(/explain[^"]+)"', compared)
    form = client.get(address.replace("&amp;", "&")).text
    assert f'value="{changed}"' in form
    wrong = client.post("/explain", data={"a": "first", "b": changed, "seeds": "<b>"})
    assert wrong.status_code == 422
    assert "&lt;b&gt;" in wrong.text
    right = {"a": "first", "b": changed, "seeds": "1000"}
    queued = client.post("/explain", data=right, follow_redirects=False)
    assert queued.status_code == 303, queued.text
    number = queued.headers["location"].rpartition("/")[2]
    assert client.post(f"/api/v1/jobs/{number}/cancel").status_code == 200
    assert finished(client, number)["state"] == "cancelled"


def test_a_job_waits_for_another_explanation_of_the_same_two_and_survives_a_restart(recordings, changed):
    sent = {"a": "first", "b": changed, "metric": "mean_length", "at": 30, "seeds": 2}
    name = ask(**sent, recordings=recordings).name
    with contextlib.ExitStack() as stack:
        lock = acquired(recordings / FOLDER / name / LOCK, RunnerError("busy"))
        stack.callback(lock.release)
        with serving(recordings) as client:
            own = {"Origin": str(client.base_url)}
            number = client.post(EXPLAIN, json=sent, headers=own).json()["number"]
            until(lambda shown: "waiting for it" in shown, lambda: client.get(f"/queue/{number}").text)
            assert client.get(f"/api/v1/jobs/{number}").json()["state"] == "running"
        stack.close()
        with serving(recordings) as client:
            job = finished(client, number)
    assert (job["state"], job["error"]) == ("finished", "")


@pytest.mark.parametrize("exists", [False, True])
def test_no_file_is_read_that_the_configuration_of_a_run_names(client, recordings, changed, tmp_path, exists):
    run, other = find_run(changed, recordings), tmp_path / "other.mcap"
    if exists:
        other.write_text("no recording")
    run.update(config=run.file.config | {"initial_q": {"run": str(other), "step": 0}})
    answer = client.post(EXPLAIN, json={"a": "first", "b": changed})
    assert answer.status_code == 422, answer.text
    assert "found the path" in answer.json()["error"]["message"]
