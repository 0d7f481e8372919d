"""The arguments and options that commands share, and the runs that they name."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from runner.cli.parameters import RunName, TrialName
from runner.errors import RunnerError

if TYPE_CHECKING:
    from runner.runs import Run

run_argument: Final = click.argument("run_name", metavar="RUN", type=RunName())

runs_argument: Final = click.argument("run_names", metavar="RUN...", nargs=-1, required=True, type=RunName())

config_argument: Final = click.argument("config", metavar="CONFIG", type=click.Path(path_type=Path))

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
    from runner.runs import recordings_folder

    return value or (recordings_folder(),)


folders_option: Final = click.option(
    "--recordings",
    type=click.Path(file_okay=False, path_type=Path),
    metavar="DIR",
    multiple=True,
    callback=_folders,
    help="A folder of runs; may be repeated.  [default: $DUALTAXI_RECORDINGS, or ./recordings]",
)

filter_argument: Final = click.argument("words", metavar="[FILTER]...", nargs=-1)

json_option: Final = click.option("--json", "as_json", is_flag=True, help="Print JSON, for programs to read.")

set_option: Final = click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="KEY=VALUE",
    help="Put another value in the configuration, such as evaluation.trials=50; may be repeated.",
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
    "--token", metavar="TOKEN", help="Lets one in.  [default: $DUALTAXI_TOKEN, or of $DUALTAXI_TOKEN_FILE]"
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


def find(name: str, recordings: Path | None) -> Run:
    """Return the run of a name, or of a path, in the chosen folder."""
    from runner.catalogue.finding import find_run
    from runner.cli.output import say
    from runner.runs import recordings_folder

    return find_run(name, recordings_folder(recordings), say)


def find_recorded(name: str, recordings: Path | None) -> Run:
    """Return the run of a name with its recording at hand: restored into the cache if it is archived."""
    return recorded(find(name, recordings))


def find_all_recorded(names: Iterable[str], recordings: Path | None) -> list[Run]:
    """Return the runs that answer to the names, each once, with their recordings at hand.

    A name stands for all runs of that name.
    """
    from runner.runs import list_runs, recordings_folder

    known = list_runs(recordings_folder(recordings))
    found: dict[Path, Run] = {}
    for name in names:
        alike = [run for run in reversed(known) if run.name == name]
        for run in alike or [find(name, recordings)]:
            found.setdefault(run.recording.absolute(), run)
    return [recorded(run) for run in found.values()]


def recorded(run: Run) -> Run:
    """Return a run with its recording at hand: restored into the cache if it is archived, and said so.

    Raises:
        RunnerError: it has none.
    """
    run = restored(run)
    if not run.recording.exists():
        raise RunnerError(_without_recording(run))
    return run


def _without_recording(run: Run) -> str:
    """Return what can be done about a run whose recording is missing."""
    if run.status == "running":
        return f"run {run.run_id} has no recording yet: it has just begun."
    if "made_by" in run.facts.get("config", {}):
        return f"run {run.run_id} has no recording, and only the loop that it was made by can make another."
    return (
        f"run {run.run_id} has no recording: {run.recording} is missing. `dualtaxi resume {run.run_id}` does "
        "it from the beginning."
    )


def restored(run: Run) -> Run:
    """Return a run, restored into the cache if it is archived, and said so."""
    if run.status != "archived":
        return run
    from runner.archive.places import at_hand
    from runner.cli.output import say
    from runner.cli.progress import steps_line

    with steps_line(f"restoring {run.run_id}") as report:
        return at_hand(run, say, report)
