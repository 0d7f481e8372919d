"""Commands for interrupted and damaged runs, and for their tables."""

from __future__ import annotations

import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from mcap.reader import make_reader
from mcap.writer import Writer

from runner.cli import cli
from runner.recording import schema
from runner.recording.integrity import survey
from runner.recording.reader import open_recording
from runner.recording.run_file import owner
from runner.replay.tables import tables_at
from runner.runs.run import Run, list_runs
from tests.runner.altering import altered

COMMANDS = ("resume", "rerecord", "evaluate", "verify", "repair", "qtable")


@pytest.fixture
def copied(recorded_run, command) -> Run:
    """A copy of the recorded run, alone in the command's folder, to be changed."""
    shutil.copytree(recorded_run.folder, command.recordings / recorded_run.run_id)
    (run,) = list_runs(command.recordings)
    return run


def cut(run: Run, share: float = 0.95) -> Run:
    """Return a run as a kill leaves it."""
    os.truncate(run.recording, int(share * run.recording.stat().st_size))
    return run.update(status="running", owner={"host": "gone"}, summary={}) and _aged(run)


def _aged(run: Run) -> Run:
    os.utime(run.folder / "run.json", (0, 0))
    return run


def flip(path: Path) -> None:
    """Invert a byte in the first chunk of training steps."""
    chunk = next(one for one in survey(path).chunks if one.channel == schema.TRAIN_STEP.channel)
    data = bytearray(path.read_bytes())
    data[chunk.offset + chunk.length // 2] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("name", COMMANDS)
def test_missing_runs(command, name):
    for missing in ("nothing", "nothing.mcap", "@latest", "some/where"):
        result = command(name, missing)
        assert result.exit_code == 2
        assert result.stderr.startswith("Error: ")
        assert not result.stdout


@pytest.mark.parametrize("name", ["verify", "repair", "qtable"])
def test_a_file_of_another_writer(command, tmp_path, name):
    path = tmp_path / "other.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.finish()
    before = path.read_bytes()
    result = command(name, path)
    assert result.exit_code == 2
    assert "not a dualtaxi recording" in result.stderr
    assert path.read_bytes() == before


# --- resume -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["verify", "repair", "play", "qtable", "plot"])
def test_a_run_that_was_killed_before_it_had_a_recording(command, copied, name):
    copied.recording.unlink()
    copied.update(status="interrupted", summary={})
    result = command(name, copied.run_id)
    assert result.exit_code == 2
    assert f"`dualtaxi resume {copied.run_id}` trains it from the beginning" in result.stderr


def test_the_hint_for_a_missing_recording_depends_on_the_run(command, copied):
    copied.recording.unlink()
    assert command.json("show", copied.run_id)["status"] == "finished"
    loop = copied.update(config={"made_by": "runner.record"})
    assert "only the loop that recorded it" in command("play", loop.run_id).stderr
    copied.update(status="running", owner=owner())
    assert "it has just begun" in command("play", copied.run_id).stderr


def test_ls_shows_the_progress_of_a_killed_run(command, copied):
    cut(copied, 0.7)
    (values,) = command.json("ls")["runs"]
    with open_recording(copied.recording) as recording:
        assert values["episodes"] == recording.train.episodes.count() < values["episodes_to_do"]
    assert f"{values['episodes']:,} of {values['episodes_to_do']:,}" in command("ls").stdout
    copied.recording.write_bytes(b"nothing that can be read")
    assert command.json("ls")["runs"][0]["episodes"] is None


def test_a_run_is_printed_with_the_path_it_was_found_by(command, copied, monkeypatch):
    monkeypatch.chdir(command.recordings.parent)
    cut(copied)
    words = ["resume", "@latest", "--recordings", command.recordings.name]
    output = CliRunner().invoke(cli, words).stdout
    assert str(Path(command.recordings.name, copied.run_id)) in output
    assert str(command.recordings) not in output


def test_resume(command, copied, recorded_run):
    cut(copied)
    assert command.json("ls")["runs"][0]["status"] == "interrupted"
    values = command.json("resume", "@latest")
    assert values["status"] == "finished"
    assert values["content_digest"] == recorded_run.summary["content_digest"]
    assert command.json("ls")["runs"][0]["status"] == "finished"


def test_resume_as_text(command, copied):
    cut(copied)
    result = command("resume", copied.run_id[:4])
    assert result.exit_code == 0
    assert "finished" in result.stdout
    assert f"dualtaxi show {copied.run_id}" in result.stdout
    (line,) = result.stderr.splitlines()
    assert re.fullmatch(
        r"Resumed after \d+ episodes: what was recorded is trained again first, and compared\.", line
    )


def test_nothing_to_resume(command, copied):
    before = copied.recording.read_bytes()
    result = command("resume", "@latest")
    assert result.exit_code == 0
    assert "there is nothing to do" in result.stderr
    assert not result.stdout
    assert command.json("resume", "@latest")["status"] == "finished"
    assert copied.recording.read_bytes() == before


def test_resume_refuses_a_living_run(command, copied):
    from runner.runs.run import owner

    copied.update(status="running", owner=owner())
    for name in ("resume", "verify", "repair", "rerecord"):
        result = command(name, "@latest")
        assert result.exit_code == 2
        assert "is running" in result.stderr


def test_accepted_changes(command, copied, monkeypatch):
    from runner.runs import provenance

    here = provenance.provenance()
    monkeypatch.setattr(provenance, "provenance", lambda: here | {"dualtaxi": "9.9"})
    cut(copied)
    result = command("resume", "@latest")
    assert result.exit_code == 2
    assert "9.9 now" in result.stderr
    assert "--accept-changes" in result.stderr
    assert command.json("ls")["runs"][0]["status"] == "interrupted"
    assert command("resume", "@latest", "--accept-changes").exit_code == 0


# --- verify -----------------------------------------------------------------------------------------------


def test_verify(recorded, recorded_run):
    for name in ("@latest", recorded_run.name, recorded_run.folder, recorded_run.recording):
        values = recorded.json("verify", name)
        assert values["verdict"] == "reproduced"
        assert values["content_digest"] == recorded_run.summary["content_digest"]
    result = recorded("verify", "@latest", "--rerun")
    assert result.exit_code == 0
    assert "reproduced: retrained with the installed environment: " in result.stdout
    assert not result.stderr


def test_verify_names_what_is_wrong(command, copied, tmp_path):
    def change(records):
        records["rewards"][50] = 12.5
        return records

    path = altered(copied.recording, tmp_path / "x.mcap", schema.TRAIN_STEP, change)
    result = command("verify", path, "--json")
    assert result.exit_code == 1
    values = json.loads(result.stdout)
    assert values["verdict"] == "differs"
    assert values["difference"] | {"expected": None} == {
        "topic": "/train/step",
        "episode": 1,
        "step": 50,
        "field": "rewards",
        "found": [12.5, 12.5],
        "expected": None,
    }
    result = command("verify", path, "--rerun")
    assert result.exit_code == 1
    assert "differs: " in result.stdout
    assert "/train/step, episode 1, step 50: rewards: found [12.5, 12.5], expected [" in result.stdout


# --- repair -----------------------------------------------------------------------------------------------


def test_repair_of_a_killed_run(command, copied):
    cut(copied)
    result = command("repair", "@latest", "--json")
    assert result.exit_code == 1  # what was being written is gone
    shown = json.loads(result.stdout)
    assert not shown["lossless"]
    assert not shown["lost"]
    assert shown["lost_bytes"] > 0
    with copied.recording.open("rb") as stream:
        summary = make_reader(stream, validate_crcs=True).get_summary()
    assert sum(shown["kept"].values()) == summary.statistics.message_count
    assert command("repair", "@latest").exit_code == 0
    assert "nothing to do" in command("repair", "@latest").stdout
    assert command("verify", "@latest").exit_code == 0
    assert command("resume", "@latest").exit_code == 0


def test_repair_lists_losses_and_resume_restores_them(command, copied, recorded_run):
    flip(copied.recording)
    damaged = copied.recording.read_bytes()
    result = command("repair", copied.run_id)
    assert result.exit_code == 1
    assert "training steps 0 to " in result.stdout
    assert f"dualtaxi resume {copied.run_id}" in result.stdout
    (kept,) = copied.folder.glob("*.damaged-1.mcap")
    assert kept.read_bytes() == damaged
    assert command.json("ls")["runs"][0]["status"] == "interrupted"
    assert command("show", copied.run_id).exit_code == 0
    assert command("verify", copied.run_id).exit_code == 1
    again = command("repair", copied.run_id)
    assert again.exit_code == 1
    assert "repaired before" in again.stdout
    assert "training steps 0 to " in again.stdout
    assert f"dualtaxi resume {copied.run_id}" in again.stdout
    assert command("qtable", copied.run_id, "--step", 5).exit_code == 2
    values = command.json("resume", copied.run_id)
    assert values["content_digest"] == recorded_run.summary["content_digest"]
    assert command("verify", copied.run_id).exit_code == 0


def test_verify_says_that_schemas_may_be_of_another_version(command, copied):
    data = copied.recording.read_bytes()
    copied.recording.write_bytes(data.replace(b"penalties", b"penaltieS"))
    result = command("verify", copied.run_id)
    assert result.exit_code == 1
    assert "the recording is of another version or program, or damaged there" in result.stdout


def test_after_a_repair_show_and_ls_say_what_is_left(command, copied):
    before = command.json("show", copied.run_id)
    os.truncate(copied.recording, int(0.6 * copied.recording.stat().st_size))
    command("repair", copied.run_id)
    with open_recording(copied.recording) as recording:
        left = recording.done()
    assert left["eval_steps"] < before["eval_steps"]
    shown, (row,) = command.json("show", copied.run_id), command.json("ls")["runs"]
    assert {key: shown[key] for key in left} == left
    assert {key: row[key] for key in left} == left
    assert shown["content_digest"] is row["content_digest"] is None
    assert shown["seconds"] == before["seconds"]


def test_repair_by_path_when_nothing_opens(command, copied, tmp_path):
    path = tmp_path / "alone.mcap"
    data = bytearray(copied.recording.read_bytes())
    data[-40] ^= 1  # the summary's checksum
    path.write_bytes(data)
    assert command("qtable", path).exit_code == 2
    assert command("verify", path).exit_code == 1
    values = command.json("repair", path)
    assert values["lossless"]
    assert command("verify", path).exit_code == 0
    assert {one.name for one in tmp_path.iterdir()} == {"alone.mcap", "recordings"}
    (copied.folder / "run.json").unlink()
    copied.recording.write_bytes(data)
    assert command("repair", copied.run_id).exit_code == 0
    assert command("verify", copied.run_id).exit_code == 0


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"hello"])
def test_an_irreparable_file_is_left_as_it_is(command, tmp_path, content):
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    result = command("repair", path)
    assert result.exit_code == 2
    assert result.stderr.startswith("Error: ")
    assert path.read_bytes() == content
    assert [one.name for one in tmp_path.iterdir()] == ["x.mcap"]


