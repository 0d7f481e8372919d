"""`dualtaxi verify`: check a recording by training its run again."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from runner.cli import Command
from runner.cli.options import json_option, recordings_option, run_argument
from runner.cli.output import draw, facts, print_json
from runner.cli.progress import bytes_line
from runner.cli.runs import find_recording, job_progress, require_over
from runner.errors import Diverged, ExitCode
from runner.util.humanize import UNKNOWN

if TYPE_CHECKING:
    from runner.execution.verify import Verification


@click.command("verify", cls=Command)
@run_argument
@click.option("--rerun", is_flag=True, help="Compare with the installed environment.")
@recordings_option
@json_option
@click.pass_context
def verify_command(
    ctx: click.Context, run_name: str, rerun: bool, recordings: Path | None, as_json: bool
) -> None:
    """Check RUN, or a recording by its path: every byte, step, episode, figure and table.

    The run is trained again in memory, with the environment in the recording, and compared. The first
    difference is named: topic, episode, step, field, what was found and what was expected. With --rerun the
    run is trained with the installed environment: the verdict says whether it can be reproduced here, and if
    not, at which step it diverges and what differs: packages, processor, code. It also compares how the
    recording describes its environment: scene and names.

    A run that was interrupted before it recorded anything is neither sound nor wrong: there is nothing to
    verify yet.

    Exit code 1 if anything is wrong.

    Examples:
      dualtaxi verify @latest
      dualtaxi verify k3v9m2xq --rerun
      dualtaxi verify backup/recording.mcap --json
    """
    from runner.execution.verify import damage_of, verify

    path, run = find_recording(run_name, recordings)
    require_over(run)
    episodes = (run.episodes_to_do or 0) if run else 0
    with bytes_line("reading") as reading:
        damage = damage_of(path, reading)
    with job_progress("verifying", episodes) as (report, _):
        found = verify(path, rerun, report, damage)
    if as_json:
        print_json(_as_json(found, rerun))
    else:
        draw(facts(_rows(found, rerun)))
    if not found.sound:
        ctx.exit(ExitCode.DIFFERENT)


def _verdict(found: Verification, rerun: bool) -> str:
    if found.nothing_yet:
        return "interrupted, nothing to verify yet"
    if found.sound:
        return "identical" if rerun else "sound"
    return "diverged" if rerun and found.difference is not None else "wrong"


def _rows(found: Verification, rerun: bool) -> dict[str, str]:
    verdict = _verdict(found, rerun)
    if verdict == "diverged" and found.difference is not None and found.difference.step is not None:
        verdict = f"diverged at step {found.difference.step:,}"
    rows = {"recording": str(found.path), "verdict": verdict}
    if found.nothing_yet:
        return rows | {"next": "`dualtaxi resume` trains the run from the beginning"}
    if found.sound:
        rows["compared"] = f"{found.train_steps:,} steps of training, {found.eval_steps:,} of evaluation"
        rows["digest"] = found.content_digest or f"{UNKNOWN} (written when a run ends properly)"
        rows["not compared"] = found.not_compared
    else:
        rows["first"] = found.finding
    rows["note"] = "\n".join(found.notes)
    rows["differs"] = "\n".join(
        f"{key}: {then or 'unknown'} then, {now or 'unknown'} here"
        for key, (then, now) in found.provenance.items()
    )
    if rerun and not found.provenance:
        rows["differs"] = "nothing: the same code, packages and processor"
    return {key: text for key, text in rows.items() if text}


def _as_json(found: Verification, rerun: bool) -> dict[str, Any]:
    return {
        "path": str(found.path.absolute()),
        "verdict": _verdict(found, rerun),
        "finding": found.finding or None,
        "difference": None if found.difference is None else _difference(found.difference),
        "train_steps": found.train_steps,
        "eval_steps": found.eval_steps,
        "content_digest": found.content_digest or None,
        "notes": list(found.notes),
        "not_compared": found.not_compared or None,
        "provenance": {key: {"then": then, "here": here} for key, (then, here) in found.provenance.items()},
    }


def _difference(difference: Diverged) -> dict[str, Any]:
    keys = ("topic", "episode", "step", "field", "found", "expected")
    values = {key: getattr(difference, key) for key in keys}
    plain = (str, int, float, list, dict, type(None))
    return {key: value if isinstance(value, plain) else str(value) for key, value in values.items()}
