"""`dualtaxi restore`: the recording of an archived run, back in its folder."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli.options import RunName, json_option, recordings_option
from runner.cli.output import draw, facts, print_json
from runner.cli.runs import find


@click.command("restore")
@click.argument("run_name", metavar="RUN|ARCHIVE", type=RunName())
@recordings_option
@json_option
def command(run_name: str, recordings: Path | None, as_json: bool) -> None:
    """Restore the recording of an archived run, with the same content digest.

    ARCHIVE is the folder or URL of one run's archive: it becomes a run of the recordings folder again, even
    if nothing else is left of it. The archive stays where it is.

    \b
    Examples:
      dualtaxi restore k3v9m2xq
      dualtaxi restore /mnt/archive/k3v9m2xq
      dualtaxi restore s3://lab/runs/k3v9m2xq --recordings /data/runs
    """  # noqa: D301 - Click wants the backspace itself
    from runner.archive.layout import MANIFEST
    from runner.archive.runs import restore_place, restore_run
    from runner.archive.store import S3
    from runner.cli.progress import steps_line
    from runner.cli.runs import compilation_notice, run_as_json, run_facts
    from runner.runs.run import recordings_folder

    is_place = run_name.startswith(S3) or (Path(run_name) / MANIFEST).is_file()
    with compilation_notice(), steps_line("restoring") as report:
        if is_place:
            place = run_name if run_name.startswith(S3) else str(Path(run_name).absolute())
            run = restore_place(place, recordings_folder(recordings), report)
        else:
            run = restore_run(find(run_name, recordings), report)
    if as_json:
        print_json(run_as_json(run))
    else:
        draw(facts(run_facts(run)))
