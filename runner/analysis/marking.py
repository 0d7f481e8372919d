"""Marks at steps of a run: set at a step that the run has, and removed."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime

from runner.analysis.episodes import EpisodeRef, StepLike
from runner.archive.places import opened
from runner.errors import NotInRecording, RunnerError
from runner.recording.labels import check_tags
from runner.recording.marks import MAX_MARK_TEXT, Mark, Marks, change_marks
from runner.runs.run import Run
from runner.util.values import is_utf8


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
    with opened(run) as recording:
        existing = []
        for at in steps:
            step = EpisodeRef.parse(at).resolved(recording)  # with its episode in place of a word
            step.steps_in(recording, with_end=True)
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
