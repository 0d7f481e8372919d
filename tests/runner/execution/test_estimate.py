"""What a run is estimated to take is counted as it is done."""

from __future__ import annotations

import pytest

from runner.execution.estimate import estimate
from runner.recording.reader import open_recording
from tests.runner.recording.making import LAKE, experiment, make_run


@pytest.mark.parametrize(("episodes", "every"), [(12, 6), (12, 5), (2, 5), (1, 1), (7, 3)])
def test_evaluations_and_snapshots_are_counted_as_they_are_made(tmp_path, episodes, every):
    changes = {
        "episodes": episodes,
        "evaluation": {"every": every, "trials": 2},
        "snapshots": {"every": every},
    }
    one = estimate(experiment(LAKE, **changes), 20)
    with open_recording(make_run(tmp_path, LAKE, **changes).recording) as recording:
        assert one.evaluations == len(recording.eval.all_metrics())
        assert one.snapshots == len(list(recording.snapshots()))
        trials = one.evaluations * 2
        assert one.max_steps == 20 * (episodes + trials)
