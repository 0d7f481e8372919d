"""The pictures of a recorded episode: one source for films, pages, reports and terminals.

    with contextlib.closing(pictures(recording, "train", 12)) as shown:
        for picture in shown:                       # T + 1 of them for an episode of T steps
            print(picture.t, picture.pixels.shape, picture.action, picture.returns)

What a picture shows is decided in one place, by what the recording has: the scene of a tabular environment; a
frame that was recorded; an observation that is an image; or else the numbers of the observation as bars.
"""

from __future__ import annotations

import io
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from runner.drawing import svg
from runner.drawing.bars import BarRaster
from runner.drawing.raster import Pixels, SceneRaster, require_packages
from runner.environments.mdp import events_of
from runner.environments.naming import deeds_in_words, events_in_words, exploration_in_words
from runner.errors import RecordingError
from runner.export.contents import ENDINGS, ending_of, require_steps
from runner.export.values import Values, value_in_words
from runner.recording import schema
from runner.recording.reader import Recording
from runner.replay.steps import check_steps, reset_of, transitions_of

SCENE_SIZE: Final = 480
"""The largest width and height of the picture of a scene."""
MAX_PIXELS: Final = 4096 * 4096
"""The most pixels of a recorded frame."""
_END_OF_TIME: Final = 2**62
"""Later than any message, in nanoseconds."""

Paint = Callable[[int, Any], Pixels]
"""Returns the picture after t steps; called in order, with t and the record of step t, of the first for 0."""


class Source(StrEnum):
    """What the pictures of an episode are made from."""

    SCENE = "scene"
    """The scene of a tabular environment, drawn from the recorded states."""
    RECORDED = "recorded frames"
    OBSERVATION = "observations"
    """Observations that are images."""
    VALUES = "values"
    """The numbers of observations and rewards, as bars."""


@dataclass(frozen=True, eq=False)
class Picture:
    """What an episode looked like after some of its steps."""

    t: int
    """Steps of the episode so far; 0 after the reset."""
    pixels: Pixels
    """uint8 [height, width, 3]; all pictures of an episode have one size."""
    action: str
    """The action of the last of these steps, by name where it has one; empty at 0."""
    rewards: tuple[float, ...]
    """The rewards of that step, one for each learner; zeros at 0."""
    returns: tuple[float, ...]
    """Sums of the rewards so far."""
    events: str
    """What happened in that step: events of the environment, exploration, texts of the observation."""
    ended: str
    """How the episode ended, as text, in its last picture; else empty."""
    note: str = ""
    """Why no picture follows although steps do; else empty."""


class Pictures:
    """The pictures of an episode, an iterator; `close` it if it is left before its end.

    Attributes:
        source: what they are made from.
        reason: why they are not made from anything better; empty for a scene and for frames.
        steps: steps of the episode; there is one more picture, unless one has a note.
        learners: the names of the learners, one for each reward.
    """

    def __init__(self, recording: Recording, phase: str, episode: int) -> None:
        require_packages()
        require_steps(recording, "show")
        self._recording, self._phase, self._episode = recording, phase, episode
        self.learners = recording.agents
        self.steps = len(recording.episode_span(phase, episode))
        self.source, self.reason = source_of(recording, phase)
        self._pictures = self._generate()

    def __iter__(self) -> Iterator[Picture]:
        return self

    def __next__(self) -> Picture:
        return next(self._pictures)

    def close(self) -> None:
        """Free what makes the pictures."""
        self._pictures.close()

    def _generate(self) -> Generator[Picture, None, None]:
        recording, phase, episode = self._recording, self._phase, self._episode
        paint = _PAINTERS[self.source](recording, phase, episode)
        describe = _describer(recording)
        returns = np.zeros(len(recording.agents))
        none = tuple(returns.tolist())
        for t, row in enumerate(transitions_of(recording, phase, episode), 1):
            if t == 1:
                yield Picture(0, paint(0, row), "", none, none, "", "")
            pixels = paint(t, row)
            action, events = describe(row)
            rewards = np.asarray(row["rewards"], np.float64)
            returns += rewards
            ended = ENDINGS[ending_of(recording, phase, episode)] if t == self.steps else ""
            yield Picture(t, pixels, action, tuple(rewards.tolist()), tuple(returns.tolist()), events, ended)


