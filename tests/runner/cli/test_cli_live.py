"""`run --live`: training goes on whatever its viewer does."""

from __future__ import annotations

import socket

from runner.export.rerun import live, viewer


def test_a_run_continues_when_its_viewer_stops_reading(command, tiny, monkeypatch):
    monkeypatch.setattr(live, "END_SECONDS", 2.0)
    with socket.create_server((viewer.LOOPBACK, 0)) as silent:
        url = f"rerun+http://{viewer.LOOPBACK}:{silent.getsockname()[1]}/proxy"
        done = command("run", tiny, "--live-url", url)
    assert done.exit_code == 0
    assert "not all was shown live" in done.stderr
    assert [run["status"] for run in command.json("ls")["runs"]] == ["finished"]


def test_a_run_without_its_viewer_does_not_start(command, tiny):
    done = command("run", tiny, "--live-url", f"rerun+http://{viewer.LOOPBACK}:{viewer.free_port()}/proxy")
    assert done.exit_code == 1
    assert "nothing answers there" in done.stderr
    assert not command.recordings.exists()
