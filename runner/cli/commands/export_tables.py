"""`dualtaxi export csv` and `export parquet`: steps, episodes and measures as tables."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli.options import EXPORTS, RANGES, recordings_option, run_argument
from runner.cli.output import say
from runner.cli.progress import count_line
from runner.cli.runs import find_recorded
from runner.util.humanize import size

Ranges = tuple[tuple[int, int | None], ...]

_OPTIONS = (
    run_argument,
    click.option(
        "-o",
        "--output",
        type=click.Path(path_type=Path),
        metavar="FOLDER",
        help="The folder to write.  [default: exports/NAME-RUN-FORM]",
    ),
    click.option(
        "--phase", type=click.Choice(["train", "eval"]), help="Only the steps and episodes of this phase."
    ),
    click.option(
        "--episodes",
        type=RANGES,
        metavar="RANGES",
        help="Episodes of the phase (train unless given), such as 0:20,49980:50000.",
    ),
    click.option("--force", is_flag=True, help="Replace the folder if it exists."),
    recordings_option,
)


def _command(form: str, text: str) -> click.Command:
    """Return the command that writes tables in a form."""

    def run(
        run_name: str,
        output: Path | None,
        phase: str | None,
        episodes: Ranges | None,
        force: bool,
        recordings: Path | None,
        gz: bool = False,
    ) -> None:
        _export(form, run_name, output, phase, episodes, force, recordings, gz)

    run.__doc__ = text
    options = [*_OPTIONS]
    if form == "csv":
        options.insert(-2, click.option("--gz", is_flag=True, help="Compress each file with gzip."))
    for option in reversed(options):
        run = option(run)
    return click.command(form)(run)


def _export(
    form: str,
    run_name: str,
    output: Path | None,
    phase: str | None,
    episodes: Ranges | None,
    force: bool,
    recordings: Path | None,
    gz: bool,
) -> None:
    from runner.export.contents import require_steps, shortcomings
    from runner.export.places import new_folder, require_pyarrow

    require_pyarrow(f"export {form}")
    from runner.export.tables import OURS, Choice, left_out, write_tables
    from runner.recording.reader import open_recording

    run = find_recorded(run_name, recordings)
    path = output or EXPORTS / f"{run.file_stem}-{form}"
    choice = Choice(phase or ("train" if episodes else ""), episodes or ())
    with open_recording(run.recording) as recording:
        require_steps(recording, "export")
        total = (recording.result.train_steps or 0) + (recording.result.eval_steps or 0)
        with new_folder(path, force, OURS) as folder, count_line("steps", total) as report:
            rows = write_tables(recording, folder, form, choice, gz, report)
        for shortcoming in shortcomings(recording):
            say(shortcoming)
        if form == "csv" and (large := left_out(recording)):
            say(f"Left out, as CSV cannot hold their bytes: {', '.join(large)}; `export parquet` has them.")
    for name, count in rows.items():
        click.echo(f"{path / name}  {size((path / name).stat().st_size)}, {count:,} rows")


csv: click.Command = _command(
    "csv",
    """Export RUN as CSV: steps.csv, episodes.csv and metrics.csv in a folder.

    Columns are named as the recording's fields; each agent's action and reward has its own. metrics.csv has
    a row for each measure. Of a loop there are resets.csv and infos.csv too, and each number of an
    observation or action has a column. Numbers are written so that they read back as they were.

    Examples:
      dualtaxi export csv @latest
      dualtaxi export csv k3v9m2xq --gz --phase eval -o trials
      dualtaxi export csv k3v9m2xq --episodes 0:20,2980: --force
    """,
)

parquet: click.Command = _command(
    "parquet",
    """Export RUN as Parquet: steps.parquet, episodes.parquet and metrics.parquet in a folder.

    Columns are named as the recording's fields; each agent's action and reward has its own. Of a loop there
    are resets.parquet and infos.parquet too, and each number of an observation or action has a column; an
    array of more than 64 is one column of bytes.

    Examples:
      dualtaxi export parquet @latest
      dualtaxi export parquet k3v9m2xq --episodes 0:20 -o first
    """,
)
