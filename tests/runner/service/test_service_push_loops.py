"""Loops recorded for a server: stored at their end, or waiting in the outbox."""

from __future__ import annotations

import contextlib
import json
import os
import re
import subprocess
import sys
import time

import gymnasium
import httpx2
import pytest
from click.testing import CliRunner
from served import Served

import runner
from runner.cli import cli
from runner.client.client import Client
from runner.recording.reader import open_recording
from runner.runs.resolve import find_run
from runner.runs.run import list_runs

pytestmark = pytest.mark.usefixtures("outbox")


def dualtaxi(*args):
    return CliRunner().invoke(cli, [str(arg) for arg in args])


LOOP = """
import os, sys, time
import gymnasium, runner

env = gymnasium.make("FrozenLake-v1", is_slippery=False)
with runner.record(env, sys.argv[1], name="loop", seed=int(sys.argv[2])) as rec:
    rec.action_space.seed(int(sys.argv[2]))
    rec.reset(seed=1)
    for step in range(int(sys.argv[3])):
        _, _, terminated, truncated, _ = rec.step(rec.action_space.sample())
        if terminated or truncated:
            rec.reset()
    if sys.argv[4] == "hang":
        time.sleep(2)
        print("now", flush=True)
        time.sleep(100)
print(rec.run.run_id, rec.run.summary["content_digest"])
"""


def loop(url, seed=0, steps=3_000, end="finish"):
    command = [sys.executable, "-c", LOOP, url, str(seed), str(steps), end]
    return subprocess.Popen(command, stdout=subprocess.PIPE, env=os.environ, text=True)


def drive(env, steps):
    env.reset(seed=1)
    for _ in range(steps):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()


def test_a_loop_recorded_for_a_server_is_stored_at_its_end(server, outbox):
    with runner.record(gymnasium.make("FrozenLake-v1"), server.url, name="loop", config={"lr": 0.1}) as rec:
        drive(rec, 2_000)
        assert [run.run_id for run in list_runs(outbox)] == [rec.run.run_id]
        time.sleep(1.5)
        with Client(server.url) as client:
            uploads = client.request("GET", "/uploads", params={"state": "receiving"}).json()["uploads"]
        assert [(entry["run_id"], entry["offset"] > 0) for entry in uploads] == [(rec.run.run_id, True)]
        drive(rec, 2_000)
    stored = find_run(rec.run.run_id, server.recordings)
    assert stored.summary["content_digest"] == rec.run.summary["content_digest"]
    assert (stored.status, stored.summary["train_steps"]) == ("finished", 4_000)
    assert list(outbox.iterdir()) == []


def fail_at_length(env):
    drive(env, 50)
    raise KeyError("x" * 100_000)


def test_a_loop_of_several_processes_is_stored_whole(server, outbox, monkeypatch):
    monkeypatch.setattr("runner.client.outbox.FOLLOW_SECONDS", 0.05)
    with runner.record(gymnasium.make("FrozenLake-v1"), server.url, name="shards") as rec:
        drive(rec, 200)
        time.sleep(1)  # a part of the first process's recording is pushed
        with runner.record(gymnasium.make("FrozenLake-v1"), join=rec.run, shard="two") as two:
            drive(two, 100)
    assert list(outbox.iterdir()) == []
    with Client(server.url) as client:
        pulled = client.pull(rec.run.run_id, outbox.parent / "back")
    with open_recording(pulled.run.recording) as recording:
        assert [shard.train_steps for shard in recording.shards] == [200, 100]
        assert recording.result.content_digest == rec.run.summary.content_digest


def test_the_page_of_a_run_names_the_processes_that_record_it_too(tmp_path):
    with Served(tmp_path / "runs") as server:
        rec = runner.record(gymnasium.make("FrozenLake-v1"), tmp_path / "runs", name="shards")
        two = runner.record(gymnasium.make("FrozenLake-v1"), join=rec.run, shard="two")
        drive(two, 100)
        page = httpx2.get(f"{server.url}/runs/{rec.run.run_id}").text
        assert "Other processes" in page
        assert "1 shard (" in page
        two.close()
        rec.close()


