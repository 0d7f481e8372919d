"""`dualtaxi export minari` and `tensorboard`: runs for other tools."""

from __future__ import annotations

import click

from runner.cli.command import Command, option
from runner.cli.options import (
    Writing,
    episodes_option,
    writing_options,
)
from runner.cli.output import Reply, say, written
from runner.cli.progress import count_line, stage_line
from runner.cli.runs import open_for_export, recorded_run
from runner.export.places import new_folder
from runner.runs.run import Run
from runner.util.values import Ranges


@click.command("minari", cls=Command, short_help="A Minari dataset, for offline learning.")
def minari(
    run: Run = recorded_run,
    phase: str = option(
        "--phase",
        type=click.Choice(["train", "eval"]),
        default="train",
        show_default=True,
        help="The phase of the episodes.",
    ),
    episodes: Ranges | None = episodes_option,
    to: Writing = writing_options("exports/minari", "FOLDER"),
) -> Reply:
    """Export the episodes of RUN as a Minari dataset: observations, actions, rewards, how each ended.

    An observation is a state, an action a joint action, a reward the sum over the learners; with several
    learners, the infos hold the reward of each. Observations and actions of your own loop are unchanged.
    Minari finds the dataset if MINARI_DATASETS_PATH is the folder of the output.

    Examples:
      dualtaxi export minari @latest --phase eval
      dualtaxi export minari k3v9m2xq --episodes 49000.. -o datasets
    """
    from runner.export.minari import PATTERNS, dataset_id, require_packages, write_dataset

    require_packages()
    with open_for_export(run, needs_steps=True) as recording:
        folder = to.path()
        path = folder / dataset_id(recording)
        total = recording.phase(phase).episodes.count()
        with new_folder(path, to.force, PATTERNS) as fresh, count_line("episodes", total) as report:
            dataset = write_dataset(recording, fresh, phase, episodes or (), report)
    for note in dataset.notes:
        say(note)
    text = (
        f"{path}  {dataset.episodes:,} episodes, {dataset.steps:,} steps; read it by: "
        f"MINARI_DATASETS_PATH={folder} and minari.load_dataset('{path.name}')"
    )
    return written(text, path, dataset=path.name, episodes=dataset.episodes, steps=dataset.steps)


@click.command("tensorboard", cls=Command, short_help="An event file for TensorBoard.")
def tensorboard(
    run: Run = recorded_run, to: Writing = writing_options("exports/tensorboard/NAME-RUN", "FOLDER")
) -> Reply:
    """Export RUN for TensorBoard: every metric, and length and return of each training episode.

    Each number is at its training step. TensorBoard itself keeps numbers as 32-bit floats, and shows a
    thousand of a curve by default.

    Examples:
      dualtaxi export tensorboard @latest
      dualtaxi export tensorboard k3v9m2xq -o logs/patient --force
    """
    from runner.export.scalars import EVENT_FILES, require_tensorboard, write_events

    require_tensorboard()
    with open_for_export(run) as recording:
        path = to.path(run)
        with new_folder(path, to.force, EVENT_FILES) as folder, stage_line("writing events"):
            count = write_events(recording, folder)
    text = (
        f"{path}  {count:,} numbers; view them by: "
        f"tensorboard --logdir {path.parent} --samples_per_plugin scalars=100000"
    )
    return written(text, path, numbers=count)
