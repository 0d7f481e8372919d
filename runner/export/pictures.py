"""The pictures of a recorded episode: one source for films, pages, reports and terminals.

    with contextlib.closing(Pictures(recording, "train", 12)) as shown:
        for picture in shown:                       # T + 1 of them for an episode of T steps
            print(picture.t, picture.pixels.shape, picture.action, picture.returns)

What the pictures are made from is decided in one place, by what there is: the scene of a tabular environment;
recorded frames; the environment, made again, which draws the episode while it is compared with the recording;
observations that are images; or else the numbers of the observations as bars.

Each source is painted by a generator of T + 1 pictures, uint8 [height, width, 3] of one size; close it to
free what it uses.

The service sends the pictures as files (`encoded_pictures`), and a report contains small ones (`thumbnails`).
Lists of episodes show a sketch, for which no environment is made (`episode_sketch`).
"""

from __future__ import annotations

import base64
import io
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.analysis.contents import ENDINGS, Step, ending_of, require_steps
from runner.drawing import palette, svg
from runner.drawing.raster import Pixels, SceneRaster, draw_bars, image_bytes, require_packages
from runner.environments.mdp import events_of
from runner.environments.naming import agent_actions_in_words, events_in_words, exploration_in_words, spoken
from runner.errors import CannotRedo, RecordingError, RunnerError
from runner.export.values import Seen, Values, observations_of, observed, step_actions_in_words
from runner.recording import schema
from runner.recording.messages import Message
from runner.recording.reader import Recording, open_recording
from runner.recording.spaces import Value, least_number
from runner.replay.makers import why_not_rerun
from runner.replay.steps import (
    environments_with_frames,
    frames_every,
    recorded_frames,
)
from runner.util.arrays import Floats
from runner.util.extras import require
from runner.util.humanize import sentence

if TYPE_CHECKING:
    from PIL import Image

SCENE_SIZE: Final = 480
"""The largest width and height of the picture of a scene."""
MAX_PIXELS: Final = 4096 * 4096
"""The most pixels of a recorded frame."""
_MAX_EXACT_PIXELS: Final = 256 * 256
"""Pictures of up to this many pixels are encoded as PNG, which is exact; larger ones as JPEG."""
MAX_THUMBNAILS: Final = 300
"""The most pictures of an episode in a report."""
_THUMBNAIL_SIDE: Final = 320
"""Pixels of the longer side of a thumbnail."""
_WEBP_QUALITY: Final = 75
_SKETCH_WIDTH, _SKETCH_HEIGHT = 160, 120
_MAX_SKETCHED_STEPS: Final = 100_000
"""Steps after which a sketch shows no more."""
_MAX_SKETCHED_POINTS: Final = 200

Painted = Generator[Pixels, None, None]


class PictureSource(StrEnum):
    """What the pictures of an episode are made from."""

    SCENE = "scene"
    """The scene of a tabular environment, drawn from the recorded states."""
    RECORDED = "recorded frames"
    REDRAWN = "pictures drawn again"
    """Drawn by the environment, which was made again and compared with the recording."""
    OBSERVATION = "observations"
    """Observations that are images."""
    VALUES = "values"
    """The numbers of observations and rewards, as bars."""


@dataclass(frozen=True, eq=False)
class PictureMoment:
    """An episode after some of its steps."""

    t: int
    """Steps of the episode so far; 0 after the reset."""
    observation: Value | None
    """What was observed, numbers where the space is `Discrete`; None if it was lost."""
    action: str
    """The action of the last of these steps, by name where it has one; empty at 0."""
    rewards: tuple[float, ...]
    """The rewards of that step, one for each learner; zeros at 0."""
    returns: tuple[float, ...]
    """Sums of the rewards so far."""
    events: str
    """What happened in that step: events of the environment, exploration, texts of the observation."""
    ended: str
    """How the episode ended, as text, after its last step; else empty."""


@dataclass(frozen=True, eq=False)
class EpisodePicture(PictureMoment):
    """What an episode looked like after some of its steps."""

    pixels: Pixels
    """uint8 [height, width, 3]; all pictures of an episode have one size."""
    note: str = ""
    """Why no picture follows although steps do; else empty."""


