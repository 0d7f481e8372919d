"""`dualtaxi repair`: repair a recording."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from runner.cli.command import Command
from runner.cli.output import Reply
from runner.cli.progress import bytes_line
from runner.cli.runs import folded, recording_and_run
from runner.errors import ExitCode
from runner.runs.locking import locked
from runner.runs.run import Run, command_for
from runner.runs.shards import shards_of
from runner.util.humanize import size

if TYPE_CHECKING:
    from runner.recording.repair import Repair


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
    "/extra": "names of extras",
    "/train/extra": "steps with extras",
    "/eval/extra": "evaluation steps with extras",
    "/checkpoint": "checkpoints",
    "/train/reset_options": "options of resets",
    "/eval/reset_options": "options of evaluation resets",
    "/train/reset_state": "states before resets",
    "/eval/reset_state": "states before evaluation resets",
    "/clock": "samples of the clock",
    "/host": "samples of the machine",
    "/console": "lines of output",
    "/image": "pictures",
    "/train/actions": "blocks of actions",
    "/eval/actions": "blocks of evaluation actions",
}


@click.command("repair", cls=Command)
def repair_command(named: tuple[Path, Run | None] = recording_and_run) -> Reply:
    """Repair the recording of RUN, or one given by its path, so that every reader opens it.

    Every good chunk is copied to a new file, also those after a damaged place; the file is read back and
    counted before it replaces the old one, which is not touched until then. If something in the middle was
    lost, the damaged file is kept next to it. The command reports what was lost; `dualtaxi resume` brings it
    back. What other processes recorded of the run, and could not be added to it, is repaired and added too.

    Exit code 1 if anything was lost, also in an earlier repair.

    Examples:
      dualtaxi repair @latest
      dualtaxi repair backup/recording.mcap
    """
    from runner.recording.integrity import refuse_foreign
    from runner.recording.repair import can_be_repaired, repair

    path, run = named
    refuse_foreign(path)
    parts = [(path, run)]
    if run is not None:
        parts += [(shard.recording, shard) for shard in shards_of(run) if can_be_repaired(shard.recording)]
    done: list[tuple[Repair, Run | None]] = []
    for part, own in parts:
        lock = contextlib.nullcontext() if own is None else locked(own)
        with lock, bytes_line("repairing") as report:
            repaired = repair(part, report, own.summary if own is not None else None)
            if own is not None and repaired.lost and own.status == "finished":
                # Resuming the run must arrive at the digest that it had. What a process of it states it holds
                # is compared when its recording is added to the run; of the run, the recording says it now.
                left = ("seconds", "error", "unfolded") if own is run else tuple(own.summary)
                summary = {key: own.summary[key] for key in left if key in own.summary}
                own.update(status="interrupted", proof=own.summary.content_digest, summary=summary)
        done.append((repaired, own))
    first, *others = [_repair_as_json(repaired) for repaired, _ in done]
    value = first | ({"shards": others} if others else {})
    text = [_repair(repaired, own) for repaired, own in done]
    whole = run if run is None else folded(run)
    has_losses = not all(repaired.lossless for repaired, _ in done) or (whole and whole.summary.unfolded)
    return Reply(value, text, exit_code=ExitCode.DIFFERENT if has_losses else ExitCode.OK)


def _repair_as_json(repaired: Repair) -> dict[str, object]:
    keys = ("was_whole", "lossless", "kept", "lost", "torn_steps", "lost_bytes")
    original = repaired.original and str(repaired.original.absolute())
    values = {key: getattr(repaired, key) for key in keys}
    return {"path": str(repaired.path.absolute()), **values, "original": original}


def _repair(repaired: Repair, run: Run | None) -> dict[str, str]:
    rows = {"recording": str(repaired.path)}
    if run is not None and run.summary.unfolded:
        rows["not in it"] = run.summary.error or ""
    if repaired.was_whole and repaired.lossless:
        return rows | {"verdict": "whole; there was nothing to do"}
    if repaired.was_whole:
        rows["verdict"] = "repaired before, when not all could be saved; there was nothing to do"
    else:
        counts = [
            f"{count:,} {_MESSAGES[topic]}"
            for topic, count in repaired.kept.items()
            if topic not in ("/log", "/clock", "/host", "/console")
        ]
        rows["verdict"] = "repaired" if repaired.lossless else "repaired, but not all could be saved"
        rows["kept"] = ", ".join(counts) or "nothing but the description: it ended before its first message"
    if not repaired.lossless:
        rows["lost"] = "\n".join(_losses(repaired))
    if repaired.original is not None:
        rows["damaged"] = f"{repaired.original} is kept"
    if run is not None and not repaired.lossless and run.can_train_again:
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
