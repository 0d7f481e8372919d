"""`dualtaxi verify`: whether a recording is what its job gives."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from runner.cli.options import json_option, recordings_option, run_argument
from runner.cli.output import draw, facts, print_json
from runner.cli.runs import find_recording, job_progress, require_over
from runner.errors import ExitCode
from runner.util.humanize import UNKNOWN

if TYPE_CHECKING:
    from runner.errors import Diverged
    from runner.execution.verify import Verification


@click.command("verify")
@run_argument
@click.option("--rerun", is_flag=True, help="Compare with the installed environment.")
@recordings_option
@json_option
@click.pass_context
def command(ctx: click.Context, run_name: str, rerun: bool, recordings: Path | None, as_json: bool) -> None:
    """Check RUN, or a recording by its path: every byte, step, episode, figure and table.

    The run is trained again in memory, with the environment in the recording, and compared. The first
    difference is named: topic, episode, step, field, what was found and what was expected. With --rerun the
    run is trained with the installed environment: the verdict says whether it can be reproduced here, and if
    not, at which step it diverges and what differs: packages, processor, code. It also compares how the
    recording describes its environment: scene and names.

    A run that was interrupted before it recorded anything is neither sound nor wrong: there is nothing to
    verify yet.

    Exit code 1 if anything is wrong.

    \b
    Examples:
      dualtaxi verify @latest
      dualtaxi verify k3v9m2xq --rerun
      dualtaxi verify backup/recording.mcap --json
    """  # noqa: D301 - Click wants the backspace itself
    from runner.cli.progress import bytes_line
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
        draw(facts(_in_words(found, rerun)))
    if not found.sound:
        ctx.exit(ExitCode.DIFFERENT)


def _verdict(found: Verification, rerun: bool) -> str:
    if found.nothing_yet:
        return "interrupted, nothing to verify yet"
    if found.sound:
        return "identical" if rerun else "sound"
    return "diverged" if rerun and found.difference is not None else "wrong"


def _in_words(found: Verification, rerun: bool) -> dict[str, str]:
    step = found.difference.step if found.difference is not None else None
    verdict = _verdict(found, rerun)
    told = {
        "recording": str(found.path),
        "verdict": f"diverged at step {step:,}" if verdict == "diverged" and step is not None else verdict,
    }
    if found.nothing_yet:
        return told | {"next": "`dualtaxi resume` does the run from its beginning"}
    if found.sound:
        told["compared"] = f"{found.train_steps:,} steps of training, {found.eval_steps:,} of evaluation"
        told["digest"] = found.content_digest or f"{UNKNOWN} (told when a run ends properly)"
    else:
        told["first"] = found.finding
    if found.sound and found.not_compared:
        told["not compared"] = found.not_compared
    if found.notes:
        told["note"] = "\n".join(found.notes)
    if found.provenance:
        told["differs"] = "\n".join(
            f"{key}: {then or 'unknown'} then, {now or 'unknown'} here"
            for key, (then, now) in found.provenance.items()
        )
    elif rerun:
        told["differs"] = "nothing: the same code, packages and processor"
    return told


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
    return {
        "topic": difference.topic,
        "episode": difference.episode,
        "step": difference.step,
        "field": difference.field,
        "found": _plain(difference.found),
        "expected": _plain(difference.expected),
    }


def _plain(value: object) -> object:
    """Return a value that JSON can hold."""
    return value if isinstance(value, str | int | float | list | dict | None) else str(value)
