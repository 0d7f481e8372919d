"""A run as TensorBoard's event file: its metrics, and length and return of each training episode.

The file is the same whenever it is written: an event's wall time is that of the recorded clock; without one,
when the run began, plus logical time.
"""

from __future__ import annotations

from itertools import chain
from pathlib import Path
from typing import Final

from runner.export.scalars import episodes, measures, times
from runner.recording.reader import Recording
from runner.util.extras import require

PATTERNS: Final = ("events.out.tfevents.*",)


def require_packages() -> None:
    """Check that the writer is installed."""
    require("tensorboardX", extra="tensorboard", purpose="export tensorboard")


def write_events(recording: Recording, folder: Path) -> int:
    """Write the event file of a run into a folder; return how many numbers it has.

    Each number is at its training step, under its name of `runner.export.scalars`; length and return of an
    episode are at its last step.
    """
    from tensorboardX.proto.event_pb2 import Event
    from tensorboardX.proto.summary_pb2 import Summary
    from tensorboardX.record_writer import RecordWriter

    began = recording.created.timestamp()
    at = times(recording)
    count = 0
    writer = RecordWriter(str(folder / f"events.out.tfevents.{int(began)}.{recording.run_id}"))
    try:
        writer.write(Event(wall_time=began, file_version="brain.Event:2").SerializeToString())
        for moment in chain(measures(recording), episodes(recording, "train")):
            numbers = [Summary.Value(tag=name, simple_value=x) for name, x in moment.by_phase.items()]
            event = Event(wall_time=at(moment.position), step=moment.step, summary=Summary(value=numbers))
            writer.write(event.SerializeToString())
            count += len(numbers)
    finally:
        writer.close()
    return count
