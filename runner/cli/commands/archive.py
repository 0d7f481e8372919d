"""`dualtaxi archive`, `restore`, `import` and `checkpoint`: runs and checkpoints in archives and files."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from runner.archive.places import default_target
from runner.cli.command import Command, CommandGroup, argument, option
from runner.cli.options import force_option, output_option, runs_argument
from runner.cli.output import Remark, Reply, path_and_size, say, written
from runner.cli.parameter_types import PATH, RunName
from runner.cli.progress import stage_line, steps_line
from runner.cli.runs import compilation_notice, find, received, recorded_run, run_reply, runs_folder
from runner.errors import RunnerError
from runner.runs.run import Run
from runner.util.files import new_file
from runner.util.humanize import size
from runner.util.row_text import json_lines

if TYPE_CHECKING:
    from runner.archive.runs import Archived


@click.command("archive", cls=Command)
def archive_command(
    run_names: tuple[str, ...] = runs_argument,
    to: str | None = option(
        "--to",
        metavar="DIR|URL",
        help="A folder, or s3://BUCKET/PREFIX.  [default: $DUALTAXI_ARCHIVE, or `archive` next to the runs]",
    ),
    remove: bool = option(
        "--remove",
        is_flag=True,
        help="Remove each recording once its archive has been read back and compared.",
    ),
    dry_run: bool = option("--dry-run", is_flag=True, help="Report the sizes, but write and change nothing."),
    folder: Path = runs_folder,
) -> Iterator[Reply]:
    """Archive runs losslessly as Parquet, which DuckDB, pandas and Polars read (docs/archive.md).

    An archived run takes a tenth of the space. With --remove its recording is removed, but the run stays
    listed; commands that need the recording restore it into the cache, and `dualtaxi restore` brings it back.
    --json prints one line for each run.

    Examples:
      dualtaxi archive @latest
      dualtaxi archive k3v9m2xq p7 --to /mnt/archive --remove
      dualtaxi archive tutorial_cooperative --to s3://lab/runs --remove
    """
    from runner.archive.runs import archive_run

    target = to or default_target(folder)
    runs = [find(name, folder) for name in dict.fromkeys(run_names)]
    left = [run for run in runs if run.status != "archived"]
    for run in runs:
        if left and run not in left:
            say(f"Run {run.run_id} is archived already, in {run.archive.target}.")
    for run in left or runs:
        with compilation_notice(), steps_line(f"archiving {run.run_id}") as report:
            archived = archive_run(run, target, remove, report, dry_run)
        yield _reply(archived, dry_run)


def _reply(archived: Archived, dry_run: bool) -> Reply:
    run, manifest = archived.run, archived.manifest
    values = archived.as_json() | {"place": archived.place, "dry_run": dry_run}
    per_step = f", {manifest.size / archived.steps:.2f} bytes per step" if archived.steps else ""
    fate = "removed" if archived.removed else "kept"
    state = "" if archived.new else "  (existed already, undamaged)"
    rows = {
        "run": f"{run.run_id}  {run.title}",
        "archive": archived.place + state,
        "size": f"{size(manifest.size)}{per_step}; the recording: {size(archived.recording_bytes)}, {fate}",
        "digest": manifest.digest,
    }
    remarks = [Remark("Nothing was kept: a dry run.")] if dry_run else []
    return Reply(text=[rows, *remarks], lines={"json": json_lines([values])})


@click.command("restore", cls=Command)
def restore_command(
    run_name: str = argument(metavar="RUN|ARCHIVE", type=RunName()),
    folder: Path = runs_folder,
) -> Reply:
    """Restore the recording of an archived run, with the same content digest.

    ARCHIVE is the folder or URL of one run's archive: it becomes a run of the recordings folder again, even
    if nothing else is left of it. The archive stays where it is.

    Examples:
      dualtaxi restore k3v9m2xq
      dualtaxi restore /mnt/archive/k3v9m2xq
      dualtaxi restore s3://lab/runs/k3v9m2xq --recordings /data/runs
    """
    from runner.archive.layout import MANIFEST
    from runner.archive.runs import restore_place, restore_run
    from runner.archive.store import S3

    is_url = run_name.startswith(S3)
    with compilation_notice(), steps_line("restoring") as report:
        if is_url or (Path(run_name) / MANIFEST).is_file():
            place = run_name if is_url else str(Path(run_name).absolute())
            run = restore_place(place, folder, report)
        else:
            run = restore_run(find(run_name, folder), report)
    return run_reply(run, {})


@click.command("import", cls=Command)
def import_command(
    file: Path = argument(metavar="FILE", type=PATH),
    as_new: bool = option("--as-new", is_flag=True, help="Give the run a new id."),
    folder: Path = runs_folder,
) -> Reply:
    """Import FILE, a recording from elsewhere, into the folder of runs.

    FILE was written by `dualtaxi export mcap`, or is any recording. Every byte is checked before the run
    appears; a damaged or inconsistent file is refused, and nothing is written. A run that is here already
    with the same content or more stays as it is; an interrupted run is completed from FILE.

    Examples:
      dualtaxi import quick-k3v9m2xq.mcap
      dualtaxi import quick-k3v9m2xq.mcap --as-new --recordings from_anna
    """
    from runner.runs.importing import Occupied, import_recording

    try:
        with stage_line(f"importing {file}"):
            imported = import_recording(file, folder, as_new=as_new)
    except Occupied as error:
        raise RunnerError(f"{error} --as-new imports it under a new id.") from error
    run, digest = imported.run, imported.content_digest
    is_same = run.summary.get("content_digest", digest) == digest
    existing = ("this content" if is_same else "this content and more") if imported.already else ""
    return received(run, digest, existing, anonymous=imported.anonymous)


@click.group("checkpoint", cls=CommandGroup)
def checkpoint_command() -> None:
    """Get a checkpoint of a run.

    Example:
      dualtaxi checkpoint get cartpole @latest -o policy.safetensors
    """


@checkpoint_command.command("get", short_help="Write a checkpoint into a file.")
def get_command(
    run: Run = recorded_run,
    reference: str = argument(metavar="[NAME]@STEP", default="@latest"),
    output: Path | None = output_option("NAME-STEP.FORMAT"),
    force: bool = force_option,
) -> Reply:
    """Write a checkpoint of RUN into a file, after comparing its digest.

    @STEP is the last checkpoint at or before that step, NAME@STEP the last one of that name; @latest is the
    last of all, and the default. Nothing is unpickled.

    Examples:
      dualtaxi checkpoint get cartpole @20000 -o policy.safetensors
      dualtaxi checkpoint get cartpole policy@latest -o policy.safetensors
    """
    from runner.runs.checkpoints import find_checkpoint

    checkpoint = find_checkpoint(run.checkpoints(), reference, f"run {run.run_id}")
    name = re.sub(r"[^\w.+=-]", "_", checkpoint.name)
    path = output or Path(f"{name}-{checkpoint.step}.{checkpoint.format}")
    checkpoint.check()
    with new_file(path, force) as temporary:
        shutil.copyfile(checkpoint.path, temporary)
    text = f"{path_and_size(path)}, {checkpoint.reference}, {checkpoint.format}"
    return written(text, path, **checkpoint.as_json())
