"""`dualtaxi export csv` and `export parquet`: steps, episodes and metrics as tables."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli import Command
from runner.cli.options import EXPORTS, episodes_option, run_argument, writing_options
from runner.cli.output import print_written, say
from runner.cli.parameter_types import Ranges
from runner.cli.progress import count_line
from runner.cli.runs import opened_run
from runner.export.places import new_folder
from runner.util.extras import require
from runner.util.humanize import size


def _command(form: str, text: str) -> click.Command:
    """Return the command that writes tables in a form."""

    def run(
        run_name: str,
        output: Path | None,
        phase: str | None,
        episodes: Ranges | None,
        force: bool,
        recordings: Path | None,
        as_json: bool,
        gz: bool = False,
    ) -> None:
        require("pyarrow", extra="archive", purpose=f"export {form}")
        from runner.export.tables import PATTERNS, left_out, write_tables

        with opened_run(run_name, recordings, needs_steps=True) as (found, recording):
            path = output or EXPORTS / f"{found.file_stem}-{form}"
            total = (recording.result.train_steps or 0) + (recording.result.eval_steps or 0)
            with new_folder(path, force, PATTERNS) as folder, count_line("steps", total) as report:
                rows = write_tables(recording, folder, form, phase, episodes or (), gz, report)
            if form == "csv" and (large := left_out(recording)):
                say(f"Left out, as CSV cannot hold bytes: {', '.join(large)}; `export parquet` has them.")
        lines = [
            f"{path / name}  {size((path / name).stat().st_size)}, {n:,} rows" for name, n in rows.items()
        ]
        print_written("\n".join(lines), as_json, *(path / name for name in rows), rows=rows)

    run.__doc__ = text
    phase_option = click.option(
        "--phase",
        type=click.Choice(["train", "eval"]),
        help="Only steps and episodes of this phase; train if --episodes is given.",
    )
    gz_option = click.option("--gz", is_flag=True, help="Compress each file with gzip.")
    for option in (
        writing_options(f"exports/NAME-RUN-{form}", "FOLDER"),
        *([gz_option] if form == "csv" else []),
        episodes_option,
        phase_option,
        run_argument,
    ):
        run = option(run)
    return click.command(form, cls=Command, short_help="Steps, episodes and metrics as tables.")(run)


csv: click.Command = _command(
    "csv",
    """Export RUN as CSV: steps.csv, episodes.csv and metrics.csv in a folder.

    Columns are named as the recording's fields; each agent's action and reward has its own. metrics.csv has
    a row for each value of a metric. A loop has resets.csv and infos.csv too, and a column for each number of
    an observation or action. Numbers are written with all their digits.

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
