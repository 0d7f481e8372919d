"""Runs put into an archive and brought back, by the commands, as a user does it."""

from __future__ import annotations

import json
import os
import re
import shutil

import pytest
from click.testing import CliRunner

from runner.archive import layout, writing
from runner.archive.layout import Entry, Manifest
from runner.archive.store import ArchiveStore
from runner.cli import cli
from runner.recording.reader import open_recording
from runner.recording.run_file import owner as this_process
from runner.runs.resolve import find_run
from runner.runs.run import create_run, list_runs
from tests.runner.recording.making import TAXIS, experiment, make_run


@pytest.fixture
def recordings(run, tmp_path):
    """Return a recordings folder of the test's own, with the run."""
    return shutil.copytree(run.folder.parent, tmp_path / "recordings")


@pytest.fixture
def command(recordings):
    def call(*words):
        env = {"DUALTAXI_RECORDINGS": str(recordings), "DUALTAXI_ARCHIVE": "", "NO_COLOR": "1"}
        return CliRunner().invoke(cli, [str(word) for word in words], env=env)

    return call


def done(result):
    assert result.exit_code == 0, result.output
    return result.stdout


def test_archived_and_removed_a_run_is_listed_and_restored_the_same(run, recordings, command):
    before = run.recording.stat().st_size
    result = json.loads(done(command("archive", run.run_id, "--remove", "--json")))
    place = recordings.parent / "archive" / run.run_id
    assert result["place"] == str(place)
    assert result["content_digest"] == run.summary["content_digest"]
    assert result["bytes"] == sum(
        p.stat().st_size for p in place.rglob("*") if p.name != layout.MANIFEST and p.is_file()
    )
    assert result["bytes"] < before
    left = find_run(run.run_id, recordings)
    assert left.status == "archived"
    assert not left.recording.exists()
    assert [row["status"] for row in json.loads(done(command("ls", "--json")))["runs"]] == ["archived"]

    done(command("restore", run.run_id))
    back = find_run(run.run_id, recordings)
    assert back.status == "finished"
    assert not back.archive
    assert (place / layout.MANIFEST).exists()
    assert command("verify", run.run_id).exit_code == 0
    assert command("diff", run.run_id, run.recording).exit_code == 0


@pytest.mark.parametrize(
    "words",
    [
        ("show", "RUN"),
        ("qtable", "RUN", "--state", "3"),
        ("verify", "RUN"),
        ("diff", "RUN", "OTHER"),
        ("report", "RUN", "-o", "DIR/page.html"),
        ("plot", "RUN", "-o", "DIR/plot.svg"),
        ("play", "RUN", "--episode", "1"),
        ("export", "csv", "RUN", "-o", "DIR/tables", "--force"),
        ("export", "parquet", "RUN", "-o", "DIR/columns", "--force"),
        ("export", "tensorboard", "RUN", "-o", "DIR/logs", "--force"),
        ("export", "minari", "RUN", "-o", "DIR/minari", "--force"),
    ],
    ids=lambda words: words[1] if words[0] == "export" else words[0],
)
@pytest.mark.usefixtures("own_folder")
def test_commands_that_read_a_run_read_an_archived_one(words, run, command, tmp_path):
    names = {"RUN": run.run_id, "OTHER": str(run.recording), "DIR": str(tmp_path)}

    def filled(word):
        for name, value in names.items():
            word = word.replace(name, value)
        return word

    done(command("archive", run.run_id, "--remove"))
    first = command(*map(filled, words))
    assert first.exit_code == 0, first.output
    assert f"Run {run.run_id} is archived; restoring it from" in first.stderr
    if words[0] in ("report", "plot"):
        return
    again = command(*map(filled, words))
    assert again.exit_code == 0
    assert "restoring" not in again.stderr
    assert re.sub("begun .* ago", "", again.stdout) == re.sub("begun .* ago", "", first.stdout)


def test_a_dry_run_reports_the_sizes_and_changes_nothing(run, recordings, command):
    result = json.loads(done(command("archive", run.run_id, "--dry-run", "--remove", "--json")))
    assert result["bytes"] > 0
    assert not result["removed"]
    assert not (recordings.parent / "archive").exists()
    assert find_run(run.run_id, recordings).facts == run.facts


def test_an_existing_archive_is_checked_and_not_written(run, command):
    done(command("archive", run.run_id))
    result = json.loads(done(command("archive", run.run_id, "--remove", "--json")))
    assert not result["new"]
    assert result["removed"]