def pictures(recording: Recording, phase: str, episode: int) -> Pictures:
    """Return the pictures of an episode of a phase (`train` or `eval`), counted from 0.

    Raises:
        RecordingError: there is no such episode, or the recording has no steps.
        MissingExtra: a package that draws them is not installed.
    """
    return Pictures(recording, phase, episode)


def _describer(recording: Recording) -> Callable[[Any], tuple[str, str]]:
    """Return how to put a step's action, and what happened in it, in words."""
    if recording.tabular:
        mdp, learners = recording.mdp, recording.agents
        deeds = deeds_in_words(mdp)

        def describe(row: Any) -> tuple[str, str]:
            step = np.asarray(row).reshape(1)
            check_steps(step, mdp, str(recording.path))
            events = events_in_words(mdp, int(events_of(mdp, step)[0]))
            explored = exploration_in_words(int(row["explored"]), learners)
            return deeds[row["action"]], ", ".join(filter(None, [events, explored]))

        return describe
    if recording.kind == "step":
        return lambda row: (f"action {row['action']}", "")
    texts, agents = Values(recording.spaces["observation"], "observation"), recording.agents

    def describe_values(row: Any) -> tuple[str, str]:
        action = row["action"]
        if len(agents) > 1:
            action = {agent: action[agent] for i, agent in enumerate(agents) if int(row["acted"]) >> i & 1}
        words = value_in_words(action)
        return f"action {words}" if words.isdecimal() else words, texts.texts_in(row["next_observation"])

    return describe_values


def source_of(recording: Recording, phase: str) -> tuple[Source, str]:
    """Return what the pictures of a phase are made from, and why it is not anything better."""
    if recording.tabular and svg.drawing_of(recording.mdp) is not None:
        return Source.SCENE, ""
    has_frames = not recording.is_job and recording.environments == 1
    if has_frames and next(recording.messages(recording.topic(f"/{phase}/frame")), None) is not None:
        return Source.RECORDED, ""
    reason = "it has no scene, and no frames were recorded"
    if (
        recording.kind in ("transition", "variable")
        and Values(recording.spaces["observation"], "observation").image is not None
    ):
        return Source.OBSERVATION, reason
    return Source.VALUES, reason


# --- what pictures are made from --------------------------------------------------------------------------


def _paint_scene(recording: Recording, phase: str, episode: int) -> Paint:  # noqa: ARG001
    """Draw the scene in each state, with the way that led there."""
    mdp = recording.mdp
    drawing = svg.drawing_of(mdp)
    assert drawing is not None
    raster = SceneRaster(drawing, SCENE_SIZE, SCENE_SIZE)
    places: deque[NDArray[np.int16]] = deque(maxlen=svg.TRAIL)

    def paint(t: int, row: Any) -> Pixels:
        check_steps(np.asarray(row).reshape(1), mdp, str(recording.path), schema.PHASE_NAMES[phase])
        state = row["next_state" if t else "state"]
        places.append(drawing.places(mdp, np.array([state]))[0])
        return raster.draw(np.stack(places))

    return paint


def _paint_recorded(recording: Recording, phase: str, episode: int) -> Paint:
    """Show the last frame that was recorded up to each step."""
    topic, every = recording.topic(f"/{phase}/frame"), _frames_every(recording)
    frames: Iterator[dict[str, Any]] = iter(())
    following: dict[str, Any] | None = None
    shown: Pixels | None = None

    def show_next() -> None:
        nonlocal following, shown
        assert following is not None
        where = f"{recording.path}: the frame at {following['log_time']} ns"
        shown = _pixels(following["data"], where, shown)
        following = next(frames, None)

    def paint(t: int, row: Any) -> Pixels:
        nonlocal frames, following
        time, over = int(row["log_time"]), row["terminated"] or row["truncated"]
        if t == 0:
            reset = reset_of(recording, phase, episode)
            first = time if reset is None else int(reset["log_time"])
            frames = recording.decoded(topic, times=range(first, _END_OF_TIME))
            following = next(frames, None)
        while following is not None and following["log_time"] < time:
            show_next()
        # A frame at the time of the episode's last step may be that of the next reset.
        if t and following is not None and following["log_time"] == time and (over or t % every == 0):
            show_next()
        if shown is None:
            raise RecordingError(f"{recording.path}: the first frame of {phase} episode {episode} was lost.")
        return shown

    return paint


