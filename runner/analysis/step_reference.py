"""References to a step of an episode, as commands (`view --at`) and addresses of pages (`?at=`) have them.

120:5            step 5 of training episode 120; `120` is its first step
eval:3000:17:5   step 5 of trial 17 of the evaluation after 3,000 training episodes;
`eval:3000` is the first step of its first trial
step:100000      a training step by its number, counted over the run; of runs that were trained here
"""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Self

from runner.errors import NotInRecording, RunnerError
from runner.replay.steps import step_of_episode

if TYPE_CHECKING:
    from runner.recording.reader import Recording

EXPECTED: Final = "EPISODE:T such as 120:5, or eval:N:TRIAL:T; a TRIAL or T that is left out is 0"
EXPECTED_OF_TRAINING: Final = "EPISODE:T such as 120:5, or step:N, a training step by its number"
_EXPECTED_ANY: Final = EXPECTED.replace(" or ", " step:N, or ", 1)
_NUMBER: Final = "([0-9]{1,15})"
_BY_NUMBER: Final = re.compile(f"step:{_NUMBER}")
_TRAINING: Final = re.compile(f"{_NUMBER}(?::{_NUMBER})?")
_EVALUATION: Final = re.compile(f"eval:{_NUMBER}(?::{_NUMBER})?(?::{_NUMBER})?")


@dataclass(frozen=True)
class StepRef:
    """A step of a training episode, or of a trial of an evaluation."""

    episode: int
    """The training episode, or the trial."""
    t: int = 0
    after: int | None = None
    """The training episodes before the evaluation; None for a training episode."""

    @classmethod
    def parse(cls, text: str, expected: str = EXPECTED) -> Self:
        """Return the step that a text refers to; `expected` is as for `parse_step`.

        Raises:
            RunnerError: the text is no step reference.
        """
        if match := _TRAINING.fullmatch(text):
            return cls(*(int(part or 0) for part in match.groups()))
        if match := _EVALUATION.fullmatch(text):
            after, trial, t = (int(part or 0) for part in match.groups())
            return cls(trial, t, after)
        raise RunnerError(f"found {text[:60]!r}, expected {expected}.")

    def __str__(self) -> str:
        """Return the text that `parse` takes."""
        return f"{self.episode_text}:{self.t}"

    @property
    def episode_text(self) -> str:
        """The part of the text that names the episode: all without the `:T`."""
        return str(self.episode) if self.after is None else f"eval:{self.after}:{self.episode}"

    @property
    def episode_path(self) -> str:
        """The address of the episode, below that of its run's replay: `train/120`, `eval/3000/17`."""
        return f"train/{self.episode}" if self.after is None else f"eval/{self.after}/{self.episode}"

    @property
    def episode_name(self) -> str:
        """The name of the episode."""
        if self.after is None:
            return f"Training episode {self.episode:,}"
        return f"Trial {self.episode} of the evaluation after {self.after:,} episodes"

    @property
    def which(self) -> tuple[int, ...]:
        """The episode: (episode,) of training, or (training episodes before, trial) of an evaluation."""
        return (self.episode,) if self.after is None else (self.after, self.episode)

    @property
    def outcome(self) -> StepRef:
        """The frame after the step, which shows its outcome."""
        return dataclasses.replace(self, t=self.t + 1)

    def replay_address(self, run_id: str) -> str:
        """Return the page of the replay of a run at the frame after the step."""
        return f"/runs/{run_id}/replay/{self.episode_path}?t={self.outcome.t}"


def parse_step(text: str, expected: str = _EXPECTED_ANY) -> int | StepRef:
    """Return the step that a text refers to, or the number of the training step that `step:N` gives.

    `expected` is what the error says that was expected.
    """
    match = _BY_NUMBER.fullmatch(text)
    return int(match[1]) if match else StepRef.parse(text, expected)


def training_steps(recording: Recording) -> int:
    """Return the number of training steps of a job, also if they were not recorded."""
    ended = step_of_episode(recording, recording.train.episodes.count())
    return max(recording.done()["train_steps"], ended)


def training_step(recording: Recording, at: int | StepRef) -> int:
    """Return the number of a training step of a job, also of one that recorded no steps.

    Raises:
        RunnerError: the reference is to a step of an evaluation.
    """
    taken = training_steps(recording)
    if isinstance(at, int):
        if not 0 <= at < taken:
            raise NotInRecording(
                f"{recording.path}: found no training step {at:,}; there are {taken:,}, from 0 to "
                f"{taken - 1:,}."
            )
        return at
    if at.after is not None:
        raise RunnerError(f"found {at}, expected a step of training: {EXPECTED_OF_TRAINING}.")
    ended = recording.train.episodes.count()
    start = step_of_episode(recording, min(at.episode, ended))
    stop = taken if at.episode >= ended else step_of_episode(recording, at.episode + 1)
    if at.episode > ended or start == stop:
        raise NotInRecording(
            f"{recording.path}: found no training episode {at.episode:,}; there are {ended:,}, from 0."
        )
    if start + at.t >= stop:
        raise NotInRecording(
            f"{recording.path}: found no step {at.t:,} of training episode {at.episode:,}, which has "
            f"{stop - start:,}, from 0."
        )
    return start + at.t


def reference_to(recording: Recording, step: int) -> StepRef:
    """Return the reference to a training step of a job, by its episode and its place in it."""
    episode = recording.train.episodes.first_from("last_step", step)
    return StepRef(episode, step - step_of_episode(recording, episode))
