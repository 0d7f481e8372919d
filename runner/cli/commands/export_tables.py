"""`dualtaxi export csv` and `export parquet`: steps, episodes and metrics as tables."""

from __future__ import annotations

import click

from runner.cli.command import Command, option
from runner.cli.options import Writing, episodes_option, writing_options
from runner.cli.output import Reply, path_and_size, say, written
from runner.cli.progress import count_line
from runner.cli.runs import open_for_export, recorded_run
from runner.export.places import new_folder
from runner.runs.run import Run
from runner.util.extras import require
from runner.util.values import Ranges

_HELP = "Steps, episodes and metrics as tables."
_phase_option = option(
    "--phase",
    type=click.Choice(["train", "eval"]),
    help="Only steps and episodes of this phase; train if --episodes is given.",
)


@click.command("csv", cls=Command, short_help=_HELP)
def csv(
    run: Run = recorded_run,
    phase: str | None = _phase_option,
    episodes: Ranges | None = episodes_option,
    gz: bool = option("--gz", is_flag=True, help="Compress each file with gzip."),
    to: Writing = writing_options("exports/NAME-RUN-csv", "FOLDER"),
) -> Reply:
    """Export RUN as CSV: steps.csv, episodes.csv and metrics.csv in a folder.

    Columns are named as the recording's fields; each agent's action and reward has its own. metrics.csv has
    a row for each value of a metric. A loop has resets.csv, reset_options.csv and infos.csv too,
    and a column for each number of an observation or action. Numbers are written with all their digits.

    Examples:
      dualtaxi export csv @latest
      dualtaxi export csv k3v9m2xq --gz --phase eval -o trials
      dualtaxi export csv k3v9m2xq --episodes 0..20,2980.. --force
    """
    return _export("csv", run, phase, episodes, gz, to)


@click.command("parquet", cls=Command, short_help=_HELP)
def parquet(
    run: Run = recorded_run,
    phase: str | None = _phase_option,
    episodes: Ranges | None = episodes_option,
    to: Writing = writing_options("exports/NAME-RUN-parquet", "FOLDER"),
) -> Reply:
    """Export RUN as Parquet: steps.parquet, episodes.parquet and metrics.parquet in a folder.

    Columns are named as the recording's fields; each agent's action and reward has its own. For a loop there
    are resets.parquet, reset_options.parquet and infos.parquet too, and each number of an observation or
    action has a column; an array of more than 64 is one column of bytes.

    Examples:
      dualtaxi export parquet @latest
      dualtaxi export parquet k3v9m2xq --episodes 0..20 -o first
    """
    return _export("parquet", run, phase, episodes, False, to)


def _export(form: str, run: Run, phase: str | None, episodes: Ranges | None, gz: bool, to: Writing) -> Reply:
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
