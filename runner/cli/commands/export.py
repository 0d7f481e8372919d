"""`dualtaxi export`: a run in another form, for other programs."""

from __future__ import annotations

import time
from dataclasses import replace
from statistics import median
from typing import TYPE_CHECKING, Final

import click

from runner.cli.command import Command, CommandGroup, option
from runner.cli.options import (
    EPISODE_OPTIONS,
    Writing,
    episode_options,
    episodes_option,
    require_one,
    selection_options,
    trust_option,
    writing_options,
)
from runner.cli.output import Reply, path_and_size, say, written
from runner.cli.parameter_types import GRID, Number
from runner.cli.progress import count_line, stage_line
from runner.cli.runs import compilation_notice, open_for_export, recorded_run
from runner.errors import ExitCode
from runner.export.plugin import installed_export
from runner.runs.run import Run
from runner.util.extras import EXPORTS, require
from runner.util.files import new_file, new_folder, require_new
from runner.util.humanize import duration, size
from runner.util.values import Ranges

if TYPE_CHECKING:
    from collections.abc import Iterator

    from runner.analysis.episodes import EpisodeRef
    from runner.export.rerun.selection import Request, Selection
    from runner.recording.reader import Recording


def _installed_command(name: str) -> Command:
    """Return the command of an export that an installed package adds."""
    added = installed_export(name)

    def call(run: Run, to: Writing) -> Reply:
        from runner.recording.reader import open_recording

        path = to.path(run)
        with (
            new_file(path, to.force) as temporary,
            open_recording(run.recording) as recording,
            stage_line(f"exporting {run.run_id}"),
        ):
            added.write(recording, temporary)
        return written(path_and_size(path), path)

    to = writing_options(f"NAME-RUN{added.ending}", f"FILE{added.ending}")
    return Command(name, call, {"run": recorded_run, "to": to}, help=added.help)


@click.group("export", cls=CommandGroup, plugins=EXPORTS, plugin=_installed_command)
def export_command() -> None:
    """Export a run for other programs.

    Example:
      dualtaxi export rerun @latest
    """


@export_command.command("rerun", short_help="For the Rerun viewer: every view of selected episodes.")
def rerun(
    run: Run = recorded_run,
    selected: Request = selection_options,
    to: Writing = writing_options("exports/NAME-RUN.rrd", "FILE.rrd"),
) -> Reply:
    """Export RUN for the Rerun viewer, arranged and ready to look at.

    All metrics are exported. By default the steps are those of 20 training episodes spread from the first to
    the last, and the trials of the last evaluation; what is left out is reported.

    Examples:
      dualtaxi export rerun @latest
      dualtaxi export rerun k3v9m2xq -o look.rrd --episodes 0..20,49980.. --evaluations 49000
      dualtaxi export rerun k3v9m2xq --all --force
      dualtaxi export rerun my-loop --episodes 0..5 --frames
    """
    from runner.export.rerun.viewer import require_rerun

    require_rerun("export rerun")
    from runner.export.rerun.writing import export

    started = time.monotonic()
    path = to.path(run)
    require_new(path, to.force)
    with compilation_notice(), stage_line("exporting") as stage:
        (selection,) = export([run], selected, path, stage)
    print_selection(selection)
    took = duration(time.monotonic() - started)
    text = f"{path_and_size(path)}, {selection.steps:,} steps, in {took}"
    return written(text, path, steps=selection.steps, left_out=selection.left_out)


def print_selection(selection: Selection) -> None:
    """Print which steps are exported, and which are not."""
    for warning in selection.warnings:
        say(warning)
    if selection.exported:
        say("Exported: all metrics; " + "; ".join(selection.exported) + ".")
    for left_out in selection.left_out:
        say(f"Left out: {left_out}.")


