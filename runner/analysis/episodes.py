"""Which episode of a recording, and which of its steps: one reference, and one grammar for all forms.

    120:5 or train:120:5    step 5 of training episode 120; `120` is its first step
    eval:3000:17:5          step 5 of trial 17 of the evaluation after 3,000 training episodes;
                            `eval:3000` is the first step of its first trial
    step:100000             a training step by its number, counted over a run that was trained here
    typical, best, worst    the episode that a page or film shows first, or the extremes by success and return
    last                    the last training episode that ended

`:T` may follow a word. A mark keeps such a reference, with a text and tags.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final, Literal, Self

import numpy as np

from runner.analysis.contents import require_steps
from runner.analysis.evaluations import Evaluation, evaluation_after, evaluations_of
from runner.archive.places import opened
from runner.errors import NotInRecording, RecordingError, RunnerError, nearest
from runner.recording.labels import check_tags
from runner.recording.marks import MAX_MARK_TEXT, Mark, Marks, change_marks
from runner.replay.steps import step_of_episode, steps_of
from runner.runs.run import Run
from runner.util.arrays import Ints, Records
from runner.util.humanize import capitalised
from runner.util.values import is_utf8

if TYPE_CHECKING:
    from runner.recording.reader import Recording
    from runner.recording.steps import EpisodeSteps

EXPECTED_OF_TRAINING: Final = "EPISODE:T such as 120:5, or step:N, a training step by its number"
EXPECTED: Final = (
    "EPISODE:T such as 120:5, step:N, or eval:N:TRIAL:T, where a TRIAL or T that is left out is 0; or "
    "typical, best, worst or last"
)
STEP: Final = "step"
"""The word of a reference that has only the number of a training step, as its `t`."""
TYPICAL: Final = "typical"
BEST: Final = "best"
UNKNOWN_EVALUATION: Final = -1
"""Stands for an evaluation that was cut off: its trials are counted over the phase."""

_EPISODE_WORDS: Final = (TYPICAL, BEST, "worst", "last")
_NUMBER: Final = "([0-9]{1,15})"
_TRAINING: Final = re.compile(f"(?:train:)?{_NUMBER}(?::{_NUMBER})?")
_EVALUATION: Final = re.compile(f"eval:{_NUMBER}(?::{_NUMBER})?(?::{_NUMBER})?")
_WORD: Final = re.compile(f"(?:(step)(?=:)|({'|'.join(_EPISODE_WORDS)}))(?::{_NUMBER})?")


@dataclass(frozen=True)
class EpisodeRef:
    """A training episode or a trial of an evaluation, and one of its steps."""

    episode: int = 0
    """The training episode, or the trial within its evaluation."""
    t: int = 0
    after: int | None = None
    """The training episodes before the evaluation; None for a training episode."""
    word: str = ""
    """A word such as `typical`, until `resolved` looks the episode up in a recording; else empty."""

    @classmethod
    def parse(cls, at: str | int | Self, expected: str = EXPECTED) -> Self:
        """Parse a reference, or refer to a training step by its number.

        Args:
            at: the text or the number; a reference is returned as it is.
            expected: what an error says that was expected.

        Raises:
            RunnerError: the text is no reference.
        """
        if isinstance(at, cls):
            return at
        if isinstance(at, int):
            return cls(t=at, word=STEP)
        text = str(at)
        if match := _TRAINING.fullmatch(text):
            episode, t = (int(part or 0) for part in match.groups())
            return cls(episode, t)
        if match := _EVALUATION.fullmatch(text):
            after, trial, t = (int(part or 0) for part in match.groups())
            return cls(trial, t, after)
        if match := _WORD.fullmatch(text):
            return cls(t=int(match[3] or 0), word=match[1] or match[2])
        near = nearest(text[:60].partition(":")[0], [word for word in _EPISODE_WORDS if word in expected])
        raise RunnerError(f"found {text[:60]!r}, expected {expected}.{near}")

    def __str__(self) -> str:
        """Return the text that `parse` takes."""
        return f"{self.episode_text}:{self.t}"

    @property
    def phase(self) -> Literal["train", "eval"]:
        """The phase of the episode."""
        return "train" if self.after is None else "eval"

    @property
    def episode_text(self) -> str:
        """The part of the text that names the episode: all without the `:T`."""
        return self.word or (str(self.episode) if self.after is None else f"eval:{self.after}:{self.episode}")

    @property
    def episode_path(self) -> str:
        """The address of the episode, below the replay of its run: `train/120`, `eval/3000/17`."""
        return f"train/{self.episode}" if self.after is None else f"eval/{self.after}/{self.episode}"

    @property
    def title(self) -> str:
        """The name of the episode, within a sentence."""
        if self.after is None:
            return f"training episode {self.episode:,}"
        if self.after == UNKNOWN_EVALUATION:
            return f"evaluation episode {self.episode:,}"
        return f"trial {self.episode:,} of the evaluation after {self.after:,} episodes"

    @property
    def heading(self) -> str:
        """The name of the episode as a title."""
        return capitalised(self.title)

    @property
    def outcome(self) -> EpisodeRef:
        """The frame after the step, which shows its outcome."""
        return replace(self, t=self.t + 1)

    @property
    def replay(self) -> str:
        """The address of the replay at the frame after the step, below the address of the run."""
        return f"replay/{self.episode_path}?t={self.outcome.t}"

    def replay_address(self, run_id: str) -> str:
        """Return the address of the replay of a run at the frame after the step."""
        return f"/runs/{run_id}/{self.replay}"

    def resolved(self, recording: Recording) -> EpisodeRef:
        """Return the reference with an episode of a recording in place of a word.

        Raises:
            RecordingError: the recording has no such episode.
        """
        if not self.word:
            return self
        if self.word == STEP:
            return reference_to(recording, training_step(recording, self))
        return replace(_episode_named(recording, self.word), t=self.t)

    def evaluation_in(self, recording: Recording) -> Evaluation:
        """Return the evaluation of a trial.

        Raises:
            NotInRecording: no evaluation followed that training episode.
        """
        return evaluation_after(evaluations_of(recording), self.after or 0, str(recording.path))

    def number_in(self, recording: Recording) -> int:
        """Return the number of the episode, counted over its phase.

        Raises:
            NotInRecording: there is no such evaluation or trial.
        """
        if self.after in (None, UNKNOWN_EVALUATION):
            return self.episode
        return self.evaluation_in(recording).trial(self.episode, str(recording.path))

    def steps_in(self, recording: Recording, with_end: bool = False) -> EpisodeSteps:
        """Return the steps of the episode, which must have step `t`; `with_end` allows the end, after them.

        Raises:
            NotInRecording: the episode has fewer steps.
        """
        steps = recording.phase(self.phase).episode(self.number_in(recording))
        if self.t >= len(steps) + with_end:
            raise self.no_step(recording, len(steps), self.t)
        return steps

    def no_step(self, recording: Recording, steps: int, t: int, part: str = "") -> NotInRecording:
        """Return the error that the episode, or a `part` of it, has `steps` steps and thus no step `t`."""
        return NotInRecording(
            f"{recording.path}: {part}{self.title} has {steps:,} steps, from 0; found no step {t:,}."
        )


StepLike = EpisodeRef | str | int
"""What names a step: a reference, the text of one, or the number of a training step."""


# --- training steps ---------------------------------------------------------------------------------------


def training_steps(recording: Recording) -> int:
    """Return the number of training steps of a job, also if they were not recorded."""
    ended = step_of_episode(recording, recording.train.episodes.count())
    return max(recording.done()["train_steps"], ended)


def training_step(recording: Recording, at: EpisodeRef) -> int:
    """Return the number of a training step of a job, also of one that recorded no steps.

    Raises:
        RunnerError: the reference is to a step of an evaluation.
    """
    taken = training_steps(recording)
    if at.word == STEP:
        if not 0 <= at.t < taken:
            raise NotInRecording(
                f"{recording.path}: found no training step {at.t:,}; there are {taken:,}, from 0 to "
                f"{taken - 1:,}."
            )
        return at.t
    at = at.resolved(recording)
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


def reference_to(recording: Recording, step: int) -> EpisodeRef:
    """Return the reference to a training step of a job: its episode, and its number within the episode."""
    episode = recording.train.episodes.first_from("last_step", step)
    return EpisodeRef(episode, step - step_of_episode(recording, episode))


def first_state(recording: Recording, at: EpisodeRef) -> int:
    """Return the state in which an episode of a tabular environment begins."""
    require_steps(recording, "show", may_redo=True)
    steps = steps_of(recording, at.phase, at.number_in(recording))[:1]
    recording.mdp.check_steps(steps, str(recording.path))
    return int(steps["state"][0])


# --- the episodes that words stand for --------------------------------------------------------------------


def _episode_named(recording: Recording, word: str) -> EpisodeRef:
    """Return the episode that a word stands for.

    The typical one is the typical trial of the last whole evaluation; of a loop, where the number of trials
    of an evaluation is unknown, the first trial after the last training. Without such a trial it is the
    last training episode.
    """
    if word not in ("last", TYPICAL):
        phase, numbers = ranked_episodes(recording)
        return references(recording, phase, numbers[[-1 if word == BEST else 0]])[0]
    if word == TYPICAL and recording.eval.has_metrics:
        if (evaluation := last_whole_evaluation(recording)) is not None:
            return ranked(recording, "eval", evaluation.start, evaluation.stop)[1]
    elif word == TYPICAL and (evaluations := evaluations_of(recording)):
        return EpisodeRef(after=evaluations[-1].after)
    return EpisodeRef(max(0, recording.train.episodes.count() - 1))


def references(recording: Recording, phase: str, numbers: Sequence[int] | Ints) -> list[EpisodeRef]:
    """Return the references to episodes, counted over their phase; trials are counted in their evaluation."""
    if phase == "train":
        return [EpisodeRef(int(number)) for number in numbers]
    evaluations = evaluations_of(recording)
    stops = [evaluation.stop for evaluation in evaluations]
    at = np.searchsorted(stops, numbers, side="right").tolist()
    return [
        EpisodeRef(int(number), after=UNKNOWN_EVALUATION)
        if index == len(evaluations) or number < evaluations[index].start
        else EpisodeRef(int(number) - evaluations[index].start, after=evaluations[index].after)
        for number, index in zip(numbers, at, strict=True)
    ]


def ranked_episodes(recording: Recording) -> tuple[str, Ints]:
    """Return the phase and the numbers of its episodes from worst to best: by success, return and length.

    They are the trials of all evaluations; of a run without trials the training episodes.

    Raises:
        RecordingError: no episode ended, or there are no steps.
    """
    require_steps(recording, "show", may_redo=True)
    phase = "eval" if recording.eval.episodes.count() else "train"
    records = _ranked_fields(recording, phase)
    records = records[records["last_step"] < recording.phase(phase).steps.total()]
    if not len(records):
        raise RecordingError(f"{recording.path}: found no episode that ended; --episode 0 shows the first.")
    return phase, records["episode"][_by_rank(records)]


def ranked(recording: Recording, phase: str, start: int, stop: int) -> list[EpisodeRef]:
    """Return the worst, the median and the best of some episodes: by success, return and length."""
    records = recording.phase(phase).episodes.array(start, stop)
    numbers = records["episode"][_by_rank(records)]
    return references(recording, phase, numbers[[0, len(numbers) // 2, -1]])


def in_order(recording: Recording, phase: str, order: str) -> Ints:
    """Return the numbers of the episodes of a phase in an order, such as `longest` first."""
    records = _ranked_fields(recording, phase)
    places = np.arange(len(records))
    if order in ("longest", "shortest"):
        places = np.argsort(records["length"], kind="stable")
    elif order in ("worst", "best"):
        places = _by_rank(records)
    numbers: Ints = records["episode"][places]
    return numbers[::-1] if order in ("newest", "longest", "best") else numbers


def _ranked_fields(recording: Recording, phase: str) -> Records:
    """Return the fields of all episodes by which they are ranked."""
    from numpy.lib.recfunctions import repack_fields  # loads much

    table = recording.phase(phase).episodes
    fields = ["episode", "success", "length", "returns", "last_step"]
    blocks = (repack_fields(block[fields]) for block in table.blocks())
    return np.concatenate([repack_fields(np.empty(0, table.row_dtype)[fields]), *blocks])


def _by_rank(records: Records) -> Ints:
    """Return the places of episodes from worst to best; a return that is no number is the worst."""
    with np.errstate(over="ignore", invalid="ignore"):  # rewards may be infinite
        returns = records["returns"].sum(axis=1)
    returns[np.isnan(returns)] = -np.inf
    return np.lexsort((-records["length"].astype(np.int64), returns, records["success"]))


def last_whole_evaluation(recording: Recording) -> Evaluation | None:
    """Return the last evaluation of which all trials were recorded; None if there is none.

    A recording that was cut off may have an evaluation's metrics without its trials. The evaluations of a
    loop are the trials that were recorded.
    """
    steps = recording.eval.steps.total()
    for evaluation in reversed(evaluations_of(recording)):
        last = recording.eval.episodes.array(evaluation.stop - 1, evaluation.stop)
        if len(last) and last[0]["last_step"] < steps:
            return evaluation
    return None


# --- marks ------------------------------------------------------------------------------------------------


def mark(run: Run, at: StepLike, text: str = "", *, tags: Iterable[str] = ()) -> Mark:
    """Mark a step of a run with a text, and return the mark.

    Args:
        run: the run, in a folder of its own.
        at: the step, such as `"812:57"`, `"eval:3000:17:5"` or `"worst"`; the number of its steps is its end.
        text: at most 1,000 characters; it may be empty if there are tags.
        tags: tags of the mark.

    Raises:
        NotInRecording: the run has no such step.
        RunnerError: the recording is not in a folder of its own, there is neither text nor tag or one
            of them is not valid, or there are too many marks.
        StorageError: the run's folder cannot be written.
    """
    (made,) = mark_steps(run, [at], text, tags=tags)
    return made


def mark_steps(run: Run, steps: Iterable[StepLike], text: str, *, tags: Iterable[str]) -> list[Mark]:
    """Mark steps of a run with the same text; arguments and errors as for `mark`."""
    run.require_folder()
    text = text.strip()
    names = tuple(sorted(set(tags)))
    existing = []
    with opened(run) as recording:
        for at in steps:
            step = EpisodeRef.parse(at).resolved(recording)
            step.steps_in(recording, with_end=True)  # or raise an error
            existing.append((step, step.number_in(recording)))
    check_tags(names)
    if not (text or names):
        raise RunnerError("mark: found no text, expected a text or tags.")
    if not is_utf8(text) or len(text) > MAX_MARK_TEXT:
        raise RunnerError(
            f"text: found {text[:100]!r}, expected at most {MAX_MARK_TEXT:,} characters in UTF-8."
        )
    created = datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    marks = [Mark(str(step), episode, text, names, created) for step, episode in existing]
    change_marks(run.folder, lambda before: before.merged(marks))
    return marks


def unmark(run: Run, *ids: str) -> None:
    """Remove marks of a run by their ids; merging brings none of them back.

    Raises:
        NotInRecording: the run has no such mark.
        StorageError: the run's folder cannot be written.
    """
    run.require_folder()

    def change(marks: Marks) -> Marks:
        known = [mark.id for mark in marks.marks]
        if missing := [name for name in ids if name not in known]:
            raise NotInRecording(
                f"run {run.run_id}: found no mark {missing[0]!r}, expected one of: "
                f"{', '.join(known) or 'none'}."
            )
        return marks.merged((), ids)

    change_marks(run.folder, change)