def _frames_every(recording: Recording) -> int:
    """Return after how many steps of an episode a frame was recorded, as its configuration says."""
    frames = recording.config.get("frames")
    every = frames.get("every") if isinstance(frames, Mapping) else None
    return every if isinstance(every, int) and every > 0 else 1


def _pixels(data: bytes, where: str, before: Pixels | None) -> Pixels:
    """Return a recorded frame in the size of the one before it, if there is one.

    Raises:
        RecordingError: it is no picture, or too large.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as image:
            if image.width * image.height > MAX_PIXELS:
                raise RecordingError(f"{where}: has {image.width}x{image.height} pixels, too many to show.")
            picture = image.convert("RGB")
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, ValueError, SyntaxError) as error:
        raise RecordingError(f"{where}: cannot be shown ({error}).") from error
    if before is not None and picture.size != before.shape[1::-1]:
        picture = picture.resize(before.shape[1::-1])
    return np.asarray(picture)


def _paint_observation(recording: Recording, phase: str, episode: int) -> Paint:
    """Show the image in each observation."""
    values = Values(recording.spaces["observation"], "observation")
    reset = reset_of(recording, phase, episode)

    def paint(t: int, row: Any) -> Pixels:
        if t == 0:
            return values.pixels_in(row["next_observation"] if reset is None else reset["observation"])
        return values.pixels_in(row["next_observation"])

    return paint


def _paint_values(recording: Recording, phase: str, episode: int) -> Paint:
    """Draw the numbers of each observation and the rewards as bars, each on a scale of its own."""
    learners = recording.agents
    rewards = [f"reward {agent}" for agent in learners] if len(learners) > 1 else ["reward"]
    names, read = _numbers(recording)
    reset = None if recording.kind in ("job", "step") else reset_of(recording, phase, episode)

    def values(t: int, row: Any) -> NDArray[np.float64]:
        paid = row["rewards"] if t else np.full(len(learners), np.nan)
        return np.append(read(t, row, reset), paid)

    low = high = np.zeros(len(names) + len(rewards))
    for t, row in enumerate(transitions_of(recording, phase, episode), 1):
        for now in (values(0, row), values(1, row)) if t == 1 else (values(t, row),):
            low, high = np.fmin(low, now), np.fmax(high, now)
    raster = BarRaster([*names, *rewards], low, high)
    return lambda t, row: raster.draw(values(t, row))


def _numbers(recording: Recording) -> tuple[list[str], Callable[[int, Any, Any], NDArray[np.float64]]]:
    """Return the names of an observation's numbers, and how to read them from t, a step and the reset.

    The numbers before the first step are nan if its reset was lost.
    """
    if recording.kind in ("job", "step"):
        return ["state"], lambda t, row, _: np.array([row["next_state" if t else "state"]], np.float64)
    shown = Values(recording.spaces["observation"], "observation")

    def read(t: int, row: Any, reset: Any) -> NDArray[np.float64]:
        if t == 0 and reset is None:
            return np.full(len(shown.names), np.nan)
        return shown.numbers_in(row["next_observation"] if t else reset["observation"])

    return shown.names, read


_PAINTERS: Final[Mapping[Source, Callable[[Recording, str, int], Paint]]] = {
    Source.SCENE: _paint_scene,
    Source.RECORDED: _paint_recorded,
    Source.OBSERVATION: _paint_observation,
    Source.VALUES: _paint_values,
}
