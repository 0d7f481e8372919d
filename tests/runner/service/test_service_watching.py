"""The client's methods for jobs."""

from __future__ import annotations

import json
import re
import threading

import pytest
from click.testing import CliRunner
from served import Served
from submitted import ENDLESS, ICY

from runner.cli import cli
from runner.client.client import Client, ServerError
from runner.client.jobs import BestTrial, JobEvent, LogEvent, SweepProgress, parse_events
from runner.errors import RunnerError
from runner.runs.run import list_runs

pytestmark = pytest.mark.long

CONFIG = {"name": "quick", "episodes": 600, "mode": "cooperative", "evaluation": {"every": 50, "trials": 400}}


def test_a_watcher_receives_every_event_once_although_the_server_is_killed(tmp_path):
    with Served(tmp_path) as server:
        seen = []
        with Client(server.url) as client:
            number = client.submit(json.dumps(CONFIG)).number

        def watch():
            with Client(server.url) as client:
                seen.extend(client.watch(number))

        watcher = threading.Thread(target=watch)
        watcher.start()
        server.until(lambda jobs: (jobs[number]["progress"] or {}).get("episode", 0) > 0)
        server.kill()
        server.start()
        watcher.join(60)
        assert not watcher.is_alive()
    states = [event.data.state for event in seen if event.kind == "state"]
    assert states[0] == "queued"
    assert states.count("finished") == 1
    assert states[-1] == "finished"
    lines = [event.data.text for event in seen if event.kind == "log"]
    evaluations = [text for text in lines if text.startswith("evaluation")]
    assert len(evaluations) == len(set(evaluations)) > 3
    places = [int(event.id) for event in seen if event.id]
    assert places == sorted(set(places))
    assert seen[-2].kind == "progress" or seen[-1].kind == "state"


def test_jobs_are_submitted_listed_cancelled_and_resumed(tmp_path):
    with Served(tmp_path, "--workers", "1") as server, Client(server.url) as client:
        first = client.submit(json.dumps(ENDLESS))
        second = client.submit(json.dumps(ICY), "icy.yaml")
        assert (second.name, second.state, second.runs) == ("icy", "queued", 2)
        assert [job.number for job in client.jobs()] == [second.number, first.number]
        server.until(lambda jobs: (jobs[first.number]["progress"] or {}).get("episode", 0) > 0)
        listed = CliRunner().invoke(cli, ["remote", "jobs", "--server", server.url]).stdout
        assert re.search(
            rf"^ *{first.number} .* running +\d[\d,]* of \d[\d,]* episodes", listed, re.MULTILINE
        )
        assert re.search(rf"^ *{second.number} .* queued  ", listed, re.MULTILINE)
        assert client.cancel(first.number).is_over
        *_, last = client.watch(second.number)
        assert last.kind == "state"
        assert last.data.state == "finished"
        done = client.job(second.number)
        assert sorted(run.run_id for run in done.begun) == sorted(
            run.run_id for run in list_runs(tmp_path) if run.status == "finished"
        )
        assert client.resume(first.number).state == "queued"
        with pytest.raises(ServerError, match=r"bad\.yaml:1:1: episodes: found 'many'"):
            client.submit("episodes: many", "bad.yaml")
        with pytest.raises(ServerError, match="no job 99; `dualtaxi remote jobs`"):
            list(client.watch(99))


def test_events_are_parsed_without_an_incomplete_last_one():
    lines = ["retry: 1000", "", ": still here", "", "id: 7", "event: log", 'data: {"text": "a: b"}', ""]
    cut_off = ["id: 9", "event: state", 'data: {"sta']
    assert list(parse_events([*lines, *cut_off])) == [JobEvent(LogEvent("a: b"), "7")]


@pytest.mark.parametrize(
    ("kind", "values"), [("log", {"line": 1}), ("gossip", {}), ("progress", {"done": 1}), ("state", [])]
)
def test_an_event_that_is_none_is_reported(kind, values):
    with pytest.raises(RunnerError, match="that is not as expected"):
        JobEvent.from_json(kind, values)


def test_progress_is_the_same_after_a_round_trip():
    best = BestTrial(3, None, {"step_size": 0.5})
    event = JobEvent(SweepProgress(done=1, runs=4, running=2, pruned=0, failed=0, bytes=10, best=best))
    assert JobEvent.from_json("progress", json.loads(json.dumps(event.as_json()))) == event
