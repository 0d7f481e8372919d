"""Which steps are exported, the messages about them, and what is refused."""

from __future__ import annotations

import socket
import sys

import gymnasium
import numpy as np
import pytest
from click.testing import CliRunner

import runner
from runner.analysis.diff import diff
from runner.analysis.episodes import EpisodeRef
from runner.cli import cli
from runner.errors import MissingExtra, RecordingError
from runner.export.rerun.selection import Request, episodes_of, locate, locate_divergence, select
from runner.export.rerun.viewer import ViewerError, free_port, require_rerun
from runner.recording import schema
from runner.recording.reader import open_recording


@pytest.fixture
def rivals(pictured):
    with open_recording(pictured("rivals").recording) as recording:
        yield recording


def invoke(*arguments):
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


class TestSelection:
    """The selected steps."""

    def test_default_is_a_spread_and_the_last_evaluation(self, rivals):
        selection = select(rivals, Request())
        train = selection.by_phase["train"]
        assert train[0].start == 0
        last = train[-1]
        assert last.stop == rivals.train.steps.count()
        assert "(after 40 episodes)" in selection.exported[1]
        assert "20 of 40 training episodes, evenly spread from 0 to 39" in selection.exported[0]
        assert any("--all" in left and "20 training episodes" in left for left in selection.left_out)
        assert any("--evaluations 20" in left for left in selection.left_out)
        assert not selection.warnings

    def test_everything(self, rivals):
        selection = select(rivals, Request(everything=True))
        assert selection.steps == rivals.train.steps.count() + rivals.eval.steps.count()
        assert not selection.left_out

    def test_ranges_every_and_evaluations_are_combined(self, rivals):
        request = Request(episodes=((0, 2), (38, None)), evaluations=(20,), every=15)
        selection = select(rivals, request)
        lengths = episodes_of(rivals, "train").lengths
        wanted = [0, 1, 15, 30, 38, 39]
        assert sum(s.stop - s.start for s in selection.by_phase["train"]) == lengths[wanted].sum()
        assert "(after 20 episodes)" in selection.exported[1]

    @pytest.mark.parametrize("ranges", [((40, 41),), ((3, 3),), ((0, 41),), ((50, None),)])
    def test_episodes_that_do_not_exist(self, rivals, ranges):
        with pytest.raises(RecordingError, match=r"there are 40, from 0"):
            select(rivals, Request(episodes=ranges))

    @pytest.mark.parametrize("number", [-1, 18])
    def test_trials_that_do_not_exist(self, rivals, number):
        with pytest.raises(RecordingError, match=r"no evaluation episodes .* there are 18, from 0"):
            select(rivals, Request(trials=(0, number)))

    def test_an_evaluation_that_does_not_exist(self, rivals):
        with pytest.raises(
            RecordingError, match=r"evaluation after 7 episodes; it has 3, the nearest after 0\."
        ):
            select(rivals, Request(evaluations=(7,)))

    def test_the_step_to_view_is_exported(self, pictured):
        run = pictured("rivals")
        location = locate(run, Request(), EpisodeRef(7, 2))
        with open_recording(run.recording) as recording:
            step = recording.train.episode_steps(7)[2]
            spans = select(recording, location.request).by_phase["train"]
        assert location.time == step["log_time"] // schema.STEP_NANOSECONDS
        assert any(span.start <= step["step"] < span.stop for span in spans)
        with pytest.raises(RecordingError, match="found no step 999"):
            locate(run, Request(), EpisodeRef(7, 999))
        with pytest.raises(RecordingError, match="no trial 6 "):
            locate(run, Request(), EpisodeRef(6, after=20))


def test_an_environment_without_a_scene_is_reported(pictured):
    with open_recording(pictured("corridor").recording) as recording:
        assert "no scene: state and action" in select(recording, Request()).warnings[0]


class TestWithoutSteps:
    """A run recorded without steps."""

    def test_metrics_are_exported_and_the_rest_is_reported(self, pictured, tmp_path):
        run = pictured("rivals", recording={"steps": "none"})
        result = invoke("export", "rerun", run.folder, "-o", tmp_path / "a.rrd")
        assert result.exit_code == 0, result.output
        assert "rerecord" in result.output
        result = invoke("export", "rerun", run.folder, "-o", tmp_path / "b.rrd", "--all")
        assert result.exit_code == 2
        assert "rerecord" in result.output
        result = invoke("view", run.folder, "--at", "1:1", "--screenshot", tmp_path / "a.png")
        assert result.exit_code == 2
        assert "rerecord" in result.output


