"""Archives of recordings, and the complete contents of a recording."""

from __future__ import annotations

from runner.archive.writing import write_archive
from runner.recording.reader import open_recording


def archived(path, folder):
    folder.mkdir()
    with open_recording(path) as recording:
        write_archive(recording, folder)
    return folder


def contents(path):
    """Return all that a recording holds, but where its chunks were closed."""
    with open_recording(path) as recording:
        blocks = {
            topic.name: b"".join(recording.table(topic).records())
            for topic in recording.topics
            if recording.layout.dtype(topic) is not None
        }
        messages = {
            topic.name: list(recording.table(topic).messages())
            for topic in recording.topics
            if recording.layout.dtype(topic) is None
        }
        metadata = {name: recording.file.metadata(name) for name in recording.file.metadata_names}
        return blocks, messages, metadata, list(recording.file.attachments())