class Pictures:
    """The pictures of an episode, an iterator; `close` it if it is left before its end.

    Args:
        recording: the run.
        phase: `train` or `eval`.
        episode: among the episodes of the phase, counted from 0.
        trust: whether what the recording names may be imported, see `runner.replay.trust`.

    Raises:
        RecordingError: there is no such episode, or the recording has no steps.
        MissingExtra: a package that draws them is not installed.

    Attributes:
        source: what they are made from.
        reason: why they are not drawn again, as a sentence; empty if they are, or have no need to be.
        steps: steps of the episode; there is one more picture, unless one has a note.
        learners: the names of the learners, one for each reward.
        note: why the pictures ended before the steps; empty if they have not.
    """

    def __init__(self, recording: Recording, phase: str, episode: int, trust: bool = False) -> None:
        require_packages()
        require_steps(recording, "show", may_redo=True)
        self.learners = recording.agents
        self.steps = len(recording.phase(phase).episode(episode))
        self.source, self.reason, _, self._painted = paint(recording, phase, episode, trust)
        self.note = ""
        self._pictures = self._generate(moments_of(recording, phase, episode))

    def __iter__(self) -> Iterator[EpisodePicture]:
        return self

    def __next__(self) -> EpisodePicture:
        return next(self._pictures)

    def close(self) -> None:
        """End what makes the pictures."""
        self._pictures.close()
        self._painted.close()

    def _generate(self, moments: Iterator[PictureMoment]) -> Generator[EpisodePicture, None, None]:
        pixels = next(self._painted)
        for moment in moments:
            try:
                pixels = next(self._painted) if moment.t else pixels
            except CannotRedo as error:
                self.note = str(error)
            yield EpisodePicture(**vars(moment), pixels=pixels, note=self.note)
            if self.note:
                return


def moments_of(recording: Recording, phase: str, episode: int) -> Iterator[PictureMoment]:
    """Yield T + 1 moments of an episode of T steps: after the reset, and after each step."""
    describe = describer(recording, phase)
    steps = len(recording.phase(phase).episode(episode))
    returns = np.zeros(len(recording.agents))
    unpaid = tuple(returns.tolist())
    for t, (observation, step) in enumerate(observations_of(recording, phase, episode)):
        if step is None:
            yield PictureMoment(t, observation, "", unpaid, unpaid, "", "")
            continue
        action, events = describe(step)
        rewards = np.asarray(step["rewards"], np.float64)
        with np.errstate(over="ignore", invalid="ignore"):  # rewards may be infinite
            returns += rewards
        ended = ENDINGS[ending_of(recording, phase, episode)] if t == steps else ""
        paid, total = tuple(rewards.tolist()), tuple(returns.tolist())
        yield PictureMoment(t, observation, action, paid, total, events, ended)


def describer(recording: Recording, phase: str) -> Callable[[Step], tuple[str, str]]:
    """Return how to put a step's action, and what happened in it, in words."""
    if recording.tabular:
        mdp, learners = recording.mdp, recording.agents
        named = agent_actions_in_words(mdp)

        def describe(row: Step) -> tuple[str, str]:
            events = events_in_words(mdp, int(events_of(mdp, np.asarray(row).reshape(1))[0]))
            explored = exploration_in_words(int(row["explored"]), learners)
            return named[row["action"]], ", ".join(filter(None, [events, explored]))

        return describe
    in_words = step_actions_in_words(recording, phase)
    texts = Values(recording)

    def describe_values(row: Step) -> tuple[str, str]:
        words = ", ".join(f"{spoken(agent)} {action}".lstrip() for agent, action in in_words(row).items())
        words = f"action {words}" if words.removeprefix("-").isdecimal() else words
        return words, texts.texts_in(observed(recording, row))

    return describe_values


# --- what they are made from --------------------------------------------------------------------------


def source_of(
    recording: Recording, phase: str, trust: bool = False, episode: int | None = None
) -> tuple[PictureSource, str]:
    """Return what the pictures of an episode are made from, and why it is not anything better.

    Nothing is imported or made: it may turn out that an environment cannot be made again. Without a number of
    the episode, frames that were recorded of some environments count for all.
    """
    recorded = source_of_recorded(recording, phase, episode)
    is_complete = recorded is PictureSource.RECORDED and frames_every(recording) == 1
    if recorded is PictureSource.SCENE or is_complete:
        return recorded, ""
    if recording.can_train_again:
        return recorded, "The environment has no scene."
    reason = why_not_rerun(recording, trust)
    return (recorded, reason) if reason else (PictureSource.REDRAWN, "")


