"""`dualtaxi repair`: make a damaged recording whole again."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from runner.cli.options import json_option, recordings_option, run_argument
from runner.cli.output import draw, facts, print_json
from runner.cli.runs import command_for, find_recording
from runner.errors import ExitCode
from runner.util.humanize import size

if TYPE_CHECKING:
    from runner.recording.repair import Repair
    from runner.runs.run import Run

_WORDS: Final = {
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
    "/scalar": "numbers logged",
    "/array": "arrays",
    "/train/frame": "frames",
    "/eval/frame": "evaluation frames",
}


@click.command("repair")
@run_argument
@recordings_option
@json_option
@click.pass_context
def command(ctx: click.Context, run_name: str, recordings: Path | None, as_json: bool) -> None:
    """Repair the recording of RUN, or one given by its path, so that every reader opens it.

    Every good chunk is copied to a new file, also those after a damaged place; the file is read back and
    counted before it replaces the old one, which is not touched until then. If something in the middle was
    lost, the damaged file is kept next to it. The command reports what was lost; `dualtaxi resume` brings it
    back.

    Exit code 1 if anything was lost, also in an earlier repair.

    \b
    Examples:
      dualtaxi repair @latest
      dualtaxi repair backup/recording.mcap
    """  # noqa: D301 - Click wants the backspace itself
    from runner.cli.progress import bytes_line
    from runner.execution.verify import refuse_foreign
    from runner.recording.repair import repair

    path, run = find_recording(run_name, recordings)
    refuse_foreign(path)
    with _kept(run), bytes_line("repairing") as report:
        done = repair(path, report)
        if run is not None and done.lost:
            _tell_run(run)
    if as_json:
        print_json(_as_json(done))
    else:
        draw(facts(_in_words(done, run)))
    if not done.lossless:
        ctx.exit(ExitCode.DIFFERENT)


def _kept(run: Run | None) -> contextlib.AbstractContextManager[Any]:
    """Return a context in which no other process writes to the run."""
    from runner.runs.locking import locked

    return contextlib.nullcontext() if run is None else locked(run)


def _tell_run(run: Run) -> None:
    """Note that a run's recording is not whole any more; the digest it had proves it when it is resumed."""
    if run.status == "finished":
        run.update(status="interrupted", proof=run.summary.content_digest)


def _in_words(done: Repair, run: Run | None) -> dict[str, str]:
    told = {"recording": str(done.path)}
    if done.was_whole and done.lossless:
        return told | {"verdict": "whole; there was nothing to do"}
    if done.was_whole:
        told["verdict"] = "repaired before, when not all could be saved; there was nothing to do"
        return told | {"lost": "\n".join(_losses(done))} | _next(done, run)
    kept = [f"{count:,} {_WORDS[topic]}" for topic, count in done.kept.items() if topic != "/log"]
    told |= {
        "verdict": "repaired" if done.lossless else "repaired, but not all could be saved",
        "kept": ", ".join(kept) or "nothing but the description: it ended before its first message",
    }
    if not done.lossless:
        told["lost"] = "\n".join(_losses(done))
    if done.original is not None:
        told["damaged"] = f"{done.original} is kept"
    return told | _next(done, run)


def _next(done: Repair, run: Run | None) -> dict[str, str]:
    """Return what brings back what was lost, if anything does: a loop cannot be done again here."""
    if run is None or done.lossless or "made_by" in run.file.config:
        return {}
    return {"next": command_for(run, "resume")}


def _losses(done: Repair) -> list[str]:
    """Return what was lost, a line each."""
    lines = [
        f"{_WORDS[topic]} {first:,} to {behind - 1:,} ({behind - first:,})"
        for topic, holes in done.lost.items()
        for first, behind in holes
    ]
    if done.torn_steps:
        lines.append(f"{done.torn_steps:,} steps in a chunk that was being written")
    elif not lines:
        lines.append("no whole step: a record that was being written")
    return [*lines, f"{size(done.lost_bytes)} of the file in all"] if done.lost_bytes else lines


def _as_json(done: Repair) -> dict[str, Any]:
    return {
        "path": str(done.path.absolute()),
        "was_whole": done.was_whole,
        "lossless": done.lossless,
        "kept": done.kept,
        "lost": done.lost,
        "torn_steps": done.torn_steps,
        "lost_bytes": done.lost_bytes,
        "original": None if done.original is None else str(done.original.absolute()),
    }
