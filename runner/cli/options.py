"""The arguments and options that several commands share."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from runner.cli.parameter_types import (
    AXIS,
    COUNT,
    DIRECTORY,
    FILTER_WORD,
    INDEX,
    NUMBERS,
    RANGES,
    SETTING,
    TARGET,
    TRIAL,
    ConfigName,
    RunName,
)

if TYPE_CHECKING:
    pass

EXPORTS: Final = Path("exports")
"""Where commands write files by default; Git ignores it in a clone."""

Decorator = Callable[[Callable[..., Any]], Any]

# --- arguments --------------------------------------------------------------------------------------------

run_argument: Final = click.argument("run_name", metavar="RUN", type=RunName())
runs_argument: Final = click.argument("run_names", metavar="RUN...", nargs=-1, required=True, type=RunName())
config_argument: Final = click.argument("config", metavar="CONFIG", type=ConfigName())
filter_argument: Final = click.argument("words", metavar="[FILTER]...", nargs=-1, type=FILTER_WORD)

# --- options ----------------------------------------------------------------------------------------------

recordings_option: Final = click.option(
    "--recordings",
    type=DIRECTORY,
    metavar="DIR",
    help="The folder of runs.  [default: $DUALTAXI_RECORDINGS, or ./recordings]",
)


def _folders(_ctx: click.Context, _param: click.Parameter, value: tuple[Path, ...]) -> tuple[Path, ...]:
    from runner.runs.run import recordings_folder

    return value or (recordings_folder(),)


folders_option: Final = click.option(
    "--recordings",
    type=DIRECTORY,
    metavar="DIR",
    multiple=True,
    callback=_folders,
    help="A folder of runs; may be repeated.  [default: $DUALTAXI_RECORDINGS, or ./recordings]",
)
set_option: Final = click.option(
    "--set",
    "overrides",
    multiple=True,
    type=SETTING,
    metavar="KEY=VALUE",
    help="Override a value of the configuration, such as evaluation.trials=50; may be repeated.",
)
json_option: Final = click.option("--json", "as_json", is_flag=True, help="Print JSON.")
markdown_option: Final = click.option("--markdown", "as_markdown", is_flag=True, help="Print Markdown.")
html_option: Final = click.option(
    "--html", type=click.Path(path_type=Path), metavar="FILE", help="Write an HTML page instead."
)
force_option: Final = click.option("--force", is_flag=True, help="Replace existing output.")
accept_changes_option: Final = click.option(
    "--accept-changes",
    is_flag=True,
    help="Resume although code, environment, file or numerical libraries have changed.",
)


def _trusted(_context: click.Context, _option: click.Parameter, value: bool) -> bool:
    """Find modules in the current folder too, as Python does for a script there."""
    if value and str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))
    return value


trust_option: Final = click.option(
    "--trust",
    is_flag=True,
    callback=_trusted,
    help="Import what the recording names, also from the current folder: run code that you trust only.",
)
checkpoint_option: Final = click.option(
    "--checkpoint", metavar="[NAME]@STEP", help="The last checkpoint at or before this step, of this name."
)
policy_option: Final = click.option(
    "--policy", metavar="MODULE:FUNCTION", help="Your function that makes a policy of a checkpoint."
)
axis_option: Final = click.option(
    "--axis",
    type=AXIS,
    default="episodes",
    show_default=True,
    metavar="episodes|steps|updates|time",
    help="Read metrics over training episodes, training steps, updates as a loop logged them, or wall time.",
)


def curve_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options on how curves are drawn: axis, lines, smooth, log_x and log_y."""
    for option in (
        click.option("--log-y", is_flag=True, help="Logarithmic vertical axes."),
        click.option("--log-x", is_flag=True, help="A logarithmic horizontal axis."),
        click.option(
            "--smooth",
            type=click.FloatRange(0, 100),
            default=0.0,
            metavar="PERCENT",
            help="Draw exponential means with this memory, in percent of the axis; values faintly behind.",
        ),
        click.option("--lines", is_flag=True, help="Draw each run as a thin line too."),
        axis_option,
    ):
        command = option(command)
    return command


