"""SQL over runs of all kinds: what it answers, how much it reads for that, and what it refuses."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time

import gymnasium
import numpy as np
import psutil
import pytest
from click.testing import CliRunner
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import runner
from runner.analysis.frames import step_columns
from runner.archive.runs import archive_run
from runner.archive.store import ArchiveStore
from runner.cli import cli
from runner.errors import RunnerError
from runner.query.chunks import opened_tables
from runner.recording.reader import open_recording
from runner.recording.record_store import RecordStore
from runner.runs.resolve import find_run
from tests.runner.loops.making import make, play
from tests.runner.recording.making import LAKE, TAXIS, make_run
from tests.waiting import until


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with jobs, and loops of one environment and of several."""
    folder = tmp_path_factory.mktemp("recordings")
    make_run(folder, TAXIS, recording={"chunk_steps": 256})
    make_run(folder, LAKE)
    for name in ("CartPole-v1", "RoomsText"):
        with runner.record(make(name), folder, name=name) as env:
            list(play(env, 300))
            env.log({"loss": 0.5})
    envs = gymnasium.make_vec("CartPole-v1", 3, vectorization_mode="sync")
    with runner.record_vector(envs, folder, name="vector") as recorded:
        recorded.action_space.seed(2)
        recorded.reset(seed=7)
        for _ in range(60):
            recorded.step(recorded.action_space.sample())
    return folder


@pytest.fixture
def read(monkeypatch):
    """Return the chunks of recordings that were unpacked, as a list of their offsets."""
    chunks, unpacked = [], RecordStore._unpacked

    def counted(self, entry):
        chunks.append(entry.offset)
        return unpacked(self, entry)

    monkeypatch.setattr(RecordStore, "_unpacked", counted)
    return chunks


def rows(folder, query, **options):
    return runner.sql(query, recordings=folder, **options).arrow().to_pylist()


def run_id(folder, name):
    return find_run(name, folder).run_id


def command(folder, *words, code=0):
    result = CliRunner().invoke(cli, ["sql", *words, "--recordings", str(folder)])
    assert result.exit_code == code, result.output
    return result


@pytest.mark.parametrize("name", ["taxis", "lake", "CartPole-v1", "RoomsText", "vector"])
def test_steps_are_those_of_the_recording(folder, name):
    run = find_run(name, folder)
    with open_recording(run.recording) as recording:
        taken = sum(map(len, recording.train.steps.taken()))
        reward = sum(float(block["rewards"].sum()) for block in recording.train.steps.taken())
    query = f"SELECT count(*) n, sum(reward) r FROM steps WHERE run = '{run.run_id}' AND phase = 'train'"
    (row,) = rows(folder, query)
    assert row["n"] == taken
    assert row["r"] == pytest.approx(reward)


@pytest.mark.parametrize("view", ["steps", "episodes", "runs", "marks"])
def test_rows_are_counted_without_their_columns(folder, view):
    (row,) = rows(folder, f"SELECT count(*) AS n FROM {view}")
    assert row["n"] == len(rows(folder, f"SELECT * FROM {view}"))


def test_columns_of_all_runs_are_united_and_null_where_a_run_has_none(folder):
    cart = run_id(folder, "CartPole-v1")
    (row,) = rows(folder, f"SELECT * FROM steps WHERE run = '{cart}' AND step = 7")
    with open_recording(find_run("CartPole-v1", folder).recording) as recording:
        recorded = step_columns(recording, start=7, stop=8)["next_observation"][0]
    assert [row[f"next_observation_{k}"] for k in range(4)] == recorded.tolist()
    assert row["state"] is None
    assert row["action"] == recording_action(folder, 7)
    kinds = rows(folder, "SELECT DISTINCT typeof(next_observation_mission) AS kind FROM steps")
    assert {row["kind"] for row in kinds} == {"VARCHAR"}


def recording_action(folder, step):
    with open_recording(find_run("CartPole-v1", folder).recording) as recording:
        return recording.train.steps.one(step)["action"]


