"""The arguments and options that commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import click

from runner.cli.parameters import ConfigName, FilterWord, RunName, Setting, TrialName

EXPORTS: Final = Path("exports")
"""Where commands write files unless -o says where; in a clone, Git ignores it."""

run_argument: Final = click.argument("run_name", metavar="RUN", type=RunName())

runs_argument: Final = click.argument("run_names", metavar="RUN...", nargs=-1, required=True, type=RunName())

config_argument: Final = click.argument("config", metavar="CONFIG", type=ConfigName())

recordings_option: Final = click.option(
    "--recordings",
    type=click.Path(file_okay=False, path_type=Path),
    metavar="DIR",
    help="The folder of runs.  [default: $DUALTAXI_RECORDINGS, or ./recordings]",
)


def _folders(
    ctx: click.Context,  # noqa: ARG001
    param: click.Parameter,  # noqa: ARG001
    value: tuple[Path, ...],
) -> tuple[Path, ...]:
    from runner.runs.run import recordings_folder

    return value or (recordings_folder(),)


folders_option: Final = click.option(
    "--recordings",
    type=click.Path(file_okay=False, path_type=Path),
    metavar="DIR",
    multiple=True,
    callback=_folders,
    help="A folder of runs; may be repeated.  [default: $DUALTAXI_RECORDINGS, or ./recordings]",
)

filter_argument: Final = click.argument("words", metavar="[FILTER]...", nargs=-1, type=FilterWord())

json_option: Final = click.option("--json", "as_json", is_flag=True, help="Print JSON.")

set_option: Final = click.option(
    "--set",
    "overrides",
    multiple=True,
    type=Setting(),
    metavar="KEY=VALUE",
    help="Override a value of the configuration, such as evaluation.trials=50; may be repeated.",
)

episode_option: Final = click.option(
    "--episode", type=click.IntRange(0), metavar="N", help="A training episode, counted from 0."
)

trial_option: Final = click.option(
    "--eval",
    "trial",
    type=TrialName(),
    metavar="N:TRIAL",
    help="A trial, counted from 0, of the evaluation after N training episodes.",
)

token_option: Final = click.option(
    "--token",
    metavar="TOKEN",
    help="The access token.  [default: $DUALTAXI_TOKEN, or the file $DUALTAXI_TOKEN_FILE]",
)

token_file_option: Final = click.option(
    "--token-file",
    type=click.Path(dir_okay=False, path_type=Path),
    metavar="FILE",
    help="A file with the token; unlike --token, no other user can see it.",
)

server_option: Final = click.option(
    "--server",
    metavar="URL",
    envvar="DUALTAXI_SERVER",
    help="The server, such as http://localhost:8000.  [default: $DUALTAXI_SERVER]",
)


def required(server: str | None) -> str:
    """Return the server that was named.

    Raises:
        UsageError: none was.
    """
    if not server:
        raise click.UsageError("missing option '--server', such as --server http://localhost:8000.")
    return server
