"""`dualtaxi view`: runs in the Rerun viewer."""

from __future__ import annotations

import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from runner.cli.command import Command, argument, option
from runner.cli.commands.export import print_selection
from runner.cli.options import force_option, recordings_option, selection_options
from runner.cli.output import echo, say
from runner.cli.parameter_types import FILE, PICTURE_SIZE, STEP, Number, RunName
from runner.cli.progress import stage_line
from runner.cli.runs import compilation_notice, find_recorded
from runner.export.places import require_new

if TYPE_CHECKING:
    from runner.analysis.episodes import EpisodeRef
    from runner.export.rerun.selection import Location, Request


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
    _show(path, location, web, port, screenshot, picture_size)


def _show(
    path: Path, location: Location, web: bool, port: int, screenshot: Path | None, picture_size: str
) -> None:
    """Show an exported file."""
    from runner.export.rerun import viewer

    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # so the viewer is ended too
    if screenshot is not None:
        with stage_line("drawing"):
            viewer.screenshot(path, location.time, screenshot, picture_size)
        echo(screenshot)
    elif web:
        with viewer.web_viewer(viewer.check_port(port), path) as (started, address):
            echo(address)
            say(f"The step is {location.time:,}: enter it at the lower right. Ctrl-C ends the viewer.")
            started.process.wait()
    else:
        viewer.open_window(path, location.time, viewer.check_port(port))
