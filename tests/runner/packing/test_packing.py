"""A run packed and unpacked is the same run; who made it and where can be left out of it."""

from __future__ import annotations

import getpass
import json
import os
import re
import shlex
import shutil
import socket
import tarfile
from dataclasses import replace
from pathlib import Path

import pytest
from blake3 import blake3
from click.testing import CliRunner
from mcap.reader import make_reader
from mcap.records import Attachment, Message, Metadata
from mcap.stream_reader import StreamReader

from runner.cli import cli
from runner.errors import RecordingError, RunnerError
from runner.execution.verify import verify
from runner.packing.packing import pack
from runner.packing.unpacking import unpack
from runner.recording.reader import open_recording
from runner.runs.labels import Labels, change_labels, read_labels
from runner.runs.resolve import find_run
from runner.runs.run import list_runs
from tests.runner.recording.making import LAKE, make_run


def copy_of(run, folder, **facts):
    """Return a copy of a run in another folder of runs, with other facts."""
    shutil.copytree(run.folder, folder / run.run_id)
    return find_run(f"{folder / run.run_id}", folder).update(**facts)


def cut_off(run, folder, missing):
    """Return a copy of a run that was killed: its file is cut off, and it never said how it ended."""
    killed = copy_of(run, folder, status="running", summary={}, owner={"host": "elsewhere"})
    os.utime(killed.folder / "run.json", (0, 0))
    killed.recording.write_bytes(killed.recording.read_bytes()[:-missing])
    return killed


def test_a_run_comes_out_as_it_went_in(taxis, tmp_path):
    packed = pack(taxis, tmp_path / "a.dualtaxi")
    unpacked = unpack(packed.path, tmp_path / "theirs").run
    assert unpacked.recording.read_bytes() == taxis.recording.read_bytes()
    ours = ("owner", "provenance")
    assert {key: value for key, value in taxis.facts.items() if key not in ours} == unpacked.facts
    assert unpacked.status == "finished"
    assert unpacked.folder == tmp_path / "theirs" / taxis.run_id
    assert verify(unpacked.recording).sound
    assert sorted(path.name for path in unpacked.folder.iterdir()) == ["recording.mcap", "run.json"]
    assert [path.name for path in (tmp_path / "theirs").iterdir()] == [taxis.run_id]


def test_the_same_run_gives_the_same_bytes_wherever_it_lies(lake, tmp_path):
    first = pack(lake, tmp_path / "a.dualtaxi").path.read_bytes()
    there = unpack(tmp_path / "a.dualtaxi", tmp_path / "theirs").run
    assert pack(there, tmp_path / "b.dualtaxi").path.read_bytes() == first


def test_any_tar_program_reads_it_and_the_manifest_is_true(lake, tmp_path):
    with tarfile.open(pack(lake, tmp_path / "a.dualtaxi").path) as tar:
        manifest = json.load(tar.extractfile("manifest.json"))
        assert tar.getnames() == ["manifest.json", *(member["name"] for member in manifest["members"])]
        for member in manifest["members"]:
            data = tar.extractfile(member["name"]).read()
            assert (len(data), blake3(data).hexdigest()) == (member["size"], member["blake3"])
    assert manifest["run_id"] == lake.run_id
    assert manifest["content_digest"] == lake.summary["content_digest"]


def test_what_is_there_already_is_left_as_it_is(lake, tmp_path):
    packed = pack(lake, tmp_path / "a.dualtaxi")
    before = packed.path.stat().st_mtime_ns
    assert pack(lake, packed.path).already
    assert packed.path.stat().st_mtime_ns == before
    assert not unpack(packed.path, tmp_path / "theirs").already
    folder = tmp_path / "theirs" / lake.run_id
    before = {path: path.stat().st_mtime_ns for path in [folder, *folder.iterdir()]}
    assert unpack(packed.path, tmp_path / "theirs").already
    assert {path: path.stat().st_mtime_ns for path in [folder, *folder.iterdir()]} == before


def test_a_run_that_is_read_from_its_archive_is_packed_with_its_labels(lake, tmp_path):
    there = copy_of(lake, tmp_path / "mine", archive={"target": "elsewhere"})
    change_labels(there.folder, lambda _: Labels("mine", ("keep",), "why"))
    restored = there.recording.rename(tmp_path / f"{lake.run_id}-restored.mcap")
    packed = pack(replace(there, restored=restored), tmp_path / "a.dualtaxi")
    unpacked = unpack(packed.path, tmp_path / "theirs").run
    assert read_labels(unpacked.folder) == Labels("mine", ("keep",), "why")


