"""A run exported to one MCAP file and imported elsewhere is the same run, on request without names."""

from __future__ import annotations

import getpass
import json
import os
import re
import shlex
import shutil
import socket
from dataclasses import replace
from pathlib import Path

import gymnasium
import pytest
from click.testing import CliRunner
from mcap.reader import make_reader
from mcap.records import Attachment, Message, Metadata
from mcap.stream_reader import StreamReader

import runner
from runner.cli import cli
from runner.errors import RecordingError, RunnerError
from runner.execution.resume import resume
from runner.execution.verify import verify
from runner.export.mcap import export_mcap
from runner.recording import schema
from runner.recording.labels import Labels, change_labels, read_labels
from runner.recording.reader import open_recording
from runner.recording.rewriting import rewrite
from runner.runs.importing import Occupied, import_recording
from runner.runs.resolve import find_run
from runner.runs.run import list_runs
from tests.runner.recording.making import LAKE, make_run


def copy_of(run, folder, **facts):
    """Return a copy of a run in another folder of runs, with other facts."""
    shutil.copytree(run.folder, folder / run.run_id)
    return find_run(f"{folder / run.run_id}", folder).update(**facts)


def cut_off(run, folder, missing):
    """Return a copy of a run that was killed: its file is cut off, and its run.json still says `running`."""
    killed = copy_of(run, folder, status="running", summary={}, owner={"host": "elsewhere"})
    os.utime(killed.folder / "run.json", (0, 0))
    killed.recording.write_bytes(killed.recording.read_bytes()[:-missing])
    return killed


def test_an_imported_run_equals_the_exported_one(taxis, tmp_path):
    file = export_mcap(taxis, tmp_path / "a.mcap").path
    imported = import_recording(file, tmp_path / "theirs").run
    assert imported.recording.read_bytes() == taxis.recording.read_bytes()
    ours = ("owner", "provenance")
    assert {key: value for key, value in taxis.facts.items() if key not in ours} == {
        key: value for key, value in imported.facts.items() if key not in ours
    }
    assert imported.status == "finished"
    assert imported.folder == tmp_path / "theirs" / taxis.run_id
    assert verify(imported.recording).sound
    assert sorted(path.name for path in imported.folder.iterdir()) == ["recording.mcap", "run.json"]
    assert list_runs(tmp_path / "theirs") == [imported]


def test_the_same_run_gives_the_same_file_wherever_it_lies(lake, tmp_path):
    first = export_mcap(lake, tmp_path / "a.mcap").path
    there = import_recording(first, tmp_path / "theirs").run
    assert export_mcap(there, tmp_path / "b.mcap").path.read_bytes() == first.read_bytes()


def test_every_mcap_reader_opens_the_file_and_finds_the_labels(lake, tmp_path):
    labelled = copy_of(lake, tmp_path / "mine")
    change_labels(labelled.folder, lambda _: Labels("lake at night", ("good",), "see figure 3"))
    file = export_mcap(labelled, tmp_path / "a.mcap").path
    with file.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_summary().statistics.message_count == sum(1 for _ in reader.iter_messages())
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    assert json.loads(metadata["export"]["json"])["labels"] == {
        "name": "lake at night",
        "tags": ["good"],
        "note": "see figure 3",
    }
    there = import_recording(file, tmp_path / "theirs").run
    assert read_labels(there.folder) == read_labels(labelled.folder)
    assert there.name == "lake at night"
    assert there.facts["name"] == "lake"


def test_a_bare_recording_is_imported_too(lake, tmp_path):
    imported = import_recording(lake.recording, tmp_path / "theirs").run
    assert imported.recording.read_bytes() == lake.recording.read_bytes()
    assert imported.status == "finished"


def test_the_path_of_an_imported_run_begins_with_the_folder_as_given(lake, tmp_path, monkeypatch):
    file = export_mcap(lake, tmp_path / "a.mcap").path
    monkeypatch.chdir(tmp_path)
    folders = [import_recording(file, Path("theirs")).run.folder for _ in range(2)]
    assert folders == [Path("theirs", lake.run_id)] * 2


def test_a_resumed_import_leaves_the_imported_file_as_it_was(taxis, tmp_path):
    file = cut_off(taxis, tmp_path / "mine", 20_000).recording
    before = file.read_bytes()
    imported = import_recording(file, tmp_path / "theirs").run
    assert resume(imported).status == "finished"
    assert file.read_bytes() == before


