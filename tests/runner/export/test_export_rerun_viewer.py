"""The viewer draws what is exported: without a screen, and every view without an error."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path
from types import SimpleNamespace

import pytest
from click.testing import CliRunner

from runner.analysis.episodes import EpisodeRef
from runner.cli import cli
from runner.cli.commands import play
from runner.errors import RecordingError, RunnerError, StorageError
from runner.export.rerun import viewer, writing
from runner.export.rerun.selection import Request, locate
from runner.export.rerun.viewer import cached_export

PLOTS = {"Success %", "Mean length", "Mean return", "Mean penalties"}
PLOTS |= {"Q-table filled (%)", "Epsilon, step size", "Rewards (% of the last steps)"}
TABLE = "Q-values of this state, before the move"


@pytest.fixture(autouse=True)
def _cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def drawn(path, step):
    """Return the views of a file by name, drawn; skip where nothing can be drawn, but fail in CI."""
    try:
        with viewer.headless(path, step) as client:
            return {view.name: view for view in client.get_state().views}
    except viewer.ViewerError as error:
        if "finds no graphics" in str(error) and "DUALTAXI_CI" not in os.environ:
            pytest.skip(f"no graphics to draw with: apt-get install {viewer.MESA_PACKAGES}")
        raise


def test_every_view_of_the_default_blueprint_is_drawn_without_an_error(pictured):
    run = pictured("rivals")
    location = locate(run, Request(), EpisodeRef(39, 3))
    path, _ = cached_export([run], location.request)
    views = drawn(path, location.time)
    maps = {f"taxi {i}: max Q, greedy moves" for i in (1, 2)}
    title = f"rivals, seed 1 ({run.run_id})"
    assert set(views) == PLOTS | maps | {TABLE, title, "Events", "Collisions per episode"}
    assert [view.reports for view in views.values()] == [[]] * len(views)
    assert all(view.visible for view in views.values())


def test_two_runs_are_side_by_side(pictured):
    runs = [pictured("rivals"), pictured("taxis")]
    path, selections = cached_export(runs, Request())
    assert len(selections) == 2
    views = drawn(path, locate(runs[0], Request(), None).time)
    assert {f"rivals, seed 1 ({runs[0].run_id})", f"taxis, seed 1 ({runs[1].run_id})"} <= set(views)
    assert all(not view.reports for view in views.values())


def test_a_second_export_comes_from_the_cache(pictured):
    run = pictured("lake")
    path, _ = cached_export([run], Request())
    made = path.stat().st_ino
    again, _ = cached_export([run], Request())
    assert again == path
    assert again.stat().st_ino == made


def test_an_export_that_another_process_removes_from_the_cache_is_made_again(pictured, monkeypatch):
    run = pictured("lake")
    path, _ = cached_export([run], Request())
    monkeypatch.setattr(Path, "exists", lambda _: True)
    path.unlink()
    again, _ = cached_export([run], Request())
    assert again.stat().st_size


def test_an_export_that_fails_leaves_no_file_open(pictured, monkeypatch, tmp_path):
    def fail(reader):
        raise RecordingError("it is damaged")

    monkeypatch.setattr(writing.RunReader, "steps", fail)
    with pytest.raises(RecordingError) as failed:
        writing.export([pictured("lake")], Request(), tmp_path / "a.rrd")
    assert failed.value
    for descriptor in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # what listed them
            assert str(tmp_path) not in str(descriptor.readlink())


def test_the_error_of_a_viewer_that_cannot_start(monkeypatch):
    monkeypatch.setattr(viewer, "viewer_program", lambda: "/bin/false")
    with (
        pytest.raises(RunnerError, match="does not start"),
        viewer.viewer(viewer.free_port()),
    ):
        pass


def test_a_screenshot_is_written_or_its_path_is_reported(monkeypatch, tmp_path):
    @contextlib.contextmanager
    def headless(path, step, size):
        yield SimpleNamespace(save_screenshot=lambda picture: Path(picture).write_bytes(b"drawn"))

    monkeypatch.setattr(viewer, "headless", headless)
    monkeypatch.setattr(viewer, "NOTICE_SECONDS", 0)
    picture = tmp_path / "step.png"
    viewer.screenshot(tmp_path / "a.rrd", 0, picture)
    assert picture.read_bytes() == b"drawn"
    viewer.screenshot(tmp_path / "a.rrd", 0, tmp_path / "new" / "step.png")
    assert (tmp_path / "new" / "step.png").read_bytes() == b"drawn"
    with pytest.raises(StorageError, match="is a file, expected a folder"):
        viewer.screenshot(tmp_path / "a.rrd", 0, picture / "step.png")


@pytest.mark.parametrize("size", ["foo", "1600", "1600x", "0x900", "1600x99999", "-5x900", "1600x900x2"])
def test_a_size_that_cannot_be_drawn_is_refused_before_anything_is_exported(pictured, monkeypatch, size):
    monkeypatch.setattr(writing, "export", lambda *_: pytest.fail("exported"))
    words = ["view", str(pictured("taxis").folder), "--screenshot", "step.png", "--size", size]
    done = CliRunner().invoke(cli, words)
    assert done.exit_code == 2
    assert f"found '{size}', expected WIDTHxHEIGHT" in done.stderr


@pytest.mark.parametrize(("names", "stages"), [(1, []), (2, ["comparing the runs"])])
def test_the_stages_of_view_are_shown_on_a_terminal(pictured, monkeypatch, names, stages):
    shown = []

    @contextlib.contextmanager
    def stage_line(stage):
        shown.append(stage)
        yield shown.append

    monkeypatch.setattr(play, "stage_line", stage_line)
    monkeypatch.setattr(viewer, "screenshot", lambda *_: None)
    runs = [str(pictured(world).folder) for world in ("taxis", "rivals")[:names]]
    done = CliRunner().invoke(cli, ["view", *runs, "--screenshot", "step.png", "--force"])
    assert done.exit_code == 0, done.output
    assert shown == ["loading Rerun", *stages, "exporting", "drawing"]


def test_the_web_viewer_ends_with_the_command(pictured):
    words = [sys.executable, "-m", "runner", "view", pictured("taxis").folder, "--web"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            address = process.stdout.readline().strip()
            with urllib.request.urlopen(address, timeout=20) as response:
                assert b"re_viewer" in response.read()
        finally:
            process.terminate()
        assert process.wait(30) == 128 + signal.SIGTERM
    with pytest.raises(urllib.error.URLError, match="refused"):
        urllib.request.urlopen(address, timeout=20)