@export_command.command("mcap", short_help="One file with everything, for `dualtaxi import`.")
def mcap(
    run: Run = recorded_run,
    anonymous: bool = option(
        "--anonymous", is_flag=True, help="Leave out host, user, command line and folder."
    ),
    to: Writing = writing_options("NAME-RUN.mcap"),
) -> Reply:
    """Write RUN into one MCAP file with its labels, for `dualtaxi import` on another machine.

    Every MCAP reader opens the file. The same run gives the same bytes. An interrupted run can be exported,
    and stays interrupted.

    Examples:
      dualtaxi export mcap @latest
      dualtaxi export mcap k3v9m2xq --anonymous -o for_review.mcap
    """
    from runner.export.mcap import export_mcap

    path = to.path(run)
    with stage_line(f"exporting {run.run_id}"):
        exported = export_mcap(run, path, anonymous, to.force)
    for warning in exported.warnings:
        say(warning)
    text = f"{path_and_size(path)}; `dualtaxi import {path}` takes it in"
    return written(text, path, anonymous=anonymous)


_GRID_LENGTHS: Final = 2
"""A grid ends after this many times the median length of its episodes; a failed trial is far longer."""
_MAX_GIF_FPS: Final = 50
"""A GIF counts in hundredths of a second, and players show one of them too slowly."""


@export_command.command("film", short_help="A film of an episode: MP4, WebM, GIF or WebP.")
def film_command(
    run: Run = recorded_run,
    reference: EpisodeRef = episode_options,
    grid: tuple[int, int] | None = option(
        "--grid",
        type=GRID,
        metavar="RxC",
        help="Several episodes side by side, evenly from the best to the worst, such as 3x3.",
    ),
    whole: bool = option(
        "--whole",
        is_flag=True,
        help=f"Show a grid until all episodes end.  [default: {_GRID_LENGTHS} times the median length]",
    ),
    fps: float | None = option(
        "--fps",
        type=Number(0.1, 240, float),
        metavar="STEPS",
        help="Steps per second.  [default: 4 of a drawn scene, else 30]",
    ),
    width: int | None = option(
        "--width",
        type=Number(160, 4096),
        metavar="PIXELS",
        help="Width of the film.  [default: about the pictures' width]",
    ),
    trust: bool = trust_option,
    to: Writing = writing_options("exports/NAME-RUN.mp4"),
) -> Reply:
    """Make a film of a recorded episode of RUN; the ending of the file chooses the format.

    Each frame has step, action, rewards and events written below it. The picture is the first of these
    that the run has: the scene of a tabular environment; recorded frames; pictures that the environment draws
    when it is made again and repeats the recorded actions, compared with the recording as it goes;
    observations that are images; or else the observation's numbers as bars.

    By default it is the typical trial of the last evaluation: the median by success, return and length; of
    your own loop the first trial of its last evaluation; of a run without evaluations the last training
    episode. --best, --worst and --grid choose among the trials of all evaluations, or, if there are none,
    among the training episodes: by success, return and length.

    Examples:
      dualtaxi export film @latest
      dualtaxi export film k3v9m2xq --eval 3000:7 -o trial.gif
      dualtaxi export film k3v9m2xq --episode 812:57
      dualtaxi export film k3v9m2xq --grid 3x3 -o nine.webm --fps 60
    """
    require_one(*EPISODE_OPTIONS, "grid")
    if whole and not grid:
        raise click.UsageError("--whole is for a grid: the film of one episode is always whole.")
    from runner.export import film
    from runner.export.film import format_of
    from runner.export.pictures import Pictures, source_of

    with open_for_export(run) as recording:
        path = to.path(run)
        format_of(path)
        require_new(path, to.force)
        episodes = _ranked(recording, grid) if grid else [reference.resolved(recording)]
        speed = fps or film.usual_speed(source_of(recording, episodes[0].phase, trust)[0])
        if path.suffix.lower() == ".gif" and speed > _MAX_GIF_FPS:
            raise click.UsageError(f"--fps: found {speed:g}, expected at most {_MAX_GIF_FPS} of a GIF.")
        opened: list[Pictures] = []

        def shots() -> Iterator[film.Shot]:
            for episode in episodes:
                opened.append(Pictures(recording, episode.phase, episode.number_in(recording), trust))
                yield film.Shot(f"{run.title}: {episode.title}", opened[-1], episode.t)

        lengths = [
            len(recording.phase(episode.phase).episode(episode.number_in(recording))) for episode in episodes
        ]
        if episodes[0].t > lengths[0]:
            raise episodes[0].no_step(recording, lengths[0], episodes[0].t)
        longest = (
            max(lengths) if whole or not grid else min(max(lengths), int(_GRID_LENGTHS * median(lengths)))
        )
        cut = sum(length > longest for length in lengths)
        frames = sum(min(length, longest) + 1 for length in lengths) - episodes[0].t
        with count_line("frames", frames) as progress, new_file(path, to.force) as temporary:
            if grid:
                made = film.write_grid(temporary, shots(), grid[1], speed, width, progress, longest + 1)
            else:
                made = film.write_film(temporary, next(shots()), speed, width, progress)
    for note in dict.fromkeys(pictures.reason for pictures in opened if pictures.reason):
        say(f"The film shows {opened[0].source}: {note}")
    notes = [pictures.note for pictures in opened if pictures.note]
    for note in notes:
        say(note)
    if cut:
        say(
            f"{cut} of {len(episodes)} episodes are longer than the film, {longest:,} steps; "
            "--whole shows all."
        )
    what = episodes[0].title if len(episodes) == 1 else f"{len(episodes)} episodes"
    facts = f"{made.frames:,} frames of {made.size[0]}x{made.size[1]}, {size(path.stat().st_size)}"
    reply = written(
        f"{path}: {what}, {opened[0].source}, {facts}",
        path,
        episodes=[episode.title for episode in episodes],
        source=str(opened[0].source),
        frames=made.frames,
    )
    return replace(reply, exit_code=ExitCode.DIFFERENT if notes else ExitCode.OK)


