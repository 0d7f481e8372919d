"""The arguments and options that commands share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

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

force_option: Final = click.option("--force", is_flag=True, help="Replace existing output.")

markdown_option: Final = click.option("--markdown", "as_markdown", is_flag=True, help="Print Markdown.")

all_option: Final = click.option(
    "--all", "everything", is_flag=True, help="Include everything, not only a selection."
)


def limit_option(default: int | None, described: str = "") -> Callable[[Callable[..., Any]], Any]:
    """Return the option --limit: the maximum number of rows, 0 for all."""
    return click.option(
        "--limit",
        type=click.IntRange(min=0),
        default=default,
        show_default=described or default is not None,
        metavar="N",
        help="Maximum number of rows, 0 for all.",
    )


def workers_option(default: int | None, described: str = "") -> Callable[[Callable[..., Any]], Any]:
    """Return the option --workers: the number of runs done in parallel."""
    return click.option(
        "--workers",
        type=click.IntRange(1, 1024),
        default=default,
        show_default=described or True,
        metavar="N",
        help="Number of runs to do in parallel.",
    )


def target_option(multiple: bool) -> Callable[[Callable[..., Any]], Any]:
    """Return the option --target: a level of a metric, and when a run first reaches it."""
    return click.option(
        "--target",
        "targets" if multiple else "target",
        multiple=multiple,
        metavar="METRIC=LEVEL",
        help="Compare when this level is first reached, such as success_percent=80"
        + ("; may be repeated." if multiple else "."),
    )
