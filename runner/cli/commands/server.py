"""`dualtaxi serve`, `token` and `remote`: a server of the runs, and its clients."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from runner.analysis.sections import Grid
from runner.cli import Failure
from runner.cli.command import Command, CommandGroup, argument, option, record
from runner.cli.options import limit_option, served_folders_option, workers_option
from runner.cli.output import Remark, Reply, echo, say
from runner.cli.parameter_types import COUNT, FILE, ConfigName, Number, RunName
from runner.cli.progress import bytes_line
from runner.cli.runs import find_recorded, received, runs_folder
from runner.errors import ExitCode, RunnerError
from runner.util.extras import require
from runner.util.files import storage_errors
from runner.util.humanize import UNKNOWN, counted, size
from runner.util.values import Json

if TYPE_CHECKING:
    from runner.client.client import Client
    from runner.client.jobs import JobStatus

# --- the server -------------------------------------------------------------------------------------------


@click.command("serve", cls=Command, forms=())
def serve_command(
    recordings: tuple[Path, ...] = served_folders_option,
    host: str = option(
        "--host", default="127.0.0.1", show_default=True, metavar="HOST", help="The address to listen on."
    ),
    port: int = option(
        "--port",
        type=Number(0, 65535),
        default=8000,
        show_default=True,
        metavar="PORT",
        help="The port to listen on; 0 for any free port.",
    ),
    hosts: tuple[str, ...] = option(
        "--allow-host",
        multiple=True,
        metavar="NAME",
        help="A host name to accept requests for, such as the proxy's; may be repeated.",
    ),
    proxies: tuple[str, ...] = option(
        "--proxy", multiple=True, metavar="ADDRESS", help="Trust X-Forwarded-* headers from this proxy."
    ),
    require_token: bool = option(
        "--require-token", is_flag=True, help="Require a token for reading too, on any host."
    ),
    workers: int = workers_option(2),
    ray: str | None = option(
        "--ray",
        metavar="ADDRESS",
        help="Run jobs on this Ray cluster, which must see the recordings under the same path.",
    ),
    log: Path | None = option(
        "--log",
        type=FILE,
        metavar="FILE",
        help="Append the log to this file, as JSON lines.  [default: stderr]",
    ),
) -> None:
    """Serve the runs to browsers and programs: list, replay, compare, upload, submit.

    The address is printed on stdout; a log goes to stderr, as JSON lines unless that is a terminal. Ctrl-C or
    SIGTERM stops it: requests in progress are completed, and jobs are finished or can be resumed.

    Other hosts than loopback ones need a token (`dualtaxi token create NAME`), and a proxy for TLS in front:
    see docs/deploy.md.

    Examples:
      dualtaxi serve
      dualtaxi serve --port 8080 --recordings /data/runs
      dualtaxi serve --host 0.0.0.0 --allow-host runs.example.org --proxy 10.0.0.2
    """
    require("fastapi", "uvicorn", "httptools", "httpx2", "jinja2", extra="service", purpose="the service")
    from runner.service import logs
    from runner.service.app import create_app
    from runner.service.jobs.store import LOCK_FILE, lock_folder
    from runner.service.server import bind, serve, url_of
    from runner.service.settings import ServiceSettings

    settings = ServiceSettings(
        recordings=recordings,
        host=host,
        port=port,
        hosts=tuple(name.lower() for name in hosts),
        proxies=",".join(proxies),
        tokens_for_all=require_token,
        workers=workers,
        ray=ray,
    )
    if ray is not None:
        from runner.service.jobs.worker import require_job_api

        require_job_api()
    missing = [str(folder) for folder in recordings if not folder.is_dir()]
    with storage_errors(log or settings.recordings[0]):
        settings.recordings[0].mkdir(parents=True, exist_ok=True)
        stream = log.open("a", encoding="utf-8") if log else sys.stderr
    lock_folder(settings.recordings[0], LOCK_FILE).release()  # fail before requests are accepted
    app = create_app(settings)
    listening = bind(settings)
    echo(url_of(listening))
    sys.stdout.flush()
    if sys.stderr.isatty():
        if missing:
            say(f"There was no folder {', '.join(missing)}: it has no runs yet.")
        say("Ctrl-C stops it.")
    with logs.logged_to(stream, for_people=log is None and sys.stderr.isatty()):
        serve(app, settings, listening)


@click.group("token", cls=CommandGroup)
def token_command() -> None:
    """Create, list and revoke access tokens.

    They are stored as hashes, in the configuration folder of the user who runs the server.

    Examples:
      dualtaxi token create laptop
      dualtaxi token ls
      dualtaxi token revoke laptop
    """


@token_command.command("create")
def create(
    name: str = argument(),
    scope: str = option(
        "--scope",
        type=click.Choice(("read", "write")),
        default="read",
        show_default=True,
        help="What the token allows; writing includes reading.",
    ),
) -> Reply:
    """Create a token called NAME and print it, once: only its hash is stored.

    Examples:
      dualtaxi token create laptop
      dualtaxi token create pusher --scope write
    """
    from runner.service.settings import tokens_file
    from runner.service.tokens import READ, WRITE, Tokens

    scopes = (READ, WRITE) if scope == WRITE else (READ,)
    token, secret = Tokens(tokens_file()).create(name, scopes)
    remark = Remark(f"Keep it; it is not shown again. `dualtaxi token revoke {token.id}` revokes it.")
    return Reply(token.as_json() | {"token": secret}, [secret, remark])


@token_command.command("ls")
def ls() -> Reply:
    """List the tokens; only their hashes are stored.

    Example:
      dualtaxi token ls
    """
    from runner.service.settings import tokens_file
    from runner.service.tokens import Tokens

    tokens = Tokens(tokens_file()).all()
    rows = [(token.id, token.name, " ".join(token.scopes), token.created) for token in tokens]
    headings = ("id", "name", "scopes", "created")
    listed = Grid(headings, rows, left=headings, cut=("name",))
    nothing = Remark("No tokens yet. `dualtaxi token create NAME` makes one.")
    return Reply({"tokens": [token.as_json() for token in tokens]}, [listed if tokens else nothing])


@token_command.command("revoke")
def revoke(which: str = argument(metavar="TOKEN")) -> Reply:
    """Revoke a token by its id or name; a running server refuses it from now on.

    Example:
      dualtaxi token revoke laptop
    """
    from runner.service.settings import tokens_file
    from runner.service.tokens import Tokens

    token = Tokens(tokens_file()).revoke(which)
    return Reply(token.as_json(), [Remark(f"Revoked {token.id} ({token.name}).")])


# --- its clients ------------------------------------------------------------------------------------------


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
    from runner.client.client import find_token

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


# --- runs on a server -------------------------------------------------------------------------------------


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
            with server.client(url) as client:
                run = run or find_recorded(name, folder)
                run_bytes = run.recording.stat().st_size  # a run leaves the outbox when it is delivered
                with bytes_line(f"pushing {name}") as report:
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


# --- jobs on a server -------------------------------------------------------------------------------------


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
    from runner.sweep.model import self_contained_text

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