def test_nothing_is_removed_for_an_archive_that_is_damaged(run, recordings, command):
    done(command("archive", run.run_id))
    path = recordings.parent / "archive" / run.run_id / layout.STEPS
    data = bytearray(path.read_bytes())
    data[1000] ^= 1
    path.write_bytes(data)
    result = command("archive", run.run_id, "--remove")
    assert result.exit_code == 2
    assert "steps.parquet" in result.output
    assert find_run(run.run_id, recordings).recording.exists()


def test_a_run_comes_back_from_its_archive_alone(run, recordings, command, tmp_path):
    done(command("archive", run.run_id, "--to", tmp_path / "elsewhere"))
    shutil.rmtree(recordings)
    done(command("restore", tmp_path / "elsewhere" / run.run_id))
    (back,) = list_runs(recordings)
    assert (back.run_id, back.status) == (run.run_id, "finished")
    assert back.summary["content_digest"] == run.summary["content_digest"]
    again = command("restore", tmp_path / "elsewhere" / run.run_id)
    assert again.exit_code == 2
    assert "found a run of that id" in again.output


def test_recordings_and_archive_may_move_together(run, recordings, command, tmp_path):
    done(command("archive", run.run_id, "--remove"))
    moved = tmp_path / "moved"
    moved.mkdir()
    recordings.rename(moved / "recordings")
    (tmp_path / "archive").rename(moved / "archive")
    done(command("restore", run.run_id, "--recordings", moved / "recordings"))
    shutil.rmtree(moved / "archive")
    done(command("archive", run.run_id, "--remove", "--recordings", moved / "recordings"))
    shutil.rmtree(moved / "archive")
    lost = command("show", run.run_id, "--recordings", moved / "recordings")
    assert lost.exit_code == 2
    assert "found no archive at" in lost.output


def test_rm_reports_whether_the_archive_exists(run, recordings, command):
    done(command("archive", run.run_id, "--remove"))
    place = recordings.parent / "archive" / run.run_id
    remove = ("rm", run.run_id, "--dry-run")
    assert f"The archive of {run.run_id} at {place} stays." in command(*remove).output
    place.rename(recordings.parent / "mislaid")
    assert f"was archived at {place}, but is not there: nothing of it will be left" in command(*remove).output


def test_a_running_run_and_an_archived_one_are_refused(run, recordings, command):
    config = experiment(TAXIS)
    running = create_run(recordings, config, 0)
    result = command("archive", running.run_id)
    assert result.exit_code == 2
    assert "is running" in result.output
    done(command("archive", run.run_id, "--remove"))
    assert f"is archived already, in {recordings.parent}" in command("archive", run.run_id).output
    for words in (("archive", run.run_id), ("resume", run.run_id), ("rerecord", run.run_id)):
        result = command(*words)
        assert result.exit_code == 2
        assert "is archived" in result.output
    done(command("restore", run.run_id))
    assert "is not archived" in command("restore", run.run_id).output


def test_archiving_several_runs_skips_those_that_are_archived_already(run, recordings, command):
    other = make_run(recordings, TAXIS, seed=1)
    done(command("archive", run.run_id, "--remove"))
    result = command("archive", run.run_id, other.run_id, "--remove")
    assert f"Run {run.run_id} is archived already" in result.stderr
    assert other.run_id in done(result)
    assert find_run(other.run_id, recordings).status == "archived"


def test_a_damaged_recording_is_refused_and_repair_is_named(run, recordings, command):
    recording = recordings / run.run_id / "recording.mcap"
    with open_recording(recording) as opened:
        place = opened.train.steps.entry(0).offset + 100
    data = bytearray(recording.read_bytes())
    data[place] ^= 255
    recording.write_bytes(data)
    result = command("archive", run.run_id)
    assert result.exit_code == 2
    assert result.output.count("`dualtaxi repair") == 1
    assert not (recordings.parent / "archive" / run.run_id).exists()


