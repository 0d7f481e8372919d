"""`dualtaxi ls`."""

import errno
import json
import os
from pathlib import Path

import pytest

from runner.api import experiment_of
from runner.config import from_mapping
from runner.runs.run import RUN_FILE, create_run


def test_json_lists_the_runs(recorded, recorded_run):
    (values,) = recorded.json("ls")["runs"]
    assert values["run_id"] == recorded_run.run_id
    assert (values["name"], values["config"], values["seed"]) == ("tiny", "tiny", 3)
    assert (values["status"], values["episodes"], values["episodes_to_do"]) == ("finished", 30, 30)
    assert values["bytes"] == recorded_run.recording.stat().st_size
    assert values["success_percent"] == recorded_run.summary["last_evaluation"]["success_percent"]


def test_text_lists_the_runs(recorded, recorded_run):
    heading, line = recorded("ls").stdout.splitlines()
    assert " ".join(heading.split()) == "id name seed status episodes success % return size age"
    assert line.split()[:5] == [recorded_run.run_id, "tiny", "3", "finished", "30"]


def test_a_run_of_another_name_shows_its_configuration(command, tiny):
    command("run", tiny, "--name", "mine")
    heading, line = command("ls").stdout.splitlines()
    assert heading.split()[:3] == ["id", "name", "config"]
    assert line.split()[1:3] == ["mine", "tiny"]


def test_the_newest_comes_first(command, tiny):
    ids = [command.json("run", tiny, "--seed", seed)["run_id"] for seed in (1, 2)]
    assert [run["run_id"] for run in command.json("ls")["runs"]] == ids[::-1]


@pytest.mark.parametrize("made", [False, True])
def test_no_runs_yet(command, made):
    if made:
        command.recordings.mkdir()
    result = command("ls")
    assert (result.exit_code, result.stdout) == (0, "")
    assert "No runs" in result.stderr
    assert command.json("ls")["runs"] == []


def test_a_run_without_a_recording_and_a_running_one(command, tiny):
    running = create_run(command.recordings, experiment_of(tiny), 3)
    died = create_run(command.recordings, experiment_of(tiny), 4)
    died.update(owner=died.facts["owner"] | {"process_started": 1.0})
    values = {run["run_id"]: run["status"] for run in command.json("ls")["runs"]}
    assert values == {running.run_id: "running", died.run_id: "interrupted"}
    assert command("ls").exit_code == 0
    assert "– of 30" in command("ls").stdout


@pytest.mark.parametrize("content", ["", "{}", "[1]", '{"run_id": 3}', "\xff", '{"created": "yesterday"}'])
def test_other_files_are_ignored(command, tiny, content):
    (command.recordings / "stray").mkdir(parents=True)
    (command.recordings / "stray" / RUN_FILE).write_text(content, encoding="latin-1")
    (command.recordings / "note.txt").write_text("mine")
    assert command.json("ls")["runs"] == []


def test_a_folder_whose_files_cannot_be_read_is_named(command, tiny):
    run = create_run(command.recordings, experiment_of(tiny), 3)
    (run.folder / RUN_FILE).write_text("{")
    run.recording.write_bytes(b"no recording")
    for form in ((), ("--quiet",), ("--json",)):
        done = command("ls", *form)
        assert done.exit_code == 0
        assert f"{run.folder}: neither run.json nor recording.mcap can be read as a run." in done.stderr


def test_a_run_in_a_folder_without_rights_is_not_found(command, tiny, monkeypatch):
    run = create_run(command.recordings, experiment_of(tiny), 3)
    (run.folder / RUN_FILE).unlink()
    stat = Path.stat

    def refused(path, **keywords):
        if path == run.recording:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return stat(path, **keywords)

    monkeypatch.setattr(Path, "stat", refused)  # root may read every folder
    done = command("show", run.run_id)
    assert done.exit_code == 2
    assert f"no run '{run.run_id}'" in done.stderr


def test_values_of_the_wrong_kind_make_a_damaged_run(command, tiny):
    run = create_run(command.recordings, experiment_of(tiny), 3)
    for key, wrong in (("created", "soon"), ("seed", "x"), ("summary", []), ("config", 3), ("owner", "me")):
        (run.folder / RUN_FILE).write_text(json.dumps(run.facts | {"status": "finished", key: wrong}))
        (values,) = command.json("ls")["runs"]
        assert (values["run_id"], values["status"]) == (run.run_id, "damaged"), key


def test_the_folder_may_be_given(recorded, recorded_run, command):
    assert command.json("ls", "--recordings", recorded.recordings)["runs"][0]["run_id"] == recorded_run.run_id


def test_a_missing_recordings_folder(command, tmp_path):
    command.recordings = tmp_path / "file"
    command.recordings.write_text("")
    result = command("ls")
    assert result.exit_code == 2
    assert "cannot be read" in result.stderr


def test_the_folder_is_the_working_directorys_by_default(recorded_run, tmp_path, monkeypatch):
    from click.testing import CliRunner

    from runner.cli import cli

    monkeypatch.chdir(recorded_run.folder.parent.parent)
    monkeypatch.delenv("DUALTAXI_RECORDINGS", raising=False)
    assert recorded_run.run_id in CliRunner().invoke(cli, ["ls"]).stdout
    assert os.environ.get("DUALTAXI_RECORDINGS") is None


@pytest.mark.parametrize("words", [("-q", "--json"), ("--quiet", "--csv"), ("--csv", "--json")])
def test_two_forms_exclude_each_other(recorded, words):
    done = recorded("ls", *words)
    assert done.exit_code == 2
    names = " and ".join(words).replace("-q ", "--quiet ")
    assert f"{names} exclude each other: choose one." in done.stderr


def test_json_of_no_run_and_of_two_is_a_named_list(command):
    assert command.json("ls")["runs"] == []
    runs = [create_run(command.recordings, from_mapping({"name": "some", "episodes": 5}), n) for n in (1, 2)]
    assert {run["run_id"] for run in command.json("ls")["runs"]} == {run.run_id for run in runs}
    assert (
        len(command.json("ls", "--offset", "1")["runs"])
        == len(command.json("ls", "--limit", "1")["runs"])
        == 1
    )


@pytest.mark.parametrize("words", [("ls",), ("du",), ("prune", "--keep-last", "1"), ("index", "rebuild")])
def test_a_folder_that_does_not_exist_is_refused(command, tmp_path, words):
    done = command(*words, "--recordings", tmp_path / "nowhere")
    assert done.exit_code == 2
    assert "nowhere' does not exist" in done.stderr
    assert "No runs in" in command("ls").stderr  # nobody named this folder, and nobody recorded yet