# --- qtable -----------------------------------------------------------------------------------------------


def test_qtable(recorded, recorded_run, tmp_path):
    out = tmp_path / "table.npy"
    result = recorded("qtable", recorded_run.recording, "--step", 300, "-o", out)
    assert result.exit_code == 0
    assert "after 300 training steps" in result.stdout
    with open_recording(recorded_run.recording) as recording:
        expected = tables_at(recording, 300)
        assert np.load(out).tobytes() == np.array(expected).tobytes()
        ended = int(recording.train.episodes.array(9, 10)[0]["last_step"]) + 1
    assert recorded.json("qtable", "@latest", "--episode", 10)["step"] == ended
    assert recorded.json("qtable", "@latest")["step"] == recorded_run.summary["train_steps"]


def test_qtable_replaces_a_file_only_with_force(recorded, tmp_path):
    out = tmp_path / "mine"
    out.write_text("mine")
    result = recorded("qtable", "@latest", "-o", out)
    assert result.exit_code == 2
    assert "--force" in result.stderr
    assert out.read_text() == "mine"
    (file,) = recorded.json("qtable", "@latest", "-o", out, "--force")["files"]
    assert file["path"] == str(out)
    assert np.load(out).dtype == np.float64
    assert list(tmp_path.iterdir()) == [out]