def test_an_interrupted_run_is_exported_as_far_as_recorded(pictured, tmp_path):
    whole = pictured("rivals", recording={"chunk_steps": 256}).recording
    part = tmp_path / "part.mcap"
    part.write_bytes(whole.read_bytes()[: whole.stat().st_size * 8 // 10])
    result = invoke("export", "rerun", part, "-o", tmp_path / "part.rrd", "--all")
    assert result.exit_code == 0, result.output
    assert "did not finish (interrupted): there are " in result.output


class TestCommand:
    """Arguments that the commands refuse."""

    def test_a_screenshot_that_exists_needs_force(self, pictured, tmp_path):
        picture = tmp_path / "mine.png"
        picture.write_text("mine")
        result = invoke("view", pictured("taxis").recording, "--screenshot", picture)
        assert result.exit_code == 2
        assert "--force" in result.stderr
        assert picture.read_text() == "mine"

    def test_a_file_that_exists_needs_force(self, pictured, tmp_path):
        run, path = pictured("lake"), tmp_path / "a.rrd"
        path.write_bytes(b"precious")
        result = invoke("export", "rerun", run.folder, "-o", path)
        assert result.exit_code == 2
        assert "--force" in result.output
        assert path.read_bytes() == b"precious"
        result = invoke("export", "rerun", run.folder, "-o", path, "--force")
        assert result.exit_code == 0, result.output
        assert "steps, in" in result.output
        assert path.read_bytes()[:4] == b"RRF2"

    def test_a_path_that_cannot_be_written_is_reported(self, pictured, tmp_path):
        (tmp_path / "file").touch()
        path = tmp_path / "file" / "a.rrd"
        result = invoke("export", "rerun", pictured("lake").folder, "-o", path)
        assert result.exit_code == 2
        assert f"{path}: {path.parent} is a file, expected a folder." in result.stderr

    def test_the_default_path_is_in_exports(self, pictured, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        assert invoke("export", "rerun", pictured("lake").folder).exit_code == 0
        assert [path.suffix for path in (tmp_path / "exports").iterdir()] == [".rrd"]

    @pytest.mark.parametrize("text", ["x", "1-2", ":x", ""])
    def test_texts_that_are_no_ranges(self, pictured, text):
        result = invoke("export", "rerun", pictured("lake").folder, "--episodes", text)
        assert result.exit_code == 2
        assert "START..STOP" in result.output

    def test_rerun_is_needed(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "rerun", None)
        with pytest.raises(MissingExtra, match=r"rerun-sdk, .* pip install"):
            require_rerun("view")

    def test_a_port_in_use(self):
        with socket.socket() as taken:
            taken.bind(("127.0.0.1", 0))
            taken.listen()
            port = taken.getsockname()[1]
            with pytest.raises(ViewerError, match=f"port {port} cannot be used .* --port"):
                free_port(port)

    def test_more_than_two_runs(self):
        result = invoke("view", "a", "b", "c")
        assert result.exit_code == 2
        assert "expected one or two" in result.output


class TestTwoRuns:
    """Where two runs are looked at: the step at which they diverge."""

    def test_they_diverge_at_the_first_step_that_differs(self, pictured):
        runs = [pictured("taxi"), pictured("taxi", discount=0.5)]
        step, message = locate_divergence(runs)
        with open_recording(runs[0].recording) as a, open_recording(runs[1].recording) as b:
            divergence = diff(a, b).divergence
            record = next(a.train.steps.blocks(divergence.step, divergence.step + 1))[0]
        assert step == EpisodeRef(divergence.episode, divergence.t)
        assert f"training step {divergence.step:,}" in message
        location = locate(runs[0], Request(), step)
        assert location.time == record["log_time"] // schema.STEP_NANOSECONDS
        assert location.request.episodes == ((divergence.episode, divergence.episode + 1),)

    def test_runs_that_never_diverge_and_runs_that_cannot_be_compared(self, pictured):
        run = pictured("taxi")
        assert locate_divergence([run, run]) == (None, "They never diverge: every step is the same.")
        for other in (pictured("lake"), pictured("taxi", recording={"steps": "none"})):
            step, message = locate_divergence([run, other])
            assert step is None
            assert "is unknown" in message

    def test_loops_diverge_at_the_first_step_that_differs(self, tmp_path):
        runs = []
        for last in (0, 1):
            with runner.record(gymnasium.make("CartPole-v1"), tmp_path) as env:
                for episode in range(3):
                    env.reset(seed=episode)
                    for action in (0, 1, last if episode == 2 else 0):
                        env.step(action)
            runs.append(env.run)
        step, message = locate_divergence(runs)
        assert step == EpisodeRef(2, 2)
        assert "training episode 2, at t = 2" in message
        assert locate(runs[0], Request(), step).time == 9
        assert locate_divergence([runs[0], runs[0]])[0] is None

    def test_vectors_diverge_in_an_episode_that_ended(self, tmp_path):
        runs = []
        for last in (0, 1):
            envs = gymnasium.make_vec("CartPole-v1", 2, vectorization_mode="sync")
            with runner.record_vector(envs, tmp_path) as env:
                env.reset(seed=3)
                for t in range(60):
                    env.step(np.array([0, last if t == 4 else 1]))
            runs.append(env.run)
        step, _ = locate_divergence(runs)
        assert step is not None
        assert locate(runs[0], Request(), step).time == 10

    def test_a_longer_run_is_the_same_as_far_as_the_shorter_goes(self, pictured):
        shorter = pictured("rivals", evaluation=None, episodes=20)
        _, message = locate_divergence([shorter, pictured("rivals", evaluation=None, episodes=30)])
        assert message == "They never diverge: every step is the same, as far as the shorter goes."