def test_a_long_error_of_a_loop_is_shortened(server, outbox):
    rec = runner.record(gymnasium.make("FrozenLake-v1"), server.url, name="long")
    with pytest.raises(KeyError, match="xxx"), rec:
        fail_at_length(rec)
    stored = find_run(rec.run.run_id, server.recordings)
    assert (stored.status, stored.summary["error"]) == ("failed", f"KeyError: '{'x' * 9_988}…")
    assert list(outbox.iterdir()) == []


def test_a_loop_waits_in_the_outbox_for_an_unavailable_server(own_server, outbox, monkeypatch):
    monkeypatch.setattr("runner.client.outbox.LAST_SECONDS", 0.5)
    with pytest.warns(UserWarning, match="dualtaxi remote push --outbox"):  # noqa: SIM117
        with runner.record(gymnasium.make("FrozenLake-v1"), own_server.url, name="away") as rec:
            drive(rec, 500)
    assert find_run(rec.run.run_id, outbox).status == "finished"
    own_server.start()
    result = dualtaxi("remote", "push", "--outbox", "--json")
    assert [run["run_id"] for run in json.loads(result.stdout)["runs"]] == [rec.run.run_id]
    stored = find_run(rec.run.run_id, own_server.recordings)
    assert stored.summary["content_digest"] == rec.run.summary["content_digest"]
    assert list(outbox.iterdir()) == []
    assert "empty" in dualtaxi("remote", "push", "--outbox").stderr


def test_a_server_that_refuses_a_loop_is_reported_while_it_runs(server, outbox, monkeypatch):
    monkeypatch.setattr("runner.client.outbox.FOLLOW_SECONDS", 0.05)
    monkeypatch.setenv("DUALTAXI_TOKEN", "dualtaxi_" + "a" * 43)
    rec = runner.record(gymnasium.make("FrozenLake-v1"), server.url, name="refused")
    with pytest.warns(UserWarning, match="is not pushed while it is recorded: .*token") as caught:  # noqa: PT031
        while not caught.list:
            drive(rec, 10)
    with pytest.warns(UserWarning, match="was not pushed: .*token"):
        rec.close()
    assert find_run(rec.run.run_id, outbox).status == "finished"


def test_a_loop_that_is_killed_leaves_what_it_recorded(server, outbox):
    with loop(server.url, end="hang") as killed:
        assert killed.stdout is not None
        assert killed.stdout.readline() == "now\n"
        killed.kill()
    (run,) = list_runs(outbox)
    assert run.status == "interrupted"
    data = run.recording.read_bytes()
    result = dualtaxi("remote", "push", "--outbox")
    assert result.exit_code == 0, result.stderr
    stored = find_run(run.run_id, server.recordings)
    assert (stored.status, stored.recording.read_bytes()) == ("interrupted", data)
    with runner.open_recording(stored.recording) as recording:
        assert recording.train.steps.count() == 3_000


def test_loops_of_several_processes_are_stored_with_equal_digests(server, outbox):
    with contextlib.ExitStack() as stack:
        loops = [stack.enter_context(loop(server.url, seed, 5_000)) for seed in range(4)]
        outputs = [started.communicate(timeout=200)[0] for started in loops]
    for line in outputs:
        assert re.fullmatch(r"\w+ [0-9a-f]{64}\n", line), line
        run_id, digest = line.split()
        assert find_run(run_id, server.recordings).summary["content_digest"] == digest
    assert list(outbox.iterdir()) == []


def test_an_invalid_address_is_refused_before_recording(outbox):
    with pytest.raises(runner.RunnerError, match="password"):
        runner.record(gymnasium.make("FrozenLake-v1"), "http://me:secret@localhost")
    assert not outbox.exists()