def source_of_recorded(recording: Recording, phase: str, episode: int | None) -> PictureSource:
    """Return the best of what the recording itself has."""
    if recording.tabular and svg.drawing_of(recording.mdp) is not None:
        return PictureSource.SCENE
    framed = environments_with_frames(recording, phase)
    if framed and (episode is None or recording.phase(phase).episode(episode).place in framed):
        return PictureSource.RECORDED
    has_image = Values(recording).image is not None
    return PictureSource.OBSERVATION if has_image else PictureSource.VALUES


def paint(
    recording: Recording, phase: str, episode: int, trust: bool = False, first: int = 0
) -> tuple[PictureSource, str, bool, Painted]:
    """Paint the states of an episode from number `first` on, of the best source that works.

    Returns:
        the source; why the environment does not draw them, as a sentence, empty if it does or has no need to;
        whether it turned out not to draw them, although it could be made again; and the pictures.
    """
    source, reason = source_of(recording, phase, trust, episode)
    has_failed = False
    if source is PictureSource.REDRAWN:
        redrawn = paint_redrawn(recording, phase, episode, trust, first)
        try:
            return source, "", has_failed, _continued(next(redrawn), redrawn)
        except CannotRedo as error:
            redrawn.close()
            source = source_of_recorded(recording, phase, episode)
            reason = str(error)
            has_failed = True
    seen = observations_of(recording, phase, episode, first)
    match source:
        case PictureSource.SCENE:
            painted = paint_scene(recording, seen)
        case PictureSource.RECORDED:
            painted = paint_recorded(recording, phase, episode, first)
        case PictureSource.OBSERVATION:
            painted = paint_observation(recording, seen)
        case _:
            painted = paint_values(recording, phase, episode, seen)
    return source, reason, has_failed, painted


def _continued(first: Pixels, painted: Painted) -> Painted:
    """Yield a picture and those after it; closing them closes what paints them."""
    with closing(painted):
        yield first
        yield from painted


# --- painting -----------------------------------------------------------------------------------------


def paint_scene(recording: Recording, seen: Iterator[Seen]) -> Painted:
    """Draw the scene in each state, with the way that led there."""
    mdp = recording.mdp
    drawing = svg.drawing_of(mdp)
    assert drawing is not None
    raster = SceneRaster(drawing, SCENE_SIZE, SCENE_SIZE)
    places: deque[NDArray[np.int16]] = deque(maxlen=svg.TRAIL)
    first = least_number(recording.spaces["observation"])
    for observation, _ in seen:
        places.append(drawing.places(mdp, np.array([observation]) - first)[0])
        yield raster.draw(np.stack(places))


def paint_recorded(recording: Recording, phase: str, episode: int, first: int) -> Painted:
    """Show the last frame that was recorded up to each step, from the one after `first` steps on."""
    last: Message = {}
    pixels: Pixels | None = None
    for frame in recorded_frames(recording, phase, episode, first):
        if pixels is None or frame is not last:
            where = f"{recording.path}: the frame at {frame['log_time']} ns"
            last = frame
            pixels = _like(np.asarray(decoded(frame["data"], where)), pixels)
        yield pixels


