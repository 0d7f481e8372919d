"""`dualtaxi export gif`: a short film of an episode."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli import Command
from runner.cli.options import EXPORTS, episode_option, recordings_option, run_argument, trial_option
from runner.cli.output import say
from runner.cli.progress import count_line
from runner.cli.runs import find_recorded
from runner.util.humanize import size


@click.command("gif", cls=Command, short_help="A short film of an episode, for slides and READMEs.")
@run_argument
@episode_option
@trial_option
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    default=EXPORTS / "episode.gif",
    show_default=True,
    metavar="FILE",
    help="The file to write.",
)
@click.option(
    "--speed",
    type=click.FloatRange(0.1, 50),
    default=2.0,
    show_default=True,
    metavar="STEPS",
    help="Steps per second.",
)
@click.option(
    "--steps",
    type=click.IntRange(1),
    default=200,
    show_default=True,
    metavar="N",
    help="Maximum number of steps.",
)
@click.option(
    "--width",
    type=click.IntRange(200, 2000),
    default=480,
    show_default=True,
    metavar="PIXELS",
    help="Width of the film.",
)
@click.option("--force", is_flag=True, help="Replace the file if it exists.")
@recordings_option
def command(
    run_name: str,
    episode: int | None,
    trial: tuple[int, int] | None,
    output: Path,
    speed: float,
    steps: int,
    width: int,
    force: bool,
    recordings: Path | None,
) -> None:
    """Make a short film of a recorded episode of RUN, for slides and READMEs.

    Each frame has step, actions, rewards and events written below it. By default it is the typical trial of
    the last evaluation: the median by success, return and length; of your own loop the first trial of its
    last evaluation; of a run without a whole evaluation the last training episode.

    Examples:
      dualtaxi export gif @latest
      dualtaxi export gif k3v9m2xq --eval 3000:7 -o trial.gif
      dualtaxi export gif k3v9m2xq --episode 0 --speed 8 --force
    """
    if episode is not None and trial is not None:
        raise click.UsageError("--episode and --eval exclude each other: choose one.")
    from runner.export.contents import require_steps, shortcomings
    from runner.export.gif import require_packages, require_states, write_gif
    from runner.export.places import write_new
    from runner.export.reports import episode as replay
    from runner.recording.reader import open_recording

    require_packages()
    frames: list[int] = []
    with open_recording(find_recorded(run_name, recordings).recording) as recording:
        require_states(recording)
        require_steps(recording, "show")
        if episode is None and trial is None:
            trial = replay.default_trial(recording)
        if trial is not None:
            shown = replay.trial(recording, *trial, steps)
        else:
            if episode is None:
                episode = replay.last_episode(recording)
                say(f"There is no whole evaluation: this is the last training episode, {episode:,}.")
            shown = replay.training_episode(recording, episode, steps)
        with count_line("frames", shown.steps + 1) as progress:

            def write(path: Path) -> None:
                frames.append(write_gif(path, recording, shown, speed, width, progress))

            write_new(output, force, write)
        for shortcoming in shortcomings(recording):
            say(shortcoming)
    if shown.steps < shown.length:
        say(f"Shown are the first {shown.steps:,} of {shown.length:,} steps; --steps shows more.")
    click.echo(f"{output}: {shown.title}, {frames[0]} frames, {size(output.stat().st_size)}")