def _ranked(recording: Recording, grid: tuple[int, int]) -> list[EpisodeRef]:
    """Return the episodes of a grid, from the best to the worst."""
    from runner.analysis.episodes import ranked_episodes, references

    phase, ranked = ranked_episodes(recording)
    cells = grid[0] * grid[1]
    if len(ranked) < cells:
        say(f"There are only {len(ranked):,} episodes: {cells - len(ranked)} cells of the grid are empty.")
    count = min(cells, len(ranked))
    places = [round((len(ranked) - 1) * (1 - k / max(count - 1, 1))) for k in range(count)]
    return references(recording, phase, ranked[places])


_TABLES_HELP: Final = "Steps, episodes and metrics as tables."
_phase_option = option(
    "--phase",
    type=click.Choice(["train", "eval"]),
    help="Only steps and episodes of this phase; train if --episodes is given.",
)


@export_command.command("parquet", short_help=_TABLES_HELP)
def parquet(
    run: Run = recorded_run,
    phase: str | None = _phase_option,
    episodes: Ranges | None = episodes_option,
    to: Writing = writing_options("exports/NAME-RUN-parquet", "FOLDER"),
) -> Reply:
    """Export RUN as Parquet: steps.parquet, episodes.parquet and metrics.parquet in a folder.

    Columns are named like the recording's fields; each agent's action and reward has its own. For a loop
    there are resets.parquet, reset_options.parquet and infos.parquet too, and each number of an observation
    or action has a column; an array of more than 64 is one column of bytes.

    Examples:
      dualtaxi export parquet @latest
      dualtaxi export parquet k3v9m2xq --episodes 0..20 -o first
    """
    return _export_tables("parquet", run, phase, episodes, False, to)


@export_command.command("csv", short_help=_TABLES_HELP)
def csv(
    run: Run = recorded_run,
    phase: str | None = _phase_option,
    episodes: Ranges | None = episodes_option,
    gz: bool = option("--gz", is_flag=True, help="Compress each file with gzip."),
    to: Writing = writing_options("exports/NAME-RUN-csv", "FOLDER"),
) -> Reply:
    """Export RUN as CSV: steps.csv, episodes.csv and metrics.csv in a folder.

    Columns are named like the recording's fields; each agent's action and reward has its own. metrics.csv has
    a row for each value of a metric. A loop has resets.csv, reset_options.csv and infos.csv too,
    and a column for each number of an observation or action. Numbers are written with all their digits.

    Examples:
      dualtaxi export csv @latest
      dualtaxi export csv k3v9m2xq --gz --phase eval -o trials
      dualtaxi export csv k3v9m2xq --episodes 0..20,2980.. --force
    """
    return _export_tables("csv", run, phase, episodes, gz, to)