def test_importing_twice_writes_nothing_the_second_time(lake, tmp_path):
    file = export_mcap(lake, tmp_path / "a.mcap").path
    assert not import_recording(file, tmp_path / "theirs").already
    folder = tmp_path / "theirs" / lake.run_id
    before = {path: path.stat().st_mtime_ns for path in [folder, *folder.iterdir()]}
    assert import_recording(file, tmp_path / "theirs").already
    assert {path: path.stat().st_mtime_ns for path in [folder, *folder.iterdir()]} == before


def test_a_run_read_from_its_archive_is_exported_with_its_labels(lake, tmp_path):
    there = copy_of(lake, tmp_path / "mine", archive={"target": "elsewhere"})
    change_labels(there.folder, lambda _: Labels("mine", ("keep",), "why"))
    restored = there.recording.rename(tmp_path / f"{lake.run_id}-restored.mcap")
    file = export_mcap(replace(there, restored=restored), tmp_path / "a.mcap").path
    imported = import_recording(file, tmp_path / "theirs").run
    assert read_labels(imported.folder) == Labels("mine", ("keep",), "why")


def test_an_existing_file_is_replaced_only_by_force(lake, tmp_path):
    target = tmp_path / "a.mcap"
    target.write_bytes(b"mine")
    with pytest.raises(RunnerError, match="--force"):
        export_mcap(lake, target)
    assert target.read_bytes() == b"mine"
    export_mcap(lake, target, force=True)
    assert target.read_bytes() != b"mine"
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


def test_a_run_of_the_same_id_and_other_content_stays(lake, taxis, tmp_path):
    file = export_mcap(lake, tmp_path / "a.mcap").path
    other = copy_of(taxis, tmp_path / "mine", run_id=lake.run_id)
    with pytest.raises(Occupied):
        import_recording(file, tmp_path / "mine")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == [taxis.run_id]
    new = import_recording(file, tmp_path / "mine", as_new=True).run
    assert new.run_id not in (lake.run_id, taxis.run_id)
    with open_recording(new.recording) as recording:
        assert recording.run_id == new.run_id
    assert verify(new.recording).content_digest == lake.summary["content_digest"]
    assert other.recording.read_bytes() == taxis.recording.read_bytes()


def test_an_interrupted_run_is_continued_by_an_import_and_never_set_back(taxis, tmp_path):
    early = cut_off(taxis, tmp_path / "early", 20_000)
    beginning, whole = (
        export_mcap(run, tmp_path / f"{name}.mcap").path for run, name in ((early, "early"), (taxis, "whole"))
    )
    theirs = tmp_path / "theirs"
    there = import_recording(beginning, theirs).run
    assert there.status == "interrupted"
    change_labels(there.folder, lambda _: Labels("mine", ("keep",), ""))
    continued = import_recording(whole, theirs)
    assert (continued.already, continued.run.status, continued.run.name) == (False, "finished", "mine")
    assert continued.run.recording.read_bytes() == taxis.recording.read_bytes()
    assert verify(continued.run.recording).sound
    back = import_recording(beginning, theirs)
    assert (back.already, back.run.status) == (True, "finished")
    assert back.run.recording.read_bytes() == taxis.recording.read_bytes()
    assert [path.name for path in theirs.iterdir()] == [taxis.run_id]


def test_a_continued_run_whose_file_was_not_updated_is_finished_by_importing_again(taxis, tmp_path):
    whole = export_mcap(taxis, tmp_path / "whole.mcap").path
    theirs = tmp_path / "theirs"
    import_recording(whole, theirs).run.update(status="interrupted", summary={})
    again = import_recording(whole, theirs)
    assert (again.already, again.run.status) == (True, "finished")
    assert list_runs(theirs)[0].summary["content_digest"] == taxis.summary["content_digest"]


@pytest.mark.parametrize("anonymous", [False, True])
@pytest.mark.parametrize("missing", [400, 20_000])
def test_a_killed_run_stays_interrupted(taxis, tmp_path, missing, anonymous):
    killed = cut_off(taxis, tmp_path / "mine", missing)
    assert killed.status == "interrupted"
    file = export_mcap(killed, tmp_path / "a.mcap", anonymous).path
    imported = import_recording(file, tmp_path / "theirs").run
    assert imported.status == imported.facts["status"] == "interrupted"
    with open_recording(killed.recording) as before, open_recording(imported.recording) as after:
        for topic in schema.BLOCK_TOPICS:
            assert after.table(topic).count() == before.table(topic).count()


