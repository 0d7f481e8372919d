"""`dualtaxi export minari`: a dataset for offline reinforcement learning."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli import Command
from runner.cli.commands.export import opened_run
from runner.cli.options import (
    EXPORTS,
    Ranges,
    episodes_option,
    force_option,
    output_option,
    recordings_option,
    run_argument,
)
from runner.cli.output import say
from runner.cli.progress import count_line


@click.command("minari", cls=Command)
@run_argument
@output_option(EXPORTS / "minari", "FOLDER")
@click.option(
    "--phase",
    type=click.Choice(["train", "eval"]),
    default="train",
    show_default=True,
    help="The phase of the episodes.",
)
@episodes_option
@force_option
@recordings_option
def command(
    run_name: str,
    output: Path,
    phase: str,
    episodes: Ranges | None,
    force: bool,
    recordings: Path | None,
) -> None:
    """Export the episodes of RUN as a Minari dataset: observations, actions, rewards, how each ended.

    An observation is a state, an action a joint action, a reward the sum over the learners; with several
    learners, the infos hold the reward of each. Observations and actions of your own loop are unchanged.
    Minari finds the dataset if MINARI_DATASETS_PATH is the folder of the output.

    Examples:
      dualtaxi export minari @latest --phase eval
      dualtaxi export minari k3v9m2xq --episodes 49000: -o datasets
    """
    from runner.export.minari import PATTERNS, dataset_id, require_packages, write_dataset
    from runner.export.places import new_folder

    require_packages()
    with opened_run(run_name, recordings, needs_steps=True) as (_, recording):
        path = output / dataset_id(recording)
        total = recording.count(recording.topic(f"/{phase}/episode"))
        with new_folder(path, force, PATTERNS) as folder, count_line("episodes", total) as report:
            written = write_dataset(recording, folder, phase, episodes or (), report)
    for note in written.notes:
        say(note)
    click.echo(
        f"{path}  {written.episodes:,} episodes, {written.steps:,} steps; read it by: "
        f"MINARI_DATASETS_PATH={output} and minari.load_dataset('{path.name}')"
    )
