"""Recordings: the format, the recorder that writes it and the reader that gives it back."""

from runner.recording.reader import Recording
from runner.recording.reader import open_recording as open  # noqa: A004  (read as `recording.open`)

__all__ = ["Recording", "open"]
