"""`dualtaxi export minari`, `tensorboard` and `mlflow`: runs for other tools."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli.command import Command, option
from runner.cli.options import (
    Writing,
    episodes_option,
    force_option,
    json_option,
    recordings_option,
    run_argument,
    writing_options,
)
from runner.cli.output import print_written, say
from runner.cli.parameter_types import Ranges
from runner.cli.progress import count_line, stage_line
from runner.cli.runs import opened_run
from runner.export.places import new_folder


@click.command("minari", cls=Command, short_help="A Minari dataset, for offline learning.")
def minari(
    run_name: str = run_argument,
    phase: str = option(
        "--phase",
        type=click.Choice(["train", "eval"]),
        default="train",
        show_default=True,
        help="The phase of the episodes.",
    ),
    episodes: Ranges | None = episodes_option,
    to: Writing = writing_options("exports/minari", "FOLDER"),
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

    require_packages()
    with opened_run(run_name, to.recordings, needs_steps=True) as (_, recording):
        folder = to.path()
        path = folder / dataset_id(recording)
        total = recording.count(recording.topic(f"/{phase}/episode"))
        with new_folder(path, to.force, PATTERNS) as fresh, count_line("episodes", total) as report:
            written = write_dataset(recording, fresh, phase, episodes or (), report)
    for note in written.notes:
        say(note)
    text = (
        f"{path}  {written.episodes:,} episodes, {written.steps:,} steps; read it by: "
        f"MINARI_DATASETS_PATH={folder} and minari.load_dataset('{path.name}')"
    )
    counts = {"episodes": written.episodes, "steps": written.steps}
    to.report(text, path, dataset=path.name, **counts)


@click.command("tensorboard", cls=Command, short_help="An event file for TensorBoard.")
def tensorboard(
    run_name: str = run_argument, to: Writing = writing_options("exports/tensorboard/NAME-RUN", "FOLDER")
) -> None:
    """Export RUN for TensorBoard: every metric, and length and return of each training episode.

    Each number is at its training step. TensorBoard itself keeps numbers as 32-bit floats, and shows a
    thousand of a curve by default.

    Examples:
      dualtaxi export tensorboard @latest
      dualtaxi export tensorboard k3v9m2xq -o logs/patient --force
    """
    from runner.export.tensorboard import PATTERNS, require_packages, write_events

    require_packages()
    with opened_run(run_name, to.recordings) as (run, recording):
        path = to.path(run.file_stem)
        with new_folder(path, to.force, PATTERNS) as folder, stage_line("writing events"):
            count = write_events(recording, folder)
    text = (
        f"{path}  {count:,} numbers; view them by: "
        f"tensorboard --logdir {path.parent} --samples_per_plugin scalars=100000"
    )
    to.report(text, path, numbers=count)


@click.command("mlflow", cls=Command, short_help="A run in an MLflow store.")
def mlflow(
    run_name: str = run_argument,
    tracking: str = option(
        "--tracking-uri",
        envvar="MLFLOW_TRACKING_URI",
        default="sqlite:///exports/mlflow.db",
        show_default="$MLFLOW_TRACKING_URI, or sqlite:///exports/mlflow.db",
        metavar="URI",
        help="The store: a database or a server.",
    ),
    experiment: str = option(
        "--experiment",
        default="dualtaxi",
        show_default=True,
        help="The experiment; created if it is missing.",
    ),
    with_recording: bool = option(
        "--with-recording", is_flag=True, help="Also store the recording as an artifact."
    ),
    force: bool = force_option,
    recordings: Path | None = recordings_option,
    as_json: bool = json_option,
) -> None:
    """Export RUN into MLflow: parameters, metrics over training steps, tags, and run.json as an artifact.

    A run that is already in the store, recognised by its id and content digest, is left as it is.

    Examples:
      dualtaxi export mlflow @latest
      dualtaxi export mlflow k3v9m2xq --tracking-uri http://127.0.0.1:5000 --with-recording
    """
    from runner.export.mlflow import export, require_packages

    require_packages()
    with opened_run(run_name, recordings) as (_, recording), stage_line("writing to the store"):
        result = export(recording, tracking, experiment, with_recording, force)
    for note in result.notes:
        say(note)
    if result.exists:
        say("The run is in the store already, with this content; nothing was written. --force replaces it.")
    text = f"{tracking}  experiment {experiment}, run {result.mlflow_run}, {result.metrics:,} metrics written"
    place = {"tracking_uri": tracking, "experiment": experiment, "mlflow_run": result.mlflow_run}
    print_written(text, as_json, already=result.exists, metrics=result.metrics, **place)
