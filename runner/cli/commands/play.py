"""`dualtaxi play`: replay a recorded episode in the terminal."""

from __future__ import annotations

import contextlib
import itertools
import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from runner.cli import Command
from runner.cli.options import episode_option, json_option, recordings_option, run_argument, trial_option
from runner.cli.output import console, print_json
from runner.cli.runs import find_recorded

if TYPE_CHECKING:
    from rich.text import Text

    from runner.recording.reader import Recording

ReadKey = Callable[[float | None], str]
"""Waits for a key, at most a number of seconds; returns its meaning, empty if none was pressed."""

_KEYS: Final = "space: pause   arrows: back, forward   q: quit"
_PAUSED_KEYS: Final = "paused   space: continue   arrows: back, forward   q: quit"
_MEANINGS: Final = {
    b" ": "pause",
    **dict.fromkeys((b"q", b"Q", b"\x1b"), "quit"),
    **dict.fromkeys((b"b", b"\x1b[D", b"\xe0K"), "back"),
    **dict.fromkeys((b"n", b"\x1b[C", b"\xe0M"), "forward"),
}
"""The bytes that terminals send (of arrows escape sequences, on Windows after 0xE0), and their meaning."""
_POLL_SECONDS: Final = 0.02


@click.command("play", cls=Command)
@run_argument
@episode_option
@trial_option
@click.option(
    "--speed",
    type=click.FloatRange(0, min_open=True),
    default=4.0,
    show_default=True,
    metavar="STEPS",
    help="Steps per second.",
)
@recordings_option
@json_option
def play_command(
    run_name: str,
    episode: int | None,
    trial: tuple[int, int] | None,
    speed: float,
    recordings: Path | None,
    as_json: bool,
) -> None:
    """Replay a recorded episode of RUN, frame by frame, with actions and rewards.

    By default it is the typical trial of the last evaluation: the median by success, return and length; of a
    run without evaluations the last training episode. Everything is drawn from the recording; its environment
    need not be installed. In a terminal the space bar pauses, the arrow keys (or b and n) step back and
    forward, and q quits. Where stdout is no terminal, the frames come one after another, without waiting.
    With --json, one line for each step.

    Examples:
      dualtaxi play @latest
      dualtaxi play k3v9m2xq --eval 3000:7 --speed 10
      dualtaxi play k3v9m2xq --episode 0 | less
    """
    if episode is not None and trial is not None:
        raise click.UsageError("--episode and --eval exclude each other: choose one.")
    from runner.cli.episode import Episode
    from runner.export.contents import require_steps
    from runner.recording.reader import open_recording

    run = find_recorded(run_name, recordings)
    with open_recording(run.recording) as recording:
        require_steps(recording, "play")
        phase, number, title = _chosen(recording, episode, trial)
        played = Episode(recording, phase, number, f"{run.title}: {title}")
    terminal = console()
    if as_json:
        for step in played.steps():
            print_json(step, indent=None)
    elif not terminal.is_terminal:
        for frame in played.frames():
            click.echo("\n".join(line.rstrip() for line in frame.plain.splitlines()) + "\n")
    else:
        from rich.live import Live

        with Live(console=terminal, auto_refresh=False) as live, _key_reader() as read_key:
            _play(played.frames(), 1 / speed, read_key, lambda frame: live.update(frame, refresh=True))


def _chosen(recording: Recording, episode: int | None, trial: tuple[int, int] | None) -> tuple[str, int, str]:
    """Return phase, number and title of the chosen episode.

    Raises:
        RecordingError: the recording has no such evaluation or trial.
    """
    from runner.analysis.evaluations import evaluation_after, evaluations_of
    from runner.environments.naming import trial_in_words
    from runner.export.reports.episode import default_trial
    from runner.recording.schema import TRAIN_EPISODE

    evaluations = [] if episode is not None else evaluations_of(recording)
    if trial is None and not evaluations:
        number = max(recording.count(TRAIN_EPISODE) - 1, 0) if episode is None else episode
        return "train", number, f"training episode {number:,}"
    after, number = trial or default_trial(recording) or (evaluations[-1].after, 0)
    where = str(recording.path)
    index = evaluation_after(evaluations, after, where).trial(number, where)
    return "eval", index, trial_in_words(after, number)


def _play(
    frames: Iterator[Text], seconds: float, read_key: ReadKey | None, show: Callable[[Text], None]
) -> None:
    """Show frames at even intervals; keys pause, step back and forward, and quit.

    Args:
        frames: the frames of the episode.
        seconds: between two of them.
        read_key: waits for a key; None if stdin is no terminal.
        show: draws a frame.
    """
    from rich.text import Text

    seen = list(itertools.islice(frames, 1))
    number, paused, due = 0, False, time.monotonic() + seconds
    while number < len(seen):
        keys = _PAUSED_KEYS if paused else _KEYS
        show(Text.assemble(seen[number], ("\n" + keys, "dim")) if read_key else seen[number])
        key = ""
        if read_key is None:
            time.sleep(max(due - time.monotonic(), 0))
        else:
            key = read_key(None if paused else max(due - time.monotonic(), 0))
        if key == "quit":
            return
        if key == "pause":
            paused = not paused
        elif key == "back":
            number, paused = max(number - 1, 0), True
        elif key == "forward" or (not paused and time.monotonic() >= due):
            if number + 1 == len(seen):
                seen += itertools.islice(frames, 1)
            number += 1 if number + 1 < len(seen) or not paused else 0
        due = max(due + seconds, time.monotonic()) if key == "" else time.monotonic() + seconds


# --- keys -------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _key_reader() -> Iterator[ReadKey | None]:
    """Yield a function that reads single keys without Enter; None if stdin is no terminal."""
    if not sys.stdin.isatty():
        yield None
    elif sys.platform == "win32":
        yield _windows_key
    else:
        import termios
        import tty

        descriptor = sys.stdin.fileno()
        before = termios.tcgetattr(descriptor)
        try:
            tty.setcbreak(descriptor)  # keys one by one and without echo; Ctrl-C still interrupts
            yield _posix_key
        finally:
            termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


def _posix_key(seconds: float | None) -> str:
    import select

    descriptor = sys.stdin.fileno()
    ready, _, _ = select.select([descriptor], [], [], seconds)
    if not ready:
        return ""
    key = os.read(descriptor, 1)
    if key == b"\x1b" and select.select([descriptor], [], [], 0)[0]:  # an arrow key sends three bytes
        key += os.read(descriptor, 2)
    return _MEANINGS.get(key, "")


def _windows_key(seconds: float | None) -> str:
    import msvcrt

    end = None if seconds is None else time.monotonic() + seconds
    while not msvcrt.kbhit():  # type: ignore[attr-defined,unused-ignore]
        if end is not None and time.monotonic() >= end:
            return ""
        time.sleep(_POLL_SECONDS)
    key = msvcrt.getch()  # type: ignore[attr-defined,unused-ignore]
    key += msvcrt.getch() if key == b"\xe0" else b""  # type: ignore[attr-defined,unused-ignore]
    return _MEANINGS.get(key, "")
