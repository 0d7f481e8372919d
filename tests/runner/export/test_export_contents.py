"""Messages about a recording that is incomplete."""

from __future__ import annotations

from runner.analysis.contents import shortcomings
from runner.recording.reader import Recording, open_recording
from runner.runs.run import Run


def test_shortcomings_of_a_recording_whose_plan_is_invalid(lake, monkeypatch):
    with open_recording(lake.recording) as recording:
        for kind in (Run, Recording):
            monkeypatch.setattr(kind, "status", "interrupted")
        monkeypatch.setattr(Recording, "config", {"episodes": "many"})
        (sentence,) = shortcomings(recording)
    assert sentence.endswith("training episodes.")
    assert "many" not in sentence
