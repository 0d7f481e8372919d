"""Loops that are pushed while they are recorded: listed at once, stopped from their page, then stored."""

from __future__ import annotations

import json
import os
import re
import time
from dataclasses import replace

import gymnasium
import httpx2
import pytest
from selenium.webdriver.common.by import By
from served import wait

import runner
from runner.errors import RunnerError
from runner.execution.verify import verify
from runner.recording.labels import change_labels
from runner.runs.run import RUN_FILE, list_runs
from tests.runner.loops.making import make, play
from tests.runner.service.test_service_upload_routes import PIECE, UPLOADS, begin, message, over, patch, put
from tests.waiting import until


@pytest.fixture(autouse=True)
def outbox(tmp_path, monkeypatch):
    for name in ("DUALTAXI_TOKEN", "DUALTAXI_TOKEN_FILE", "DUALTAXI_SERVER"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("DUALTAXI_OUTBOX", str(tmp_path / "outbox"))


@pytest.fixture
def elsewhere(settings, tmp_path):
    """Return the settings of a service that has no runs yet."""
    return replace(settings, recordings=(tmp_path / "theirs",))


def listed(server, run_id):
    runs = server.client.get("/runs", params={"limit": 100}).json()["runs"]
    return next((run for run in runs if run["run_id"] == run_id), None)


def test_a_loop_that_is_pushed_is_listed_at_once_and_stopped_from_its_page(server):
    with runner.record(make("CartPole-v1"), server.url, name="pushed", seed=3) as env:
        for _ in play(env, 300):
            env.log("loss", 0.5)
        run_id = env.run.run_id
        shown = until(lambda run: run, lambda: listed(server, run_id))
        assert (shown["status"], shown["name"], shown["seed"]) == ("running", "pushed", 3)
        curves = until(
            lambda found: found, lambda: server.client.get(f"/runs/{run_id}/metrics").json()["curves"]
        )
        assert {"training.mean_return", "training.logged.loss"} <= {curve["metric"] for curve in curves}
        part = server.client.get(f"/runs/{run_id}/replay/train/0").json()
        assert part["episode"]["length"] > 5
        page = httpx2.get(f"{server.url}/runs/{run_id}", headers={"Accept": "text/html"}).text
        assert ">Stop</button>" in page
        assert server.client.patch(f"/runs/{run_id}", json={"tag": ["watched"]}).status_code == 200
        assert not env.should_stop
        answer = httpx2.post(f"{server.url}/runs/{run_id}/stop", headers=server.origin)
        assert answer.status_code == 303
        until(lambda stops: stops, lambda: env.should_stop)
        page = httpx2.get(f"{server.url}/runs/{run_id}", headers={"Accept": "text/html"}).text
        assert ">Stop</button>" not in page
        assert "was requested to stop" in page
    stored = until(lambda run: run["status"] == "finished", lambda: listed(server, run_id))
    assert stored["tags"] == ["watched"]
    assert stored["train_steps"] == 300
    (folder,) = [path for path in server.recordings.iterdir() if path.name == run_id]
    assert {path.name for path in folder.iterdir()} == {"run.json", "recording.mcap", "labels.json"}
    assert verify(folder / "recording.mcap").sound
    again = server.client.post(f"/runs/{run_id}/stop")
    assert (again.status_code, "is finished" in message(again)) == (400, True)


def test_the_row_of_a_running_loop_has_its_episodes_and_return(connect, settings, recordings):
    client = connect(settings)

    def row():
        found = client.get("/api/v1/runs", params={"filter": 'name == "growing"'}).json()["runs"]
        return found[0] if found else {"episodes": None}

    with runner.record(make("CartPole-v1"), recordings, name="growing") as env:
        lengths = [0]
        for what, *step in play(env, 200):
            if what == "step":
                lengths[-1] += 1
                if any(step[3:5]):
                    lengths.append(0)
        ended = lengths[:-1]
        shown = until(lambda row: row["episodes"] == len(ended), row)
        assert shown["status"] == "running"
        assert shown["mean_return"] == sum(ended) / len(ended), "each step is rewarded by 1"


def test_the_latest_whole_episode_is_sent_until_the_run_is_over(connect, settings, recordings):
    client = connect(settings)
    latest = "/runs/growing/replay/latest"
    with runner.record(make("CartPole-v1"), recordings, name="growing") as env:
        env.reset(seed=0)
        until(lambda answer: answer.status_code == 204, lambda: client.get(latest))
        assert "x-run-over" not in client.get(latest).headers
        for _ in play(env, 200):
            pass
        shown = until(lambda answer: answer.status_code == 200, lambda: client.get(latest)).text
        path = re.search('data-episode="([^"]+)"', shown)[1]
        assert path.startswith("train/")
        assert client.get(latest, params={"shown": path}).status_code in (200, 204)
        page = client.get("/runs/growing", headers={"Accept": "text/html"}).text
        assert f'data-latest="/runs/{env.run.run_id}/replay/latest"' in page
    last = re.search('data-episode="([^"]+)"', client.get(latest).text)[1]
    over = client.get(latest, params={"shown": last})
    assert (over.status_code, over.headers["x-run-over"]) == (204, "true")
    assert "data-latest" not in client.get("/runs/growing", headers={"Accept": "text/html"}).text


@pytest.mark.parametrize("steps", ["actions", "none"])
def test_the_page_of_a_running_run_says_that_it_records_no_steps(client, recordings, steps):
    env = runner.record(make("CartPole-v1"), recordings, name=f"without_{steps}", steps=steps)
    with env:
        for _ in play(env, 100):
            pass
        for address in (f"/runs/{env.run.run_id}", f"/compare?run={env.run.run_id}&run=first"):
            page = client.get(address, headers={"Accept": "text/html"}).text
            assert "data-latest" not in page
            assert "episode has ended yet" not in page
        page = client.get(f"/runs/{env.run.run_id}", headers={"Accept": "text/html"}).text
        assert f"does not record its steps (<code>recording.steps: {steps}</code>)" in page


def test_two_loops_replay_next_to_each_other(server, browser):
    with (
        runner.record(make("CartPole-v1"), server.url, name="left") as left,
        runner.record(make("CartPole-v1"), server.url, name="right") as right,
    ):
        ids = [env.run.run_id for env in (left, right)]
        for env in (left, right):
            for _ in play(env, 100):
                pass
        for run_id in ids:
            until(lambda run: run, lambda run_id=run_id: listed(server, run_id))
        browser.get(f"{server.url}/compare?run={ids[0]}&run={ids[1]}")

        def counts():
            return [count.text for count in browser.find_elements(By.CSS_SELECTOR, "[data-latest] .count")]

        before = wait(
            browser, lambda: len(counts()) == 2 and all("of" in text for text in counts()) and counts()
        )
        wait(browser, lambda: all(now != then for now, then in zip(counts(), before, strict=True)))


def test_a_loop_in_a_folder_is_stopped_by_its_page(connect, settings, recordings):
    client = connect(settings)
    with runner.record(gymnasium.make("CartPole-v1"), recordings, name="here") as env:
        env.reset()
        assert client.post("/api/v1/runs/here/stop").json()["stop_requested"]
        until(lambda stops: stops, lambda: env.should_stop)
    assert env.run.status == "finished"


def test_only_loops_that_are_running_can_be_stopped(connect, settings, recordings):
    client = connect(settings)
    answer = client.post("/api/v1/runs/first/stop")
    assert (answer.status_code, "made by a job" in message(answer)) == (400, True)
    with runner.record(gymnasium.make("CartPole-v1"), recordings, name="over") as env:
        pass
    assert ">Stop</button>" not in client.get("/runs/over", headers={"Accept": "text/html"}).text
    with pytest.raises(RunnerError, match="only a run that is running"):
        env.run.request_stop()


@pytest.mark.parametrize("path", ["/runs/first/stop", "/api/v1/runs/first/stop"])
def test_no_other_site_can_stop_a_loop(connect, settings, path):
    client = connect(settings, Origin="http://evil.example")
    assert client.post(path).status_code == 403


@pytest.fixture
def growing(tmp_path):
    """Return the recording of a loop, as bytes, and its run."""
    with runner.record(make("CartPole-v1"), tmp_path / "made", name="mine", chunk_steps=256) as env:
        for _ in play(env, 900):
            pass
    return env.run.recording.read_bytes(), env.run


def runs_of(client):
    return {run["run_id"]: run["status"] for run in client.get("/api/v1/runs").json()["runs"]}


def test_what_has_arrived_is_shown_and_what_is_refused_disappears(connect, elsewhere, growing):
    data, run = growing
    client = connect(elsewhere)
    upload = begin(client, run_id=run.run_id)
    patch(client, upload, data[:100], 0)
    assert list_runs(elsewhere.recordings[0]) == []  # it is not described yet
    patch(client, upload, data[100 : len(data) // 2], 100)
    (shown,) = list_runs(elsewhere.recordings[0])
    assert (shown.run_id, shown.status) == (run.run_id, "running")
    rest = data[len(data) // 2 : -9] + b"damaged!!"
    patch(client, upload, rest, len(data) // 2)
    whole = data[: len(data) // 2] + rest
    assert over(client, upload, whole, run_id=run.run_id)["state"] == "refused"
    until(lambda runs: runs == [], lambda: list_runs(elsewhere.recordings[0]))


def test_a_sender_that_is_gone_leaves_an_interrupted_run_until_it_is_back(connect, elsewhere, growing):
    data, run = growing
    client = connect(elsewhere)
    upload = begin(client, run_id=run.run_id)
    patch(client, upload, data[:-50], 0)
    (shown,) = list_runs(elsewhere.recordings[0])
    assert shown.status == "running"
    long_ago = time.time() - 60
    os.utime(shown.folder / RUN_FILE, (long_ago, long_ago))
    assert shown.status == "interrupted"
    back = put(client, upload, run_id=run.run_id)  # its sender asks how far it is
    assert not back.json()["stop_requested"]
    assert shown.status == "running"
    shown.request_stop()
    assert put(client, upload, run_id=run.run_id).json()["stop_requested"]
    assert client.delete(f"{UPLOADS}/{upload}").status_code == 204
    assert list_runs(elsewhere.recordings[0]) == []


@pytest.mark.parametrize("announced", ["another", "../outside", ".uploads", ""])
def test_an_upload_is_shown_only_under_the_id_of_its_run(connect, elsewhere, growing, announced):
    data, _ = growing
    client = connect(elsewhere)
    upload = begin(client, run_id=announced)
    assert patch(client, upload, data, 0).status_code == 200
    assert list_runs(elsewhere.recordings[0]) == []
    assert not (elsewhere.recordings[0].parent / "outside").exists()


def test_a_run_that_is_there_stays_as_it_is(connect, elsewhere, growing):
    data, run = growing
    client = connect(elsewhere)
    first, second = begin(client, run_id=run.run_id), begin(client, run_id=run.run_id)
    patch(client, first, data[:-200], 0)
    patch(client, second, data, 0)
    (shown,) = list_runs(elsewhere.recordings[0])
    assert shown.facts["upload"] == first
    change_labels(shown.folder, lambda labels: replace(labels, note="seen"))
    assert over(client, second, data, run_id=run.run_id)["state"] == "stored"
    (stored,) = list_runs(elsewhere.recordings[0])
    assert (stored.status, stored.note, "upload" in stored.facts) == ("finished", "seen", False)
    before = stored.recording.read_bytes()
    patch(client, first, b"more", len(data) - 200)
    assert client.delete(f"{UPLOADS}/{first}").status_code == 204
    assert stored.recording.read_bytes() == before == data


def test_a_server_that_is_started_again_shows_it_again(connect, elsewhere, growing):
    data, run = growing
    client = connect(elsewhere)
    upload = begin(client, run_id=run.run_id)
    patch(client, upload, data[:-200], 0)
    client.__exit__(None, None, None)
    client = connect(elsewhere)
    headers = PIECE | {"Upload-Offset": str(len(data) - 200)}
    assert client.patch(f"{UPLOADS}/{upload}", content=data[-200:], headers=headers).status_code == 200
    (shown,) = list_runs(elsewhere.recordings[0])
    assert (shown.status, json.loads((shown.folder / RUN_FILE).read_text())["upload"]) == ("running", upload)
