"""Marks at steps of runs: set, removed, merged, and taken along wherever a run goes."""

from __future__ import annotations

import json
import shutil

import pytest
from click.testing import CliRunner

import runner
from runner.archive.runs import archive_run, restore_place, restore_run
from runner.cli import cli
from runner.errors import NotInRecording, RunnerError
from runner.export.mcap import export_mcap
from runner.recording.labels import MAX_TAGS
from runner.recording.marks import MARKS_FILE, MAX_MARKS, Marks, marks_from, read_marks
from runner.runs.importing import import_recording
from runner.runs.resolve import find_run
from runner.runs.trust_marks import mark_of


@pytest.fixture
def run(lake, tmp_path):
    return find_run(lake.run_id, shutil.copytree(lake.folder.parent, tmp_path / "recordings"))


def test_a_mark_names_a_step_that_the_run_has(run):
    digest = run.recording.read_bytes()
    first = runner.mark(run, "3:1", " both stuck ", tags=["stuck", "again"])
    assert (first.at, first.episode, first.text, first.tags) == ("3:1", 3, "both stuck", ("again", "stuck"))
    trial = runner.mark(run, "eval:6:1", tags=["trial"])
    assert (trial.at, trial.phase, trial.episode, trial.t) == ("eval:6:1:0", "eval", 3, 0)
    word = runner.mark(run, "last", "the end")
    assert word.at == "11:0"
    assert run.marks == (trial, first, word)
    assert run.recording.read_bytes() == digest
    for at in ("3:99", "99", "eval:7:0"):
        with pytest.raises(NotInRecording):
            runner.mark(run, at)


@pytest.mark.parametrize(
    ("text", "tags"),
    [("x" * 1001, []), ("", ["not a tag"]), ("", map(str, range(MAX_TAGS + 1))), ("\udcff", []), (" ", [])],
)
def test_marks_that_cannot_be_are_refused(run, text, tags):
    with pytest.raises(RunnerError, match="expected"):
        runner.mark(run, "3:1", text, tags=tags)
    assert run.marks == ()


def test_marks_of_two_people_merge_and_removed_ones_stay_removed(run, tmp_path):
    other = find_run(run.run_id, shutil.copytree(run.folder.parent, tmp_path / "other"))
    shared = runner.mark(run, "3:1", "seen")
    for _ in range(2):
        import_recording(export_mcap(run, tmp_path / "a.mcap", force=True).path, other.folder.parent)
    assert other.marks == (shared,)
    own = runner.mark(other, "4:0", "mine")
    runner.unmark(run, shared.id)
    import_recording(export_mcap(run, tmp_path / "a.mcap", force=True).path, other.folder.parent)
    import_recording(export_mcap(other, tmp_path / "b.mcap").path, run.folder.parent)
    assert run.marks == other.marks == (own,)
    with pytest.raises(RunnerError, match=f"found no mark '{shared.id}', expected one of: {own.id}"):
        runner.unmark(run, shared.id)


def test_marks_are_archived_and_come_back(run, tmp_path):
    mark = runner.mark(run, "3:1", "seen")
    archived = archive_run(run, str(tmp_path / "archive"), remove=True)
    assert archived.run.marks == (mark,)
    later = runner.mark(archived.run, "4:0", "of an archived run")
    runner.unmark(archived.run, mark.id)
    assert restore_run(find_run(run.run_id, run.folder.parent)).marks == (later,)
    assert restore_place(archived.place, tmp_path / "elsewhere").marks == (mark,)


GOOD = {"at": "3:1", "episode": 3, "text": "", "tags": [], "created": "2026-11-27T08:00:00.123Z"}


@pytest.mark.parametrize(
    "change",
    [
        {"at": "../3"},
        {"at": "3:1\n"},
        {"episode": -1},
        {"episode": 2**70},
        {"text": 5},
        {"text": "x" * 1001},
        {"tags": ["<b>"]},
        {"tags": "stuck"},
        {"created": "yesterday"},
        {"created": "2026-99-27T08:00:00.123Z"},
    ],
)
def test_what_others_wrote_is_ignored_unless_it_is_a_mark(change):
    assert marks_from({"marks": [GOOD | change, GOOD]}) == marks_from({"marks": [GOOD]})
    assert marks_from({"marks": [dict(list(GOOD.items())[1:]), 5, None]}) == Marks()


@pytest.mark.parametrize("content", ["", "[]", "{", '{"marks": {}, "removed": 5}', '{"marks": ' + "[" * 9999])
def test_a_damaged_file_has_no_marks(run, content):
    (run.folder / MARKS_FILE).write_text(content)
    assert read_marks(run.folder) == Marks()
    assert run.marks == ()


def test_there_are_not_too_many(run):
    many = [GOOD | {"text": str(number)} for number in range(MAX_MARKS + 1)]
    (run.folder / MARKS_FILE).write_text(json.dumps({"marks": many}))
    assert len(run.marks) == MAX_MARKS
    with pytest.raises(RunnerError, match="expected at most 1,000"):
        runner.mark(run, "3:1", "one more")


def test_the_command_marks_lists_and_removes(run):
    def command(*words):
        result = CliRunner().invoke(cli, [*words, "--recordings", str(run.folder.parent)])
        assert result.exit_code == 0, result.output
        return result.stdout

    assert "no marks" in command("mark", "lake")
    listed = json.loads(command("mark", "lake", "3:1", "both stuck", "--tag", "stuck", "--json"))
    assert listed["marks"] == [mark.as_row() for mark in run.marks]
    assert "both stuck" in command("mark", "lake")
    assert "both stuck" in command("show", "lake")
    assert json.loads(command("show", "lake", "--json"))["marks"] == listed["marks"]
    assert json.loads(command("mark", "lake", "--unmark", run.marks[0].id, "--json"))["marks"] == []
    command("rm", "lake", "--yes")
    assert not run.folder.exists()


def test_a_mark_does_not_make_a_run_trusted(run):
    before = mark_of(run.folder)
    runner.mark(run, "3:1", "seen")
    assert mark_of(run.folder) == before
