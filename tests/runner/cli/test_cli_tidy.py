"""Labels, ls, rm, prune, du and index rebuild."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import shlex
import shutil
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from runner.cli.commands import catalogue
from runner.config import from_mapping
from runner.recording.labels import LABELS_FILE
from runner.runs.run import RECORDING_FILE, RUN_FILE, create_run, list_runs, locked

CONFIG = from_mapping({"name": "some", "episodes": 5})


@pytest.fixture
def make(command):
    """Return a function that makes a finished run."""

    def made(days=0.0, status="finished", config=CONFIG, size=1000):
        run = create_run(command.recordings, config, 1)
        began = datetime.now(UTC) - timedelta(days=days)
        run = run.update(status=status, created=began.isoformat(timespec="milliseconds"))
        run.recording.write_bytes(bytes(size))
        return run

    return made


@pytest.fixture
def answer(monkeypatch):
    """Return a function that types an answer at a terminal."""

    def answers(text):
        class Terminal(io.StringIO):
            def isatty(self):
                return True

        monkeypatch.setattr(catalogue.sys, "stdin", Terminal(text))
        monkeypatch.setattr("click.termui.visible_prompt_func", lambda *_: text)

    return answers


def there(command):
    return {run.run_id for run in list_runs(command.recordings)}


# --- labels ----------------------------------------------------------------------------------------


def test_labels_are_stored_next_to_the_recording(command, make):
    run = make()
    before = (run.folder / RUN_FILE).read_bytes()
    assert "fig-3 keep" in command("label", run.run_id, "--tag", "keep", "--tag", "fig-3").stdout
    labels = {"run_id": run.run_id, "name": "some", "tags": ["keep"], "note": ""}
    assert command.json("label", run.run_id, "--untag", "fig-3") == labels
    assert command("label", run.run_id, "--note", "first\nsecond").exit_code == 0
    assert command.json("label", "some")["note"] == "first\nsecond"
    assert command.json("label", "some", "--name", "patient")["name"] == "patient"
    assert (run.folder / RUN_FILE).read_bytes() == before
    assert json.loads((run.folder / LABELS_FILE).read_text()) == {
        "name": "patient",
        "tags": ["keep"],
        "note": "first\nsecond",
    }
    (values,) = command.json("ls", '"patient" and "keep" in tags and "SECOND" in note')["runs"]
    assert (values["name"], values["tags"], values["note"]) == ("patient", ["keep"], "first\nsecond")
    assert command.json("show", "patient")["name"] == "patient"
    command("label", "patient", "--name", "")
    assert command("label", "some", "--note", "").exit_code == 0
    assert command.json("ls")["runs"][0]["note"] == ""


def test_a_note_from_stdin(command, make):
    run = make()
    command("label", run.run_id, "--note", "-", input="observed\n")
    assert command.json("label", run.run_id)["note"] == "observed"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("label", "some", "--tag", "two words"), "expected 1 to 64 letters"),
        (("label", "some", *(f"--tag={i}" for i in range(101))), "at most 100"),
        (("label", "some", "--note", "x" * 10_001), "at most 10,000"),
        (("label", "some", "--name", "../x"), "expected 1 to 100 letters"),
    ],
)
def test_invalid_labels_are_refused(command, make, words, message):
    make()
    result = command(*words)
    assert result.exit_code == 2
    assert message in result.stderr


# --- ls --------------------------------------------------------------------------------------------


def test_filters_sorting_columns_and_paging(command, make):
    runs = [make(days=day, size=1000 * (5 - day)) for day in range(5)]
    by_size = [run.run_id for run in reversed(runs)]
    assert command("ls", "--quiet", "--sort", "bytes").stdout.split() == by_size
    assert command("ls", "-q", "--sort", "-age").stdout.split() == by_size
    result = command("ls", "-q", "--limit", 2, "--offset", 1)
    assert result.stdout.split() == [run.run_id for run in runs[1:3]]
    assert "Showing 2 of 5 runs" in result.stderr
    assert "--offset 3" in result.stderr
    assert command("ls", "-q", 'age > "2.5d"').stdout.split() == [run.run_id for run in runs[3:]]
    values = command.json("ls", "--columns", "id,config.episodes,bytes", "--limit", 1)["runs"]
    assert values == [{"id": runs[0].run_id, "config.episodes": 5, "bytes": 5000}]
    assert command("ls", 'bytes > "1MB"').stderr == f"No run in {command.recordings} matches.\n"


def test_csv_has_what_json_has(command, make):
    run = make()
    command("label", run.run_id, "--tag", "a", "--tag", "b", "--note", 'with "quotes", and\nlines')
    (row,) = csv.DictReader(io.StringIO(command("ls", "--csv").stdout))
    (values,) = command.json("ls")["runs"]
    assert list(row) == list(values)
    assert (row["note"], row["tags"]) == (values["note"], "a b")
    assert command("ls", "--csv", "--quiet").exit_code == 2


def test_ids_are_never_cut(command, make, monkeypatch):
    run = make()
    command("label", run.run_id, "--name", "n" * 100)
    monkeypatch.setenv("COLUMNS", "40")
    assert run.run_id in command("ls").stdout


def test_a_name_cannot_paint_the_terminal(command, make):
    make().update(name="\x1b[31mred\nline")
    assert "\x1b" not in command("ls").stdout
    assert len(command("ls").stdout.splitlines()) == 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--sort", "sede"), "Did you mean 'seed'?"),
        (("--columns", "id,bites"), "Did you mean 'bytes'?"),
        (("--columns", ","), "columns: found nothing"),
        (("sede:3",), "Did you mean 'seed'?"),
    ],
)
def test_wrong_fields_are_refused_with_the_nearest(command, words, message):
    result = command("ls", *words)
    assert result.exit_code == 2
    assert message in result.stderr


def test_the_same_content_is_shown_as_such(recorded, command, recorded_run):
    for name in ("one", "two"):
        shutil.copytree(recorded_run.folder, command.recordings / name)
        facts = json.loads((command.recordings / name / RUN_FILE).read_text())
        later = {"run_id": name, "created": f"2026-01-0{len(name) - 2}T00:00:0{int(name == 'two')}+00:00"}
        (command.recordings / name / RUN_FILE).write_text(json.dumps(facts | later))
    assert {run["run_id"]: run["same_as"] for run in command.json("ls")["runs"]} == {
        "one": None,
        "two": "one",
    }
    assert "same as" in command("ls").stdout
    assert "same as" not in recorded("ls").stdout
    values = command.json("du")
    copied = {run["run_id"]: run["total"] for run in values["runs"]}
    assert values["freeable"]["same_content"] == copied["two"]


def test_an_archived_run_stays_listed(command, make):
    run = make().update(archive={"target": "/archives/a", "digest": "d", "bytes": 3})
    assert command.json("ls")["runs"][0]["status"] == "finished"
    run.recording.unlink()
    for _ in range(2):
        (values,) = command.json("ls", 'status == "archived" and archive is not None')["runs"]
        assert (values["status"], values["archive"], values["bytes"]) == ("archived", "/archives/a", None)
        assert command("index", "rebuild").exit_code == 0
    assert command("prune", "--older-than", "0s", "--yes").stderr.startswith("Left alone: 1 archived.")
    result = command("rm", run.run_id, "--yes")
    assert "was archived at /archives/a, but is not there: nothing of it will be left" in result.stderr
    assert there(command) == set()


# --- rm --------------------------------------------------------------------------------------------


def test_rm_shows_asks_and_frees(command, make, answer):
    run, other = make(), make()
    assert command("rm", run.run_id).exit_code == 2
    assert "no terminal" in command("rm", run.run_id).stderr
    size = sum(path.stat().st_size for path in run.folder.iterdir())
    values = command.json("rm", run.run_id, "--dry-run")
    assert (values["dry_run"], values["freed"]) == (True, size)
    assert there(command) == {run.run_id, other.run_id}
    result = command("rm", run.run_id, "--yes")
    assert result.stdout.splitlines()[-1].startswith("Removed 1 run, freed ")
    assert there(command) == {other.run_id}
    assert [path.name for path in command.recordings.iterdir()] == [other.run_id]


def test_rm_removes_nothing_if_a_run_is_protected(command, make):
    free, kept, busy, running = make(), make(), make(), create_run(command.recordings, CONFIG, 1)
    command("label", kept.run_id, "--tag", "keep")
    for run, values in ((kept, "--untag keep"), (running, "is running")):
        result = command("rm", free.run_id, run.run_id, "--yes")
        assert result.exit_code == 2
        assert values in result.stderr
    with locked(busy):
        assert "locked by another process" in command("rm", busy.run_id, "--yes").stderr
    assert there(command) == {run.run_id for run in (free, kept, busy, running)}


@pytest.mark.parametrize("damaged", ['{"tags": ["keep"', '{"tags": 3}', "[]"])
def test_a_run_with_damaged_labels_stays(command, make, damaged):
    run = make()
    (run.folder / "labels.json").write_text(damaged)
    for words in (("rm", run.run_id, "--yes"), ("prune", "config is not None", "--yes")):
        assert "labels.json cannot be read, and may say keep" in " ".join(command(*words).stderr.split())
    assert there(command) == {run.run_id}
    (run.folder / "labels.json").unlink()
    command("rm", run.run_id, "--yes")
    assert there(command) == set()


def test_rm_leaves_strange_files_unless_forced(command, make):
    run = make()
    (run.folder / "thesis.tex").write_text("years of work")
    (run.folder / "figures").mkdir()
    result = command("rm", run.run_id, "--yes")
    assert result.exit_code == 2
    assert "figures, thesis.tex" in result.stderr
    assert (run.folder / "thesis.tex").exists()
    assert command("rm", run.run_id, "--yes", "--foreign-files").exit_code == 0
    assert not run.folder.exists()


def test_rm_follows_no_link_and_stays_in_its_folder(command, make, tmp_path, recorded_run):
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "precious").write_text("mine")
    linked, moved, inside = make(), make(), make()
    (linked.folder / "link").symlink_to(outside, target_is_directory=True)
    assert command("rm", linked.run_id, "--yes", "--foreign-files").exit_code == 0
    moved.recording.unlink()
    moved.recording.symlink_to(outside / "precious")
    assert command("rm", moved.run_id, "--yes", "--foreign-files").exit_code == 0
    assert (outside / "precious").read_text() == "mine"
    elsewhere = tmp_path / "elsewhere"
    inside.folder.rename(elsewhere)
    assert "is not in" in command("rm", elsewhere, "--yes").stderr
    (command.recordings / inside.run_id).symlink_to(elsewhere, target_is_directory=True)
    assert "is a link" in command("rm", inside.run_id, "--yes").stderr
    assert (elsewhere / RECORDING_FILE).exists()
    alone = shutil.copy(recorded_run.recording, tmp_path / "alone.mcap")
    assert "stands alone" in command("rm", alone, "--yes").stderr


def test_an_interrupted_removal_is_completed_later(command, make):
    run, other = make(), make()
    stray = command.recordings / ".removed-abc-01234567"
    run.folder.rename(stray)
    assert there(command) == {other.run_id}
    assert [each["run_id"] for each in command.json("ls")["runs"]] == [other.run_id]
    assert command.json("du")["freeable"]["half_removed"] > 1000
    os.utime(stray, (time.time() - 3600,) * 2)
    command("rm", other.run_id, "--yes")
    assert list(command.recordings.iterdir()) == []


# --- prune -----------------------------------------------------------------------------------------


def test_prune_criteria_are_joined_by_and(command, make):
    old = [make(40 + day, "interrupted") for day in range(3)]
    make(50, "finished")
    make(5, "interrupted")
    words = ("prune", "--older-than", "30d", "--keep-last", 2, "--status", "interrupted")
    values = command.json(*words, "--dry-run")
    assert {run["run_id"] for run in values["removed"]} == {run.run_id for run in old[1:]}
    assert values["freed"] == sum(run["bytes"] for run in values["removed"]) > 2000
    assert len(there(command)) == 5
    assert command(*words).exit_code == 2
    assert command(*words, "--yes").exit_code == 0
    assert len(there(command)) == 3
    assert "nothing to remove" in command(*words, "--yes").stderr


def test_prune_keeps_the_last_of_each_configuration(command, make):
    configs = [from_mapping({"name": name, "episodes": 5}) for name in ("one", "two")]
    newest = [make(day, config=config).run_id for config in configs for day in (1, 2)]
    older = [make(day, config=config).run_id for config in configs for day in (3, 4)]
    values = command.json("prune", "--keep-last", 2, "--dry-run")
    assert {run["run_id"] for run in values["removed"]} == set(older)
    command("prune", 'config == "one"', "--keep-last", 0, "--yes")
    assert there(command) == {newest[2], newest[3], older[2], older[3]}


def test_prune_reports_protected_runs(command, make):
    kept, strange, goes = make(9), make(9), make(9)
    running = create_run(command.recordings, CONFIG, 1)
    command("label", kept.run_id, "--tag", "keep")
    (strange.folder / "mine.txt").write_text("")
    result = command("prune", 'name == "some"', "--yes")
    assert result.exit_code == 0
    assert "1 running, 1 tagged keep" in result.stderr
    assert "mine.txt" in result.stderr
    assert there(command) == {kept.run_id, strange.run_id, running.run_id}
    assert not goes.folder.exists()


@pytest.mark.parametrize("as_json", [False, True])
def test_a_run_that_is_tagged_while_others_are_removed_stays_and_is_named(
    command, make, monkeypatch, as_json
):
    runs = [make(9) for _ in range(3)]

    def confirmed(*_):
        command("label", runs[1].run_id, "--tag", "keep")

    monkeypatch.setattr(catalogue, "_confirm", confirmed)
    result = command("prune", 'name == "some"', *(["--json"] if as_json else []))
    assert result.exit_code == 2
    assert f"run {runs[1].run_id} stays: it is tagged keep" in " ".join(result.stderr.split())
    assert there(command) == {runs[1].run_id}
    if as_json:
        values = json.loads(result.stdout)
        assert [run["run_id"] for run in values["kept"]] == [runs[1].run_id]
        assert len(values["removed"]) == 2
        assert values["freed"] == sum(run["bytes"] for run in values["removed"])
    else:
        assert "Removed 2 runs" in result.stdout


@pytest.mark.parametrize(
    ("words", "message"),
    [((), "which runs?"), (("--older-than", "soon"), "expected an age"), (("  ",), "which runs?")],
)
def test_prune_requires_a_criterion(command, make, words, message):
    make()
    result = command("prune", *words, "--yes")
    assert result.exit_code == 2
    assert message in result.stderr
    assert len(there(command)) == 1


# --- du and index ---------------------------------------------------------------------------------


def test_du_adds_up_by_kind(command, make, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    large, small = make(size=5000), make(size=10, status="failed")
    exports = tmp_path / "cache" / "dualtaxi" / "rerun"
    exports.mkdir(parents=True)
    (exports / f"{large.run_id}+{small.run_id}-0123.rrd").write_bytes(bytes(700))
    (small.folder / "recording.damaged-1.mcap").write_bytes(bytes(300))
    values = command.json("du")
    first, second = values["runs"]
    assert (first["run_id"], first["recording"], first["exports"]) == (large.run_id, 5000, 700)
    assert (second["recording"], second["exports"]) == (10, 0)
    assert second["other"] > 300
    assert values["total"]["total"] == first["total"] + second["total"]
    assert values["freeable"]["left_over"] == 300
    assert values["freeable"]["unfinished"] == second["total"]
    assert values["freeable"]["cached"] == 700
    text = command("du", "--limit", 1).stdout
    assert large.run_id in text
    assert "1 more" in text


def test_index_rebuild_counts_runs_and_problems(command, make):
    make()
    make(status="failed")
    values = command.json("index", "rebuild")
    assert (values["runs"], values["statuses"], values["problems"]) == (2, {"failed": 1, "finished": 1}, [])
    (command.recordings / "stray").mkdir()
    (command.recordings / "stray" / RUN_FILE).write_text("{")
    result = command("index", "rebuild")
    assert result.exit_code == 1
    assert "stray" in result.stderr
    assert "2: 1 failed, 1 finished" in result.stdout


def test_several_folders_are_one_list(command, make, recorded, recorded_run):
    run = make()
    both = ("--recordings", command.recordings, "--recordings", recorded.recordings)
    assert {each["run_id"] for each in command.json("ls", *both)["runs"]} == {run.run_id, recorded_run.run_id}
    assert str(recorded.recordings) in command("ls", *both).stdout
    assert command.json("index", "rebuild", *both)["runs"] == 2


def documented():
    """Return the commands in the shell examples of the page on the catalogue, as words."""
    page = (Path(__file__).parents[3] / "docs" / "catalogue.md").read_text()
    blocks = re.findall(r"^```sh\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    return [shlex.split(line)[1:] for block in blocks for line in block.splitlines()]


def test_the_documented_examples_run(command, make, monkeypatch, tmp_path):
    make(40, "interrupted")
    monkeypatch.chdir(tmp_path)
    Path("loops").mkdir()
    assert len(documented()) > 10
    for words in documented():
        result = command(*words)
        assert result.exit_code == 0, (words, result.stderr)
    assert command.json("ls")["runs"][0]["note"] == "the step size of the paper"
