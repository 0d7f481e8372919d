"""`dualtaxi remote`: runs and jobs on a server."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import click

from runner.analysis.sections import Grid
from runner.cli import Failure
from runner.cli.command import CommandGroup, argument, option, record
from runner.cli.options import limit_option, workers_option
from runner.cli.output import Remark, Reply, say
from runner.cli.parameter_types import COUNT, FILE, ConfigName, RunName
from runner.cli.progress import bytes_line
from runner.cli.runs import find_recorded, received, runs_folder
from runner.errors import ExitCode, RunnerError
from runner.util.humanize import UNKNOWN, counted, size
from runner.util.values import Json

if TYPE_CHECKING:
    from runner.client.client import Client
    from runner.client.jobs import JobStatus


@dataclasses.dataclass(frozen=True)
class Server:
    """The server that the options name, and the token for it."""

    url: str | None
    token: str | None

    def client(self, default_url: str | None = None) -> Client:
        """Return a client of the server.

        Raises:
            UsageError: no server was named.
        """
        from runner.client.client import Client

        url = self.url or default_url
        if not url:
            raise click.UsageError("missing option '--server', such as --server http://localhost:8000.")
        return Client(url, self.token, log=say)


@record
def server_options(
    url: str | None = option(
        "--server",
        metavar="URL",
        envvar="DUALTAXI_SERVER",
        help="The server, such as http://localhost:8000.  [default: $DUALTAXI_SERVER]",
    ),
    token: str | None = option(
        "--token",
        metavar="TOKEN",
        help="The access token.  [default: $DUALTAXI_TOKEN, or the file $DUALTAXI_TOKEN_FILE]",
    ),
    token_file: Path | None = option(
        "--token-file",
        type=FILE,
        metavar="FILE",
        help="A file with the token; unlike --token, no other user can see it.",
    ),
) -> Server:
    """Return the server."""
    from runner.client.connection import find_token

    return Server(url, find_token(token, token_file))


_job_argument = argument(metavar="JOB", type=COUNT)


@click.group("remote", cls=CommandGroup)
def remote_command() -> None:
    """Upload and download runs, and submit and control jobs on a server (`dualtaxi serve`).

    Examples:
      dualtaxi remote push @latest --server http://localhost:8000
      dualtaxi remote submit quick --server http://localhost:8000 --watch
      dualtaxi remote jobs --server http://localhost:8000
    """


# --- runs -------------------------------------------------------------------------------------------------


@remote_command.command("push")
def push(
    names: tuple[str, ...] = argument(metavar="[RUN]...", nargs=-1, type=RunName()),
    outbox: bool = option(
        "--outbox",
        is_flag=True,
        help="Upload the runs that could not be sent while they were recorded, each to its server.",
    ),
    server: Server = server_options,
    folder: Path = runs_folder,
) -> Reply:
    """Upload runs to a server, which lists them once it has verified every byte.

    RUN may also be the path of a recording. An upload resumes after a broken connection, and a run that the
    server already has is left as it is. With --outbox, the runs that `runner.record(env, "http://...")` could
    not send are sent now.

    Examples:
      dualtaxi remote push @latest --server http://localhost:8000
      dualtaxi remote push k3v9m2xq 7wd2qhmz --server https://runs.example.org --token-file ~/.dualtaxi-token
      dualtaxi remote push --outbox
    """
    if bool(names) == outbox:
        raise click.UsageError("expected either runs or --outbox.")
    from runner.client.outbox import deliver, outbox_folder, waiting

    kept = {run.run_id: (run, url) for run, url in waiting(outbox_folder())} if outbox else {}
    if outbox and not kept:
        say(f"The outbox {outbox_folder()} is empty; there is nothing to do.")
    runs: list[Json] = []
    code = 0
    for name in kept or names:
        run, url = kept.get(name, (None, None))
        try:
            with server.client(url) as client, bytes_line(f"pushing {name}") as report:
                run = run or find_recorded(name, folder)
                run_bytes = run.recording.stat().st_size  # a run leaves the outbox when it is delivered
                status = deliver(run, client, report) if outbox else client.push(run, report)
        except RunnerError as error:
            failure = Failure(error, name)
            failure.show()
            code = max(code, failure.exit_code)
        else:
            facts = {"name": run.name, "bytes": run_bytes, "already": status.already}
            runs.append({"run_id": status.run_id, **facts})
    outcomes = {True: "was there already", False: "stored"}
    rows = [(run["run_id"], run["name"], size(run["bytes"]), outcomes[run["already"]]) for run in runs]
    pushed = Grid(("run", "name", "size", ""), rows, left=("run", "name", ""))
    return Reply({"runs": runs}, [pushed] if runs else (), exit_code=code)


@remote_command.command("pull")
def pull(
    run_name: str = argument(metavar="RUN"),
    server: Server = server_options,
    folder: Path = runs_folder,
) -> Reply:
    """Download RUN from a server into the folder of runs, with its tags and note.

    RUN is named as the server knows it: its id, the beginning of one, its name, or @latest. Every byte is
    checked before the run appears; a run that is here already with the same content is left as it is.

    Examples:
      dualtaxi remote pull @latest --server http://localhost:8000
      dualtaxi remote pull k3v9m2xq --server https://runs.example.org --token-file ~/.dualtaxi-token
    """
    with server.client() as client, bytes_line(f"pulling {run_name}") as report:
        pulled = client.pull(run_name, folder, report)
    already = "this content" if pulled.already else ""
    return received(pulled.run, pulled.content_digest, already)


# --- jobs -------------------------------------------------------------------------------------------------


@remote_command.command("submit")
def submit(
    file: Path = argument(metavar="FILE", type=ConfigName()),
    is_watched: bool = option(
        "--watch", is_flag=True, help="Wait until the job is over, and show its progress."
    ),
    workers: int | None = workers_option(
        "all of the server", "Number of runs to do in parallel; only for sweeps."
    ),
    server: Server = server_options,
) -> Reply:
    """Submit the experiment or sweep in FILE to a server.

    The server checks it as `dualtaxi run` would, and queues it. The server's pages and `dualtaxi remote
    watch` show its progress.

    Exit code 0 when it is queued, or with --watch finished; 1 when it failed or was cancelled.

    Examples:
      dualtaxi remote submit quick --server http://localhost:8000
      dualtaxi remote submit hyperparameters --server http://localhost:8000 --watch
    """
    from runner.config.shipped import config_path
    from runner.sweep.loading import self_contained_text

    with server.client() as client:
        file = config_path(file)
        job = client.submit(self_contained_text(file), file.name, workers)
        runs = counted(job.runs, "run")
        say(f"Job {job.number}: {job.name}, {runs}; {client.url}/queue/{job.number}")
        if is_watched:
            job = _watched(client, job.number)
    return _reply(job, is_watched)


@remote_command.command("jobs")
def jobs(limit: int = limit_option(20), server: Server = server_options) -> Reply:
    """List the jobs of a server, newest first.

    Example:
      dualtaxi remote jobs --server http://localhost:8000
    """
    with server.client() as client:
        newest = client.jobs(limit or 1000)
    rows = [
        (
            str(job.number),
            job.kind,
            job.name,
            job.state,
            job.progress.text if job.progress else "",
            f"{job.runs:,}",
            str(job.workers),
        )
        for job in newest
    ]
    left = ("kind", "name", "state", "progress")
    listed = Grid(("job", *left, "runs", "workers"), rows, left=left, cut=("name",))
    nothing = Remark("No jobs yet. `dualtaxi remote submit FILE` submits one.")
    return Reply({"jobs": [dataclasses.asdict(job) for job in newest]}, [listed if newest else nothing])


@remote_command.command("watch")
def watch(number: int = _job_argument, server: Server = server_options) -> Reply:
    """Show the progress of JOB until it is over; Ctrl-C ends the watching, not the job.

    A broken connection is restored. Exit code 0 when the job finished, 1 when it failed or was cancelled.

    Example:
      dualtaxi remote watch 12 --server http://localhost:8000
    """
    with server.client() as client:
        return _reply(_watched(client, number), must_finish=True)


@remote_command.command("cancel")
def cancel(number: int = _job_argument, server: Server = server_options) -> Reply:
    """Cancel JOB, whether queued or running; what it has recorded is kept.

    Example:
      dualtaxi remote cancel 12 --server http://localhost:8000
    """
    with server.client() as client:
        return _reply(client.cancel(number))


@remote_command.command("resume")
def resume(
    number: int = _job_argument,
    accept_changes: bool = option(
        "--accept-changes", is_flag=True, help="Resume although the code has changed."
    ),
    server: Server = server_options,
) -> Reply:
    """Resume JOB, which failed or was cancelled, as if it had never stopped.

    Example:
      dualtaxi remote resume 12 --server http://localhost:8000
    """
    with server.client() as client:
        return _reply(client.resume(number, accept_changes))


def _watched(client: Client, number: int) -> JobStatus:
    """Print the events of a job on stderr until it is over, and return it."""
    from runner.client.jobs import LogEvent, StateEvent

    for event in client.watch(number):
        if isinstance(event.data, LogEvent):
            seed = "" if event.data.seed is None else f"seed {event.data.seed}: "
            say(f"{seed}{event.data.text}")
        elif isinstance(event.data, StateEvent):
            say(event.data.state)
    return client.job(number)


def _reply(job: JobStatus, must_finish: bool = False) -> Reply:
    runs = "\n".join(f"{run.run_id}  seed {run.seed}" for run in job.begun)
    title = f"{job.number}  {job.name}, {job.state}"
    rows = {"job": title, "runs": runs or UNKNOWN, "error": job.error}
    is_well = job.state == "finished" or not must_finish
    return Reply(dataclasses.asdict(job), [rows], exit_code=ExitCode.OK if is_well else ExitCode.DIFFERENT)
