"""`dualtaxi pull`: a run from a server."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli.options import (
    json_option,
    recordings_option,
    required,
    server_option,
    token_file_option,
    token_option,
)
from runner.cli.output import say


@click.command("pull")
@click.argument("run_name", metavar="RUN")
@server_option
@token_option
@token_file_option
@recordings_option
@json_option
def command(
    run_name: str,
    server: str | None,
    token: str | None,
    token_file: Path | None,
    recordings: Path | None,
    as_json: bool,
) -> None:
    """Download RUN from a server into the folder of runs, with its tags and note.

    RUN is named as the server knows it: its id, the beginning of one, its name, or @latest. Every byte is
    checked before the run appears; a run that is here already with the same content is left as it is.

    \b
    Examples:
      dualtaxi pull @latest --server http://localhost:8000
      dualtaxi pull k3v9m2xq --server https://runs.example.org --token-file ~/.dualtaxi-token
    """  # noqa: D301 - Click wants the backspace itself
    from runner.cli.progress import bytes_line
    from runner.cli.working import tell_received
    from runner.client.address import find_token
    from runner.client.client import Client
    from runner.runs.run import recordings_folder

    with (
        Client(required(server), find_token(token, token_file), tell=say) as client,
        bytes_line(f"pulling {run_name}") as report,
    ):
        pulled = client.pull(run_name, recordings_folder(recordings), report)
    already = "this content" if pulled.already else ""
    tell_received(pulled.run, pulled.content_digest, already, as_json)
