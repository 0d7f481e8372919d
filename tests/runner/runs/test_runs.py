"""The recordings folder: runs are created, listed and found."""

import json
import os
import socket
import sys

import pytest

from runner.config import from_mapping
from runner.errors import RunNotFound, StorageError
from runner.runs import run as runs
from runner.runs.resolve import find_run
from runner.runs.run import RUN_FILE, create_run, list_runs, recordings_folder

CONFIG = from_mapping({"name": "some", "episodes": 5})


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "recordings"


def _renamed(run, run_id):
    """Give a run another id, to have two of one beginning."""
    run.folder.rename(run.folder.parent / run_id)
    facts = run.facts | {"run_id": run_id}
    (run.folder.parent / run_id / RUN_FILE).write_text(json.dumps(facts))


def test_a_run_is_on_disk_with_its_configuration(folder):
    run = create_run(folder, CONFIG, 7)
    (found,) = list_runs(folder)
    assert found == run
    assert (found.name, found.seed, found.status) == ("some", 7, "running")
    assert from_mapping(found.facts["config"]) == CONFIG
    assert found.created.tzinfo is not None
    assert found.summary == {}
    assert {path.name for path in run.folder.iterdir()} == {RUN_FILE, "trust.json"}


def test_a_run_may_have_another_name(folder):
    assert create_run(folder, CONFIG, 7, "other").name == "other"


def test_ids_are_never_used_twice(folder, monkeypatch):
    numbers = iter([0, 0, 1])
    monkeypatch.setattr(runs.secrets, "randbelow", lambda _: next(numbers))
    assert [create_run(folder, CONFIG, 0).run_id for _ in range(2)] == ["aaaaaaaa", "baaaaaaa"]


def test_an_id_that_is_a_path_is_refused(folder):
    with pytest.raises(StorageError, match="cannot be written"):
        create_run(folder, CONFIG, 0, run_id="no/folder")


def test_a_folder_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="cannot be written"):
        create_run(tmp_path / "file" / "deeper", CONFIG, 0)
    with pytest.raises(StorageError, match="cannot be read"):
        list_runs(tmp_path / "file")


def test_an_update_is_whole_and_leaves_the_rest(folder):
    run = create_run(folder, CONFIG, 7)
    changed = run.update(status="finished", summary={"bytes": 3})
    assert (changed.status, changed.summary) == ("finished", {"bytes": 3})
    assert list_runs(folder) == [changed]
    assert {path.name for path in run.folder.iterdir()} == {RUN_FILE, "trust.json"}


@pytest.mark.parametrize(
    ("owner", "status"),
    [
        ({}, "running"),
        ({"pid": 2**30}, "interrupted"),
        ({"pid": "x"}, "interrupted"),
        ({"process_started": 1.0}, "interrupted"),
        (
            {"boot_id": "another"},
            "running",
        ),  # of another machine, it seems: it still beats
        ({"host": "elsewhere"}, "running"),
    ],
)
def test_a_run_runs_as_long_as_its_owner_lives(folder, owner, status):
    run = create_run(folder, CONFIG, 7)
    assert run.facts["owner"]["host"] == socket.gethostname()
    assert run.update(owner=run.facts["owner"] | owner).status == status


def test_on_another_host_the_heartbeat_counts(folder):
    run = create_run(folder, CONFIG, 7)
    run = run.update(owner=run.facts["owner"] | {"host": "elsewhere"})
    long_ago = 1_700_000_000
    os.utime(run.folder / RUN_FILE, (long_ago, long_ago))
    assert run.status == "interrupted"
    run.beat()
    assert run.status == "running"


def test_a_run_whose_folder_is_gone_is_not_running(folder):
    run = create_run(folder, CONFIG, 7)
    run = run.update(owner={"host": "elsewhere"})
    (run.folder / RUN_FILE).unlink()
    assert run.status == "interrupted"
    run.beat()  # and does not complain


def test_runs_are_found_by_id_prefix_name_and_latest(folder):
    first, second = create_run(folder, CONFIG, 1), create_run(folder, CONFIG, 2, "other")
    for run in (first, second):
        for name in (run.run_id, run.run_id[:5], run.name, f"{run.name}@latest", str(run.folder)):
            assert find_run(name, folder) == run
    newest = max((first, second), key=lambda run: (run.facts["created"], run.run_id))
    assert find_run("@latest", folder) == newest


def test_an_id_goes_before_a_prefix_and_a_name(folder):
    _renamed(create_run(folder, CONFIG, 1), "abc")
    _renamed(create_run(folder, CONFIG, 2), "abcd")
    create_run(folder, CONFIG, 3, "abc")
    assert find_run("abc", folder).seed == 1
    with pytest.raises(RunNotFound, match="matches 2 runs"):
        find_run("ab", folder)


def test_the_only_run_of_a_name_goes_before_the_beginning_of_an_id(folder):
    _renamed(create_run(folder, CONFIG, 1), "c2zzzzzz")
    create_run(folder, CONFIG, 2, "c2")
    assert find_run("c2", folder).seed == 2
    _renamed(create_run(folder, CONFIG, 3), "c3zzzzzz")
    _renamed(create_run(folder, CONFIG, 4), "c3yyyyyy")
    with pytest.raises(RunNotFound, match="name one by its id:"):
        find_run("c3", folder)


def test_several_runs_of_a_name_are_listed(folder):
    made = [create_run(folder, CONFIG, seed) for seed in (1, 2)]
    with pytest.raises(RunNotFound, match=r"'some' matches 2 runs; .* by some@latest") as caught:
        find_run("some", folder)
    assert all(f"{run.run_id}  some, seed {run.seed}" in str(caught.value) for run in made)


@pytest.mark.parametrize("name", ["nothing", "nothing@latest", "@latest", ""])
def test_no_runs_at_all(folder, name):
    with pytest.raises(RunNotFound, match="there are no runs"):
        find_run(name, folder)


def test_a_wrong_name_gets_a_suggestion(folder):
    create_run(folder, CONFIG, 1)
    with pytest.raises(RunNotFound, match=r"Did you mean 'some'\?.*`dualtaxi ls` lists all runs"):
        find_run("soem", folder)
    with pytest.raises(RunNotFound, match="no run 'other@latest'"):
        find_run("other@latest", folder)
    for typo, name in (("@lates", "@latest"), ("some@lastest", "some@latest")):
        with pytest.raises(RunNotFound, match=f"Did you mean '{name}'"):
            find_run(typo, folder)


def test_paths_that_are_no_runs(tmp_path):
    with pytest.raises(RunNotFound, match="no such file"):
        find_run(str(tmp_path / "nothing"), tmp_path)
    with pytest.raises(RunNotFound, match="expected a run"):
        find_run(str(tmp_path) + os.sep, tmp_path)


def test_the_folder_is_the_chosen_the_variables_or_here(monkeypatch):
    monkeypatch.setenv("DUALTAXI_RECORDINGS", "there")
    assert [str(recordings_folder(chosen)) for chosen in ("chosen", None)] == ["chosen", "there"]
    monkeypatch.delenv("DUALTAXI_RECORDINGS")
    assert str(recordings_folder()) == "recordings"


@pytest.mark.skipif(sys.platform == "win32" or not hasattr(os, "geteuid"), reason="POSIX permissions")
def test_a_folder_that_may_not_be_written(folder):
    if os.geteuid() == 0:
        pytest.skip("nothing is forbidden to root")
    folder.mkdir(mode=0o500)
    with pytest.raises(StorageError, match="Permission denied"):
        create_run(folder, CONFIG, 0)