def test_another_file_is_replaced_only_by_force(lake, tmp_path):
    target = tmp_path / "a.dualtaxi"
    target.write_bytes(b"mine")
    with pytest.raises(RunnerError, match="--force"):
        pack(lake, target)
    assert target.read_bytes() == b"mine"
    assert not pack(lake, target, force=True).already
    assert [path.name for path in tmp_path.iterdir()] == ["a.dualtaxi"]


def test_a_run_of_the_same_id_and_other_content_stays(lake, taxis, tmp_path):
    packed = pack(lake, tmp_path / "a.dualtaxi")
    other = copy_of(taxis, tmp_path / "mine", run_id=lake.run_id)
    with pytest.raises(RunnerError, match="--as-new"):
        unpack(packed.path, tmp_path / "mine")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == [taxis.run_id]
    new = unpack(packed.path, tmp_path / "mine", as_new=True).run
    assert new.run_id not in (lake.run_id, taxis.run_id)
    with open_recording(new.recording) as recording:
        assert recording.run["run_id"] == new.run_id
    assert verify(new.recording).content_digest == lake.summary["content_digest"]
    assert other.recording.read_bytes() == taxis.recording.read_bytes()


def test_an_interrupted_run_is_gone_on_with_by_a_pack_of_its_end_and_not_set_back(taxis, tmp_path):
    early = cut_off(taxis, tmp_path / "early", 20_000)
    beginning, whole = (
        pack(run, tmp_path / f"{name}.dualtaxi").path for run, name in ((early, "early"), (taxis, "whole"))
    )
    theirs = tmp_path / "theirs"
    there = unpack(beginning, theirs).run
    change_labels(there.folder, lambda _: Labels("mine", ("keep",), ""))
    gone_on = unpack(whole, theirs)
    assert (gone_on.already, gone_on.run.status, gone_on.run.name) == (False, "finished", "mine")
    assert gone_on.run.recording.read_bytes() == taxis.recording.read_bytes()
    assert verify(gone_on.run.recording).sound
    back = unpack(beginning, theirs)
    assert (back.already, back.run.status) == (True, "finished")
    assert back.run.recording.read_bytes() == taxis.recording.read_bytes()
    assert [path.name for path in theirs.iterdir()] == [taxis.run_id]


def test_a_run_whose_end_came_without_its_word_says_it_when_that_comes_again(taxis, tmp_path):
    whole = pack(taxis, tmp_path / "whole.dualtaxi").path
    theirs = tmp_path / "theirs"
    unpack(whole, theirs).run.update(status="interrupted", summary={})
    again = unpack(whole, theirs)
    assert (again.already, again.run.status) == (True, "finished")
    assert list_runs(theirs)[0].summary["content_digest"] == taxis.summary["content_digest"]


@pytest.mark.parametrize("anonymous", [False, True])
@pytest.mark.parametrize("missing", [400, 20_000])
def test_a_killed_run_stays_interrupted(taxis, tmp_path, missing, anonymous):
    killed = cut_off(taxis, tmp_path / "mine", missing)
    assert killed.status == "interrupted"
    unpacked = unpack(pack(killed, tmp_path / "a.dualtaxi", anonymous).path, tmp_path / "theirs").run
    assert unpacked.status == unpacked.facts["status"] == "interrupted"
    with open_recording(killed.recording) as before, open_recording(unpacked.recording) as after:
        for topic in before.dtypes:
            assert after.count(topic) == before.count(topic)
    assert pack(killed, tmp_path / "a.dualtaxi", anonymous).already


def test_a_failed_run_says_why_unless_it_is_anonymous(lake, tmp_path):
    failed = copy_of(lake, tmp_path / "mine", status="failed", summary={"error": "/home/ann: no room"})
    failed.recording.write_bytes(failed.recording.read_bytes()[:-400])
    there = unpack(pack(failed, tmp_path / "a.dualtaxi").path, tmp_path / "theirs").run
    assert (there.status, there.summary["error"]) == ("failed", "/home/ann: no room")
    nameless = pack(failed, tmp_path / "b.dualtaxi", anonymous=True).path
    assert b"ann" not in nameless.read_bytes()
    assert unpack(nameless, tmp_path / "others").run.status == "failed"


def test_a_running_run_is_refused(lake, tmp_path):
    running = copy_of(lake, tmp_path / "mine", status="running", owner={"host": "elsewhere"})
    assert running.status == "running"
    with pytest.raises(RunnerError, match="running"):
        pack(running, tmp_path / "a.dualtaxi")
    assert not (tmp_path / "a.dualtaxi").exists()


