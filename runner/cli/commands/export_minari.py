"""`dualtaxi export minari`: a dataset for offline reinforcement learning."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli import Command
from runner.cli.options import EXPORTS, RANGES, recordings_option, run_argument
from runner.cli.output import say
from runner.cli.progress import count_line
from runner.cli.runs import find_recorded


@click.command("minari", cls=Command)
@run_argument
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    default=EXPORTS / "minari",
    show_default=True,
    metavar="FOLDER",
    help="The folder of datasets, as MINARI_DATASETS_PATH names it.",
)
@click.option(
    "--phase",
    type=click.Choice(["train", "eval"]),
    default="train",
    show_default=True,
    help="The phase of the episodes.",
)
@click.option("--episodes", type=RANGES, metavar="RANGES", help="Episodes, such as 0:20,49980:50000.")
@click.option("--force", is_flag=True, help="Replace the dataset if it exists.")
@recordings_option
def command(
    run_name: str,
    output: Path,
    phase: str,
    episodes: tuple[tuple[int, int | None], ...] | None,
    force: bool,
    recordings: Path | None,
) -> None:
    """Export the episodes of RUN as a Minari dataset: observations, actions, rewards, how each ended.

    An observation is a state, an action a joint action, a reward the sum over the learners; where there are
    several, the infos have theirs. Of your own loop, observations and actions are as they were.

    Examples:
      dualtaxi export minari @latest --phase eval
      dualtaxi export minari k3v9m2xq --episodes 49000: -o datasets
    """
    from runner.export.contents import require_steps, shortcomings
    from runner.export.minari import OURS, dataset_id, require_packages, write_dataset
    from runner.export.places import new_folder
    from runner.recording.reader import open_recording

    require_packages()
    with open_recording(find_recorded(run_name, recordings).recording) as recording:
        require_steps(recording, "export")
        path = output / dataset_id(recording)
        total = recording.count(recording.topic(f"/{phase}/episode"))
        with new_folder(path, force, OURS) as folder, count_line("episodes", total) as report:
            written = write_dataset(recording, folder, phase, episodes or (), report)
        for note in (*shortcomings(recording), *written.notes):
            say(note)
    click.echo(
        f"{path}  {written.episodes:,} episodes, {written.steps:,} steps; read it by: "
        f"MINARI_DATASETS_PATH={output} and minari.load_dataset('{path.name}')"
    )
