"""Runs that this user recorded are rerun with all that they name; copies of them elsewhere are not."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import gymnasium
import pytest

import runner
from runner.archive.places import at_hand
from runner.archive.runs import archive_run
from runner.execution.verify import verify
from runner.recording.reader import open_recording
from runner.runs.run import Run, run_at
from runner.runs.trust_marks import KEY_FILE, MARK_FILE, TrustMark, _make_key, mark, mark_of, merge_marks

SCRIPT = """\
import gymnasium, runner
from wrappers_of_mine import Doubled

with runner.record(Doubled(gymnasium.make("CartPole-v1"), by=3), "runs", name="mine") as env:
    env.action_space.seed(0)
    env.reset(seed=1)
    for _ in range(60):
        if any(env.step(env.action_space.sample())[2:4]):
            env.reset()
"""
WRAPPER = """\
import gymnasium

class Doubled(gymnasium.RewardWrapper, gymnasium.utils.RecordConstructorArgs):
    def __init__(self, env, by):
        gymnasium.utils.RecordConstructorArgs.__init__(self, by=by)
        super().__init__(env)
        self.by = by

    def reward(self, reward):
        return self.by * reward
"""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Return the folder of a run that a script recorded, with a wrapper in a module next to it."""
    project = tmp_path_factory.mktemp("project")
    (project / "wrappers_of_mine.py").write_text(WRAPPER)
    (project / "train.py").write_text(SCRIPT)
    subprocess.run([sys.executable, project / "train.py"], cwd=project, check=True, timeout=120)
    (folder,) = (project / "runs").glob("*/run.json")
    return folder.parent


@pytest.fixture
def own(recorded, own_folder, tmp_path):
    """Return a copy of it, of another name, in another folder than its modules."""
    return Path(shutil.copytree(recorded, tmp_path / "renamed"))


def altered(folder, **values):
    path = folder / MARK_FILE
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


def reason(folder):
    found = verify(folder / "recording.mcap")
    assert found.verdict == "consistent"
    assert "wrappers_of_mine" not in sys.modules
    return found.reason


def test_own_classes_are_found_from_any_folder(own, recorded):
    found = verify(own / "recording.mcap")
    assert (found.verdict, found.steps) == ("reproduced", 60)
    assert str(recorded.parents[1]) in mark_of(own).folders


def test_with_the_key_of_another_user_it_is_refused_with_the_reason(own, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "other"))
    assert "--trust" in reason(own)
    (tmp_path / "other" / "dualtaxi").mkdir(parents=True)
    (tmp_path / "other" / "dualtaxi" / KEY_FILE).write_bytes(bytes(32))
    assert "--trust" in reason(own)


@pytest.mark.parametrize(
    "values",
    [
        {"environments": []},
        {"folders": ["/tmp"]},
        {"script": "/tmp/script.py"},
        {"seal": "0" * 64},
        {"seal": 3},
        {"more": 1},
        {"folders": None},
    ],
)
def test_a_mark_that_was_changed_states_nothing(own, values):
    altered(own, **values)
    assert mark_of(own) == TrustMark()
    assert "--trust" in reason(own)


def test_a_mark_of_another_run_covers_only_that_run(own, tmp_path):
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path / "others") as env:
        env.reset(seed=1)
        env.step(0)
    shutil.copy(env.run.folder / MARK_FILE, own / MARK_FILE)
    assert mark_of(own).environments
    assert "--trust" in reason(own)


def test_no_mark_is_in_the_recording_and_the_key_is_for_its_user_alone(own):
    key = Path(os.environ["XDG_DATA_HOME"], "dualtaxi", KEY_FILE)
    assert (key.stat().st_mode & 0o777, key.stat().st_size) == (0o600, 32)
    with open_recording(own / "recording.mcap") as recording:
        assert not [name for name in recording.file.metadata_names if "trust" in name]


def test_processes_that_make_a_key_at_once_have_the_same_one(tmp_path):
    path, keys = tmp_path / "data" / KEY_FILE, []
    barrier = threading.Barrier(8)

    def work():
        barrier.wait()
        _make_key(path)
        keys.append(path.read_bytes())

    threads = [threading.Thread(target=work) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(keys) == 8
    assert len(set(keys)) == 1
    assert [file.name for file in path.parent.iterdir()] == [KEY_FILE]


def test_where_no_key_can_be_made_runs_are_recorded_without_a_mark(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "file"))
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path / "runs") as env:
        env.reset(seed=1)
        env.step(0)
    assert not (env.run.folder / MARK_FILE).exists()
    assert verify(env.run.recording).verdict == "reproduced"  # a listed environment


def test_every_environment_of_a_run_is_marked(tmp_path):
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path) as env:
        other = runner.record(gymnasium.make("CartPole-v1", max_episode_steps=9), into=env, phase="eval")
        for each in (env, other):
            each.reset(seed=1)
            each.step(0)
    assert len(mark_of(env.run.folder).environments) == 2


def test_an_archived_run_has_its_mark_until_its_folder_has_none(own, tmp_path):
    archived = archive_run(run_at(own / "recording.mcap"), str(tmp_path / "archive"), remove=True).run
    assert not (own / "recording.mcap").exists()
    recording = at_hand(archived).recording
    assert own not in recording.parents
    found = verify(recording)
    assert (found.verdict, found.steps) == ("reproduced", 60)
    (own / MARK_FILE).unlink()
    assert "--trust" in verify(at_hand(archived).recording).reason


def test_a_mark_that_is_extended_is_replaced_at_once(own, recorded):
    before = (own / MARK_FILE).read_bytes()
    os.link(own / MARK_FILE, own / "earlier")
    mark(own, {"id": "Taxi-v4"})
    assert (own / "earlier").read_bytes() == before
    assert set(mark_of(own).environments) > set(mark_of(recorded).environments)


def test_a_folded_run_has_the_marks_of_its_shards_and_branches_that_of_their_parent(recorded, tmp_path):
    shards = [Path(shutil.copytree(recorded, tmp_path / name)) for name in ("a", "b", "c")]
    altered(shards[1], seal="0" * 64)
    (shards[0] / MARK_FILE).unlink()
    merge_marks(shards[0], shards[1:2])
    assert mark_of(shards[0]) == TrustMark()
    merge_marks(shards[0], shards[1:])
    assert mark_of(shards[0]) == mark_of(recorded)


def test_what_is_made_of_an_own_run_is_marked_and_of_another_one_is_not(tmp_path, lake):
    branch = runner.branch(lake, at="0:0", action=1, recordings=tmp_path)
    assert mark_of(branch.run.folder).environments == mark_of(lake.folder).environments != ()
    copied = Path(shutil.copytree(lake.folder, tmp_path / lake.run_id))
    (copied / MARK_FILE).unlink()
    strange = runner.branch(Run(copied, lake.facts), at="0:0", action=1, recordings=tmp_path)
    assert mark_of(strange.run.folder) == TrustMark()