def test_a_damaged_recording_is_refused(lake, tmp_path):
    damaged = copy_of(lake, tmp_path / "mine")
    data = bytearray(damaged.recording.read_bytes())
    data[len(data) // 2] ^= 1
    damaged.recording.write_bytes(data)
    with pytest.raises(RecordingError):
        pack(damaged, tmp_path / "a.dualtaxi")
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_labels_go_along(lake, tmp_path):
    labelled = copy_of(lake, tmp_path / "mine")
    change_labels(labelled.folder, lambda _: Labels("a/b, ours", ("good",), "see figure 3"))
    packed = pack(labelled, tmp_path / "a.dualtaxi")
    assert packed.manifest.name == "lake"
    there = unpack(packed.path, tmp_path / "theirs").run
    assert read_labels(there.folder) == read_labels(labelled.folder)
    assert there.name == "a/b, ours"


def everything_in(path: Path) -> bytes:
    """Return the bytes of a packed run, and of every record in it, decompressed."""
    parts = [path.read_bytes()]
    with tarfile.open(path) as tar:
        for record in StreamReader(tar.extractfile("recording.mcap")).records:
            if isinstance(record, Metadata):
                parts.append(json.dumps(record.metadata).encode())
            elif isinstance(record, Attachment | Message):
                parts.append(record.data)
    return b"\n".join(parts)


def test_an_anonymous_pack_names_no_person_host_or_folder(taxis, tmp_path, monkeypatch):
    monkeypatch.setattr(socket, "gethostname", lambda: "hostess-41")
    monkeypatch.setattr(getpass, "getuser", lambda: "annabella")
    monkeypatch.setattr("sys.argv", ["/home/annabella/bin/dualtaxi", "run"])
    run = make_run(tmp_path / "mine", LAKE)
    private = re.compile(rb"hostess|annabella|" + re.escape(str(Path.cwd()).encode()))
    assert private.search(everything_in(pack(run, tmp_path / "a.dualtaxi").path))
    packed = pack(run, tmp_path / "b.dualtaxi", anonymous=True)
    assert not private.search(everything_in(packed.path))
    assert packed.manifest.anonymous
    assert packed.manifest.content_digest == run.summary["content_digest"]
    there = unpack(packed.path, tmp_path / "theirs").run
    assert verify(there.recording).sound
    with open_recording(there.recording) as recording:
        assert recording.provenance.keys().isdisjoint({"host", "user", "command", "directory"})
        assert recording.provenance["dualtaxi"]
    with there.recording.open("rb") as stream:
        assert make_reader(stream, validate_crcs=True).get_summary().statistics.message_count
    assert pack(run, tmp_path / "b.dualtaxi", anonymous=True).already


def test_an_anonymous_pack_tells_of_a_path_that_belongs_to_the_job(lake, tmp_path):
    later = make_run(tmp_path / "mine", LAKE, initial_q={"run": str(lake.recording), "step": 0}, name="later")
    (note,) = pack(later, tmp_path / "a.dualtaxi", anonymous=True).notes
    assert str(lake.recording) in note


def test_what_is_suggested_finds_the_run_in_its_folder(lake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DUALTAXI_RECORDINGS", "usual")
    packed = str(pack(lake, tmp_path / "a.dualtaxi").path)
    usual = CliRunner().invoke(cli, ["unpack", packed]).stdout
    assert usual.splitlines()[-1] == f"next    dualtaxi show {lake.run_id}"
    theirs = CliRunner().invoke(cli, ["unpack", packed, "--recordings", "of anna"]).stdout
    words = shlex.split(" ".join(theirs.partition("dualtaxi ")[2].split()))
    assert CliRunner().invoke(cli, words).exit_code == 0
    assert words[-2] == "--recordings"


def test_the_commands(lake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DUALTAXI_RECORDINGS", str(lake.folder.parent))
    told = CliRunner().invoke(cli, ["pack", lake.run_id, "--json"])
    assert told.exit_code == 0, told.output
    assert Path(json.loads(told.stdout)["path"]) == tmp_path / f"lake-{lake.run_id}.dualtaxi"
    taken = CliRunner().invoke(cli, ["unpack", f"lake-{lake.run_id}.dualtaxi", "--recordings", "theirs"])
    assert taken.exit_code == 0, taken.output
    assert f"dualtaxi show {lake.run_id}" in taken.stdout
    again = CliRunner().invoke(cli, ["unpack", f"lake-{lake.run_id}.dualtaxi", "--recordings", "theirs"])
    assert again.exit_code == 0
    assert "there already" in again.stderr
    assert [run.run_id for run in list_runs(Path("theirs"))] == [lake.run_id]
    for words in (["ls"], ["show", lake.run_id], ["verify", lake.run_id]):
        assert CliRunner().invoke(cli, [*words, "--recordings", "theirs"]).exit_code == 0
    same = CliRunner().invoke(cli, ["diff", lake.run_id, f"theirs/{lake.run_id}"])
    assert same.exit_code == 0, same.output
