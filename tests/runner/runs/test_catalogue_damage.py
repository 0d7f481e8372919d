"""The catalogue among damaged and hostile files, which are left out or listed as damaged."""

from __future__ import annotations

import json
import os
import sqlite3

import pytest

from runner.errors import RunNotFound
from runner.recording.labels import LABELS_FILE, Labels, read_labels
from runner.runs.catalogue.database import index_path
from runner.runs.catalogue.index import look
from runner.runs.run import RUN_FILE, create_run, list_runs, listed_run
from tests.runner.runs.listed import CONFIG, ids, rows


@pytest.mark.parametrize(
    "damage", ["deleted", "text", "truncated", "zeros inside", "foreign", "another version"]
)
def test_a_lost_or_damaged_index_is_rebuilt(folder, damage):
    made = [create_run(folder, CONFIG, seed).run_id for seed in range(40)]
    ids(folder)
    path = index_path()
    match damage:
        case "deleted":
            path.unlink()
        case "text":
            path.write_text("no database" * 1000)
        case "truncated":
            path.write_bytes(path.read_bytes()[:5000])
        case "zeros inside":
            path.write_bytes(path.read_bytes()[:4096] + bytes(path.stat().st_size - 4096))
        case "foreign":
            path.unlink()
            with sqlite3.connect(path) as other:
                other.execute("CREATE TABLE runs (a)")
        case "another version":
            with sqlite3.connect(path) as other:
                other.execute("PRAGMA user_version = 99")
    found, messages = rows(folder)
    assert {row["id"] for row in found} == set(made)
    assert (not messages) == (damage == "deleted")
    assert rows(folder)[1] == []


def test_without_a_place_for_the_index_the_folders_are_read(folder, tmp_path, monkeypatch):
    run = create_run(folder, CONFIG, 1)
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    found, messages = rows(folder)
    assert [row["id"] for row in found] == [run.run_id]
    assert "cannot be used" in messages[0]


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"{}",
        b"[" * 100_000,
        b'{"run_id": "../a", "name": "a", "seed": 1, "status": "x", "created": "2026-01-01"}',
        b" " * (9 << 20),
    ],
)
def test_what_is_no_run_is_left_out(folder, content):
    run = create_run(folder, CONFIG, 1)
    (folder / "hostile").mkdir()
    (folder / "hostile" / RUN_FILE).write_bytes(content)
    assert ids(folder) == [run.run_id]
    assert [each.run_id for each in list_runs(folder)] == [run.run_id]
    assert look([folder], lambda index: len(index.problems())) == 1


@pytest.mark.parametrize(
    "content",
    [
        b'{"run_id": "a", "name": "a", "seed": -1, "status": "x", "created": "2026-01-01"}',
        b'{"run_id": "a", "name": "a", "seed": 1, "status": "x", "created": "0001-01-01T00:00:00+14:00"}',
        b'{"run_id": "a"}',
    ],
)
def test_a_run_of_which_little_is_known_is_listed_as_damaged(folder, content):
    (folder / "a").mkdir(parents=True)
    (folder / "a" / RUN_FILE).write_bytes(content)
    assert [(row["id"], row["status"]) for row in rows(folder)[0]] == [("a", "damaged")]
    assert look([folder], lambda index: len(index.problems())) == 1


def test_a_run_without_a_readable_file_is_not_said_to_be_removed_for_certain(folder):
    run = create_run(folder, CONFIG, 1)
    (run.folder / RUN_FILE).write_text("{")
    run.recording.write_bytes(b"")
    with pytest.raises(RunNotFound, match=r"removed just now, or .* has neither a readable run\.json nor"):
        listed_run(run.folder, run.run_id)


def test_odd_values_do_no_harm(folder):
    odd = {
        "run_id": "odd",
        "name": "\x1b[31mred\ud800\x00" + "n" * 100_000,
        "seed": 2**64 - 1,
        "status": "\x07",
        "created": "2026-01-01T00:00:00.123456+01:00",
        "recording": "../../etc/passwd",
        "config": {
            "name": 3,
            "episodes": 10**400,
            "deep": {"a": [{"b": float("inf")}]},
            "k\ud800'\"": 1,
            "env": [],
        },
        "summary": {
            "episodes": "many",
            "train_steps": True,
            "last_evaluation": {"success_percent": float("nan")},
        },
    }
    (folder / "odd").mkdir(parents=True)
    (folder / "odd" / RUN_FILE).write_text(json.dumps(odd))
    (row,) = rows(folder)[0]
    assert (row["id"], row["seed"], row["episodes"], row["success_percent"]) == ("odd", 2**64 - 1, None, None)
    assert len(row["name"]) <= 4000
    assert list_runs(folder)[0].recording.parent == folder / "odd"
    assert ids(folder, "seed == 18446744073709551615") == ["odd"]


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[]",
        '{"tags": "keep", "name": 3, "note": []}',
        '{"tags": [1, "a b", "\\u001b"], "name": "a\\nb"}',
        " " * (2 << 20),
    ],
)
def test_hostile_labels_are_ignored(folder, content):
    run = create_run(folder, CONFIG, 1)
    (run.folder / LABELS_FILE).write_text(content)
    assert read_labels(run.folder) == Labels()
    assert ids(folder, 'name == "some" and tags is None') == [run.run_id]


def test_a_pipe_in_place_of_a_file_does_not_block(folder):
    (folder / "pipe").mkdir(parents=True)
    os.mkfifo(folder / "pipe" / RUN_FILE)
    assert ids(folder) == []
