"""Which trials an evaluation has."""

from __future__ import annotations

from runner.analysis.evaluations import evaluation_after, evaluation_records, evaluations_of
from runner.analysis.series import training_readings
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


def test_measures_of_learners_that_a_recording_is_older_than_are_unknown(lake, monkeypatch):
    with open_recording(lake.recording) as recording:
        older = {"mean_returns": [], "percent_filled": []}  # as a list that is not there is read
        metrics = [measures | older for measures in recording.eval.all_metrics()]
        monkeypatch.setattr(Phase, "all_metrics", lambda _: metrics)
        record, *_ = evaluation_records(recording)
    assert record.values["mean_return"] == dict.fromkeys(recording.agents)
    assert record.training is not None
    values = record.training.as_json()
    assert values["zero_cells"].keys() == {*recording.agents}
    assert "percent_filled" not in values
    assert "training.percent_filled" not in training_readings(record.training)
