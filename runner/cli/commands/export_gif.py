"""`dualtaxi export gif`: a short film of an episode."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli import Command
from runner.cli.commands.export import opened_run
from runner.cli.options import (
    EXPORTS,
    episode_option,
    force_option,
    output_option,
    recordings_option,
    run_argument,
    trial_option,
)
from runner.cli.output import say
from runner.cli.progress import count_line
from runner.util.humanize import size


@click.command("gif", cls=Command, short_help="A short film of an episode, for slides and READMEs.")
@run_argument
@episode_option
@trial_option
@output_option(EXPORTS / "episode.gif")
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
@force_option
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
    from runner.export.contents import require_steps
    from runner.export.gif import require_packages, require_states, write_gif
    from runner.export.places import write_new
    from runner.export.reports import episode as replay

    require_packages()
    frames: list[int] = []
    with opened_run(run_name, recordings) as (_, recording):
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
            write_new(
                output,
                force,
                lambda path: frames.append(write_gif(path, recording, shown, speed, width, progress)),
            )
    if shown.steps < shown.length:
        say(f"Shown are the first {shown.steps:,} of {shown.length:,} steps; --steps shows more.")
    click.echo(f"{output}: {shown.title}, {frames[0]} frames, {size(output.stat().st_size)}")
