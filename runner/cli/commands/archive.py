"""`dualtaxi archive`: runs as Parquet in a folder or in object storage."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from runner.cli.options import json_option, recordings_option, runs_argument
from runner.cli.output import draw, facts, print_json, say
from runner.cli.runs import find
from runner.util.humanize import size

if TYPE_CHECKING:
    from runner.archive.runs import Archived
    from runner.runs.run import Run


@click.command("archive")
@runs_argument
@click.option(
    "--to",
    metavar="DIR|URL",
    help="A folder, or s3://BUCKET/PREFIX.  [default: $DUALTAXI_ARCHIVE, or `archive` by the recordings]",
)
@click.option(
    "--remove", is_flag=True, help="Remove each recording once its archive has been read back and compared."
)
@click.option("--dry-run", is_flag=True, help="Report the sizes, but write and change nothing.")
@recordings_option
@json_option
def command(
    run_names: tuple[str, ...],
    to: str | None,
    remove: bool,
    dry_run: bool,
    recordings: Path | None,
    as_json: bool,
) -> None:
    """Archive runs losslessly as Parquet, which DuckDB, pandas and Polars read (docs/archive.md).

    An archived run takes a tenth of the space. With --remove its recording is removed, but the run stays
    listed; commands that need the recording restore it into the cache, and `dualtaxi restore` brings it back.

    \b
    Examples:
      dualtaxi archive @latest
      dualtaxi archive k3v9m2xq p7 --to /mnt/archive --remove
      dualtaxi archive tutorial_cooperative --to s3://lab/runs --remove
    """  # noqa: D301 - Click wants the backspace itself
    from runner.archive.places import default_target
    from runner.archive.runs import archive_run
    from runner.cli.progress import steps_line
    from runner.cli.runs import compilation_notice
    from runner.runs.run import recordings_folder

    target = to or default_target(recordings_folder(recordings))
    for run in _to_do([find(name, recordings) for name in dict.fromkeys(run_names)]):
        with compilation_notice(), steps_line(f"archiving {run.run_id}") as report:
            done = archive_run(run, target, remove, report, dry_run)
        if as_json:
            print_json(_as_json(done, dry_run), indent=None)
        else:
            draw(facts(_in_words(done)))
            if dry_run:
                say("Nothing was kept: a dry run.")


def _to_do(runs: list[Run]) -> list[Run]:
    """Return the runs that are not in an archive alone; if all are, all, which is refused."""
    left = [run for run in runs if run.status != "archived"]
    if not left:
        return runs
    for run in runs:
        if run not in left:
            say(f"Run {run.run_id} is archived already, in {run.archive.target}.")
    return left


def _as_json(done: Archived, dry_run: bool) -> dict[str, Any]:
    return {
        "run_id": done.run.run_id,
        "name": done.run.name,
        "place": done.place,
        "content_digest": done.manifest.digest,
        "steps": _steps(done),
        "bytes": done.manifest.size,
        "recording_bytes": done.recording_bytes,
        "new": done.new,
        "removed": done.removed,
        "dry_run": dry_run,
    }


def _in_words(done: Archived) -> dict[str, str]:
    steps = _steps(done)
    each = f", {done.manifest.size / steps:.2f} bytes a step" if steps else ""
    kept = "removed" if done.removed else "kept"
    state = "" if done.new else "  (it was there already, and is whole)"
    return {
        "run": f"{done.run.run_id}  {done.run.title}",
        "archive": done.place + state,
        "size": f"{size(done.manifest.size)}{each}; the recording: {size(done.recording_bytes)}, {kept}",
        "digest": done.manifest.digest,
    }


def _steps(done: Archived) -> int:
    topics = done.manifest.topics
    return sum(topics[name].size for name in ("/train/step", "/eval/step") if name in topics)
