"""`dualtaxi play`: a recorded episode in the terminal."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from runner.cli.options import episode_option, json_option, recordings_option, run_argument, trial_option
from runner.cli.output import print_json
from runner.cli.runs import find_recorded

if TYPE_CHECKING:
    from rich.text import Text

    from runner.cli.episode import Episode
    from runner.cli.keys import ReadKey
    from runner.recording.reader import Recording

_KEYS: Final = "space: pause   arrows: back, forward   q: quit"
_PAUSED_KEYS: Final = "paused   space: continue   arrows: back, forward   q: quit"


@click.command("play")
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
def command(
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

    \b
    Examples:
      dualtaxi play @latest
      dualtaxi play k3v9m2xq --eval 3000:7 --speed 10
      dualtaxi play k3v9m2xq --episode 0 | less
    """  # noqa: D301 - Click wants the backspace itself
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
    if as_json:
        for step in played.steps():
            print_json(step, indent=None)
    else:
        _show(played, speed)


def _chosen(recording: Recording, episode: int | None, trial: tuple[int, int] | None) -> tuple[str, int, str]:
    """Return phase, number and title of the episode that is meant.

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
    if trial is None:
        trial = default_trial(recording)
    after, number = trial or (evaluations[-1].after, 0)
    where = str(recording.path)
    index = evaluation_after(evaluations, after, where).trial(number, where)
    return "eval", index, trial_in_words(after, number)


def _show(played: Episode, speed: float) -> None:
    """Draw the frames in one place of the terminal, or one after another where there is none."""
    from runner.cli.output import console

    drawn = console()
    if not drawn.is_terminal:
        for frame in played.frames():
            click.echo("\n".join(line.rstrip() for line in frame.plain.splitlines()) + "\n")
        return
    from rich.live import Live

    from runner.cli.keys import pressed_keys

    with Live(console=drawn, auto_refresh=False) as live, pressed_keys() as read_key:
        _play(played.frames(), 1 / speed, read_key, lambda frame: live.update(frame, refresh=True))


def _play(
    frames: Iterator[Text], seconds: float, read_key: ReadKey | None, show: Callable[[Text], None]
) -> None:
    """Show frames at even intervals; keys pause, step back and forward, and quit.

    Args:
        frames: of the episode.
        seconds: between two of them.
        read_key: waits for a key; None where there are none.
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