def test_a_question_about_one_episode_reads_its_chunks_alone(folder, read):
    run = find_run("taxis", folder)
    with open_recording(run.recording) as recording:
        chunks, episodes = len(recording.train.steps), sum(len(phase.episodes) for phase in recording.phases)
        wanted = recording.train.episode_steps(33)["step"].tolist()
        steps = recording.train.steps
        numbers = np.searchsorted(steps.chunk_numbers[1], wanted, side="right")
        held = {steps.entry(k).offset for k in numbers.tolist()}
    read.clear()
    query = f"SELECT step FROM steps WHERE run = '{run.run_id}' AND phase = 'train' AND episode = 33"
    assert [row["step"] for row in rows(folder, query)] == wanted
    assert held <= set(read)
    assert len(set(read)) <= len(held) + episodes < chunks


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_conditions_on_episodes_of_a_vector_read_few_chunks_and_lose_no_steps(tmp_path, read, mode):
    envs = SyncVectorEnv([lambda: gymnasium.make("CartPole-v1")] * 3, autoreset_mode=AutoresetMode(mode))
    with runner.record_vector(envs, tmp_path, chunk_steps=256) as rec:
        rec.action_space.seed(2)
        for t in range(600):
            if t % 250 == 0:
                rec.reset(seed=t)
            rec.step(rec.action_space.sample())
    with open_recording(rec.run.recording) as recording:
        chunks, steps = len(recording.train.steps), np.concatenate(list(recording.train.steps.taken()))
    for episode in (0, 1, 9, int(steps["episode"].max())):
        read.clear()
        answer = rows(tmp_path, f"SELECT step FROM steps WHERE episode = {episode} ORDER BY step")
        assert [row["step"] for row in answer] == steps["step"][steps["episode"] == episode].tolist()
        assert len(set(read)) < chunks
    rec.run.update(status="interrupted")
    size = rec.run.recording.stat().st_size
    for part in (0.8, 0.6, 0.4, 0.3):  # it may end with steps whose episodes were lost
        os.truncate(rec.run.recording, int(part * size))
        with open_recording(rec.run.recording) as recording:
            there = np.concatenate([block["episode"] for block in recording.train.steps.taken()])
        least = int(there.max()) - 1
        (answer,) = rows(tmp_path, f"SELECT count(*) AS n FROM steps WHERE episode >= {least}")
        assert answer["n"] == (there >= least).sum()


@pytest.mark.parametrize("episode", [0, 1, 19, 59])
@pytest.mark.parametrize("phase", ["train", "eval"])
def test_conditions_on_episodes_lose_no_steps(folder, phase, episode):
    run = find_run("taxis", folder)
    with open_recording(run.recording) as recording:
        of_phase = recording.phase(phase)
        episode = min(episode, of_phase.episodes.count() - 1)
        wanted = of_phase.episode_steps(episode)["step"].tolist()
    query = (
        f"SELECT step FROM steps WHERE phase = '{phase}' AND episode IN ({episode}) AND run = '{run.run_id}'"
    )
    assert sorted(row["step"] for row in rows(folder, query)) == wanted


def test_a_condition_on_steps_reads_one_chunk(folder, read):
    run = run_id(folder, "taxis")
    query = f"SELECT t FROM steps WHERE run = '{run}' AND phase = 'train' AND step BETWEEN 300 AND 310"
    assert len(rows(folder, query)) == 11
    assert len(set(read)) == 1


def test_small_views(folder):
    runs = rows(folder, "SELECT run, name, tags, created, settings->>'episodes' e FROM runs ORDER BY name")
    assert [row["name"] for row in runs] == ["CartPole-v1", "RoomsText", "lake", "taxis", "vector"]
    assert [row["e"] for row in runs if row["name"] == "lake"] == ["12"]
    evaluations = rows(
        folder, "SELECT evaluation, episode, mean_return FROM evaluations", runs='name == "taxis"'
    )
    frame = runner.frames.evaluations(find_run("taxis", folder))
    assert [row["episode"] for row in evaluations] == frame["episode"].tolist()
    assert rows(folder, "SELECT name, value FROM scalars") == 2 * [{"name": "loss", "value": 0.5}]
    mark = runner.mark(find_run("lake", folder), "3:1", 'it\'s "odd"; DROP', tags=["x"])
    (row,) = rows(folder, "SELECT mark, ref, episode, t, text, tags FROM marks")
    assert row == {"mark": mark.id, "ref": "3:1", "episode": 3, "t": 1, "text": mark.text, "tags": ["x"]}


def test_rows_that_were_read_are_not_read_again(folder):
    result = runner.sql("SELECT run FROM runs", recordings=folder)
    with contextlib.closing(result):
        assert result.arrow().num_rows
        with pytest.raises(RunnerError, match="rows are read once"):
            result.arrow()