def test_a_killed_run_is_archived_and_restored(run, recordings, command):
    """Its `run.json` says for ever that it is running, by a process that is gone."""
    folder = recordings / run.run_id
    with open_recording(folder / "recording.mcap") as recording:
        chunks = recording.file.index.chunks
        cut = sum(chunks[len(chunks) - 6][:2])
    left = (folder / "recording.mcap").read_bytes()[: cut + 11]
    (folder / "recording.mcap").write_bytes(left)
    stored = json.loads((folder / "run.json").read_text())
    owner = {**this_process(), "process_started": -1.0}
    (folder / "run.json").write_text(
        json.dumps(stored | {"status": "running", "owner": owner, "summary": {}})
    )
    with open_recording(folder / "recording.mcap") as recording:
        came = {"episodes": recording.train.episodes.count()}
        came["train_steps"] = recording.train.steps.count()
    (before,) = json.loads(done(command("ls", "--json")))["runs"]
    assert {key: before[key] for key in came} == came
    done(command("archive", run.run_id, "--remove"))
    done(command("index", "rebuild"))
    (row,) = json.loads(done(command("ls", "--json")))["runs"]
    assert row["status"] == "archived"
    assert {key: row[key] for key in came} == came
    done(command("show", run.run_id))
    assert f"steps   {came['train_steps']:,} of training" in done(command("restore", run.run_id))
    back = find_run(run.run_id, recordings)
    assert back.status == "interrupted"
    assert back.recording.exists()
    assert "existed already" in done(command("archive", run.run_id, "--remove"))
    assert not back.recording.exists()


def test_another_archive_of_the_same_id_is_left_alone(run, recordings, command):
    done(command("archive", run.run_id))
    facts = json.loads((recordings / run.run_id / "run.json").read_text())
    place = recordings.parent / "archive" / run.run_id
    stored = json.loads((place / layout.MANIFEST).read_text())
    other = Manifest({**stored["run"], "content_digest": "0" * 64}, {"/log": Entry(1, "0" * 64)})
    (place / layout.MANIFEST).write_bytes(other.to_json())
    result = command("archive", run.run_id, "--remove")
    assert result.exit_code == 2
    assert "an archive of this run with other content" in result.output
    assert json.loads((recordings / run.run_id / "run.json").read_text()) == facts


def test_a_target_that_cannot_be_written_leaves_nothing(run, recordings, command, tmp_path):
    (tmp_path / "file").write_text("")
    result = command("archive", run.run_id, "--to", tmp_path / "file", "--remove")
    assert result.exit_code == 2
    assert "cannot be written" in result.output
    assert find_run(run.run_id, recordings).status == "finished"
    result = command("archive", run.run_id, "--to", "ftp://host/there")
    assert result.exit_code == 2
    assert "expected a folder or s3://" in result.output


def test_a_disk_that_fills_up_leaves_no_archive(run, recordings, command, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(writing.TableWriter, "flush", full)
    result = command("archive", run.run_id, "--remove")
    assert result.exit_code == 1
    assert "No space left on device" in result.output
    assert list((recordings.parent / "archive").iterdir()) == []
    assert find_run(run.run_id, recordings).status == "finished"


def test_the_rest_of_an_interrupted_archiving_is_no_archive_and_is_replaced(run, recordings, command):
    left = recordings.parent / "archive" / ".partial" / run.run_id
    left.mkdir(parents=True)
    (left / layout.STEPS).write_text("half")
    half = recordings.parent / "archive" / run.run_id
    half.mkdir()
    (half / layout.STEPS).write_text("half")
    assert command("restore", half).exit_code == 2
    done(command("archive", run.run_id, "--remove"))
    done(command("restore", run.run_id))
    assert not left.exists()


def test_two_processes_do_not_write_the_same_archive_at_once(run, recordings, command):
    to = recordings.parent / "archive"
    with ArchiveStore(str(to)).writing(run.run_id) as folder:
        result = command("archive", run.run_id, "--remove")
        assert result.exit_code == 2
        assert "another process is writing this archive" in result.output
        assert folder.is_dir()
        with open_recording(run.recording) as recording:
            writing.write_archive(recording, folder)
    assert "existed already" in done(command("archive", run.run_id, "--remove"))
    assert [path.name for path in to.iterdir()] == [run.run_id]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no named pipes")
def test_a_pipe_in_place_of_a_manifest_is_refused(run, recordings, command):
    place = recordings.parent / "archive" / run.run_id
    place.mkdir(parents=True)
    os.mkfifo(place / layout.MANIFEST)
    result = command("archive", run.run_id)
    assert result.exit_code == 1
    assert "it is not a regular file" in result.output


def test_a_renamed_run_keeps_its_name_where_only_its_archive_is_left(run, recordings, command):
    done(command("label", run.run_id, "--name", "patient"))
    done(command("archive", run.run_id))
    shutil.rmtree(recordings / run.run_id)
    done(command("restore", recordings.parent / "archive" / run.run_id))
    assert find_run(run.run_id, recordings).name == "patient"
