"""Which trials an evaluation has."""

from __future__ import annotations

from runner.analysis.evaluations import evaluation_after, evaluations_of
from runner.recording.reader import Phase, open_recording


def test_trials_stay_those_of_their_evaluation_when_the_metrics_of_another_are_lost(lake, monkeypatch):
    with open_recording(lake.recording) as recording:
        whole = evaluations_of(recording)
        kept = recording.eval.all_metrics()[1:]
        monkeypatch.setattr(Phase, "all_metrics", lambda _: kept)  # as a repair may leave them
        assert len(whole) > 2
        assert evaluations_of(recording) == whole[1:]
        last = whole[-1]
        assert (
            evaluation_after(evaluations_of(recording), last.after, "--eval").trial(0, "--eval") == last.start
        )
