"""`dualtaxi submit`: a configuration or a sweep to a server, to be done there."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from runner.cli.options import json_option, required, server_option, token_file_option, token_option
from runner.cli.output import draw, facts, print_json, say
from runner.cli.parameters import ConfigName

if TYPE_CHECKING:
    from runner.client.jobs import JobEvent, RemoteJob


@click.command("submit")
@click.argument("file", metavar="FILE", type=ConfigName())
@server_option
@token_option
@token_file_option
@click.option("--watch", "watching", is_flag=True, help="Wait until the job is over, and show its progress.")
@json_option
@click.pass_context
def command(
    ctx: click.Context,
    file: Path,
    server: str | None,
    token: str | None,
    token_file: Path | None,
    watching: bool,
    as_json: bool,
) -> None:
    """Submit the experiment or sweep in FILE to a server.

    The server checks it as `dualtaxi run` would, and queues it. The server's pages and `--watch` show its
    progress; Ctrl-C ends the watching, not the job. A broken connection is restored.

    Exit code 0 when it is queued, or with --watch finished; 1 when it failed or was cancelled.

    \b
    Examples:
      dualtaxi submit quick --server http://localhost:8000
      dualtaxi submit hyperparameters --server http://localhost:8000 --watch
    """  # noqa: D301 - Click wants the backspace itself
    from runner.client.address import find_token
    from runner.client.client import Client
    from runner.config.shipped import config_path

    with Client(required(server), find_token(token, token_file), tell=say) as client:
        file = config_path(file)
        job = client.submit(text_of(file), file.name)
        runs = "1 run" if job.runs == 1 else f"{job.runs:,} runs"
        say(f"Job {job.number}: {job.name}, {runs}; {client.url}/queue/{job.number}")
        if watching:
            _tell(client.watch(job.number))
            job = client.job(job.number)
    if as_json:
        print_json(_as_json(job))
    else:
        draw(facts(_in_words(job)))
    if watching and job.state != "finished":
        ctx.exit(1)


def text_of(file: Path) -> str:
    """Return what is submitted of a file: its text; of a sweep whose base is another file, all of it.

    Raises:
        ConfigError: it cannot be read, or its base cannot.
    """
    from runner.config.document import read_yaml, write_yaml
    from runner.config.loading import read_text
    from runner.sweep.loading import load_sweep

    text = read_text(file)
    value = read_yaml(text, str(file)).value
    if isinstance(value, Mapping) and isinstance(value.get("base"), str):
        return write_yaml(load_sweep(file).to_mapping())
    return text


def _tell(happening: Iterable[JobEvent]) -> None:
    """Say on stderr what happens."""
    for happened in happening:
        data = happened.data
        if happened.kind == "log":
            seed = f"seed {data['seed']}: " if "seed" in data else ""
            say(f"{seed}{data['text']}")
        elif happened.kind == "state":
            say(data["state"])


def _as_json(job: RemoteJob) -> dict[str, object]:
    runs = {str(seed): run_id for seed, run_id in job.begun.items()}
    known = {"number": job.number, "kind": job.kind, "name": job.name, "state": job.state}
    return known | {"runs": runs, "error": job.error}


def _in_words(job: RemoteJob) -> dict[str, str]:
    told = {"job": f"{job.number}  {job.name}, {job.state}"}
    if job.begun:
        told["runs"] = "\n".join(f"{run_id}  seed {seed}" for seed, run_id in job.begun.items())
    return told | ({"error": job.error} if job.error else {})
