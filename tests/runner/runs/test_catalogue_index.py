"""The index: right at once, whatever changes; never the only copy; no trouble with parallel use."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sqlite3
import subprocess
import sys
import threading
from pathlib import Path

import pytest

import runner
from runner.errors import RunNotFound
from runner.recording.labels import Labels, change_labels, read_labels
from runner.runs.catalogue import index as index_module
from runner.runs.catalogue.database import index_path, open_index
from runner.runs.catalogue.index import MAX_TREE, changed_entries, look
from runner.runs.resolve import find_run
from runner.runs.run import RECORDING_FILE, RUN_FILE, create_run, list_runs
from tests.runner.runs.listed import ALL, CONFIG, aged, ids, rows


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """The folder of a finished run."""
    made = tmp_path_factory.mktemp("one")
    (made / "tiny.yaml").write_text("name: tiny\nepisodes: 4\nevaluation: {every: 2, trials: 2}\nseed: 1\n")
    return runner.run(made / "tiny.yaml", recordings=made / "recordings").folder


def test_the_index_agrees_with_the_folder(folder, recorded):
    shutil.copytree(recorded, folder / recorded.name)
    (row,) = rows(folder)[0]
    (run,) = list_runs(folder)
    summary = run.summary
    assert (row["id"], row["name"], row["seed"], row["status"]) == (run.run_id, "tiny", 1, "finished")
    assert (row["digest"], row["episodes"]) == (summary["content_digest"], 4)
    assert row["success_percent"] == summary["last_evaluation"]["success_percent"]
    assert row["steps"] == summary["train_steps"] + summary["eval_steps"]
    assert row["bytes"] == run.recording.stat().st_size
    assert (row["mode"], row["environment"]) == ("cooperative", "dualtaxi:DualTaxi-v1")
    assert row["host"] == os.uname().nodename
    assert json.loads(row["settings"])["evaluation.every"] == 2


def test_what_changes_is_seen_at_once(folder):
    runs = [create_run(folder, CONFIG, seed) for seed in range(3)]
    aged(folder)
    assert len(ids(folder)) == 3
    runs[0].update(status="finished", summary={"episodes": 5})
    change_labels(runs[1].folder, lambda _: Labels("patient", ("keep",), "why"))
    shutil.rmtree(runs[2].folder)
    more = create_run(folder, CONFIG, 9)
    (more.folder / RECORDING_FILE).write_bytes(b"123")
    found = {row["id"]: row for row in rows(folder)[0]}
    assert set(found) == {runs[0].run_id, runs[1].run_id, more.run_id}
    assert (found[runs[0].run_id]["status"], found[runs[0].run_id]["episodes"]) == ("finished", 5)
    assert (found[runs[1].run_id]["name"], found[runs[1].run_id]["tags"]) == ("patient", "keep")
    assert found[more.run_id]["bytes"] == 3
    assert ids(folder, '"keep" in tags and "why" in note') == [runs[1].run_id]


def test_only_what_changed_is_read(folder):
    for seed in range(5):
        create_run(folder, CONFIG, seed).update(status="finished")
    aged(folder)
    changed = list_runs(folder)[2].update(status="failed")
    with contextlib.closing(open_index(pytest.fail)) as database:
        assert changed_entries(database, str(folder)) == [changed.run_id]
    assert ids(folder, 'status == "failed"') == [changed.run_id]


def test_a_change_within_the_same_moment_is_not_missed(folder):
    run = create_run(folder, CONFIG, 1).update(status="finished")
    ids(folder)
    text = (run.folder / RUN_FILE).read_text()
    before = (run.folder / RUN_FILE).stat()
    (run.folder / RUN_FILE).write_text(text.replace('"finished"', '"failed"  '))
    os.utime(run.folder / RUN_FILE, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert rows(folder)[0][0]["status"] == "failed"


def test_a_run_whose_process_dies_is_interrupted(folder):
    waiting = "import sys; from pathlib import Path; from runner.runs.run import create_run; \
from runner.config import from_mapping; create_run(Path(sys.argv[1]), \
from_mapping({'name': 'some', 'episodes': 5}), 1); print(flush=True); sys.stdin.read()"
    process = subprocess.Popen(
        [sys.executable, "-c", waiting, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    process.stdout.readline()
    aged(folder)
    assert [row["status"] for row in rows(folder)[0]] == ["running"]
    process.communicate(b"")
    assert ids(folder, 'status == "running"') == []
    assert len(ids(folder, 'status == "interrupted"')) == 1


def test_a_run_is_found_in_the_recording_alone_and_keeps_its_labels(folder, recorded):
    place = folder / recorded.name
    shutil.copytree(recorded, place)
    change_labels(place, lambda _: Labels(tags=("mine",)))
    whole = rows(folder)[0][0]
    (place / RUN_FILE).unlink()
    alone = rows(folder)[0][0]
    differing = {key for key in whole if whole[key] != alone[key]}
    assert differing <= {"fingerprint", "stable", "seconds", "settings"}
    assert json.loads(whole["settings"]) == json.loads(alone["settings"])


def test_an_index_that_another_process_replaces_is_opened_again(folder, monkeypatch):
    made = [create_run(folder, CONFIG, seed).run_id for seed in range(2)]
    ids(folder)
    made.append(create_run(folder, CONFIG, 2).run_id)

    def replaced_first(*arguments):
        monkeypatch.setattr(index_module, "changed_entries", changed_entries)
        index_path().unlink()
        return changed_entries(*arguments)

    monkeypatch.setattr(index_module, "changed_entries", replaced_first)
    found, messages = rows(folder)
    assert ({row["id"] for row in found}, messages) == (set(made), [])
    assert index_path().exists()


def test_the_index_is_never_needed(folder):
    runs = [create_run(folder, CONFIG, seed) for seed in range(3)]
    change_labels(runs[1].folder, lambda _: Labels("patient", ("keep",), "why"))
    before = rows(folder)[0]
    index_path().unlink()
    assert rows(folder)[0] == before
    assert look([folder], lambda index: index.select(ALL), rebuild=True) == before


def test_several_folders_and_the_same_content_in_them(folder, recorded, tmp_path):
    shutil.copytree(recorded, folder / "first")
    shutil.copytree(recorded, tmp_path / "elsewhere" / "second")
    both = [folder, tmp_path / "elsewhere"]
    assert len(rows(*both)[0]) == 2
    assert len(rows(folder)[0]) == 1
    (original,) = look(both, lambda index: index.originals()).values()
    assert original[2] == rows(folder)[0][0]["id"]
    assert look([folder], lambda index: index.originals()) == {}


def test_runs_may_vanish_and_come_while_listing(folder):
    stop = threading.Event()

    def churn():
        while not stop.is_set():
            run = create_run(folder, CONFIG, 1)
            shutil.rmtree(run.folder)

    stays = create_run(folder, CONFIG, 2)
    thread = threading.Thread(target=churn)
    thread.start()
    try:
        for _ in range(30):
            assert stays.run_id in ids(folder)
    finally:
        stop.set()
        thread.join()


def test_a_run_is_found_by_the_names_that_find_it_in_the_folder(folder):
    runs = [create_run(folder, CONFIG, seed) for seed in range(3)]
    change_labels(runs[1].folder, lambda _: Labels(name="patient"))
    newest = max(runs, key=lambda run: (run.created, run.run_id))
    assert find_run("patient", folder).run_id == runs[1].run_id
    assert find_run("@latest", folder).run_id == newest.run_id
    assert find_run(runs[0].run_id, folder) == find_run(runs[0].run_id[:7], folder) == runs[0]
    for name, message in (
        ("", "empty name"),
        ("some", "matches 2 runs"),
        ("ptient", "Did you mean 'patient'"),
    ):
        with pytest.raises(RunNotFound, match=message):
            find_run(name, folder)


WRITER = """
import sys
from pathlib import Path
from runner.runs.catalogue.index import look
from runner.runs.catalogue.filters import parse
from types import SimpleNamespace
from runner.recording.labels import Labels, change_labels
from runner.runs.run import create_run
config = SimpleNamespace(name="some", to_mapping=lambda: {"name": "some", "episodes": 5})
folder, number = Path(sys.argv[1]), int(sys.argv[2])
sys.stdin.readline()
for turn in range(3):
    run = create_run(folder, config, number)
    change_labels(folder / "shared", lambda was: Labels(was.name, (*was.tags, f"p{number}.{turn}"), was.note))
    run.update(status="finished", summary={"episodes": 5})
    chosen = parse(f'id == "{run.run_id}" and status == "finished"')
    found = look([folder], lambda index: index.select(chosen), sys.exit)
    assert [row["id"] for row in found] == [run.run_id]
