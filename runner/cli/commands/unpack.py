"""`dualtaxi unpack`: a packed run into the folder of runs."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli.options import json_option, recordings_option


@click.command("unpack")
@click.argument("file", metavar="FILE", type=click.Path(path_type=Path))
@click.option("--as-new", is_flag=True, help="Give the run a new id, so that it can stand beside another.")
@recordings_option
@json_option
def command(file: Path, as_new: bool, recordings: Path | None, as_json: bool) -> None:
    """Take a run out of FILE, which `dualtaxi pack` wrote, into the folder of runs.

    Every byte is checked before the run appears: checksums, the content digest, and that the parts say
    the same. A file that is damaged, cut off or made to do harm is refused, and nothing is written. A run
    that is there already with the same content, or further on, is left as it is; an interrupted one that
    FILE goes on with takes over what came.

    \b
    Examples:
      dualtaxi unpack quick-k3v9m2xq.dualtaxi
      dualtaxi unpack quick-k3v9m2xq.dualtaxi --as-new --recordings from_anna
    """  # noqa: D301 - Click wants the backspace itself
    from runner.cli.working import tell_received
    from runner.packing.unpacking import unpack
    from runner.runs.run import recordings_folder

    unpacked = unpack(file, recordings_folder(recordings), as_new)
    run, manifest = unpacked.run, unpacked.manifest
    digest = run.summary.get("content_digest") or manifest.content_digest
    content = "this content" if digest == manifest.content_digest else "this content and more"
    already = content if unpacked.already else ""
    tell_received(run, digest, already, as_json, anonymous=manifest.anonymous)