def test_a_failed_run_says_why_unless_it_is_anonymous(lake, tmp_path):
    failed = copy_of(lake, tmp_path / "mine", status="failed", summary={"error": "/home/ann: no room"})
    failed.recording.write_bytes(failed.recording.read_bytes()[:-400])
    there = import_recording(export_mcap(failed, tmp_path / "a.mcap").path, tmp_path / "theirs").run
    assert (there.status, there.summary["error"]) == ("failed", "/home/ann: no room")
    nameless = export_mcap(failed, tmp_path / "b.mcap", anonymous=True).path
    assert b"/home/ann" not in everything_in(nameless)
    assert import_recording(nameless, tmp_path / "others").run.status == "failed"


def test_a_running_run_is_refused(lake, tmp_path):
    running = copy_of(lake, tmp_path / "mine", status="running", owner={"host": "elsewhere"})
    assert running.status == "running"
    with pytest.raises(RunnerError, match="running"):
        export_mcap(running, tmp_path / "a.mcap")
    assert not (tmp_path / "a.mcap").exists()


def test_a_damaged_recording_is_neither_exported_nor_imported(lake, tmp_path):
    damaged = copy_of(lake, tmp_path / "mine")
    data = bytearray(damaged.recording.read_bytes())
    data[len(data) // 2] ^= 1
    damaged.recording.write_bytes(data)
    with pytest.raises(RecordingError):
        export_mcap(damaged, tmp_path / "a.mcap")
    with pytest.raises(RecordingError):
        import_recording(damaged.recording, tmp_path / "theirs")
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize("cut", [0, 1, 8, 9, 1_000])
def test_what_is_not_a_recording_is_refused(lake, tmp_path, cut):
    file = tmp_path / "a.mcap"
    file.write_bytes(lake.recording.read_bytes()[:cut])
    result = CliRunner().invoke(cli, ["import", str(file), "--recordings", str(tmp_path / "theirs")])
    assert result.exit_code == 2, result.output
    assert str(file) in result.stderr
    assert not (tmp_path / "theirs").exists()


@pytest.mark.parametrize("record", ["", "nonsense", "[" * 100_000], ids=["empty", "no JSON", "deep"])
def test_an_export_record_that_is_not_json_is_refused(lake, tmp_path, record):
    file = tmp_path / "a.mcap"
    rewrite(lake.recording, file, lambda _, entries: entries, {"export": {"json": record}})
    with pytest.raises(RecordingError, match="export"):
        import_recording(file, tmp_path / "theirs")
    assert not (tmp_path / "theirs").exists()


@pytest.mark.parametrize("record", ["[]", '{"labels": 7, "status": 3, "summary": [], "name": null}'])
def test_what_an_export_record_cannot_mean_is_ignored(lake, tmp_path, record):
    file = tmp_path / "a.mcap"
    rewrite(lake.recording, file, lambda _, entries: entries, {"export": {"json": record}})
    imported = import_recording(file, tmp_path / "theirs").run
    assert (imported.name, imported.status, imported.labels) == ("lake", "finished", Labels())


def everything_in(path: Path) -> bytes:
    """Return the bytes of a recording, and of every record in it, decompressed."""
    parts = [path.read_bytes()]
    with path.open("rb") as stream:
        for record in StreamReader(stream).records:
            if isinstance(record, Metadata):
                parts.append(json.dumps(record.metadata).encode())
            elif isinstance(record, Attachment | Message):
                parts.append(record.data)
    return b"\n".join(parts)


def test_an_anonymous_file_names_no_person_host_or_folder(taxis, tmp_path, monkeypatch):
    monkeypatch.setattr(socket, "gethostname", lambda: "hostess-41")
    monkeypatch.setattr(getpass, "getuser", lambda: "annabella")
    monkeypatch.setattr("sys.argv", ["/home/annabella/bin/dualtaxi", "run"])
    run = make_run(tmp_path / "mine", LAKE)
    private = re.compile(rb"hostess|annabella|" + re.escape(str(Path.cwd()).encode()))
    assert private.search(everything_in(export_mcap(run, tmp_path / "a.mcap").path))
    file = export_mcap(run, tmp_path / "b.mcap", anonymous=True).path
    assert not private.search(everything_in(file))
    imported = import_recording(file, tmp_path / "theirs")
    assert imported.anonymous
    assert imported.content_digest == run.summary["content_digest"]
    assert verify(imported.run.recording).sound
    with open_recording(imported.run.recording) as recording:
        assert recording.provenance.keys().isdisjoint({"host", "user", "command", "directory"})
        assert recording.provenance["dualtaxi"]


def test_an_anonymous_file_has_no_path_of_windows(tmp_path, monkeypatch):
    monkeypatch.setenv("VIRTUAL_ENV", r"C:\Users\annabella\venv")
    config = {"data": r"C:\Users\annabella\lake"}
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path / "mine", config=config) as env:
        env.reset(seed=0)
    run = env.run
    exported = export_mcap(run, tmp_path / "a.mcap", anonymous=True)
    with open_recording(run.recording) as recording, open_recording(exported.path) as anonymous:
        assert recording.provenance["env.VIRTUAL_ENV"]
        assert "env.VIRTUAL_ENV" not in anonymous.provenance
    (warning,) = exported.warnings
    assert r"config.data: C:\Users\annabella\lake" in warning


