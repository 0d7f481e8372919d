"""`dualtaxi play` and `view`: runs in the terminal, and in the Rerun viewer."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from runner.cli.command import Command, argument, option
from runner.cli.commands.export import print_selection
from runner.cli.options import (
    episode_options,
    force_option,
    recordings_option,
    selection_options,
)
from runner.cli.output import Remark, Reply, console, echo, say
from runner.cli.parameter_types import FILE, PICTURE_SIZE, STEP, Number, RunName
from runner.cli.progress import stage_line
from runner.cli.runs import compilation_notice, find_recorded, recorded_run
from runner.runs.run import Run
from runner.util.files import require_new
from runner.util.row_text import json_lines

if TYPE_CHECKING:
    from rich.text import Text

    from runner.analysis.episodes import EpisodeRef
    from runner.cli.episode import ShownEpisode
    from runner.export.rerun.selection import Location, Request

ReadKey = Callable[[float | None], str]
"""Waits for a key, at most a number of seconds; returns its meaning, empty if none was pressed."""

_KEYS: Final = "space: pause   arrows: back, forward   r: restart   q: quit"
_PAUSED_KEYS: Final = "paused   space: continue   arrows: back, forward   r: restart   q: quit"
_END_KEYS: Final = "the end   arrow: back   r: restart   q: quit"
_MEANINGS: Final = {
    b" ": "pause",
    **dict.fromkeys((b"q", b"Q", b"\x1b"), "quit"),
    **dict.fromkeys((b"b", b"\x1b[D", b"\xe0K"), "back"),
    **dict.fromkeys((b"r", b"R"), "restart"),
    **dict.fromkeys((b"n", b"\x1b[C", b"\xe0M"), "forward"),
}
"""The bytes that terminals send (of arrows escape sequences, on Windows after 0xE0), and their meaning."""
_POLL_SECONDS: Final = 0.02


@click.command("play", cls=Command, forms=("json",))
def play_command(
    run: Run = recorded_run,
    reference: EpisodeRef = episode_options,
    speed: float = option(
        "--speed",
        type=Number(0, kind=float, above=True),
        default=4.0,
        show_default=True,
        metavar="STEPS",
        help="Steps per second.",
    ),
) -> Iterator[Reply]:
    """Replay a recorded episode of RUN, step by step, with actions and rewards.

    By default it is the typical trial of the last evaluation: the median by success, return and length; of
    your own loop the first trial of its last evaluation; of a run without evaluations the last training
    episode. --best and --worst choose among the trials of all evaluations, or else the training episodes. The
    space bar pauses, the arrow keys (or b and n) step back and forward, r restarts, and q quits; the last
    step stays until a key is pressed. Where stdout is not a terminal, the frames come one after another,
    without waiting. --json prints one line for each step.

    `dualtaxi export film` writes the pictures of an episode.

    Examples:
      dualtaxi play @latest
      dualtaxi play k3v9m2xq --eval 3000:7 --speed 10
      dualtaxi play k3v9m2xq --best
      dualtaxi play k3v9m2xq --episode 812:57
      dualtaxi play k3v9m2xq --episode 0 | less
    """
    from runner.cli.episode import ShownEpisode
    from runner.export.values import Values
    from runner.recording.reader import open_recording

    with open_recording(run.recording) as recording:
        at = reference.resolved(recording)
        played = ShownEpisode(recording, at, f"{run.title}: {at.title}")
        remarks = []
        if not recording.tabular and Values(recording).image:
            film = f"`dualtaxi export film {run.run_id}`"
            remarks = [Remark(f"Observations that are pictures are not shown: {film} does.")]
        yield Reply(
            text=itertools.chain(remarks, _shown(played, speed)), lines={"json": json_lines(played.steps())}
        )


def _shown(played: ShownEpisode, speed: float) -> Iterator[str]:
    """Play an episode on a terminal; elsewhere yield its frames."""
    terminal = console()
    if not terminal.is_terminal or terminal.is_dumb_terminal:
        for frame in played.frames():
            yield "\n".join(line.rstrip() for line in frame.plain.splitlines()) + "\n"
        return

    from rich.live import Live
    from rich.text import Text

    with (
        Live(console=terminal, auto_refresh=False, vertical_overflow="crop") as live,
        _key_reader() as read_key,
    ):

        def show(frame: Text, keys: str) -> None:
            live.update(Text.assemble(frame, (f"\n{keys}" if keys else "", "dim")), refresh=True)

        _play(played.frames(), 1 / speed, read_key, show)


def _play(
    frames: Iterator[Text], seconds: float, read_key: ReadKey | None, show: Callable[[Text, str], None]
) -> None:
    """Show frames at even intervals; keys pause, step back and forward, restart and quit.

    `read_key` waits for a key, None if stdin is no terminal; `show` draws a frame, and a text about the keys.
    The last frame stays until a key is pressed, if there are keys.
    """
    seen = list(itertools.islice(frames, 2))
    number, paused, due = 0, False, time.monotonic() + seconds
    while seen:
        is_last = number + 1 == len(seen)
        if read_key is None:
            show(seen[number], "")
            time.sleep(max(due - time.monotonic(), 0))
            key = "quit" if is_last else ""
        else:
            show(seen[number], _END_KEYS if is_last else _PAUSED_KEYS if paused else _KEYS)
            key = read_key(None if paused or is_last else max(due - time.monotonic(), 0))
        if key == "quit":
            show(seen[number], "")
            return
        if key == "restart":
            number, paused = 0, False
        elif key == "pause":
            paused = not paused
        elif key == "back":
            number, paused = max(number - 1, 0), True
        elif not is_last and (key == "forward" or (not paused and time.monotonic() >= due)):
            number += 1
            if number + 1 == len(seen):
                seen += itertools.islice(frames, 1)
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
            termios.tcsetattr(descriptor, termios.TCSAFLUSH, before)  # keys are not for the shell


def _posix_key(seconds: float | None) -> str:
    import select

    descriptor = sys.stdin.fileno()
    ready, _, _ = select.select([descriptor], [], [], seconds)
    if not ready:
        return ""
    key = os.read(descriptor, 1)
    if not key:  # the terminal was closed
        return "quit"
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


@click.command("view", cls=Command, forms=())
def view_command(
    run_names: tuple[str, ...] = argument(metavar="RUN [RUN]", nargs=-1, required=True, type=RunName()),
    step: EpisodeRef | None = option(
        "--at",
        type=STEP,
        metavar="EPISODE:T",
        help="The step: EPISODE:T of training, step:N by its number, or eval:N:TRIAL:T of an evaluation. T "
        "and TRIAL default to 0.",
    ),
    web: bool = option(
        "--web", is_flag=True, help="Serve the web viewer on 127.0.0.1 instead of opening a window."
    ),
    port: int = option(
        "--port",
        type=Number(0, 65535),
        default=0,
        metavar="PORT",
        help="Port of the viewer.  [default: any free port]",
    ),
    screenshot: Path | None = option(
        "--screenshot",
        type=FILE,
        metavar="FILE.png",
        help="Write one frame to a file; no screen is needed.",
    ),
    picture_size: str = option(
        "--size",
        type=PICTURE_SIZE,
        default="1600x900",
        show_default=True,
        metavar="WxH",
        help="Size of the screenshot in pixels.",
    ),
    force: bool = force_option,
    selected: Request = selection_options,
    recordings: Path | None = recordings_option,
) -> None:
    """Open RUN in the Rerun viewer at a step, or two runs side by side where they diverge.

    The run is exported first, unless it was before. The steps are chosen as for `export rerun`, with the
    episode of --at among them, or of two runs the episode in which they diverge. The command ends when the
    viewer is closed, or by Ctrl-C.

    Examples:
      dualtaxi view @latest
      dualtaxi view @latest --at 2999:3
      dualtaxi view first second --web
      dualtaxi view my-loop --frames
      dualtaxi view @latest --at eval:3000:0:4 --screenshot step.png
    """
    if len(run_names) > 2:
        raise click.UsageError(f"found {len(run_names)} runs, expected one or two.")
    from runner.export.rerun.viewer import require_rerun

    require_rerun("view")
    if screenshot is not None:
        require_new(screenshot, force)
    runs = [find_recorded(name, recordings) for name in run_names]
    with stage_line("loading Rerun") as stage:
        from runner.export.rerun.selection import locate, locate_divergence
        from runner.export.rerun.viewer import cached_export

        divergence = None
        if len(runs) == 2 and step is None:
            stage("comparing the runs")
            divergence, message = locate_divergence(runs)
            say(message)
        location = locate(runs[0], selected, step or divergence)
        if divergence is not None:
            # Trials before it that differ in length shift the second run's timeline.
            first, second = location.time, locate(runs[1], selected, divergence).time
            also = "" if first == second else f" in the first run, step {second:,} in the second"
            say(f"On the timeline that is step {first:,}{also}.")
        stage("exporting")
        with compilation_notice():
            path, selections = cached_export(runs, location.request, stage)
    for selection in selections:
        print_selection(selection)
    _open_viewer(path, location, web, port, screenshot, picture_size)


def _open_viewer(
    path: Path, location: Location, web: bool, port: int, screenshot: Path | None, picture_size: str
) -> None:
    """Show an exported file in the viewer: as a picture, in the browser or in a window."""
    from runner.export.rerun import viewer

    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # so the viewer is ended too
    if screenshot is not None:
        with stage_line("drawing"):
            viewer.screenshot(path, location.time, screenshot, picture_size)
        echo(screenshot)
    elif web:
        with viewer.web_viewer(viewer.free_port(port), path) as (started, address):
            echo(address)
            say(f"The step is {location.time:,}: enter it at the lower right. Ctrl-C ends the viewer.")
            started.process.wait()
    else:
        viewer.open_window(path, location.time, viewer.free_port(port))