def decoded(data: bytes, where: str, formats: tuple[str, ...] = ("PNG", "JPEG")) -> Image.Image:
    """Return a recorded picture as an RGB image; of a film the first frame.

    Raises:
        RecordingError: it is no picture, or too large; `where` names it.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(data), formats=formats) as image:
            if image.width * image.height > MAX_PIXELS:
                raise RecordingError(f"{where} has {image.width}x{image.height} pixels, too many to show.")
            return image.convert("RGB")
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, ValueError, SyntaxError) as error:
        raise RecordingError(f"{where} cannot be shown ({error}).") from error


def _like(pixels: Pixels, before: Pixels | None) -> Pixels:
    """Return a picture in the size of the one before it, if there is one."""
    from PIL import Image

    if before is None or pixels.shape == before.shape:
        return pixels
    return np.asarray(Image.fromarray(pixels).resize(before.shape[1::-1]))


def paint_redrawn(recording: Recording, phase: str, episode: int, trust: bool, first: int) -> Painted:
    """Draw each state by the environment, from the one after `first` steps on; see `redrawn`."""
    pixels: Pixels | None = None
    with closing(redrawn(recording, phase, [episode], trust, first)) as pictures:
        for _, _, frame in pictures:
            pixels = _like(frame, pixels)
            yield pixels


def redrawn(
    recording: Recording, phase: str, episodes: Sequence[int], trust: bool, draw_from: int = 0
) -> Generator[tuple[int, int, Pixels], None, None]:
    """Draw episodes by the environment, made again in a child process and compared with the recording.

    With `draw_from`, the first steps of the only episode are taken without pictures.

    Yields:
        the number of an episode, how many of its steps were taken, and the picture after them.

    Raises:
        CannotRedo: the environment cannot be made again, draws no pictures, or differs from the recording, of
            which no picture comes after that step.
    """
    from runner.replay.environment import rerun_in_child  # loads Gymnasium

    blocks: Any = rerun_in_child(
        recording.path, phase, episodes, render=True, trust=trust, draw_from=draw_from
    )
    waiting = iter(episodes)
    episode = episodes[0]
    t = draw_from
    with closing(blocks):
        for steps in blocks:
            differs = steps.difference
            first = [start.frame for start in steps.starts if start.frame is not None and not draw_from]
            if first:
                episode = next(waiting)
                t = 0
            frames = [*first, *steps.frames]
            if differs is not None:  # the last of them is not a picture of what was recorded
                frames = frames[:-1]
            for frame in frames:
                yield episode, t, frame
                t += 1
            if differs is not None and (differs.phase, differs.episode) != (phase, episode):
                raise CannotRedo(f"The environment differs from the recording before, at {differs}.")
            if differs is not None:
                raise CannotRedo(
                    f"At step {differs.t + 1:,} the environment differs from the recording: {differs.field}: "
                    f"recorded {differs.recorded}, got {differs.got}."
                )


def paint_observation(recording: Recording, seen: Iterator[Seen]) -> Painted:
    """Show the image in each observation; if the first was lost, the second in its place."""
    values = Values(recording)
    lost = 0
    for observation, _ in seen:
        if observation is None:
            lost = 1
            continue
        for _ in range(1 + lost):
            yield values.pixels_in(observation)
        lost = 0


def paint_values(recording: Recording, phase: str, episode: int, seen: Iterator[Seen]) -> Painted:
    """Draw the numbers of each observation and the rewards as bars, each on a scale of its own.

    The steps are read once more before, for the scales.
    """
    learners = recording.agents
    values = Values(recording, "state" if recording.has_states else "observation")
    names = [*values.names, *([f"reward {agent}" for agent in learners] if len(learners) > 1 else ["reward"])]
    unknown, unpaid = np.full(len(values.names), np.nan), np.full(len(learners), np.nan)

    def numbers(steps: Iterator[Seen]) -> Iterator[Floats]:
        for observation, step in steps:
            observed = unknown if observation is None else values.numbers_in(observation)
            yield np.append(observed, unpaid if step is None else step["rewards"])

    low = np.zeros(len(names))
    high = low
    for now in numbers(observations_of(recording, phase, episode)):
        finite = np.where(np.isfinite(now), now, np.nan)
        low, high = np.fmin(low, finite), np.fmax(high, finite)
    yield from draw_bars(names, low, high, numbers(seen))


# --- as files -----------------------------------------------------------------------------------------


def picture_note(recording: Recording, phase: str) -> tuple[bool, str]:
    """Return whether an episode has pictures besides those of a scene, and why not, or why no better ones."""
    source, reason = source_of(recording, phase)
    if source is PictureSource.VALUES:
        return False, f"There is no picture. {sentence(reason)}"
    if source is PictureSource.OBSERVATION:
        return True, f"These are the observations. {sentence(reason)}"
    return source is not PictureSource.SCENE, ""


def encoded_pictures(
    path: Path, phase: str, episode: int, start: int = 0
) -> Generator[bytes | str, None, None]:
    """Yield the pictures of an episode from the frame after `start` steps on; none of a scene.

    Before the first one there may be a note, a text: why they are not drawn by the environment, although it
    could be made again.

    Raises:
        RecordingError: there is no such episode, or the recording is damaged.
        CannotRedo: the environment cannot be made again, or is another one than was recorded, and the
            recording has no pictures of its own.
    """
    with open_recording(path) as recording:
        source, reason, has_failed, painted = paint(recording, phase, episode, first=start)
        if source is PictureSource.VALUES:
            raise CannotRedo(f"There is no picture. {reason}")
        if has_failed:
            yield f"These are the {source}. {reason}"
        if source is PictureSource.RECORDED:
            last = None
            for frame in recorded_frames(recording, phase, episode, start):
                yield b"" if frame is last else frame["data"]
                last = frame
        elif source is not PictureSource.SCENE:
            with closing(painted):
                yield from map(encoded_picture, painted)


def encoded_picture(pixels: Pixels) -> bytes:
    """Return a picture as a file."""
    require("PIL", extra="plots", purpose="a picture")
    return image_bytes(pixels, "png" if pixels.shape[0] * pixels.shape[1] <= _MAX_EXACT_PIXELS else "jpeg")


# --- thumbnails and sketches --------------------------------------------------------------------------


@dataclass
class Thumbnails:
    """Small pictures of an episode, and which of them each frame shows."""

    pictures: list[str] = field(default_factory=list)
    """The pictures as addresses: `data:image/webp;base64,...`."""
    picture: list[int] = field(default_factory=list)
    """The index of each frame's picture: that of its own step, or of one before it."""
    picture_note: str = ""
    """Why there are none, or no further ones."""


