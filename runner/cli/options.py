"""The arguments and options that several commands share."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from runner.cli.command import Declared, argument, option, record
from runner.cli.parameter_types import (
    COUNT,
    DIRECTORY,
    EPISODE,
    FILTER_WORD,
    INDEX,
    NUMBERS,
    PATH,
    RANGES,
    SETTING,
    STEP,
    TRIAL,
    TRIAL_FROM_STEP,
    ConfigName,
    Number,
    RunName,
)
from runner.errors import ExitCode
from runner.runs.run import Run, recordings_folder
from runner.util.values import Ranges

if TYPE_CHECKING:
    from runner.analysis.episodes import EpisodeRef
    from runner.environments.mdp import Mdp
    from runner.export.plots.curves import CurveStyle
    from runner.export.rerun.selection import Request

# --- arguments --------------------------------------------------------------------------------------------

run_argument: Final = argument(metavar="RUN", type=RunName())
runs_argument: Final = argument(metavar="RUN...", nargs=-1, required=True, type=RunName())
compared_argument: Final = argument(metavar="RUN...", nargs=-1, required=True, type=RunName(or_filter=True))
config_argument: Final = argument(metavar="CONFIG", type=ConfigName())
filter_argument: Final = argument(metavar="[FILTER]...", nargs=-1, type=FILTER_WORD)

# --- options ----------------------------------------------------------------------------------------------

recordings_option: Final = option(
    "--recordings",
    type=DIRECTORY,
    metavar="DIR",
    help="The folder of runs.  [default: $DUALTAXI_RECORDINGS, or ./recordings]",
)


def _folders_option(must_exist: bool) -> Declared:
    return option(
        "--recordings",
        type=click.Path(exists=must_exist, file_okay=False, path_type=Path),
        metavar="DIR",
        multiple=True,
        callback=lambda _context, _option, folders: folders or (recordings_folder(),),
        help="A folder of runs; may be repeated.  [default: $DUALTAXI_RECORDINGS, or ./recordings]",
    )


folders_option: Final = _folders_option(must_exist=True)
served_folders_option: Final = _folders_option(must_exist=False)
set_option: Final = option(
    "--set",
    multiple=True,
    type=SETTING,
    metavar="KEY=VALUE",
    help="Override a value of the configuration, such as evaluation.trials=50; may be repeated.",
)


@record
def environment_options(
    env_id: str = option(
        "--env",
        default="dualtaxi:DualTaxi-v1",
        show_default=True,
        metavar="ID",
        help="Gymnasium's id of the environment; before a colon, the module to import for it.",
    ),
    overrides: tuple[str, ...] = set_option,
) -> Mdp:
    """Return the MDP of the environment that the command names."""
    from runner.config import from_mapping
    from runner.environments.loading import load_mdp

    config = from_mapping({"env": {"id": env_id}, "episodes": 1}, overrides)
    return load_mdp(config.env.id, config.env.kwargs, config.rewards)


html_option: Final = option("--html", type=PATH, metavar="FILE", help="Write an HTML page instead.")
runs_option: Final = option("--runs", default="", metavar="FILTER", help="Runs, as for `dualtaxi ls`.")
tags_option: Final = option("--tag", multiple=True, metavar="TAG", help="Add a tag; may be repeated.")
force_option: Final = option("--force", is_flag=True, help="Replace existing output.")
accept_changes_option: Final = option(
    "--accept-changes",
    is_flag=True,
    help="Resume although code, environment, file or numerical libraries have changed.",
)


def _trusted(_context: click.Context, _option: click.Parameter, value: bool) -> bool:
    """Find modules in the current folder too, as Python does for a script there."""
    if value and str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))
    return value


trust_option: Final = option(
    "--trust",
    is_flag=True,
    callback=_trusted,
    help="Import what a recording of others names, also from the current folder: it runs their code.",
)
checkpoint_option: Final = option(
    "--checkpoint", metavar="[NAME]@STEP", help="The last checkpoint at or before this step, of this name."
)
policy_option: Final = option(
    "--policy", metavar="MODULE:FUNCTION", help="Your function that makes a policy of a checkpoint."
)


@record
def curve_options(
    lines: bool = option("--lines", is_flag=True, help="Draw each run as a thin line too."),
    smooth: float = option(
        "--smooth",
        type=Number(0, 100, float),
        default=0.0,
        metavar="PERCENT",
        help="Draw exponential means with this memory, in percent of the axis; values faintly behind.",
    ),
    log_x: bool = option("--log-x", is_flag=True, help="A logarithmic horizontal axis."),
    log_y: bool = option("--log-y", is_flag=True, help="Logarithmic vertical axes."),
) -> CurveStyle:
    """Return how curves are drawn."""
    from runner.export.plots.curves import CurveStyle

    return CurveStyle(lines, smooth, log_x, log_y)


all_option: Final = option("--all", is_flag=True, help="Include everything, not only a selection.")
episode_option: Final = option(
    "--episode",
    type=EPISODE,
    metavar="EPISODE",
    help="An episode: N of training, counted from 0, eval:N:TRIAL, typical, best, worst or last.",
)
episodes_option: Final = option(
    "--episodes",
    type=RANGES,
    metavar="RANGES",
    help="Episodes, such as 0..20,49980..50000; the second number is not included.",
)
trial_option: Final = option(
    "--eval",
    type=TRIAL,
    metavar="N:TRIAL",
    help="A trial, counted from 0, of the evaluation after N training episodes.",
)


EPISODE_OPTIONS: Final = ("episode", "trial", "best", "worst")


def require_one(*names: str) -> None:
    """Refuse options of the command, by the names of their parameters, that exclude each other.

    Raises:
        UsageError: more than one of them is given.
    """
    context = click.get_current_context()
    flags = {parameter.name: parameter.opts[-1] for parameter in context.command.params}
    values = context.params
    given = [flags[name] for name in names if values[name] is not None and values[name] is not False]
    if len(given) > 1:
        raise click.UsageError(f"{' and '.join(given[:2])} exclude each other: choose one.")


@record
def episode_options(
    episode: EpisodeRef | None = option(
        "--episode",
        type=STEP,
        metavar="EPISODE[:T]",
        help="An episode, from its step T on: N of training, counted from 0, eval:N:TRIAL, step:N, typical, "
        "best, worst or last.",
    ),
    trial: EpisodeRef | None = option(
        "--eval",
        type=TRIAL_FROM_STEP,
        metavar="N:TRIAL[:T]",
        help="A trial, counted from 0, of the evaluation after N training episodes, from its step T on.",
    ),
    best: bool = option("--best", is_flag=True, help="The episode of the highest return."),
    worst: bool = option("--worst", is_flag=True, help="The episode of the lowest return."),
) -> EpisodeRef:
    """Return the episode that the options name, and its first step; without any, a typical episode."""
    require_one(*EPISODE_OPTIONS)
    from runner.analysis.episodes import EpisodeRef

    return episode or trial or EpisodeRef.parse("best" if best else "worst" if worst else "typical")


def output_option(default: str, metavar: str = "FILE") -> Declared:
    """Return the option -o, with a text that describes the default."""
    kind = "file" if metavar.startswith("FILE") else "folder"
    return option(
        "-o",
        "--output",
        type=PATH,
        metavar=metavar,
        help=f"The {kind} to write.  [default: {default}]",
    )


@dataclass(frozen=True)
class Writing:
    """Where a command writes files made from runs."""

    output: Path | None
    default: str
    """The path without --output, in which NAME-RUN stands for the run."""
    force: bool

    def path(self, run: Run | None = None) -> Path:
        """Return the path to write, for a run or for none."""
        return self.output or Path(self.default.replace("NAME-RUN", run.file_stem if run else ""))


def writing_options(default: str, metavar: str = "FILE") -> Declared:
    """Return the options of a command that writes files made from runs, by default at the path `default`."""

    def writing(output: Path | None = output_option(default, metavar), force: bool = force_option) -> Writing:
        return Writing(output, default, force)

    return record(writing)


def limit_option(default: int) -> Declared:
    """Return the option --limit, with a default number of rows."""
    return option(
        "--limit",
        type=INDEX,
        default=default,
        help=f"Maximum number of rows, 0 for all.  [default: {default}]",
    )


def workers_option(default: int | str, text: str = "Number of runs to do in parallel.") -> Declared:
    """Return the option --workers, with a default number, or a text that describes the default."""
    return option(
        "--workers",
        type=Number(1, 1024),
        default=default if isinstance(default, int) else None,
        help=f"{text}  [default: {default}]",
    )


ray_option: Final = option(
    "--ray",
    is_flag=False,
    flag_value="",
    metavar="[ADDRESS]",
    help="Run on Ray: on the cluster at ADDRESS, or on this machine.",
)


@record
def selection_options(
    episodes: Ranges | None = episodes_option,
    evaluations: tuple[int, ...] | None = option(
        "--evaluations",
        type=NUMBERS,
        metavar="N[,N]",
        help="The trials of the evaluations after N training episodes.",
    ),
    every: int | None = option("--every", type=COUNT, help="Every Nth training episode."),
    everything: bool = all_option,
    frames: bool = option(
        "--frames",
        is_flag=True,
        help="Draw pictures of a loop's selected episodes, by its environment, which is made again.",
    ),
    trust: bool = trust_option,
) -> Request:
    """Return the steps to export."""
    from runner.export.rerun.selection import Request

    return Request(episodes or (), evaluations or (), every or 0, everything, frames=frames, trust=trust)


# --- jobs -------------------------------------------------------------------------------------------------


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
"""By the hidden option --job a command does a job of the service: a machine of a Ray cluster can do it, and a
person can repeat it, as the folder describes the job."""
