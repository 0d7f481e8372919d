"""`dualtaxi pack`: a run as one file."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli.finding import find_recorded
from runner.cli.options import json_option, recordings_option, run_argument
from runner.cli.output import draw, facts, print_json, say, size


@click.command("pack")
@run_argument
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="The file to write.  [default: NAME-RUN.dualtaxi]",
)
@click.option(
    "--anonymous", is_flag=True, help="Leave out host, user, command line and folder, wherever they stand."
)
@click.option("--force", is_flag=True, help="Replace the file if it exists.")
@recordings_option
@json_option
def command(
    run_name: str, output: Path | None, anonymous: bool, force: bool, recordings: Path | None, as_json: bool
) -> None:
    """Put RUN into one file, which `dualtaxi unpack` takes apart elsewhere.

    The file is a plain tar: the recording, what the run is, its labels, and a manifest with sizes and
    checksums. The same run gives the same bytes. An interrupted run can be packed, and stays interrupted.

    \b
    Examples:
      dualtaxi pack @latest
      dualtaxi pack k3v9m2xq --anonymous -o for_review.dualtaxi
    """  # noqa: D301 - Click wants the backspace itself
    from runner.packing.packing import pack

    packed = pack(find_recorded(run_name, recordings), output, anonymous, force)
    manifest, path = packed.manifest, packed.path
    for note in packed.notes:
        say(note)
    if as_json:
        bytes_ = path.stat().st_size
        print_json(
            {"path": str(path.absolute()), "bytes": bytes_, "already": packed.already}
            | manifest.model_dump(mode="json")
        )
        return
    if packed.already:
        say(f"{path} holds this run already; there is nothing to do.")
    draw(
        facts(
            {
                "run": f"{manifest.run_id}  {manifest.name}, seed {manifest.seed}, {manifest.status}",
                "digest": manifest.content_digest,
                "file": f"{path}  {size(path.stat().st_size)}",
                "next": f"dualtaxi unpack {path}",
            }
        )
    )