def thumbnails(path: Path, phase: str, episode: int, frames: int) -> Thumbnails:
    """Return thumbnails for the first frames of an episode."""
    require("PIL.Image", extra="plots", purpose="the pictures of a report")
    result = Thumbnails()
    every = -(-frames // MAX_THUMBNAILS)
    latest = b""
    try:
        with closing(encoded_pictures(path, phase, episode)) as pictures:
            for data in pictures:
                if isinstance(data, str):
                    result.picture_note = data
                    continue
                k = len(result.picture)
                if k == frames:
                    break
                latest = data or latest
                if k % every == 0 and latest:
                    result.pictures.append(_small(latest))
                    latest = b""
                result.picture.append(len(result.pictures) - 1)
    except RunnerError as error:
        result.picture_note = str(error)
    if result.pictures:
        result.picture += [len(result.pictures) - 1] * (frames - len(result.picture))
    return result


def _small(data: bytes) -> str:
    """Return the thumbnail of a picture, as an address that contains it.

    Raises:
        RecordingError: it is no picture, or too large.
    """
    image = decoded(data, "A recorded frame")
    image.thumbnail((_THUMBNAIL_SIDE, _THUMBNAIL_SIDE))
    buffer = io.BytesIO()
    options: dict[str, object] = {"quality": _WEBP_QUALITY, "method": 2}
    image.save(buffer, "WEBP", **options)
    return f"data:image/webp;base64,{base64.b64encode(buffer.getvalue()).decode()}"


def episode_sketch(recording: Recording, phase: str, episode: int, title: str) -> str:
    """Sketch an episode as SVG: its last state with the trails of the movers, or its return over its steps.

    No environment is made; without recorded steps the sketch says so.

    Raises:
        RecordingError: there is no such episode, or the recording is damaged.
    """
    tables = recording.phase(phase)
    if recording.leaves_out_steps or tables.steps.are_actions:
        where = f'x="{_SKETCH_WIDTH / 2}" y="{_SKETCH_HEIGHT / 2}" text-anchor="middle"'
        text = f'<text {where} font-size="13" fill="{palette.MIDTONE}">no steps</text>'
        return svg.picture(_SKETCH_WIDTH, _SKETCH_HEIGHT, title, text)
    drawing = svg.drawing_of(recording.mdp) if recording.tabular else None
    states = []
    rewards = [np.zeros(1)]
    count = 0
    for rows in tables.episode(episode).rows(0):
        rewards.append(rows["rewards"].sum(axis=1))
        if drawing is not None:
            recording.mdp.check_steps(rows, str(recording.path), schema.PHASE_NAMES[phase])
            states += [rows["state"], rows["next_state"][-1:]]
        count += len(rows)
        if count >= _MAX_SKETCHED_STEPS:
            break
    if drawing is not None and states:
        places = drawing.places(recording.mdp, np.concatenate(states).astype(np.int64))
        return drawing.frame(places[-1], title, places)
    returns = np.concatenate(rewards).cumsum()
    return _curve(returns[:: -(-len(returns) // _MAX_SKETCHED_POINTS)].tolist(), title)


def _curve(values: Sequence[float], title: str) -> str:
    """Return a curve without axes."""
    finite = [value for value in values if np.isfinite(value)]
    low, high = min(finite, default=0.0), max(finite, default=0.0)
    across = _SKETCH_WIDTH / max(1, len(values) - 1)
    up = (_SKETCH_HEIGHT - 20) / ((high - low) or 1.0)
    points = " ".join(
        f"{k * across:.1f},{_SKETCH_HEIGHT - 10 - (value - low) * up:.1f}"
        for k, value in enumerate(values)
        if np.isfinite(value)
    )
    line = f'<polyline fill="none" stroke="{palette.agent(0)}" stroke-width="2" points="{points}"/>'
    return svg.picture(_SKETCH_WIDTH, _SKETCH_HEIGHT, title, line)
