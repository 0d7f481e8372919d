"""The pictures of a recorded episode: one source for films, pages, reports and terminals.

    with contextlib.closing(Pictures(recording, "train", 12)) as shown:
        for picture in shown:                       # T + 1 of them for an episode of T steps
            print(picture.t, picture.pixels.shape, picture.action, picture.returns)

What the pictures are made from is decided in one place, by what there is: the scene of a tabular environment;
recorded frames; the environment, made again, which draws the episode while it is compared with the recording;
observations that are images; or else the numbers of the observations as bars.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import dataclass
from enum import StrEnum
from itertools import tee
from typing import NamedTuple

import numpy as np

from runner.analysis.contents import ENDINGS, Step, ending_of, require_steps
from runner.drawing import svg
from runner.drawing.raster import Pixels, require_packages
from runner.environments.mdp import events_of
from runner.environments.naming import agent_actions_in_words, events_in_words, exploration_in_words, spoken
from runner.errors import CannotRedo
from runner.export.painting import (
    Painted,
    paint_observation,
    paint_recorded,
    paint_redrawn,
    paint_scene,
    paint_values,
)
from runner.export.values import Seen, Values, observations_of, observed, step_actions_in_words
from runner.recording.reader import Recording
from runner.recording.spaces import Value
from runner.replay.makers import why_not_rerun
from runner.replay.steps import (
    environments_with_frames,
    frames_every,
)


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


def moments_of(
    recording: Recording, phase: str, episode: int, seen: Iterator[Seen] | None = None
) -> Iterator[PictureMoment]:
    """Yield T + 1 moments of an episode of T steps: after the reset, and after each step.

    `seen` are the steps of the episode as `observations_of` yields them, if they are read already.
    """
    describe = describer(recording, phase)
    steps = len(recording.phase(phase).episode(episode))
    returns = np.zeros(len(recording.agents))
    unpaid = tuple(returns.tolist())
    for t, (observation, step) in enumerate(seen or observations_of(recording, phase, episode)):
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
        # Read once: what draws the pictures takes the steps at the same time as their descriptions do.
        seen, shown = tee(observations_of(recording, phase, episode))
        self.source, self.reason, _, self._painted = paint(recording, phase, episode, trust, seen=shown)
        self.note = ""
        self._pictures = self._generate(moments_of(recording, phase, episode, seen))

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


class Painting(NamedTuple):
    """The painted states of an episode."""

    source: PictureSource
    reason: str
    """Why the environment does not draw them, as a sentence; empty if it does, or has no need to."""
    has_failed: bool
    """Whether it turned out not to draw them, although it could be made again."""
    pictures: Painted


def paint(
    recording: Recording,
    phase: str,
    episode: int,
    trust: bool = False,
    first: int = 0,
    seen: Iterator[Seen] | None = None,
) -> Painting:
    """Return the painted states of an episode from number `first` on, of the best source that works.

    `seen` are the steps from there on as `observations_of` yields them, if they are read already.
    """
    source, reason = source_of(recording, phase, trust, episode)
    has_failed = False
    if source is PictureSource.REDRAWN:
        redrawn = paint_redrawn(recording, phase, episode, trust, first)
        try:
            return Painting(source, "", has_failed, _continued(next(redrawn), redrawn))
        except CannotRedo as error:
            redrawn.close()
            source = source_of_recorded(recording, phase, episode)
            reason = str(error)
            has_failed = True
    seen = seen or observations_of(recording, phase, episode, first)
    match source:
        case PictureSource.SCENE:
            painted = paint_scene(recording, seen)
        case PictureSource.RECORDED:
            painted = paint_recorded(recording, phase, episode, seen)
        case PictureSource.OBSERVATION:
            painted = paint_observation(recording, seen)
        case _:
            painted = paint_values(recording, phase, episode, seen)
    return Painting(source, reason, has_failed, painted)


def _continued(first: Pixels, painted: Painted) -> Painted:
    """Yield a picture and those after it; closing them closes what paints them."""
    with closing(painted):
        yield first
        yield from painted


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