normalise_option: Final = click.option(
    "--normalise",
    metavar="FILE|minmax",
    help="Compare over environments, by a table of random and expert scores, or the worst and best values.",
)
all_option: Final = click.option(
    "--all", "everything", is_flag=True, help="Include everything, not only a selection."
)
episode_option: Final = click.option(
    "--episode", type=INDEX, metavar="N", help="A training episode, counted from 0."
)
episodes_option: Final = click.option(
    "--episodes", type=RANGES, metavar="RANGES", help="Episodes, such as 0:20,49980:50000."
)
trial_option: Final = click.option(
    "--eval",
    "trial",
    type=TRIAL,
    metavar="N:TRIAL",
    help="A trial, counted from 0, of the evaluation after N training episodes.",
)
best_option: Final = click.option("--best", is_flag=True, help="The episode of the highest return.")
worst_option: Final = click.option("--worst", is_flag=True, help="The episode of the lowest return.")


def require_one_choice(**choices: object) -> None:
    """Refuse options that exclude each other, given by name; None and False are not given.

    Raises:
        UsageError: there is more than one.
    """
    given = [f"--{name}" for name, value in choices.items() if value is not None and value is not False]
    if len(given) > 1:
        raise click.UsageError(f"{' and '.join(given[:2])} exclude each other: choose one.")


def output_option(default: Path | str, metavar: str = "FILE") -> Decorator:
    """Return the option -o, with a default path, or a text that describes the default."""
    kind = "file" if metavar.startswith("FILE") else "folder"
    return click.option(
        "-o",
        "--output",
        type=click.Path(path_type=Path),
        default=default if isinstance(default, Path) else None,
        metavar=metavar,
        help=f"The {kind} to write.  [default: {default}]",
    )


def writing_options(default: Path | str, metavar: str = "FILE") -> Decorator:
    """Return the options of a command that writes files made from runs; arguments as for `output_option`."""

    def add(command: Callable[..., Any]) -> Callable[..., Any]:
        for option in (json_option, recordings_option, force_option, output_option(default, metavar)):
            command = option(command)
        return command

    return add


def limit_option(default: int | str) -> Decorator:
    """Return the option --limit, with a default number of rows, or a text that describes the default."""
    return click.option(
        "--limit",
        type=INDEX,
        default=default if isinstance(default, int) else None,
        metavar="N",
        help=f"Maximum number of rows, 0 for all.  [default: {default}]",
    )


def workers_option(default: int | str) -> Decorator:
    """Return the option --workers, with a default number, or a text that describes the default."""
    return click.option(
        "--workers",
        type=click.IntRange(1, 1024),
        default=default if isinstance(default, int) else None,
        metavar="N",
        help=f"Number of runs to do in parallel.  [default: {default}]",
    )


ray_option: Final = click.option(
    "--ray",
    is_flag=False,
    flag_value="",
    metavar="[ADDRESS]",
    help="Run on Ray: on the cluster at ADDRESS, or on this machine.",
)


def target_option(multiple: bool) -> Decorator:
    """Return the option --target: a level of a metric; runs are compared when they first reach it."""
    return click.option(
        "--target",
        "targets" if multiple else "target",
        multiple=multiple,
        metavar="METRIC=LEVEL",
        type=TARGET,
        help="Compare when this level is first reached, such as success_percent=80"
        + ("; may be repeated." if multiple else "."),
    )


def selection_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that select the steps to export."""
    for option in (
        trust_option,
        click.option(
            "--frames",
            is_flag=True,
            help="Draw pictures of a loop's selected episodes, by its environment, which is made again.",
        ),
        all_option,
        click.option("--every", type=COUNT, metavar="N", help="Every Nth training episode."),
        click.option(
            "--evaluations",
            type=NUMBERS,
            metavar="N[,N]",
            help="The trials of the evaluations after N training episodes.",
        ),
        episodes_option,
    ):
        command = option(command)
    return command
