"""`dualtaxi import`: a recording from elsewhere into the folder of runs."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli.options import json_option, recordings_option


@click.command("import")
@click.argument("file", metavar="FILE", type=click.Path(path_type=Path))
@click.option("--as-new", is_flag=True, help="Give the run a new id, so that it can stand next to another.")
@recordings_option
@json_option
def command(file: Path, as_new: bool, recordings: Path | None, as_json: bool) -> None:
    """Import FILE, a recording from elsewhere, into the folder of runs.

    FILE is what `dualtaxi export mcap` wrote, or any recording. Every byte is checked before the run appears;
    a damaged or inconsistent file is refused, and nothing is written. A run that is there already with the
    same content or more is left as it is; an interrupted one that FILE continues takes over its content.

    \b
    Examples:
      dualtaxi import quick-k3v9m2xq.mcap
      dualtaxi import quick-k3v9m2xq.mcap --as-new --recordings from_anna
    """  # noqa: D301 - Click wants the backspace itself
    from runner.cli.progress import stage_line
    from runner.cli.runs import print_received
    from runner.errors import RunnerError
    from runner.runs.importing import Occupied, import_recording
    from runner.runs.run import recordings_folder

    try:
        with stage_line(f"importing {file}"):
            imported = import_recording(file, recordings_folder(recordings), as_new=as_new)
    except Occupied as error:
        raise RunnerError(f"{error} --as-new imports it under a new id.") from error
    run, digest = imported.run, imported.content_digest
    content = (
        "this content" if run.summary.get("content_digest", digest) == digest else "this content and more"
    )
    already = content if imported.already else ""
    print_received(run, digest, already, as_json, anonymous=imported.anonymous)
