"""`dualtaxi push`: runs to a server."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from runner.cli import error_as_json, exit_code_of
from runner.cli.finding import find_recorded
from runner.cli.options import (
    json_option,
    recordings_option,
    required,
    server_option,
    token_file_option,
    token_option,
)
from runner.cli.output import draw, print_json, say, size, table
from runner.cli.parameters import RunName
from runner.errors import RunnerError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from runner.client.connection import Report
    from runner.client.upload_source import UploadStatus
    from runner.runs.run import Run

    Push = Callable[[Report], tuple[UploadStatus, str, int]]
    """Pushes a run; returns what became of it, its name and its bytes."""


@click.command("push")
@click.argument("names", metavar="[RUN]...", nargs=-1, type=RunName())
@server_option
@token_option
@token_file_option
@click.option(
    "--outbox",
    is_flag=True,
    help="Upload the runs that could not be sent while they were recorded, each to its server.",
)
@recordings_option
@json_option
def command(
    names: tuple[str, ...],
    server: str | None,
    token: str | None,
    token_file: Path | None,
    outbox: bool,
    recordings: Path | None,
    as_json: bool,
) -> None:
    """Upload runs to a server, which lists them once it has verified every byte.

    RUN may also be the path of a recording. An upload resumes after a broken connection, and a run that the
    server already has is left as it is. With --outbox, the runs that `runner.record(env, "http://...")` could
    not send are sent now.

    \b
    Examples:
      dualtaxi push @latest --server http://localhost:8000
      dualtaxi push k3v9m2xq 7wd2qhmz --server https://runs.example.org --token-file ~/.dualtaxi-token
      dualtaxi push --outbox
    """  # noqa: D301 - Click wants the backspace itself
    from runner.client.address import find_token

    if bool(names) == outbox:
        raise click.UsageError("expected either runs or --outbox.")
    secret = find_token(token, token_file)
    pushes = _outbox(server, secret) if outbox else _runs(names, required(server), secret, recordings)
    stored: list[dict[str, Any]] = []
    codes: list[int] = []
    for name, push in pushes:
        try:
            stored.append(_outcome(name, push))
        except RunnerError as error:
            codes.append(exit_code_of(error))
            message = f"{name}: {error}"
            say(error_as_json(message, codes[-1], run=name) if as_json else f"Error: {message}")
    if as_json:
        print_json(stored)
    else:
        _draw(stored)
    if codes:
        raise click.exceptions.Exit(max(codes))


def _runs(
    names: tuple[str, ...], server: str, token: str | None, recordings: Path | None
) -> Iterator[tuple[str, Push]]:
    """Yield what is to be pushed, and what pushes it."""
    from runner.client.client import Client
    from runner.client.upload_source import UploadSource

    def push(name: str, report: Report) -> tuple[UploadStatus, str, int]:
        source = UploadSource.of(find_recorded(name, recordings))
        sent = client.push(source, report)
        return sent, source.name, source.path.stat().st_size

    with Client(server, token, tell=say) as client:
        for name in names:
            yield name, partial(push, name)


def _outbox(server: str | None, token: str | None) -> Iterator[tuple[str, Push]]:
    """Yield the runs in the outbox, and what pushes each."""
    from runner.client.client import Client
    from runner.client.outbox import deliver, outbox_folder, waiting

    def push(run: Run, url: str, report: Report) -> tuple[UploadStatus, str, int]:
        size = run.recording.stat().st_size
        with Client(url, token, tell=say) as client:
            return deliver(run, client, report), run.name, size

    found = waiting(outbox_folder())
    if not found:
        say(f"The outbox {outbox_folder()} is empty; there is nothing to do.")
    for run, url in found:
        yield run.run_id, partial(push, run, server or url)


def _outcome(name: str, push: Push) -> dict[str, Any]:
    """Push, and return what became of it."""
    from runner.cli.progress import bytes_line

    with bytes_line(f"pushing {name}") as report:
        sent, called, bytes_ = push(report)
    return {"run_id": sent.run_id, "name": called, "bytes": bytes_, "already": sent.already}


def _draw(stored: list[dict[str, Any]]) -> None:
    if not stored:
        return
    drawn = table("run", "name", "size", "", left=("run", "name", ""))
    for run in stored:
        told = "was there already" if run["already"] else "stored"
        drawn.add_row(run["run_id"], run["name"], size(run["bytes"]), told)
    draw(drawn)