def test_qtable_of_a_state(recorded, recorded_run):
    with open_recording(recorded_run.recording) as recording:
        step = next(recording.train.steps.blocks())[0]
        state, action = int(step["state"]), int(step["action"])
    shown = recorded.json("qtable", "@latest", "--state", state, "--step", 1)
    assert shown["visits"] == 1
    assert "taxi 1" in shown["state_in_words"]
    assert [one["agent"] for one in shown["values"]] == ["taxi_1"] * 6 + ["taxi_2"] * 6
    visited = [one for one in shown["values"] if one["visits"]]
    assert [one["action"] for one in visited] == [action // 6, action % 6]
    assert all(one["changed_step"] in (0, None) for one in shown["values"])
    assert sum(one["greedy"] for one in shown["values"]) == 2
    result = recorded("qtable", "@latest", "--state", state)
    assert "drop-off" in result.stdout
    assert "greedy" in result.stdout


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--step", 10**9), "expected at least 1,000,000,000"),
        (("--episode", 31), "found 30 training episodes"),
        (("--episode", 99_999), "expected at least 99,999"),
        (("--state", 10**7), "found '10000000', expected a state"),
        (("--step", 1, "--episode", 1), "choose one"),
        (("--step", -1), "-1"),
        (("-o", "/dev/null/table.npy"), "/dev/null is a file, expected a folder"),
    ],
)
def test_qtable_of_missing_states_and_steps(recorded, words, message):
    result = recorded("qtable", "@latest", *words)
    assert result.exit_code == 2
    assert message in result.stderr
    assert not result.stdout


