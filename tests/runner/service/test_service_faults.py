"""Faults around a running service: slow clients, a full disk, a lost index, a stop."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import json
import os
import signal
import socket
import threading
import time

import httpx2 as httpx
import pytest
from click.testing import CliRunner
from served import Served

from runner.cli import cli
from runner.runs.catalogue.database import index_path
from runner.service.app import create_app
from runner.service.server import bind, serve
from runner.service.settings import ServiceLimits
from tests.waiting import until


@pytest.fixture
def impatient(settings):
    """Return the port of a service with timeouts of half a second."""
    limits = ServiceLimits(header_seconds=0.5, idle_seconds=0.5, keep_alive_seconds=1, stop_seconds=1)
    settings = dataclasses.replace(settings, port=0, limits=limits)
    app, listening = create_app(settings), bind(settings)
    ended = threading.Thread(target=serve, args=(app, settings, listening), daemon=True)
    servers = []
    with pytest.MonkeyPatch.context() as patch:
        from runner.service import server

        made = server._Server

        def remembered(*args):
            servers.append(made(*args))
            return servers[0]

        patch.setattr(server, "_Server", remembered)
        ended.start()
        yield listening.getsockname()[1]
        servers[0].should_exit = True
        ended.join(60)
    assert not ended.is_alive()


def _seconds_until_cut_off(connection):
    began = time.monotonic()
    connection.settimeout(5)
    try:
        while connection.recv(65536):
            pass
    except ConnectionResetError:
        pass
    return time.monotonic() - began


@pytest.mark.parametrize("sent", [b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: localhost\r\n", b"\r\n"])
def test_a_client_that_sends_no_request_is_cut_off(impatient, sent):
    with socket.create_connection(("localhost", impatient)) as connection:
        connection.sendall(sent)
        assert 0.2 < _seconds_until_cut_off(connection) < 3


def test_a_client_that_sends_headers_slowly_is_cut_off(impatient):
    with socket.create_connection(("localhost", impatient)) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\n")
        began = time.monotonic()
        with contextlib.suppress(OSError):
            while time.monotonic() - began < 5:
                connection.sendall(b"X: 1\r\n")
                time.sleep(0.1)
        assert time.monotonic() - began < 3


def test_a_body_that_does_not_arrive_is_refused(impatient):
    with socket.create_connection(("localhost", impatient)) as connection:
        origin = f"Origin: http://localhost:{impatient}\r\nHost: localhost:{impatient}\r\n"
        head = f"PATCH /api/v1/runs/first HTTP/1.1\r\n{origin}Content-Type: application/json\r\n"
        connection.sendall(f"{head}Content-Length: 100\r\n\r\n{{".encode())
        connection.settimeout(5)
        assert connection.recv(65536).startswith(b"HTTP/1.1 408")


@pytest.mark.parametrize("between", [b"", b"\r\nX-Long: "])
def test_an_endless_head_is_refused(impatient, between):
    with socket.create_connection(("localhost", impatient)) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nX-Long: ")
        for _ in range(9):
            connection.sendall(b"x" * 8000 + between)
        connection.settimeout(5)
        assert connection.recv(65536).startswith(b"HTTP/1.1 400")


def test_a_client_that_does_not_read_is_cut_off(impatient, recordings):
    large = next(recordings.glob("*/recording.mcap"))
    with large.open("r+b") as stream:
        stream.truncate(64 << 20)
    run = large.parent.name
    with socket.create_connection(("localhost", impatient)) as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        connection.sendall(f"GET /api/v1/runs/{run}/recording HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
        time.sleep(1.5)
        received = 0
        with contextlib.suppress(ConnectionResetError):
            connection.settimeout(5)
            while part := connection.recv(1 << 20):
                received += len(part)
        assert received < 32 << 20


def test_clients_that_do_not_read_keep_neither_pages_nor_each_other_waiting(impatient, recordings):
    run = next(recordings.glob("*/recording.mcap")).parent.name
    request = f"GET /api/v1/runs/{run}/recording HTTP/1.1\r\nHost: localhost\r\n\r\n".encode()
    with contextlib.ExitStack() as unread:
        slow = []
        for _ in range(100):
            slow.append(unread.enter_context(socket.create_connection(("localhost", impatient))))
            slow[-1].sendall(request)  # at once, as the service closes connections that ask nothing
        assert httpx.get(f"http://localhost:{impatient}/runs", timeout=30).status_code == 200
        for connection in slow:
            connection.settimeout(5)
            assert connection.recv(12) == b"HTTP/1.1 200"


def test_many_slow_clients_do_not_block_others(impatient):
    slow = [socket.create_connection(("localhost", impatient)) for _ in range(200)]
    try:
        for connection in slow:
            with contextlib.suppress(OSError):  # on a slow machine the first ones are cut off already
                connection.sendall(b"GET / HTTP/1.1\r\nHost: loc")
        assert httpx.get(f"http://localhost:{impatient}/healthz", timeout=30).status_code == 200
    finally:
        for connection in slow:
            connection.close()


def test_more_idle_connections_than_descriptors_do_not_block_others(own_server):
    own_server.max_files = 128
    with own_server, contextlib.ExitStack() as idle:
        address = "127.0.0.1", own_server.port
        connections = [idle.enter_context(socket.create_connection(address)) for _ in range(300)]
        for path in ("/runs", "/readyz", "/api/v1/runs"):
            assert httpx.get(own_server.url + path, timeout=30).status_code == 200
        connections[0].settimeout(5)
        assert connections[0].recv(1) == b"", "the oldest is closed"
        connections[-1].setblocking(False)
        with pytest.raises(BlockingIOError):  # the newest stays open
            connections[-1].recv(1)
    lines = own_server.log.read_text().splitlines()
    assert len(lines) < 50
    events = [json.loads(line)["event"] for line in lines]
    assert 1 <= events.count("too many connections") <= 5


def test_a_deleted_or_damaged_index_is_created_again(client, recordings):
    before = client.get("/api/v1/runs").json()
    for damage in (index_path().unlink, lambda: index_path().write_bytes(b"no database" * 1000)):
        damage()
        assert client.get("/api/v1/runs", params={"sort": "id"}).json()["total"] == 2
        after = client.get("/api/v1/runs").json()
        assert after == before


def test_new_and_removed_runs_are_noticed_soon(client, recordings):
    import shutil

    assert client.get("/api/v1/runs").json()["total"] == 2
    shutil.rmtree(next(recordings.glob("*/recording.mcap")).parent)
    until(lambda total: total == 1, lambda: client.get("/api/v1/runs").json()["total"])


def test_a_full_disk_is_reported(client, monkeypatch):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("runner.recording.labels.write_object", full)
    answer = client.patch("/api/v1/runs/first", json={"note": "x"})
    assert answer.status_code == 507
    assert "No space left" in answer.json()["error"]["message"]
    assert client.get("/api/v1/runs").status_code == 200


@pytest.mark.parametrize("how", [signal.SIGTERM, signal.SIGINT])
def test_a_stop_completes_running_responses(recordings, how):
    large = next(recordings.glob("*/recording.mcap"))
    with large.open("r+b") as stream:
        stream.truncate(40 << 20)
    log = recordings.with_name("service.log")
    with Served(recordings, "--log", str(log)) as served:
        address = f"{served.url}/api/v1/runs/{large.parent.name}/recording"
        with httpx.stream("GET", address) as answer:
            parts = answer.iter_bytes()
            received = len(next(parts))
            os.kill(served.process.pid, how)
            time.sleep(0.3)
            assert served.process.is_alive()
            received += sum(map(len, parts))
        assert received == 40 << 20
        served.process.join(10)
        assert served.process.exitcode == 0
    assert served.log.read_text() == "", "everything is in the log"
    events = [json.loads(line)["event"] for line in log.read_text().splitlines()]
    assert events.count("stopping") == 1


def test_a_used_port_and_a_served_folder_are_reported(recordings):
    with Served(recordings) as served:
        port, elsewhere = str(served.port), recordings.with_name("elsewhere")
        taken, twice = (
            CliRunner().invoke(cli, ["serve", "--port", where, "--recordings", str(folder)])
            for where, folder in ((port, elsewhere), ("0", recordings))
        )
    assert (taken.exit_code, twice.exit_code) == (2, 2)
    assert f"127.0.0.1:{port}: cannot listen there (Address already in use); choose" in taken.stderr
    assert "served by another process" in twice.stderr
    assert "Traceback" not in taken.stderr + twice.stderr
