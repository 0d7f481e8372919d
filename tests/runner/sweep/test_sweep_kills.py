"""A worker that is killed at any moment of its task loses no result and leaves nothing behind."""

from __future__ import annotations

from dataclasses import replace

import dying
import pytest
from sweeping import described, digests, swept

from runner.runs.run import list_runs
from runner.sweep.model import from_values
from runner.sweep.workers import LocalWorkers, RayWorkers

pytestmark = [
    pytest.mark.long,
    pytest.mark.filterwarnings("ignore"),  # Ray's own, about its future defaults and open files
]


class OnOwnDisk(LocalWorkers):
    """Workers that record on another disk than that of the recordings."""

    def submit(self, task):
        super().submit(replace(task, on_own_disk=True))


def processes(monkeypatch, own):
    monkeypatch.setattr("runner.sweep.workers.serve", dying.serve)
    return LocalWorkers(2)


def processes_on_own_disk(monkeypatch, own):
    monkeypatch.setattr("runner.sweep.workers.serve", dying.serve)
    monkeypatch.setenv("TMPDIR", str(own))
    return OnOwnDisk(2)


def ray_workers(monkeypatch, own):
    ray = pytest.importorskip("ray")

    ray.cloudpickle.register_pickle_by_value(dying)
    monkeypatch.setattr("runner.sweep.workers.RayActor", dying.DyingActor)
    return RayWorkers(2, None, 6)


@pytest.mark.parametrize(
    ("start", "moments"),
    [
        (processes, dying.MOMENTS),
        (processes_on_own_disk, dying.MOVING),
        (ray_workers, dying.MOMENTS),
    ],
)
def test_workers_killed_at_each_moment_of_a_task_change_nothing(start, moments, monkeypatch, tmp_path):
    notes, own, recordings = tmp_path / "notes", tmp_path / "own", tmp_path / "recordings"
    notes.mkdir()
    own.mkdir()
    monkeypatch.setenv("DYING_NOTES", str(notes))
    monkeypatch.setenv("DYING_MOMENTS", ",".join(moments))
    sweep = from_values(described(strategy="random", trials=4, seeds=[0, 1]))
    with start(monkeypatch, own) as workers:
        trials, status = swept(recordings, sweep, workers)
    assert {path.name for path in notes.glob("died *")} == {f"died {moment}" for moment in moments}
    assert (status.done, status.failed) == (8, 0)
    calm, _ = swept(tmp_path / "calm", sweep)
    assert digests(trials) == digests(calm)
    runs = list_runs(recordings)
    assert [run.status for run in runs] == ["finished"] * 8
    assert {path.name for path in recordings.iterdir()} == {".sweeps", *(run.run_id for run in runs)}
    files = {path.name for run in runs for path in run.folder.iterdir()}
    assert files - {"owner.lock"} == {"run.json", "labels.json", "recording.mcap", "trust.json"}
    assert list(own.glob("dualtaxi-*")) == []
