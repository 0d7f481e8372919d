"""`on_error="warn"`: a recorder that fails does not end a training, and the run says what it lacks."""

from __future__ import annotations

import contextlib
import resource
import warnings
from concurrent.futures import ThreadPoolExecutor

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import SyncVectorEnv
from making import Leaving, dualtaxi

import runner
from runner.analysis.contents import shortcomings
from runner.errors import RunnerError
from runner.loops.media import Video
from runner.recording.reader import open_recording
from runner.runs.run import list_runs


class Odd(gymnasium.Env):
    """Observations of another shape from some step on."""

    observation_space = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.Discrete(2)

    def __init__(self, until: int = 10) -> None:
        self.until, self.steps = until, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.steps += 1
        shape = 2 if self.steps <= self.until else 3
        return np.full(shape, action, np.float32), 1.0, False, self.steps % 7 == 0, {}


SPACES = {"observation_space": Odd.observation_space, "action_space": Odd.action_space}


class Broken(Odd):
    """Fails by itself."""

    def step(self, action):
        super().step(action)
        raise ZeroDivisionError("the environment itself")


def train(rec, steps: int = 40) -> int:
    """Train as a user does, with every call that records; return the steps that were taken."""
    rec.reset(seed=0)
    taken = 0
    for k in range(steps):
        result = rec.step(1, extras={"value": k / 2})
        rec.note_step(error=1.0)
        rec.log({"loss": 0.5, "part": {"a": k}})
        rec.snapshot("weights", np.zeros(3))
        rec.checkpoint("policy", b"content")
        taken += 1
        if result[2] or result[3]:
            with rec.phase("eval"):
                rec.reset()
                rec.step(0)
            rec.reset()
    return taken


def only_run(folder):
    (run,) = list_runs(folder)
    return run


def test_by_default_the_error_ends_the_loop(tmp_path):
    with pytest.raises(RunnerError, match="shape"), runner.record(Odd(), tmp_path) as rec:
        train(rec)
    assert only_run(tmp_path).status == "failed"


def test_a_value_of_another_shape_ends_the_recording_only(tmp_path):
    with runner.record(Odd(), tmp_path, on_error="warn") as rec:
        with pytest.warns(RuntimeWarning, match=r"recording stopped at step 10") as caught:
            assert train(rec) == 40
        assert train(rec) == 40
    assert len(caught) == 1
    run = only_run(tmp_path)
    assert run.status == "failed"
    assert "recording stopped at step 10, and the loop went on without it" in run.summary["error"]
    with open_recording(run.recording) as recording:
        assert recording.status == "failed"
        assert shortcomings(recording) == [f"Run {run.run_id}: recording stopped at step 10."]
        counts = recording.done()
        assert counts["train_steps"] + counts["eval_steps"] == 10
    shown = dualtaxi(tmp_path, "show", run.run_id).output
    assert "recording stopped at step 10" in shown


def test_a_recording_that_fails_while_its_flush_waits_stops_that_flush_only(tmp_path):
    rec = runner.record(Odd(until=1), tmp_path, on_error="warn")
    rec.reset(seed=0)
    rec.step(0)
    with ThreadPoolExecutor() as pool:
        with rec._loop.lock:
            flushed = pool.submit(rec._loop.flush)  # it waits for the lock
            with pytest.warns(RuntimeWarning, match="recording stopped"):
                rec.step(0)
        flushed.result()