def test_forms_of_a_result(folder, tmp_path):
    query = "SELECT run, count(*) AS n, sum(length) AS steps FROM episodes GROUP BY run ORDER BY run"
    table = runner.sql(query, recordings=folder).arrow()
    assert runner.sql(query, recordings=folder).pandas()["steps"].tolist() == table["steps"].to_pylist()
    assert runner.sql(query, recordings=folder).polars()["n"].to_list() == table["n"].to_pylist()
    assert json.loads(command(folder, query, "--json").stdout)["rows"] == table.to_pylist()
    assert command(folder, query, "--csv").stdout.splitlines()[0] == "run,n,steps"
    command(folder, query, "--parquet", str(tmp_path / "n.parquet"))
    assert runner.sql(query, recordings=folder).columns == table.schema
    assert str(table["steps"][0]) in command(folder, query).stdout
    command(folder, query, "--parquet", str(tmp_path / "n.parquet"), code=2)


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("SELECT rewrd FROM steps", '"reward"'),
        ("SELECT * FROM stepz", 'Did you mean "steps"'),
        ("SELEC 1", "syntax error"),
        ("", "found nothing, expected one SELECT"),
        ("SELECT 1; SELECT 2", "found SELECT, SELECT"),
        ("COPY runs TO '{path}'", "found COPY"),
        ("ATTACH '{path}' AS x", "found ATTACH"),
        ("INSTALL httpfs", "found LOAD"),
        ("LOAD httpfs", "found LOAD"),
        ("PRAGMA version", "found PRAGMA"),
        ("SET memory_limit = '9GB'", "found SET"),
        ("CREATE TABLE x AS SELECT 1", "found CREATE"),
        ("EXPORT DATABASE '{path}'", "found EXPORT"),
        ("SELECT * FROM read_csv('/etc/passwd')", "disabled"),
        ("SELECT * FROM read_text('/etc/passwd')", "disabled"),
        ("SELECT * FROM '/etc/passwd'", "does not exist"),
        ("SELECT * FROM read_parquet('https://example.com/x.parquet')", "Error"),
        ("SELECT * FROM glob('/etc/*')", "disabled"),
        ("FROM query('COPY runs TO ''{path}''')", "single SELECT"),
        ("SELECT * FROM rows", "does not exist"),
    ],
)
def test_only_one_select_over_the_views_is_answered(folder, tmp_path, query, message):
    path = tmp_path / "file"
    with pytest.raises(RunnerError, match=r"^sql: ") as error:
        rows(folder, query.replace("{path}", str(path)))
    assert message in str(error.value)
    assert not path.exists()


@pytest.mark.parametrize("form", ["--csv", "--json", "--markdown"])
def test_a_row_that_cannot_be_computed_is_an_error_without_output(folder, form):
    query = "SELECT CASE WHEN step = 3 THEN error('a bad row') ELSE step END AS value FROM steps"
    result = CliRunner().invoke(cli, ["sql", query, form, "--recordings", str(folder)])
    assert (result.exit_code, result.stdout) == (2, "")
    assert "sql: Invalid Input Error: a bad row" in result.stderr
    large = CliRunner().invoke(
        cli, ["sql", "SELECT 1::HUGEINT << 100 AS x", form, "--recordings", str(folder)]
    )
    assert (large.exit_code, large.stdout) == (2, ""), large.stderr


def test_limits_say_how_far_a_query_came(folder):
    with pytest.raises(RunnerError, match=r"stopped after 0\.5 s; .* runs were read"):
        rows(folder, "SELECT count(*) FROM range(100000000000) WHERE hash(range) = 3", timeout=0.5)
    with pytest.raises(RunnerError, match=r"needs more than 50 MB of memory, .* runs were read"):
        rows(folder, "SELECT range FROM range(100000000) ORDER BY hash(range)", memory=50)


def test_a_query_is_stopped_while_runs_are_opened(folder, monkeypatch):
    opened = []

    @contextlib.contextmanager
    def slowly(run):
        opened.append(run)
        time.sleep(0.5)
        with opened_tables(run) as tables:
            yield tables

    monkeypatch.setattr("runner.query.chunks.opened_tables", slowly)
    with pytest.raises(RunnerError, match=r"stopped after 0\.2 s"):
        rows(folder, "SELECT count(*) FROM steps", timeout=0.2)
    assert len(opened) < 3


