"""A run as TensorBoard's event file: its measures, and length and return of each training episode.

The file is the same whenever it is written: an event's wall time is when the run began, plus logical time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from runner.export.scalars import created, episodes, measures, seconds_of
from runner.recording.reader import Recording
from runner.util.extras import require

OURS: Final = ("events.out.tfevents.*",)


def require_packages() -> None:
    """Raise an error that says what is missing, if the writer is not installed.

    Raises:
        MissingExtra: it is not.
    """
    require("tensorboardX", extra="tensorboard", purpose="export tensorboard")


def write_events(recording: Recording, folder: Path) -> int:
    """Write the event file of a run into a folder; return how many numbers it has.

    Each is at its training step, under the names of `runner.export.scalars`, with the phase before them;
    `train/episode/length` and `train/episode/return/AGENT` stand at the last step of each episode.

    Raises:
        RecordingError: the recording is damaged.
        OSError: the folder cannot be written.
    """
    from tensorboardX.proto.event_pb2 import Event
    from tensorboardX.proto.summary_pb2 import Summary
    from tensorboardX.record_writer import RecordWriter

    began, count = created(recording), 0
    writer = RecordWriter(str(folder / f"events.out.tfevents.{int(began)}.{recording.run_id}"))
    try:
        writer.write(Event(wall_time=began, file_version="brain.Event:2").SerializeToString())
        for position, step, values in _moments(recording):
            numbers = [Summary.Value(tag=name, simple_value=value) for name, value in values.items()]
            event = Event(wall_time=began + seconds_of(position), step=step, summary=Summary(value=numbers))
            writer.write(event.SerializeToString())
            count += len(numbers)
    finally:
        writer.close()
    return count


def _moments(recording: Recording) -> Iterator[tuple[int, int, Mapping[str, float]]]:
    """Yield position, training step and named numbers of each moment."""
    for found in measures(recording):
        yield found.position, found.step, {f"{found.phase}/{k}": v for k, v in found.values.items()}
    for found in episodes(recording, "train"):
        yield found.position, found.step, {f"{found.phase}/{k}": v for k, v in found.values.items()}