@contextlib.contextmanager
def disk_of(size):
    """Limit the size of files: as with a full disk, writing stops in the middle of a record."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_ends_the_recording_only(tmp_path):
    rec = runner.record(Odd(until=10**9), tmp_path, on_error="warn", compression="none")

    def learn():
        rec.reset(seed=0)
        for _ in range(60_000):
            if rec.step(0)[3]:
                rec.reset()
        rec.close()

    with disk_of(200_000), pytest.warns(RuntimeWarning, match="File too large") as caught:
        learn()
    assert len(caught) == 1
    run = only_run(tmp_path)
    assert run.status == "failed"
    assert "File too large" in run.summary["error"]
    with open_recording(run.recording) as recording:
        assert recording.done()["train_steps"] > 0


def test_a_disk_that_is_full_at_the_end(tmp_path):
    rec = runner.record(Odd(until=10**9), tmp_path, on_error="warn")
    rec.reset(seed=0)
    rec.step(0)
    with disk_of(1000), pytest.warns(RuntimeWarning, match="could not be completed"):
        rec.close()
    assert only_run(tmp_path).status != "finished"


def test_values_that_cannot_be_recorded_are_left_out(tmp_path):
    def log_all(rec):
        rec.step(0)
        rec.log({"loss": 0.5, "broken": object()})
        rec.log("broken", object())
        rec.snapshot("weights", [[1], [1, 2]])
        assert rec.checkpoint("policy", 3) == ""

    with runner.record(Odd(until=100), tmp_path, on_error="warn") as rec:
        rec.reset(seed=0)
        with pytest.warns(RuntimeWarning, match="a value was left out") as caught:
            log_all(rec)
        log_all(rec)  # warned of already: another warning would be an error here
    assert len(caught) == 3
    run = only_run(tmp_path)
    assert run.status == "finished"
    assert run.summary["messages"]["/scalar"] == 2
    assert run.summary["train_steps"] == 2


def test_extras_that_cannot_be_recorded_are_left_out_of_their_step(tmp_path):
    with runner.record(Odd(until=100), tmp_path / "one", on_error="warn") as rec:
        rec.reset(seed=0)
        rec.step(0, extras={"v": 1.0})
        with pytest.warns(RuntimeWarning, match="a value was left out: extras: found str"):
            rec.step(0, extras={"v": "x"})
        rec.step(0, extras={"v": 3.0})
    run = only_run(tmp_path / "one")
    assert (run.status, run.summary.train_steps) == ("finished", 3)
    with open_recording(run.recording) as recording:
        assert recording.train.extras.at(np.arange(3))["v"].tolist() == [1, None, 3]

    base = SyncVectorEnv([Odd, Odd])
    with runner.record_vector(base, tmp_path / "vector", on_error="warn") as envs:
        envs.reset(seed=0)
        with pytest.warns(RuntimeWarning, match="a value was left out: extras: found shape"):
            envs.step(np.array([0, 1]), extras={"v": np.zeros(3)})
    assert only_run(tmp_path / "vector").status == "finished"

    with runner.record_parallel(Leaving(), tmp_path / "game", on_error="warn") as game:
        game.reset(seed=0)
        with pytest.warns(RuntimeWarning, match="a value was left out: extras: found 'nobody'"):
            game.step(
                {agent: game.action_space(agent).sample() for agent in game.agents},
                {"nobody": {"v": 1}, game.agents[0]: {"v": 2}},
            )
    run = only_run(tmp_path / "game")
    assert run.summary.train_steps == 1
    with open_recording(run.recording) as recording:
        assert list(recording.train.extras) == [f"{Leaving.possible_agents[0]}/v"]


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        ({"b": "x"}, "extras: found str for 'b', expected float64 of shape"),
        ({"c": object()}, "found object of object for 'c', expected a number"),
        ({"n": 2**63}, "found 9223372036854775808 for 'n', which int64 cannot hold"),
        ({"large": np.zeros(200_000)}, "expected at most 1,048,576: 'large' is too large"),
        ({"words": "x" * 2_000_000}, "expected at most 1,048,576: 'words' is too large"),
    ],
)
def test_only_the_extra_that_cannot_be_recorded_is_lost(tmp_path, bad, reason):
    with runner.record(Odd(until=100), tmp_path, on_error="warn") as rec:
        rec.reset(seed=0)
        rec.step(0, extras={"a": 1.0, "b": 1.0, "n": 1, "words": "long"})
        with pytest.warns(RuntimeWarning, match=reason):
            rec.step(0, extras={"a": 2.0, **bad, "z": 2.0, "more": "text"})
        rec.step(0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # given once if it has the same words
            rec.note_step(a=3.0, **bad, z=3.0, more="text")
    with open_recording(rec.run.recording) as recording:
        values = recording.train.extras.at(np.arange(3))
        assert values["a"].tolist() == [1, 2, 3]
        assert values["z"].tolist() == [None, 2, 3]
        assert values["more"].tolist() == [None, "text", "text"]


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        ([1.0, object()], "found object of object for 'v' of environment 1"),
        ([1.0, "x"], "found a text for 'v' of environment 1, and a number for others"),
        ([np.zeros(2), np.zeros((2, 3))], r"found an array of shape \(T, 3\) for 'v' of environment 1"),
        (["x", 1.0], "found a number for 'v' of environment 1, and a text"),
    ],
)
def test_an_extra_of_a_vector_is_refused_by_name_and_environment(tmp_path, bad, reason):
    with runner.record_vector(SyncVectorEnv([Odd, Odd]), tmp_path, on_error="warn") as envs:
        envs.reset(seed=0)
        with pytest.warns(RuntimeWarning, match=reason):
            envs.step(np.array([0, 1]), extras={"a": [1.0, 2.0], "v": bad, "z": ["x", "y"]})
        batch = (
            np.zeros((1, 2, 2), np.float32),
            np.zeros((1, 2), np.int64),
            np.zeros((1, 2)),
            np.zeros((1, 2)),
        )
    with runner.record_batches(
        "two", tmp_path / "batches", autoreset_mode="NextStep", on_error="warn", **SPACES
    ) as rec:
        rec.reset(batch[0][0])
        with pytest.warns(RuntimeWarning, match=reason):
            rec.batch(*batch, extras={"a": [[1.0, 2.0]], "v": [bad], "z": [["x", "y"]]})
    for run in (envs.run, rec.run):
        with open_recording(run.recording) as recording:
            values = recording.train.extras.at(np.arange(2))
            assert (values["a"].tolist(), values["z"].tolist()) == ([1, 2], ["x", "y"])


def test_errors_of_the_environment_are_raised(tmp_path):
    with pytest.raises(ZeroDivisionError), runner.record(Broken(), tmp_path, on_error="warn") as rec:
        train(rec)
    assert "the environment itself" in only_run(tmp_path).summary["error"]


def test_steps_after_the_end_do_not_end_the_loop(tmp_path):
    rec = runner.record(Odd(until=10**9), tmp_path, on_error="warn")
    rec.reset(seed=0)
    rec.step(0)
    rec.close()
    with pytest.warns(RuntimeWarning, match="is closed"):
        assert train(rec) == 40
    assert only_run(tmp_path).status == "finished"


@pytest.mark.parametrize("fps", ["30", float("nan"), -1])
def test_a_film_that_cannot_be_written_is_left_out(tmp_path, fps):
    film = np.zeros((2, 3, 8, 8), np.uint8)
    with runner.record(Odd(until=10**9), tmp_path, on_error="warn") as rec:
        with pytest.warns(RuntimeWarning, match="a value was left out: picture: found .* frames per second"):
            rec.log("film", Video(film, fps=fps))
        assert train(rec) == 40
    assert only_run(tmp_path).status == "finished"


def test_values_without_a_step_are_left_out(tmp_path):
    with runner.record(Odd(until=10**9), tmp_path, on_error="warn") as rec:
        with pytest.warns(RuntimeWarning, match="a value was left out: note_step: found no step"):
            rec.note_step(value=1.0)
        assert train(rec) == 40
    assert only_run(tmp_path).status == "finished"


def test_vectors(tmp_path):
    base = SyncVectorEnv([lambda: Odd(until=5), lambda: Odd(until=5)])
    with runner.record_vector(base, tmp_path, on_error="warn") as envs:
        envs.reset(seed=0)
        for k in range(3):
            envs.step(np.array([0, 1]))
            envs.log("loss", k)
        envs._rows.take_vector = None  # as a mistake in the recorder would fail
        with pytest.warns(RuntimeWarning, match="recording stopped at step 6"):
            envs.step(np.array([0, 1]))
        assert envs.step(np.array([0, 1]))[0].tolist() == [[0, 0], [1, 1]]
        envs.reset()
        envs.log("loss", 3)
    assert only_run(tmp_path).status == "failed"


def test_games(tmp_path):
    with runner.record_parallel(Leaving(), tmp_path, on_error="warn") as game:
        game.reset(seed=0)
        game.step({agent: game.action_space(agent).sample() for agent in game.agents})
        game._rows.take_game = None
        with pytest.warns(RuntimeWarning, match="recording stopped at step 1"):
            game.step({agent: game.action_space(agent).sample() for agent in game.agents})
        game.step({agent: game.action_space(agent).sample() for agent in game.agents})
        game.reset()
    assert only_run(tmp_path).status == "failed"


def test_mistakes_in_arguments_are_raised(tmp_path):
    with pytest.raises(RunnerError, match="on_error: found 'ignore', expected raise or warn"):
        runner.record(Odd(), tmp_path, on_error="ignore")
    with pytest.raises(RunnerError, match="name: found"):
        runner.record(Odd(), tmp_path, name="?", on_error="warn")
    assert not list_runs(tmp_path)


def test_nothing_is_warned_of_without_an_error(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with runner.record(Odd(until=100), tmp_path, on_error="warn") as rec:
            assert train(rec) == 40
    assert only_run(tmp_path).status == "finished"
