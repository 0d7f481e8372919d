"""Checkpoints go with their runs to a server and back."""

from __future__ import annotations

import re

import gymnasium
import httpx2
import pytest
from blake3 import blake3
from click.testing import CliRunner

import runner
from runner.cli import cli
from runner.client.client import Client, ServerError, put_upload
from runner.runs.checkpoints import Store

pytestmark = pytest.mark.usefixtures("outbox")


def record_loop(recordings, name):
    with runner.record(gymnasium.make("CartPole-v1"), recordings, name=name) as rec:
        rec.reset(seed=0)
        for k in range(5):
            rec.step(0, extras={"value": float(k)})
            rec.checkpoint("policy", bytes([k // 2]) * 1000)
    return rec.run


def test_a_pushed_run_has_its_checkpoints_and_so_has_a_pulled_one(server, tmp_path):
    run = record_loop(tmp_path / "here", "pushed")
    words = ["remote", "push", "pushed", "--server", server.url, "--recordings", str(tmp_path / "here")]
    for _ in range(2):  # the second push sends nothing again
        done = CliRunner().invoke(cli, words)
        assert done.exit_code == 0, done.output
    there = httpx2.get(f"{server.url}/api/v1/runs/{run.run_id}/checkpoints").json()["checkpoints"]
    assert [(each["step"], each["here"]) for each in there] == [(k, True) for k in range(1, 6)]
    content = httpx2.get(f"{server.url}/api/v1/runs/{run.run_id}/checkpoints/{there[0]['digest']}").content
    assert content == bytes(1000)
    words = ["remote", "pull", run.run_id, "--server", server.url, "--recordings", str(tmp_path / "other")]
    part = tmp_path / "other/.pulling" / f"{run.run_id}-{there[0]['digest']}.part"
    part.parent.mkdir(parents=True)
    part.write_bytes(b"damaged while it was interrupted")
    done = CliRunner().invoke(cli, words)
    assert done.exit_code != 0
    assert "it was changed" in done.output
    done = CliRunner().invoke(cli, words)
    assert done.exit_code == 0, done.output
    pulled = runner.find_run(run.run_id, tmp_path / "other")
    assert [each.load() for each in pulled.checkpoints()] == [bytes([k // 2]) * 1000 for k in range(5)]
    assert list((tmp_path / "other").glob(".pulling/*")) == []
    address = f"{server.url}/runs/{run.run_id}/checkpoints"
    page = httpx2.get(address).text
    assert (page.count("policy@"), page.count(">here<")) == (6, 5)
    downloads = re.findall(r'href="(/api/v1/[^"]*)">policy@', page)
    assert [httpx2.get(f"{server.url}{one}").content for one in downloads] == [
        bytes([k // 2]) * 1000 for k in range(5)
    ]
    assert str(server.recordings) not in page
    for each in runner.find_run(run.run_id, server.recordings).checkpoints():
        each.path.unlink(missing_ok=True)
    assert httpx2.get(address).text.count(">missing<") == 5


def test_a_run_that_was_removed_is_pushed_again_with_its_checkpoints(server, tmp_path):
    run = record_loop(tmp_path / "here", "removed")
    with Client(server.url) as client:
        for _ in range(2):
            client.push(run)
            there = runner.find_run(run.run_id, server.recordings)
            assert all(each.is_here for each in there.checkpoints())
            done = CliRunner().invoke(
                cli, ["rm", run.run_id, "--yes", "--recordings", str(server.recordings)]
            )
            assert done.exit_code == 0, done.output


def test_a_loop_recorded_for_a_server_leaves_no_content_in_the_outbox(server, outbox):
    run = record_loop(server.url, "sent")
    there = httpx2.get(f"{server.url}/api/v1/runs/{run.run_id}/checkpoints").json()["checkpoints"]
    assert all(each["here"] for each in there)
    assert list(outbox.glob(".store/objects/*/*")) == []


def test_a_server_takes_no_content_that_its_run_does_not_name(server, tmp_path):
    run = record_loop(tmp_path, "strict")
    with Client(server.url) as client:
        client.push(run)
        digest = blake3(b"strange").hexdigest()
        with pytest.raises(ServerError, match="has no checkpoint of this digest"):
            put_upload(client, digest, digest=digest, size=7, checkpoint_of=run.run_id)
        with pytest.raises(ServerError, match="push it before"):
            put_upload(client, digest, digest=digest, size=7, checkpoint_of="unknown")
    response = httpx2.get(f"{server.url}/api/v1/runs/{run.run_id}/checkpoints/{digest}")
    assert response.status_code == 404
    for strange in ("..%2F..%2Frun.json", "run.json", "A" * 64):
        response = httpx2.get(f"{server.url}/api/v1/runs/{run.run_id}/checkpoints/{strange}")
        assert response.status_code in (404, 422), strange


def test_a_content_that_is_changed_on_the_way_is_refused(server, tmp_path):
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path) as rec:
        rec.checkpoint("policy", b"new to the server")
    run = rec.run
    Store(tmp_path).path(run.checkpoints()[0].digest).write_bytes(b"NEW to the server")
    with Client(server.url) as client, pytest.raises(ServerError, match="refused policy@0"):
        client.push(run)
