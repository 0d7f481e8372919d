"""Pushing and pulling runs: commands, crashes, servers that are killed or unavailable."""

from __future__ import annotations

import json
import secrets
import shutil
import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import httpx2
import pytest
from blake3 import blake3
from click.testing import CliRunner

import runner
from runner.cli import cli
from runner.client import client as client_module
from runner.client.client import (
    Backoff,
    Client,
    ServerError,
    ServerUnavailable,
    append_upload,
    checked_url,
    find_token,
    put_upload,
)
from runner.export.mcap import export_mcap
from runner.recording.labels import change_labels
from runner.runs.resolve import find_run
from runner.runs.run import Run, list_runs
from tests.runner.recording.making import TAXIS, make_run, with_id
from tests.waiting import until

pytestmark = pytest.mark.usefixtures("outbox")


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Return a folder of two small runs, `first` and `second`."""
    folder = tmp_path_factory.mktemp("small")
    for seed, name in enumerate(("first", "second")):
        make_run(folder, TAXIS, name=name, seed=seed)
    return folder


@pytest.fixture
def recordings(small, tmp_path):
    return Path(shutil.copytree(small, tmp_path / "recordings"))


@pytest.fixture
def run(recordings):
    return find_run("first", recordings)


def dualtaxi(*args):
    return CliRunner().invoke(cli, [str(arg) for arg in args])


def copies(run, folder, count):
    """Return runs of the same content, each with an id of its own."""
    paths = {f"copy{number}": folder / f"{number}.mcap" for number in range(count)}
    return [
        Run(folder, run.facts | {"run_id": run_id}, with_id(run_id, run.recording, path))
        for run_id, path in paths.items()
    ]


# --- commands ---------------------------------------------------------------------------------------------


def test_a_run_is_pushed_and_pulled_with_its_labels(server, run, recordings, tmp_path):
    change_labels(run.folder, lambda labels: replace(labels, name="renamed", tags=("good",), note="seen"))
    push = ("remote", "push", run.run_id, "--recordings", recordings, "--server", server.url, "--json")
    pushed = json.loads(dualtaxi(*push).stdout)
    (stored,) = pushed["runs"]
    expected = {"run_id": run.run_id, "name": "renamed", "bytes": run.summary["bytes"], "already": False}
    assert stored == expected
    assert json.loads(dualtaxi(*push).stdout)["runs"][0]["already"]
    pull = ("remote", "pull", "renamed", "--recordings", tmp_path / "back", "--server", server.url, "--json")
    assert json.loads(dualtaxi(*pull).stdout)["content_digest"] == run.summary["content_digest"]
    assert json.loads(dualtaxi(*pull).stdout)["already"]
    back, run = find_run(run.run_id, tmp_path / "back"), find_run(run.run_id, recordings)
    assert back.recording.read_bytes() == run.recording.read_bytes()
    assert {key: value for key, value in run.facts.items() if key != "owner"} == back.facts
    assert back.labels == run.labels
    assert [path.name for path in (tmp_path / "back").iterdir()] == [run.run_id]


def test_marks_are_pushed_and_pulled_and_those_of_two_people_merge(server, recordings, tmp_path):
    make_run(recordings, TAXIS, name="marked", seed=7)
    mine = find_run("marked", recordings)
    push = ("remote", "push", mine.run_id, "--server", server.url, "--recordings")
    pull = ("remote", "pull", mine.run_id, "--server", server.url, "--recordings")

    def sync(*words):
        result = dualtaxi(*words)
        assert result.exit_code == 0, result.output

    first = runner.mark(mine, "3:1", "both stuck", tags=["stuck"])
    sync(*push, recordings)
    sync(*pull, tmp_path / "theirs")
    theirs = find_run("marked", tmp_path / "theirs")
    assert find_run("marked", server.recordings).marks == (first,)
    assert theirs.marks == (first,)
    second = runner.mark(theirs, "4:0", "mine")
    runner.unmark(mine, first.id)
    sync(*push, recordings)
    sync(*push, tmp_path / "theirs")
    sync(*pull, recordings)
    assert mine.marks == find_run("marked", server.recordings).marks == (second,)


def test_an_exported_file_is_pushed_like_its_run(server, recordings, tmp_path):
    run = find_run("second", recordings)
    change_labels(run.folder, lambda labels: replace(labels, note="seen"))
    packed = export_mcap(run, tmp_path / "a.mcap").path
    result = dualtaxi("remote", "push", packed, "--server", server.url)
    assert (result.exit_code, "stored" in result.stdout) == (0, True)
    assert find_run(run.run_id, server.recordings).recording.read_bytes() == run.recording.read_bytes()


def test_runs_that_cannot_be_pushed_are_reported_and_the_others_pushed(server, run, recordings):
    result = dualtaxi(
        "remote", "push", "nosuch", run.run_id, "--recordings", recordings, "--server", server.url
    )
    assert result.exit_code == 2
    assert "nosuch" in result.stderr
    assert run.run_id in result.stdout
    assert dualtaxi("remote", "push", run.run_id, "--recordings", recordings).exit_code == 2
    assert dualtaxi("remote", "push", "--server", server.url).exit_code == 2
    assert dualtaxi("remote", "pull", "x", "--server", "ftp://there").exit_code == 2
    missing = dualtaxi("remote", "pull", "nosuch", "--server", server.url, "--recordings", recordings)
    assert (missing.exit_code, "nosuch" in missing.stderr) == (2, True)


def test_a_refused_run_is_reported(server, run, tmp_path):
    data = bytearray(run.recording.read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "bad.mcap").write_bytes(data)
    with Client(server.url) as client, pytest.raises(ServerError, match="refused the run"):
        client.push(Run(run.folder, run.facts | {"summary": {}}, tmp_path / "bad.mcap"))


def test_a_token_is_found_and_never_printed(own_server, run, recordings, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    token = dualtaxi("token", "create", "pusher", "--scope", "write").stdout.strip()
    own_server.options = ("--require-token",)
    own_server.start()
    push = ("remote", "push", run.run_id, "--recordings", recordings, "--server", own_server.url)
    refused = dualtaxi(*push, "--token", "dualtaxi_wrong")
    assert (refused.exit_code, "token" in refused.stderr) == (2, True)
    without = dualtaxi(*push)
    assert (without.exit_code, "--token" in without.stderr, "$DUALTAXI_TOKEN" in without.stderr) == (
        2,
        True,
        True,
    )
    assert "Bearer" not in without.stderr
    (tmp_path / "token").write_text(token + "\n")
    taken = dualtaxi(*push, "--token-file", tmp_path / "token")
    assert taken.exit_code == 0, taken.stderr
    own_server.stop()
    log = own_server.log.read_text()
    assert not [
        text for text in (log, taken.output, refused.output) if token in text or "dualtaxi_wrong" in text
    ]
    states = own_server.recordings.glob(".uploads/*/upload.json")
    assert all(token not in path.read_text() for path in states)


def test_pauses_are_logged_and_as_long_as_the_server_asks(monkeypatch):
    slept, messages = [], []
    monkeypatch.setattr("runner.client.client.time.sleep", slept.append)
    locked = ServerUnavailable("token: too many wrong ones; try again in 40 s.", 429, 40)
    backoff = Backoff(60, messages.append)
    backoff.wait(locked)
    assert (slept, messages) == ([40], [f"{locked} Trying again, for 60 s at most."])
    with pytest.raises(ServerUnavailable, match="too many"):
        Backoff(30, messages.append).wait(locked)
    slept.clear(), messages.clear()
    backoff.reset()
    for _ in range(3):
        backoff.wait(ServerUnavailable("does not answer"))
    assert (slept, messages) == ([0.2, 0.4, 0.8], []), "short pauses are not logged"
    for _ in range(2):
        backoff.wait(ServerUnavailable("does not answer"))
    assert (slept[3:], len(messages)) == ([1.6, 3.2], 1)


def test_the_header_retry_after_is_obeyed():
    answer = httpx2.Response(429, headers={"retry-after": "40"}, json={"error": {"message": "too many"}})
    with Client("http://localhost:8000") as client:
        client._http = httpx2.Client(transport=httpx2.MockTransport(lambda _: answer), base_url=client.url)
        with pytest.raises(ServerUnavailable, match="too many") as raised:
            client.request("GET", "/runs")
    assert (raised.value.status, raised.value.retry_seconds) == (429, 40)


def test_tokens_and_addresses_are_checked(tmp_path, monkeypatch):
    monkeypatch.setenv("DUALTAXI_TOKEN_FILE", str(tmp_path / "token"))
    with pytest.raises(runner.RunnerError, match="file with a token"):
        find_token()
    (tmp_path / "token").write_text("abc\n")
    assert (find_token(), find_token("said")) == ("abc", "said")
    monkeypatch.setenv("DUALTAXI_TOKEN", "variable")
    assert find_token() == "variable"
    with pytest.raises(runner.RunnerError, match="one line"):
        find_token("two words")
    assert checked_url("https://runs.example.org/them/") == "https://runs.example.org/them"
    for wrong in ("localhost:8000", "http://", "file:///etc", "http://a:b@c", "http://c/?x=1"):
        with pytest.raises(runner.RunnerError, match="server: found"):
            checked_url(wrong)


# --- faults -----------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_server_killed_during_twenty_uploads_loses_none(own_server, run, tmp_path, monkeypatch):
    monkeypatch.setattr(client_module, "PIECE", 8 << 10)
    sources = copies(run, tmp_path, 20)
    own_server.start()
    some, begun = threading.Semaphore(0), time.monotonic()

    def push(source):
        with Client(own_server.url, retry_timeout=120) as client:
            return client.push(source, lambda done, total: some.release() if 0 < done < total else None)

    with ThreadPoolExecutor(20) as pool:
        sent = [pool.submit(push, source) for source in sources]
        for _ in range(40):
            assert some.acquire(timeout=60)
        own_server.kill()
        visible = [path for path in own_server.recordings.iterdir() if path.name[0] != "."]
        assert all((folder / "run.json").exists() for folder in visible)
        received = [path.stat().st_size for path in own_server.recordings.glob(".uploads/*/body")]
        assert any(received)
        own_server.start()
        states = [future.result(120) for future in sent]
    assert {state.state for state in states} == {"stored"}
    assert len(list_runs(own_server.recordings)) == 20, time.monotonic() - begun
    for source in sources:
        stored = find_run(source.run_id, own_server.recordings)
        assert stored.recording.read_bytes() == source.recording.read_bytes()
    assert not list(own_server.recordings.glob(".uploads/*/body"))


def test_a_broken_connection_leaves_what_was_received(server, run):
    data = run.recording.read_bytes()
    with Client(server.url) as client:
        known = {"digest": blake3(data).hexdigest(), "size": len(data) + 5}
        sent = put_upload(client, secrets.token_hex(32), **known)
        head = (
            f"PATCH /api/v1/uploads/{sent.id} HTTP/1.1\r\nHost: 127.0.0.1\r\nOrigin: http://127.0.0.1\r\n"
            f"Upload-Offset: 0\r\nContent-Length: {len(data)}\r\n\r\n"
        )
        with socket.create_connection(("127.0.0.1", server.port)) as connection:
            connection.sendall(head.encode() + data[:1000])
            time.sleep(0.2)
        now = until(lambda now: now.offset, lambda: put_upload(client, sent.id, **known))
        assert now.offset == 1000
        with socket.create_connection(("127.0.0.1", server.port)) as stalled:
            stalled.sendall(head.replace("Offset: 0", "Offset: 1000").encode() + data[1000:2000])
            time.sleep(0.2)
            whole = append_upload(client, now, run.recording, len(data))
            assert whole.offset == len(data), "a connection that stalled holds nobody up"
        with pytest.raises(ServerError, match=f"expected {len(data):,}") as refused:
            append_upload(client, now, run.recording, len(data))
        assert refused.value.status == 409
        assert put_upload(client, sent.id, **known).state == "receiving", "bytes are missing"
        client.request("DELETE", f"/uploads/{sent.id}")
        with pytest.raises(ServerError, match="no such upload"):
            append_upload(client, now, run.recording, len(data))


def test_a_pull_is_resumed(server, recordings, tmp_path, monkeypatch):
    run = find_run("second", recordings)
    real, begun = Client.download, []

    def cut(self, path, tag, offset, size):
        begun.append(offset)
        for piece in real(self, path, tag, offset, size):
            yield piece[: size // 3]
            raise ServerUnavailable("cut off")

    with Client(server.url) as client:
        client.push(run)
        monkeypatch.setattr(Client, "download", cut)
        pulled = client.pull(run.run_id, tmp_path / "back")
    third = run.summary["bytes"] // 3
    assert begun[:3] == [0, third, 2 * third]
    assert pulled.run.recording.read_bytes() == run.recording.read_bytes()


def test_an_archived_run_is_pulled(server, recordings, tmp_path):
    run = find_run("second", recordings)
    with Client(server.url) as client:
        client.push(run)
        answer = client.request("POST", f"/runs/{run.run_id}/archive?remove=true")
        assert answer.json()["removed"]
        pulled = client.pull(run.run_id, tmp_path / "back")
    assert pulled.run.summary.content_digest == run.summary.content_digest


def test_a_recording_made_to_exhaust_memory_is_refused(server, tmp_path, run):
    import zstandard

    data = run.recording.read_bytes()
    at = data.index(bytes.fromhex("28b52ffd"), len(data) // 3)  # the first chunk behind it
    bomb = zstandard.compress(bytes(1 << 28), 19)
    (tmp_path / "bomb.mcap").write_bytes(data[:at] + bomb + data[at + len(bomb) :])
    with Client(server.url) as client, pytest.raises(ServerError, match="refused"):
        client.push(Run(run.folder, run.facts | {"summary": {}}, tmp_path / "bomb.mcap"))


def test_an_upload_begun_with_other_bytes_is_sent_again(server, run):
    with Client(server.url) as client:
        begun = put_upload(client, secrets.token_hex(32), name="stale")
        wrong = append_upload(client, begun, run.recording, 5_000)
        assert wrong.offset == 5_000
        other = list_runs(run.folder.parent)[0 if list_runs(run.folder.parent)[0].name == "second" else 1]
        sent = client.push(other, begun=begun.id)
    assert (sent.state, sent.run_id) == ("stored", other.run_id)
