"""`dualtaxi verify` and `dualtaxi repair`: check and repair recordings."""

from __future__ import annotations

import contextlib
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from runner.cli.command import Command, option
from runner.cli.options import json_option, recordings_option, run_argument, trust_option
from runner.cli.output import draw, facts, print_json
from runner.cli.parameter_types import COUNT
from runner.cli.progress import bytes_line, count_line
from runner.cli.runs import command_for, find_recording, job_progress, require_over
from runner.errors import Diverged, ExitCode
from runner.runs.locking import locked
from runner.runs.run import Run
from runner.util.humanize import UNKNOWN, counted, size

if TYPE_CHECKING:
    from runner.execution.redo import Redone
    from runner.execution.verification import Verification
    from runner.recording.repair import Repair


@click.command("verify", cls=Command)
def verify_command(
    run_name: str = run_argument,
    rerun: bool | None = option(
        "--rerun/--no-rerun",
        default=None,
        help="Run it again in the installed environment; by default loops only, where that is possible.",
    ),
    sample: int | None = option(
        "--sample", type=COUNT, metavar="N", help="Do only N episodes of a loop again, evenly spread."
    ),
    tolerance: float = option(
        "--tolerance",
        type=click.FloatRange(0, 1),
        default=0.0,
        metavar="X",
        help="Accept this absolute and relative difference of a loop's observations and rewards.",
    ),
    trust: bool = trust_option,
    recordings: Path | None = recordings_option,
    as_json: bool = json_option,
) -> None:
    """Check RUN, or a recording by its path: every byte, step, episode, figure and table.

    A run that was trained here is trained again in memory, with the environment in the recording, and
    compared. The first difference is named: topic, episode, step, field, what was found and what was
    expected. With --rerun the run is trained with the installed environment: the verdict says whether it can
    be reproduced here, and if not, at which step it diverges and what differs: packages, processor, code. It
    also compares how the recording describes its environment: scene and names.

    A loop's environment is made again, in a process with limits, and takes the recorded resets and actions:
    every observation, reward and end is compared. Only installed packages of environments are imported;
    --trust allows all that the recording names. Where the environment cannot be had, or depends on more than
    its seed, the verdict says why; that is an error with --rerun only. --no-rerun leaves it out.

    A run that was interrupted before it recorded anything is neither sound nor wrong: there is nothing to
    verify yet.

    Exit code 1 if anything is wrong.

    Examples:
      dualtaxi verify @latest
      dualtaxi verify k3v9m2xq --rerun
      dualtaxi verify k3v9m2xq --sample 20 --tolerance 1e-6
      dualtaxi verify backup/recording.mcap --json
    """
    from runner.execution.redo import verify_by_redoing
    from runner.execution.verify import damage_of, verify

    path, run = find_recording(run_name, recordings)
    require_over(run)
    episodes = (run.episodes_to_do or 0) if run else 0
    with bytes_line("reading") as reading:
        damage = damage_of(path, reading)
    with job_progress("verifying", episodes) as (report, _):
        verification = verify(path, bool(rerun), report, damage)
    redone = None
    if verification.needs_redo and verification.sound and not verification.nothing_yet and rerun is not False:
        steps = verification.train_steps + verification.eval_steps
        with count_line("steps done again", 0 if sample else steps) as count:
            redone = verify_by_redoing(path, sample, tolerance, trust, count)
    with_installed = bool(rerun) and not verification.needs_redo
    if as_json:
        print_json(
            _verification_as_json(verification, with_installed) | (_redone_as_json(redone) if redone else {})
        )
    else:
        draw(facts(_verification(verification, with_installed) | (_redone(redone) if redone else {})))
    failures = ("differs", "impossible") if rerun else ("differs",)
    if not verification.sound or (redone is not None and redone.verdict in failures):
        raise click.exceptions.Exit(ExitCode.DIFFERENT)


def _redone(redone: Redone) -> dict[str, str]:
    """Return what came of doing a loop again, as rows."""
    steps, of = counted(redone.steps, "step"), redone.of_episodes
    episodes = counted(redone.episodes if of is None else of, "episode")
    if redone.unfinished:
        episodes += f" ({redone.unfinished:,} unfinished)"
    compared = f"{episodes if of is None else f'{redone.episodes:,} of {episodes}'}, {steps}"
    exactness = f"within {redone.tolerance:g}" if redone.tolerance else "every byte"
    rows = {"verdict": f"reproduced: {compared}, {exactness}"}
    if redone.verdict == "differs":
        rows = {"verdict": "differs", "first": str(redone.difference)}
        rows["compared"] = f"{compared}, {exactness}"
    elif redone.verdict == "impossible":
        rows = {"verdict": "sound; it cannot be reproduced here", "reason": redone.reason}
        rows["first"] = str(redone.difference or "")
    notes = [f"{name}: its arguments were assumed, as they could not be recorded" for name in redone.assumed]
    if redone.left_out:
        notes.append(
            f"{redone.left_out:,} steps were left out: the random generators before them are not known"
        )
    if redone.cut_off:
        notes.append(f"the last {redone.cut_off:,} steps were left out: their resets were lost in the kill")
    rows["done again"] = "\n".join(notes)
    if redone.verdict != "reproduced":
        rows["differs"] = "\n".join(
            f"{name}: {then or 'unknown'} then, {now or 'unknown'} here"
            for name, (then, now) in redone.versions.items()
        )
        if redone.verdict == "differs" and not redone.versions:
            rows["differs"] = "no version: the same packages and platform as recorded"
    return rows


def _redone_as_json(redone: Redone) -> dict[str, object]:
    versions = {key: {"then": then, "here": here} for key, (then, here) in redone.versions.items()}
    verdict = {} if redone.verdict == "impossible" else {"verdict": redone.verdict}
    return verdict | {"redone": asdict(redone) | {"assumed": list(redone.assumed), "versions": versions}}


def _verdict(found: Verification, rerun: bool) -> str:
    if found.nothing_yet:
        return "interrupted, nothing to verify yet"
    if found.sound:
        return "identical" if rerun else "sound"
    return "diverged" if rerun and found.difference is not None else "wrong"


def _verification(found: Verification, rerun: bool) -> dict[str, str]:
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
    return rows


def _verification_as_json(found: Verification, rerun: bool) -> dict[str, object]:
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
        "redone": None,
        "provenance": {key: {"then": then, "here": here} for key, (then, here) in found.provenance.items()},
    }


def _difference(difference: Diverged) -> dict[str, object]:
    keys = ("topic", "episode", "step", "field", "found", "expected")
    values = {key: getattr(difference, key) for key in keys}
    plain = (str, int, float, list, dict, type(None))
    return {key: value if isinstance(value, plain) else str(value) for key, value in values.items()}


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
def repair_command(
    run_name: str = run_argument, recordings: Path | None = recordings_option, as_json: bool = json_option
) -> None:
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
    from runner.recording.integrity import refuse_foreign
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
        draw(facts(_repair(repaired, run)))
    if not repaired.lossless:
        raise click.exceptions.Exit(ExitCode.DIFFERENT)


def _repair(repaired: Repair, run: Run | None) -> dict[str, str]:
    rows = {"recording": str(repaired.path)}
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
