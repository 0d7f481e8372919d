"""`dualtaxi export mlflow`: a run in an MLflow store."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli import Command
from runner.cli.commands.export import opened_run
from runner.cli.options import force_option, recordings_option, run_argument
from runner.cli.output import say


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
@force_option
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
    from runner.export.mlflow import export, require_packages

    require_packages()
    with opened_run(run_name, recordings) as (_, recording), stage_line("writing to the store"):
        result = export(recording, tracking, experiment, with_recording, force)
    for note in result.notes:
        say(note)
    if result.exists:
        say("The run is in the store already, with this content; nothing was written. --force replaces it.")
    click.echo(
        f"{tracking}  experiment {experiment}, run {result.mlflow_run}, {result.metrics:,} metrics written"
    )
