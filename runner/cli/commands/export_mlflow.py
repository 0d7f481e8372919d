"""`dualtaxi export mlflow`: a run in an MLflow store."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli import Command
from runner.cli.options import recordings_option, run_argument
from runner.cli.output import say
from runner.cli.runs import find_recorded


@click.command("mlflow", cls=Command)
@run_argument
@click.option(
    "--tracking-uri",
    "tracking",
    envvar="MLFLOW_TRACKING_URI",
    default="sqlite:///exports/mlflow.db",
    show_default="$MLFLOW_TRACKING_URI, or sqlite:///exports/mlflow.db",
    metavar="URI",
    help="The store: a database or a server.",
)
@click.option(
    "--experiment", default="dualtaxi", show_default=True, help="The experiment; created if it is missing."
)
@click.option("--with-recording", is_flag=True, help="Also store the recording as an artifact.")
@click.option("--force", is_flag=True, help="Restore the run again, and replace what is there.")
@recordings_option
def command(
    run_name: str, tracking: str, experiment: str, with_recording: bool, force: bool, recordings: Path | None
) -> None:
    """Export RUN into MLflow: parameters, metrics over training steps, tags, and run.json as an artifact.

    A run that is already in the store, recognised by its id and content digest, is left as it is.

    Examples:
      dualtaxi export mlflow @latest
      dualtaxi export mlflow k3v9m2xq --tracking-uri http://127.0.0.1:5000 --with-recording
    """
    from runner.cli.progress import stage_line
    from runner.export.contents import shortcomings
    from runner.export.mlflow import export, require_packages
    from runner.recording.reader import open_recording

    require_packages()
    run = find_recorded(run_name, recordings)
    with open_recording(run.recording) as recording:
        with stage_line("writing to the store"):
            done = export(recording, tracking, experiment, with_recording, force)
        for note in (*shortcomings(recording), *done.notes):
            say(note)
    if done.already:
        say("The run is there already with this content; nothing was written. --force writes it anew.")
    click.echo(
        f"{tracking}  experiment {experiment}, run {done.mlflow_run}, {done.metrics:,} metrics written"
    )
