"""A loop's episodes, rerun: its environment is made again and takes the recorded resets and actions.

    for steps in rerun_in_child(path, "train", episodes=[5], render=True):
        for row in range(len(steps)):
            show(steps.frames[row], steps.recorded["rewards"][row])
        if steps.difference:
            ...                           # the environment is not the recorded one; nothing follows

`rerun` runs the environment, which is foreign code, in this process; `rerun_in_child` in a child process with
limits on memory and time. `runner.replay.makers` says whether a recording can be rerun, and
`runner.export.pictures` what its pictures are made from.
"""

from __future__ import annotations

import multiprocessing
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, Final

from runner.errors import CannotRedo
from runner.recording.reader import Recording, open_recording
from runner.replay.comparison import RerunSteps
from runner.replay.engine import Replay, Report
from runner.replay.episodes import rerun_episode
from runner.replay.makers import why_not_rerun
from runner.util.processes import CallFailed, ChildProcess, TimedOut, report_progress

MEMORY_BYTES: Final = 4 * 10**9
"""How much a child process may allocate; importing RLlib, which wraps many games, takes 2.1 GB of it."""
SECONDS: Final = 60.0
"""How long a child process may take for a block of steps, which is meant to take 0.2 s, or to begin."""


def rerun(
    recording: Recording,
    phase: str | None = None,
    episodes: Sequence[int] | None = None,
    *,
    render: bool = False,
    trust: bool = False,
    tolerance: float = 0.0,
    report: Report = lambda _: None,
    make: Callable[[], object] | None = None,
    draw_from: int = 0,
) -> Iterator[RerunSteps]:
    """Rerun recorded episodes; yield their steps in blocks of about 0.2 s, compared with the recording.

    An episode alone is begun at its reset, if that has a seed or the state of the random generators was
    recorded there, else at the nearest such reset before it. Where its first steps differ then, as in
    environments that keep more than that from episode to episode, it is rerun with all episodes since an
    earlier seed, and at last since the beginning of the recording.

    Args:
        recording: of a loop.
        phase: `train` or `eval`; None for both, in the order of time, without `episodes`.
        episodes: numbers of ended episodes of the phase, in any order; of a single environment also that of
            the last, unfinished one. None for all that happened, in the order of time.
        render: whether to draw a picture after each reset and step.
        trust: whether what the recording names may be imported, see `runner.replay.trust`.
        tolerance: absolute and relative, for floating-point observations and rewards; 0 compares bytes.
        report: called with the number of steps taken so far, also of those before an episode.
        make: returns the environment, which is closed at the end, instead of making it as recorded.
        draw_from: steps of an episode before its first picture.

    Raises:
        CannotRedo: the environment cannot be made again, or draws no pictures; the message is why.
        RecordingError: the recording is damaged, or has no such episode.
    """
    if make is None and (reason := why_not_rerun(recording, trust)):
        raise CannotRedo(reason)
    begin = partial(Replay, recording, trust, tolerance, report, render, make)
    if episodes is None:
        with closing(begin()) as replay:
            for steps in replay.all():
                if phase in (None, steps.phase) or steps.difference is not None:
                    yield steps
        return
    for episode in episodes:
        own = phase or "train"
        if draw_from:
            recorded = recording.phase(own).episode(episode)
            is_inside = draw_from <= len(recorded)
            first = int(recorded.one(draw_from - 1)["step"]) if is_inside else recorded.last + 1
            begin = partial(begin, draw_from=first)
        for steps in rerun_episode(recording, own, episode, begin):
            yield steps
            if steps.difference is not None:
                return


def rerun_in_child(
    path: Path,
    phase: str | None = None,
    episodes: Sequence[int] | None = None,
    *,
    render: bool = False,
    trust: bool = False,
    draw_from: int = 0,
) -> Iterator[RerunSteps]:
    """Rerun recorded episodes in a child process, which ends with the iterator; see `rerun`.

    The child works ahead of the caller by a block at most. A process that is such a child reruns them
    itself, as it may have none.

    Raises:
        CannotRedo: see `rerun`; or the environment hangs, crashes, or needs more memory.
    """
    options: Any = {"render": render, "trust": trust, "draw_from": draw_from}
    if multiprocessing.current_process().daemon:
        _silence()
        with open_recording(path) as recording:
            yield from rerun(recording, phase, episodes, **options)
        return
    for message in stream_from_child(_rerun_path, path, phase, episodes, **options):
        if isinstance(message, RerunSteps):  # else steps taken, which show that it does not hang
            yield message


def stream_from_child(
    function: Callable[..., None],
    path: Path,
    *arguments: object,
    hash_seed: int | None = None,
    **keywords: object,
) -> Iterator[Any]:
    """Yield what a function that runs foreign code passes to `report_progress` in a child process.

    Args:
        function: of a module; called with the path and the other arguments.
        hash_seed: runs in a fresh interpreter with this hash seed.

    Raises:
        CannotRedo: the process hangs, crashes or needs more memory.
    """
    with ChildProcess(MEMORY_BYTES, hash_seed=hash_seed) as child:
        try:
            yield from child.stream(_quietly, SECONDS, function, path, *arguments, **keywords)
        except TimedOut:
            raise CannotRedo(
                f"The environment took longer than {SECONDS:g} s to be made or stepped, and was stopped."
            ) from None
        except CallFailed as error:
            raise CannotRedo(f"The environment ended its process: {error}") from error


def _quietly(function: Callable[..., None], *arguments: object, **keywords: object) -> None:
    """Call a function in a child process, without what environments print: it would be mixed with results."""
    _silence()
    function(*arguments, **keywords)


def _silence() -> None:
    warnings.simplefilter("ignore")
    with open(os.devnull, "wb") as nothing:  # noqa: PTH123 - a device
        for stream in (1, 2):
            os.dup2(nothing.fileno(), stream)


def _rerun_path(path: Path, phase: str | None, episodes: Sequence[int] | None, **arguments: Any) -> None:
    """Pass the rerun steps of a recording to the process that called this one."""
    with open_recording(path) as recording:
        for steps in rerun(recording, phase, episodes, report=report_progress, **arguments):
            report_progress(steps)
