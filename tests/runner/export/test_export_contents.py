"""What is said of a recording that is not whole."""

from __future__ import annotations

from runner.export.contents import shortcomings
from runner.recording.reader import Recording, open_recording


def test_what_a_recording_lacks_is_told_though_it_does_not_say_what_was_planned(lake, monkeypatch):
    with open_recording(lake.recording) as recording:
        monkeypatch.setattr(Recording, "status", "interrupted")
        monkeypatch.setattr(Recording, "config", {"episodes": "many"})
        (told,) = shortcomings(recording)
    assert told.endswith("training episodes.")
    assert "many" not in told