def waits_for_rows(process):
    """Return whether other threads of a process compute, and its main thread waits for what they find."""
    busy = sum(thread.user_time for thread in process.threads() if thread.id != process.pid)
    return busy > 0.3 and process.status() == psutil.STATUS_SLEEPING


@pytest.mark.skipif(sys.platform != "linux", reason="the state of a main thread is read from /proc")
@pytest.mark.parametrize(
    ("select", "form"), [("count(*)", ()), ("range", ("--csv",))], ids=["before a row", "between rows"]
)
def test_an_interrupted_query_says_how_far_it_came(folder, select, form):
    query = f"SELECT {select} FROM range(100000000000) WHERE range < 100000 OR hash(range) = 3"
    words = [sys.executable, "-m", "runner", "sql", query, "--recordings", str(folder), *form]
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        until(waits_for_rows, lambda: psutil.Process(process.pid))
        process.send_signal(signal.SIGINT)
        assert "runs were read" in process.communicate(timeout=60)[1]
    assert process.returncode == 130


def test_damaged_runs_and_runs_without_steps_are_named(folder, tmp_path):
    copied = shutil.copytree(folder, tmp_path / "recordings")
    taxis, lake = find_run("taxis", copied), find_run("lake", copied)
    with open_recording(taxis.recording) as recording:
        entry = recording.train.steps.entry(3)
    with taxis.recording.open("r+b") as stream:
        stream.seek(entry.offset + entry.length // 2)
        stream.write(b"damage")
    lake.recording.write_bytes(b"nothing of MCAP")
    make_run(copied, LAKE, name="stepless", recording={"steps": "none"})
    result = runner.sql("SELECT run, count(*) FROM steps GROUP BY run", recordings=copied)
    counted = [row["run"] for row in result.arrow().to_pylist()]
    assert lake.run_id not in counted
    left_out = "\n".join(result.left_out)
    for run in (taxis, lake, find_run("stepless", copied)):
        assert f"run {run.run_id} is left out of steps: " in left_out
    assert "rows before the damage were read." in left_out
    output = command(copied, "SELECT count(*) FROM steps").stderr
    assert taxis.run_id in output
    assert "it has no steps" in output


def test_archives_are_read_where_they_are(folder, tmp_path, read):
    copied = shutil.copytree(folder, tmp_path / "recordings")
    queries = (
        "SELECT run, phase, count(*) n, sum(reward) r, max(t) t FROM steps GROUP BY ALL ORDER BY ALL",
        "SELECT * EXCLUDE (run) FROM steps WHERE episode = 5 ORDER BY ALL",
        "SELECT * FROM episodes ORDER BY ALL",
        "SELECT run, count(*) FROM steps GROUP BY ALL ORDER BY ALL",
    )
    before = [rows(copied, query) for query in queries]
    for name in ("taxis", "CartPole-v1", "RoomsText", "vector"):
        archive_run(find_run(name, copied), str(tmp_path / "archive"), remove=True)
    assert [rows(copied, query) for query in queries] == before
    taxis = find_run("taxis", copied)
    shutil.rmtree(ArchiveStore(str(tmp_path / "archive")).place(taxis.run_id))
    result = runner.sql("SELECT count(*) FROM steps", recordings=copied)
    result.arrow()
    assert any(f"{taxis.run_id} is left out of steps" in sentence for sentence in result.left_out)
    read.clear()


def test_columns_that_differ_in_case_alone_are_both_there(tmp_path):
    class Cased(gymnasium.Env):
        observation_space = gymnasium.spaces.Dict(
            {name: gymnasium.spaces.Discrete(9) for name in ("x", "X", 'a "b"')}
        )
        action_space = gymnasium.spaces.Discrete(2)

        def reset(self, *, seed=None, options=None):
            return {"x": np.int64(1), "X": np.int64(2), 'a "b"': np.int64(3)}, {}

        def step(self, action):
            return self.reset()[0], 0.0, True, False, {}

    with runner.record(Cased(), tmp_path, name="cased") as env:
        env.reset(seed=1)
        env.step(0)
    (row,) = rows(tmp_path, "SELECT * FROM steps WHERE next_observation_x > 0")
    assert sorted(row[name] for name in row if name.startswith("next_observation")) == [1, 2, 3]
    (row,) = rows(tmp_path, 'SELECT "next_observation_a ""b""" AS b FROM steps')
    assert row == {"b": 3}
