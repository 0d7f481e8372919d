"""`dualtaxi serve` and `token`: serve the runs over HTTP, and the access tokens for it."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from runner.analysis.sections import Grid
from runner.cli.command import Command, CommandGroup, argument, option
from runner.cli.options import served_folders_option, workers_option
from runner.cli.output import Remark, Reply, echo, say
from runner.cli.parameter_types import FILE, Number
from runner.service.settings import ServiceSettings, tokens_file
from runner.util.extras import require
from runner.util.files import storage_errors


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
    from runner.service.tokens import Tokens

    token = Tokens(tokens_file()).revoke(which)
    return Reply(token.as_json(), [Remark(f"Revoked {token.id} ({token.name}).")])