"""


def test_eight_processes_write_at_once(folder):
    shared = create_run(folder, CONFIG, 0)
    shared.folder.rename(folder / "shared")
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", WRITER, str(folder), str(number)],
            stdin=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        for number in range(8)
    ]
    for process in processes:
        process.stdin.write(b"\n")
        process.stdin.flush()
    errors = [process.communicate(timeout=120)[1].decode() for process in processes]
    assert errors == [""] * 8
    assert len(ids(folder)) == 25
    assert len(read_labels(folder / "shared").tags) == 24
    with sqlite3.connect(index_path()) as database:
        assert database.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    assert [path.name for path in Path(index_path()).parent.glob("*.tmp")] == []


def renamed(run, name):
    change_labels(run.folder, lambda _: Labels(name=name))


def test_a_name_given_or_taken_away_just_now_is_known(folder):
    runs = [create_run(folder, CONFIG, seed).update(status="finished") for seed in range(3)]
    aged(folder)
    renamed(runs[1], "patient")
    assert find_run("patient", folder).run_id == runs[1].run_id
    aged(folder)
    renamed(runs[2], "patient")
    with pytest.raises(RunNotFound, match="matches 2 runs"):
        find_run("patient", folder)
    aged(folder)
    renamed(runs[1], "other")
    renamed(runs[2], "another")
    with pytest.raises(RunNotFound, match="no run 'patient'"):
        find_run("patient", folder)
    newest = create_run(folder, CONFIG, 9)
    assert find_run("@latest", folder).run_id == newest.run_id
    assert find_run(newest.run_id[:7], folder).run_id == newest.run_id


def test_rebuilding_the_index_never_empties_it(folder, monkeypatch):
    runs = [create_run(folder, CONFIG, seed) for seed in range(4)]
    ids(folder)
    seen = []
    row_of = index_module.row_of

    def looking_on(run, size):
        with contextlib.closing(sqlite3.connect(index_path())) as other:
            seen.extend(other.execute("SELECT COUNT(*) FROM runs").fetchone())
        return row_of(run, size)

    monkeypatch.setattr(index_module, "row_of", looking_on)
    assert len(look([folder], lambda index: index.select(ALL), rebuild=True)) == 4
    assert seen == [len(runs)] * 4


def test_a_tree_of_branches_is_bounded_and_ends_where_runs_name_each_other(folder):
    def branched(run_id, parent):
        branch = {"run": parent, "step": 1, "actions": {}, "settings": {}}
        config = CONFIG.to_mapping() | {"branches": [branch] if parent else []}
        (folder / run_id).mkdir(parents=True)
        created = f"2026-01-01T00:00:00.{int(run_id[1:]):06}+00:00"
        facts = {"run_id": run_id, "name": run_id, "seed": 1, "status": "finished", "created": created}
        (folder / run_id / RUN_FILE).write_text(json.dumps(facts | {"config": config}))

    def tree(run_id):
        def size(node):
            return 1 + sum(map(size, node.branches))

        root = look([folder], lambda index: index.branch_tree(run_id))
        return root.run, size(root)

    for own, parent in (("a1", "a3"), ("a2", "a1"), ("a3", "a2"), ("b1", "b1"), ("c1", "")):
        branched(own, parent)
    for number in range(2, 400):
        branched(f"c{number}", "c1")
    assert tree("a2")[1] == 3
    assert tree("b1") == ("b1", 1)
    assert tree("c5") == ("c1", MAX_TREE)
    assert tree("unknown") == ("unknown", 1)
