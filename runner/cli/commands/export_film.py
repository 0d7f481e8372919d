"""`dualtaxi export film`: a film of an episode, or of several side by side."""

from __future__ import annotations

from dataclasses import replace
from statistics import median
from typing import TYPE_CHECKING

import click

from runner.cli.command import Command, option
from runner.cli.options import (
    EPISODE_OPTIONS,
    Writing,
    episode_options,
    require_one,
    trust_option,
    writing_options,
)
from runner.cli.output import Reply, say, written
from runner.cli.parameter_types import GRID, Number
from runner.cli.progress import count_line
from runner.cli.runs import open_for_export, recorded_run
from runner.errors import ExitCode
from runner.export.places import new_file, require_new
from runner.runs.run import Run
from runner.util.humanize import size

if TYPE_CHECKING:
    from collections.abc import Iterator

    from runner.analysis.episodes import EpisodeRef
    from runner.recording.reader import Recording

GRID_LENGTHS = 2
"""A grid ends after this many times the median length of its episodes; a failed trial is far longer."""
_MAX_GIF_FPS = 50
"""A GIF counts in hundredths of a second, and players show one of them too slowly."""


@click.command("film", cls=Command, short_help="A film of an episode: MP4, WebM, GIF or WebP.")
def command(
    run: Run = recorded_run,
    chosen: EpisodeRef = episode_options,
    grid: tuple[int, int] | None = option(
        "--grid",
        type=GRID,
        metavar="RxC",
        help="Several episodes side by side, evenly from the best to the worst, such as 3x3.",
    ),
    whole: bool = option(
        "--whole",
        is_flag=True,
        help=f"Show a grid until all episodes end.  [default: {GRID_LENGTHS} times the median length]",
    ),
    fps: float | None = option(
        "--fps",
        type=Number(0.1, 240, float),
        metavar="STEPS",
        help="Steps per second.  [default: 4 of a drawn scene, else 30]",
    ),
    width: int | None = option(
        "--width",
        type=Number(160, 4096),
        metavar="PIXELS",
        help="Width of the film.  [default: about that of the pictures]",
    ),
    trust: bool = trust_option,
    to: Writing = writing_options("exports/NAME-RUN.mp4"),
) -> Reply:
    """Make a film of a recorded episode of RUN; the ending of the file chooses the format.

    Each frame has step, action, rewards and events written below it. What it shows is the best that there
    is: the scene of a tabular environment; recorded frames; pictures that the environment draws when it is
    made again and repeats the recorded actions, compared with the recording as it goes; observations that
    are images; or else the observation's numbers as bars.

    By default it is the typical trial of the last evaluation: the median by success, return and length; of
    your own loop the first trial of its last evaluation; of a run without evaluations the last training
    episode. --best, --worst and --grid choose among the trials of all evaluations, or, if there are none,
    among the training episodes: by success, return and length.

    Examples:
      dualtaxi export film @latest
      dualtaxi export film k3v9m2xq --eval 3000:7 -o trial.gif
      dualtaxi export film k3v9m2xq --episode 812:57
      dualtaxi export film k3v9m2xq --grid 3x3 -o nine.webm --fps 60
    """
    require_one(*EPISODE_OPTIONS, "grid")
    if whole and not grid:
        raise click.UsageError("--whole is for a grid: the film of one episode is always whole.")
    from runner.export import film
    from runner.export.film import format_of
    from runner.export.pictures import Pictures, source_of

    with open_for_export(run) as recording:
        path = to.path(run)
        format_of(path)
        require_new(path, to.force)
        shown = _ranked(recording, grid) if grid else [chosen.resolved(recording)]
        speed = fps or film.usual_speed(source_of(recording, shown[0].phase, trust)[0])
        if path.suffix.lower() == ".gif" and speed > _MAX_GIF_FPS:
            raise click.UsageError(f"--fps: found {speed:g}, expected at most {_MAX_GIF_FPS} of a GIF.")
        opened: list[Pictures] = []

        def shots() -> Iterator[film.Shot]:
            for one in shown:
                opened.append(Pictures(recording, one.phase, one.number_in(recording), trust))
                yield film.Shot(f"{run.title}: {one.title}", opened[-1], one.t)

        lengths = [len(recording.phase(one.phase).episode(one.number_in(recording))) for one in shown]
        if shown[0].t > lengths[0]:
            raise shown[0].no_step(recording, lengths[0], shown[0].t)
        longest = (
            max(lengths) if whole or not grid else min(max(lengths), int(GRID_LENGTHS * median(lengths)))
        )
        cut = sum(length > longest for length in lengths)
        frames = sum(min(length, longest) + 1 for length in lengths) - shown[0].t
        with count_line("frames", frames) as progress, new_file(path, to.force) as temporary:
            if grid:
                made = film.write_grid(temporary, shots(), grid[1], speed, width, progress, longest + 1)
            else:
                made = film.write_film(temporary, next(shots()), speed, width, progress)
    for note in dict.fromkeys(each.reason for each in opened if each.reason):
        say(f"The film shows {opened[0].source}: {note}")
    notes = [each.note for each in opened if each.note]
    for note in notes:
        say(note)
    if cut:
        say(f"{cut} of {len(shown)} episodes are longer than the film, {longest:,} steps; --whole shows all.")
    what = shown[0].title if len(shown) == 1 else f"{len(shown)} episodes"
    facts = f"{made.frames:,} frames of {made.size[0]}x{made.size[1]}, {size(path.stat().st_size)}"
    reply = written(
        f"{path}: {what}, {opened[0].source}, {facts}",
        path,
        episodes=[one.title for one in shown],
        source=str(opened[0].source),
        frames=made.frames,
    )
    return replace(reply, exit_code=ExitCode.DIFFERENT if notes else ExitCode.OK)


def _ranked(recording: Recording, grid: tuple[int, int]) -> list[EpisodeRef]:
    """Return the episodes of a grid, from the best to the worst."""
    from runner.analysis.episodes import ranked_episodes, references

    phase, ranked = ranked_episodes(recording)
    cells = grid[0] * grid[1]
    if len(ranked) < cells:
        say(f"There are only {len(ranked):,} episodes: {cells - len(ranked)} cells of the grid are empty.")
    count = min(cells, len(ranked))
    places = [round((len(ranked) - 1) * (1 - k / max(count - 1, 1))) for k in range(count)]
    return references(recording, phase, ranked[places])