def _export_tables(
    form: str, run: Run, phase: str | None, episodes: Ranges | None, gz: bool, to: Writing
) -> Reply:
    require("pyarrow", extra="archive", purpose=f"export {form}")
    from runner.export.tables import PATTERNS, left_out, write_tables

    with open_for_export(run, needs_steps=True) as recording:
        path = to.path(run)
        total = (recording.result.train_steps or 0) + (recording.result.eval_steps or 0)
        with new_folder(path, to.force, PATTERNS) as folder, count_line("steps", total) as report:
            rows = write_tables(recording, folder, form, phase, episodes or (), gz, report)
        if form == "csv" and (large := left_out(recording)):
            say(f"Left out, as CSV cannot hold bytes: {', '.join(large)}; `export parquet` has them.")
    lines = [f"{path_and_size(path / name)}, {n:,} rows" for name, n in rows.items()]
    return written("\n".join(lines), *(path / name for name in rows), rows=rows)


@export_command.command("minari", short_help="A Minari dataset, for offline learning.")
def minari(
    run: Run = recorded_run,
    phase: str = option(
        "--phase",
        type=click.Choice(["train", "eval"]),
        default="train",
        show_default=True,
        help="The phase of the episodes.",
    ),
    episodes: Ranges | None = episodes_option,
    to: Writing = writing_options("exports/minari", "FOLDER"),
) -> Reply:
    """Export the episodes of RUN as a Minari dataset: observations, actions, rewards, how each ended.

    An observation is a state, an action a joint action, a reward the sum over the learners; with several
    learners, the infos hold the reward of each. Observations and actions of your own loop are unchanged.
    Minari finds the dataset if MINARI_DATASETS_PATH is the folder of the output.

    Examples:
      dualtaxi export minari @latest --phase eval
      dualtaxi export minari k3v9m2xq --episodes 49000.. -o datasets
    """
    from runner.export.minari import PATTERNS, dataset_id, require_packages, write_dataset

    require_packages()
    with open_for_export(run, needs_steps=True) as recording:
        folder = to.path()
        path = folder / dataset_id(recording)
        total = recording.phase(phase).episodes.count()
        with new_folder(path, to.force, PATTERNS) as fresh, count_line("episodes", total) as report:
            dataset = write_dataset(recording, fresh, phase, episodes or (), report)
    for note in dataset.notes:
        say(note)
    text = (
        f"{path}  {dataset.episodes:,} episodes, {dataset.steps:,} steps; read it by: "
        f"MINARI_DATASETS_PATH={folder} and minari.load_dataset('{path.name}')"
    )
    return written(text, path, dataset=path.name, episodes=dataset.episodes, steps=dataset.steps)


@export_command.command("tensorboard", short_help="An event file for TensorBoard.")
def tensorboard(
    run: Run = recorded_run, to: Writing = writing_options("exports/tensorboard/NAME-RUN", "FOLDER")
) -> Reply:
    """Export RUN for TensorBoard: every metric, and length and return of each training episode.

    Each number is at its training step. TensorBoard itself keeps numbers as 32-bit floats, and shows a
    thousand of a curve by default.

    Examples:
      dualtaxi export tensorboard @latest
      dualtaxi export tensorboard k3v9m2xq -o logs/patient --force
    """
    from runner.export.tables import EVENT_FILES, require_tensorboard, write_events

    require_tensorboard()
    with open_for_export(run) as recording:
        path = to.path(run)
        with new_folder(path, to.force, EVENT_FILES) as folder, stage_line("writing events"):
            count = write_events(recording, folder)
    text = (
        f"{path}  {count:,} numbers; view them by: "
        f"tensorboard --logdir {path.parent} --samples_per_plugin scalars=100000"
    )
    return written(text, path, numbers=count)
