"""Pictures of a loop in Rerun: frames that were recorded, and those that its environment draws afterwards."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterator, Sequence
from itertools import islice

import rerun as rr
import rerun.blueprint as rrb

from runner.errors import CannotRedo
from runner.export.encoded import encoded_picture
from runner.export.painting import redrawn
from runner.export.pictures import Source, source_of
from runner.export.rerun.members import entity_name
from runner.export.rerun.selection import MAX_MEMBERS
from runner.recording.messages import frame_place, media_type
from runner.recording.reader import Recording
from runner.recording.schema import IMAGE_TOPIC, STEP_NANOSECONDS
from runner.replay.steps import environment_of, frames_every, log_times_of
from runner.util.extras import require


class FrameSender:
    """Sends pictures of the environments of a loop; their names are parts of entities, empty for one."""

    def __init__(
        self, stream: rr.RecordingStream, root: str, recording: Recording, names: Sequence[str]
    ) -> None:
        self._stream, self._root, self._recording, self._names = stream, root, recording, names
        self._sent: dict[str, dict[int, int]] = {}
        """The step of the last picture, by phase and environment."""
        self._logged: dict[str, None] = {}
        """The names of logged pictures, in order."""

    def send_recorded(self, phase: str) -> None:
        """Send the frames that were recorded, each with the step of its own environment."""
        n, is_each_step = len(self._names), frames_every(self._recording) == 1
        for frame in self._recording.decoded(self._recording.topic(f"/{phase}/frame")):
            environment, _ = frame_place(frame)
            if environment < n:
                step = max(0, frame["log_time"] // STEP_NANOSECONDS - (n - 1 - environment))
                self._send(phase, environment, step, frame["data"], is_each_step)

    def send_logged(self) -> None:
        """Send the pictures that were logged under a name; of a film its first frame."""
        for image in self._recording.decoded(IMAGE_TOPIC):
            name, data = entity_name(image["frame_id"]), image["data"]
            if (kind := media_type(data)) not in ("image/png", "image/jpeg"):
                data, kind = _first_frame(data), "image/png"
            if data:
                self._logged[name] = None
                self._stream.set_time("step", sequence=image["log_time"] // STEP_NANOSECONDS)
                picture = rr.EncodedImage(contents=data, media_type=kind)
                self._stream.log(f"{self._root}/picture/{name}", picture)

    def draw(
        self, phase: str, episodes: Sequence[int], trust: bool, stage: Callable[[str], None]
    ) -> Iterator[str]:
        """Send the pictures of episodes that the environment draws, as far as it does what was recorded.

        Yields:
            what is not shown, and why, as text.
        """
        recording = self._recording
        sources = {number: source_of(recording, phase, trust, number) for number in episodes}
        yield from sorted({f"No {phase} pictures: {reason}" for _, reason in sources.values() if reason})
        chosen = [number for number, (source, _) in sources.items() if source is Source.REDRAWN]
        if not chosen:
            return
        number, times, environment = chosen[0], [0], 0
        try:
            for number, t, pixels in redrawn(recording, phase, chosen, trust):
                if t == 0:
                    times = [time // STEP_NANOSECONDS for time in log_times_of(recording, phase, number)]
                    environment = environment_of(recording, phase, number)
                    stage(f"drawing {phase} episode {chosen.index(number) + 1:,} of {len(chosen):,}")
                step = times[t - 1] if t else times[0] - 1
                self._send(phase, environment, step, encoded_picture(pixels), True)
                if t == len(times):  # nothing is shown until the next picture
                    self._stream.set_time("step", sequence=step + len(self._names))
                    self._stream.log(self._entity(phase, environment), rr.Clear(recursive=False))
        except CannotRedo as error:
            yield f"No {phase} pictures from episode {number} on: {error}"

    def _send(self, phase: str, environment: int, step: int, data: bytes, is_each_step: bool) -> None:
        """Send a picture; where each step has one, that of a reset must not hide that of the last step."""
        sent = self._sent.setdefault(phase, {})
        if not is_each_step or sent.get(environment, -1) < step:
            sent[environment] = step
            self._stream.set_time("step", sequence=step)
            image = rr.EncodedImage(contents=data, media_type=media_type(data) or "image/jpeg")
            self._stream.log(self._entity(phase, environment), image)

    def views(self) -> list[rrb.Container]:
        """Return the views of each phase that has pictures, those of several environments side by side."""
        grids: list[rrb.Container] = []
        for phase, sent in self._sent.items():
            shown = sorted(sent)[:MAX_MEMBERS]
            views = [
                rrb.Spatial2DView(
                    origin=self._entity(phase, environment),
                    name=" ".join([*filter(None, [phase, self._names[environment]]), "frame"]),
                )
                for environment in shown
            ]
            grids.append(rrb.Grid(*views, grid_columns=math.ceil(math.sqrt(len(views)))))
        if self._logged:
            pictures = [
                rrb.Spatial2DView(origin=f"{self._root}/picture/{name}", name=name)
                for name in islice(self._logged, MAX_MEMBERS)
            ]
            grids.append(rrb.Grid(*pictures, grid_columns=math.ceil(math.sqrt(len(pictures)))))
        return grids

    def _entity(self, phase: str, environment: int) -> str:
        return "/".join([self._root, phase, *filter(None, [self._names[environment]]), "frame"])


def _first_frame(data: bytes) -> bytes:
    """Return the first frame of a film as PNG; empty if it is none."""
    image = require("PIL.Image", extra="plots", purpose="logged films in Rerun")
    try:
        with image.open(io.BytesIO(data), formats=["WEBP"]) as film:
            film.convert("RGB").save(buffer := io.BytesIO(), "png")
    except (OSError, ValueError, image.DecompressionBombError):
        return b""
    return buffer.getvalue()
