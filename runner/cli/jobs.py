"""The hidden option --job, by which a command does a job of the service.

The folder describes the job, so that a machine of a Ray cluster can do it, and a person can repeat it.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from pathlib import Path
from typing import Final

import click

from runner.errors import ExitCode

_CODES: Final = {
    "finished": ExitCode.OK,
    "failed": ExitCode.DIFFERENT,
    "interrupted": ExitCode.INTERRUPTED,
}


def _do_job(context: click.Context, _parameter: click.Parameter, folder: Path | None) -> None:
    """Do what is left of a job, print its events as lines of JSON, and exit."""
    if folder is None:
        return
    from runner.api import interruptible
    from runner.client.jobs import EventData, JobEvent
    from runner.service.jobs.store import STATE_FILE, read_job
    from runner.service.jobs.worker import JobChannel, JobSpec, do_job

    if not (folder / STATE_FILE).is_file():
        raise click.BadParameter(
            f"found no {STATE_FILE} in {folder}, expected the folder of a job, such as recordings/.jobs/17."
        )
    stdout = sys.stdout
    folder = folder.resolve()
    spec = JobSpec(folder, read_job(folder), os.environ.get("RAY_ADDRESS"))

    def send(event: EventData) -> None:
        print(JobEvent(event).as_line(), file=stdout, flush=True)

    with contextlib.redirect_stdout(sys.stderr), interruptible(second=signal.SIG_DFL) as interrupt:
        outcome = do_job(spec, JobChannel(send, interrupt))
    send(outcome)
    context.exit(_CODES[outcome.state])


job_option: Final = click.option(
    "--job",
    hidden=True,
    is_eager=True,  # no argument of the command is needed
    expose_value=False,
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    callback=_do_job,
    help="Do the job of the service in this folder, of any kind.",
)
