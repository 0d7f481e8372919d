"""`dualtaxi repair`: repair a damaged recording."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from runner.cli import Command
from runner.cli.options import json_option, recordings_option, run_argument
from runner.cli.output import draw, facts, print_json
from runner.cli.progress import bytes_line
from runner.cli.runs import command_for, find_recording
from runner.errors import ExitCode
from runner.runs.locking import locked
from runner.util.humanize import size

if TYPE_CHECKING:
    from runner.recording.repair import Repair
    from runner.runs.run import Run

_MESSAGES: Final = {
    "/train/step": "training steps",
    "/eval/step": "evaluation steps",
    "/train/episode": "training episodes",
    "/eval/episode": "evaluation episodes",
    "/train/metrics": "reports of training",
    "/eval/metrics": "evaluations",
    "/eval/optimality": "exact measures",
    "/q_table": "Q-table snapshots",
    "/log": "log lines",
    "/train/reset": "resets",
    "/eval/reset": "evaluation resets",
    "/train/info": "infos",
    "/eval/info": "evaluation infos",
    "/scalar": "logged numbers",
    "/array": "arrays",
    "/train/frame": "frames",
    "/eval/frame": "evaluation frames",
}


@click.command("repair", cls=Command)
@run_argument
@recordings_option
@json_option
@click.pass_context
def repair_command(ctx: click.Context, run_name: str, recordings: Path | None, as_json: bool) -> None:
    """Repair the recording of RUN, or one given by its path, so that every reader opens it.

    Every good chunk is copied to a new file, also those after a damaged place; the file is read back and
    counted before it replaces the old one, which is not touched until then. If something in the middle was
    lost, the damaged file is kept next to it. The command reports what was lost; `dualtaxi resume` brings it
    back.

    Exit code 1 if anything was lost, also in an earlier repair.

    Examples:
      dualtaxi repair @latest
      dualtaxi repair backup/recording.mcap
    """
    from runner.execution.verify import refuse_foreign
    from runner.recording.repair import repair

    path, run = find_recording(run_name, recordings)
    refuse_foreign(path)
    lock = contextlib.nullcontext() if run is None else locked(run)
    with lock, bytes_line("repairing") as report:
        repaired = repair(path, report)
        if run is not None and repaired.lost and run.status == "finished":
            # Resuming the run must arrive at the digest that it had.
            run.update(status="interrupted", proof=run.summary.content_digest)
    if as_json:
        keys = ("was_whole", "lossless", "kept", "lost", "torn_steps", "lost_bytes")
        original = repaired.original and str(repaired.original.absolute())
        values = {key: getattr(repaired, key) for key in keys}
        print_json({"path": str(repaired.path.absolute()), **values, "original": original})
    else:
        draw(facts(_rows(repaired, run)))
    if not repaired.lossless:
        ctx.exit(ExitCode.DIFFERENT)


def _rows(repaired: Repair, run: Run | None) -> dict[str, str]:
    rows = {"recording": str(repaired.path)}
    if repaired.was_whole and repaired.lossless:
        return rows | {"verdict": "whole; there was nothing to do"}
    if repaired.was_whole:
        rows["verdict"] = "repaired before, when not all could be saved; there was nothing to do"
    else:
        counts = [
            f"{count:,} {_MESSAGES[topic]}" for topic, count in repaired.kept.items() if topic != "/log"
        ]
        rows["verdict"] = "repaired" if repaired.lossless else "repaired, but not all could be saved"
        rows["kept"] = ", ".join(counts) or "nothing but the description: it ended before its first message"
    if not repaired.lossless:
        rows["lost"] = "\n".join(_losses(repaired))
    if repaired.original is not None:
        rows["damaged"] = f"{repaired.original} is kept"
    if run is not None and not repaired.lossless and "made_by" not in run.file.config:
        rows["next"] = command_for(run, "resume")
    return rows


def _losses(repaired: Repair) -> list[str]:
    """Return what was lost, one kind of message per line."""
    lines = [
        f"{_MESSAGES[topic]} {first:,} to {end - 1:,} ({end - first:,})"
        for topic, holes in repaired.lost.items()
        for first, end in holes
    ]
    if repaired.torn_steps:
        lines.append(f"{repaired.torn_steps:,} steps in a chunk that was being written")
    elif not lines:
        lines.append("no whole step: a record that was being written")
    return [*lines, f"{size(repaired.lost_bytes)} of the file in all"] if repaired.lost_bytes else lines