@pytest.mark.parametrize("text", ["no JSON", '["error"]', "[" * 100_000])
def test_a_result_that_is_no_object_is_not_exported_anonymously(lake, tmp_path, text):
    run = copy_of(lake, tmp_path / "mine")
    rewrite(
        lake.recording,
        tmp_path / "changed.mcap",
        lambda name, entries: entries | {"json": text} if name == "result" else entries,
    )
    (tmp_path / "changed.mcap").replace(run.recording)
    with pytest.raises(RecordingError, match="'result' holds no JSON object"):
        export_mcap(run, tmp_path / "a.mcap", anonymous=True)
    assert not (tmp_path / "a.mcap").exists()


def test_an_anonymous_export_warns_of_a_path_that_belongs_to_the_job(lake, tmp_path):
    later = make_run(tmp_path / "mine", LAKE, initial_q={"run": str(lake.recording), "step": 0}, name="later")
    (warning,) = export_mcap(later, tmp_path / "a.mcap", anonymous=True).warnings
    assert str(lake.recording) in warning


def test_what_is_suggested_finds_the_run_in_its_folder(lake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DUALTAXI_RECORDINGS", "usual")
    file = str(export_mcap(lake, tmp_path / "a.mcap").path)
    usual = CliRunner().invoke(cli, ["import", file]).stdout
    assert usual.splitlines()[-1] == f"next    dualtaxi show {lake.run_id}"
    theirs = CliRunner().invoke(cli, ["import", file, "--recordings", "of anna"]).stdout
    words = shlex.split(" ".join(theirs.partition("dualtaxi ")[2].split()))
    assert CliRunner().invoke(cli, words).exit_code == 0
    assert words[-2] == "--recordings"


def test_the_commands(lake, taxis, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DUALTAXI_RECORDINGS", str(lake.folder.parent))
    exported = CliRunner().invoke(cli, ["export", "mcap", lake.run_id, "-o", "lake.mcap", "--json"])
    assert exported.exit_code == 0, exported.output
    assert Path(json.loads(exported.stdout)["files"][0]["path"]) == tmp_path / "lake.mcap"
    imported = CliRunner().invoke(cli, ["import", "lake.mcap", "--recordings", "theirs"])
    assert imported.exit_code == 0, imported.output
    assert f"dualtaxi show {lake.run_id}" in imported.stdout
    again = CliRunner().invoke(cli, ["import", "lake.mcap", "--recordings", "theirs"])
    assert again.exit_code == 0
    assert "nothing was written" in again.stderr
    assert [run.run_id for run in list_runs(Path("theirs"))] == [lake.run_id]
    for words in (["ls"], ["show", lake.run_id], ["verify", lake.run_id]):
        assert CliRunner().invoke(cli, [*words, "--recordings", "theirs"]).exit_code == 0
    same = CliRunner().invoke(cli, ["diff", lake.run_id, f"theirs/{lake.run_id}"])
    assert same.exit_code == 0, same.output
    copy_of(taxis, tmp_path / "others", run_id=lake.run_id)
    refused = CliRunner().invoke(cli, ["import", "lake.mcap", "--recordings", "others"])
    assert refused.exit_code == 2
    assert "--as-new" in refused.stderr
