"""The events of recorded steps, by the environment's table, against the kernel's counts."""

from __future__ import annotations

import numpy as np
import pytest

import runner
from runner.environments import mdp as mdps
from runner.environments.mdp import events_of

WORLDS = {
    "sure": {"mode": "cooperative"},
    "slipping": {"mode": "competitive", "env": {"kwargs": {"slip": 0.3, "max_episode_steps": 100}}},
    "team": {"tables": "per_agent", "rewards": "team", "env": {"kwargs": {"slip": 0.3}}},
    "taxi": {"env": {"id": "Taxi-v4"}},
    "cliff": {"env": {"id": "CliffWalking-v1", "kwargs": {"is_slippery": True, "max_episode_steps": 60}}},
}


@pytest.mark.parametrize("world", WORLDS)
def test_every_episode_has_the_events_that_were_counted(tmp_path, world, monkeypatch):
    run = runner.run({"episodes": 20, "evaluation": None, **WORLDS[world]}, recordings=tmp_path)
    with runner.open_recording(run.recording) as recording:
        mdp = recording.mdp
        steps = recording.train.steps.array()
        counted = recording.train.episodes.array()["events"]
    monkeypatch.setattr(mdps, "_BATCH_OUTCOMES", 1000)  # so that some steps are looked at after others
    bits = events_of(mdp, steps)[:, np.newaxis] >> np.arange(len(mdp.event_names)) & 1
    found = np.zeros_like(counted)
    np.add.at(found, steps["episode"].astype(np.int64), bits.astype(counted.dtype))
    assert counted.any()
    assert found.tolist() == counted.tolist()


def test_a_step_that_the_table_does_not_have_has_no_events(tmp_path):
    run = runner.run({"episodes": 3, "evaluation": None}, recordings=tmp_path)
    with runner.open_recording(run.recording) as recording:
        mdp, steps = recording.mdp, recording.train.episode_steps(0).copy()
    assert events_of(mdp, steps).any()
    steps["next_state"] = (mdp.next_state[steps["state"], steps["action"]].max(axis=1) + 1) % mdp.states
    assert not events_of(mdp, steps).any()