# --- evaluate and rerecord ---------------------------------------------------------------------------------


def test_evaluate(command, copied):
    values = command.json("evaluate", copied.run_id, "--step", 200, "--trials", 7, "--seed", 5)
    assert values["origin"] == {"run": copied.run_id, "step": 200}
    assert values["episodes"] == 0
    assert values["seed"] == 5
    assert command.json("verify", values["run_id"])["verdict"] == "reproduced"
    assert command("play", values["run_id"], "--eval", "0:6").exit_code == 0
    result = command("evaluate", copied.run_id, "--trials", 3)
    assert f"of run {copied.run_id} after {copied.summary['train_steps']:,} training steps" in result.stdout
    assert len(list_runs(command.recordings)) == 3


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--start", "each", "--trials", 3), "leave out --trials"),
        (("--step", 10**9), "expected at least"),
        (("--start", 10**7), "start: found state 10000000, expected one of 0 to 6143."),
        (("--seed", -1), "-1"),
    ],
)
def test_invalid_evaluations_are_refused(command, copied, words, message):
    result = command("evaluate", copied.run_id, *words)
    assert result.exit_code == 2
    assert message in result.stderr
    assert len(list_runs(command.recordings)) == 1


def test_rerecord(command, tiny):
    before = command.json("run", tiny, "--set", "recording.steps=none")
    refused = command("qtable", "@latest", "--step", 5)
    assert refused.exit_code == 2
    assert "`dualtaxi rerecord`" in refused.stderr
    values = command.json("rerecord", "@latest")
    assert values["content_digest"] == before["content_digest"]
    assert values["bytes"] > before["bytes"]
    assert command("play", "@latest").exit_code == 0
    again = command("rerecord", "@latest")
    assert again.exit_code == 0
    assert "nothing to do" in again.stderr
