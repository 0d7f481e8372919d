"""`dualtaxi verify` and `dualtaxi repair`: check and repair recordings."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from runner.cli.command import Command, option
from runner.cli.options import trust_option
from runner.cli.output import Reply
from runner.cli.parameter_types import COUNT, Number
from runner.cli.progress import bytes_line, count_line
from runner.cli.runs import folded, job_progress, recording_and_run, require_over
from runner.errors import ExitCode, RunnerError
from runner.runs.locking import locked
from runner.runs.run import Run, command_for
from runner.runs.shards import shards_in_words, shards_of
from runner.util.humanize import UNKNOWN, counted, size

if TYPE_CHECKING:
    from runner.execution.verify import Verification
    from runner.recording.repair import Repair


@click.command("verify", cls=Command)
def verify_command(
    named: tuple[Path, Run | None] = recording_and_run,
    rerun: bool | None = option(
        "--rerun/--no-rerun",
        default=None,
        help="Rerun or retrain it in the installed environment; by default loops only, where possible.",
    ),
    sample: int | None = option(
        "--sample", type=COUNT, metavar="N", help="Rerun only N episodes of a loop, evenly spread."
    ),
    tolerance: float = option(
        "--tolerance",
        type=Number(0, 1, float),
        default=0.0,
        metavar="X",
        help="Accept this absolute and relative difference of a loop's observations and rewards.",
    ),
    trust: bool = trust_option,
) -> Reply:
    """Check RUN, or a recording by its path: every byte, step, episode, figure and table.

    A run that was trained here is retrained in memory, with the environment in the recording, and compared.
    --rerun retrains it with the installed environment, whose scene and names are compared with the recorded
    ones, too.

    A loop's environment is rerun, in a process with limits: it takes the recorded resets and actions, and
    every observation, reward and end is compared. Of a run that you did not record, only listed environments
    are made, unless you say --trust. --no-rerun checks the file only.

    Verdicts:
      reproduced   all that was retrained or rerun is equal
      consistent   only the file was checked; the reason is stated
      interrupted  the run did not finish; all that it recorded holds
      differs      from the stated step on; packages or code that changed are named
      damaged      bytes are wrong, or parts of the file contradict each other

    Exit code 1 if it differs or is damaged; with --rerun also if it cannot be rerun.

    Examples:
      dualtaxi verify @latest
      dualtaxi verify k3v9m2xq --rerun
      dualtaxi verify k3v9m2xq --sample 20 --tolerance 1e-6
      dualtaxi verify backup/recording.mcap --json
    """
    from runner.execution.verify import check, damage_of, rerun_loop

    path, run = named
    require_over(run)
    if run is not None and (shards := shards_in_words(run)):
        raise RunnerError(f"run {run.run_id} is not complete: {shards} of it could not be added.")
    episodes = (run.episodes_to_do or 0) if run else 0
    with bytes_line("reading") as reading:
        damage = damage_of(path, reading)
    with job_progress("verifying", episodes) as (report, _):
        found = check(path, damage, bool(rerun), report, trust)
    if found.can_be_rerun and rerun is not False:
        with count_line("steps rerun", 0 if sample else found.train_steps + found.eval_steps) as count:
            found = rerun_loop(found, sample, tolerance, trust, count)
    code = ExitCode.DIFFERENT if not found.sound or (rerun and found.reason) else ExitCode.OK
    return Reply(_as_json(found), [_rows(found, run)], exit_code=code)


def _rows(found: Verification, run: Run | None) -> dict[str, str]:
    """Return a verdict and all that belongs to it, as text by name."""
    rows = {"recording": str(found.path), "verdict": _verdict(found), "first": found.finding}
    rows["environment"] = str(found.composition or "")
    if found.verdict == "interrupted" and run is not None and run.can_train_again:
        rows["next"] = f"`{command_for(run, 'resume')}` continues from there"
    if found.reason:
        rows["reason"] = f"cannot be rerun: {found.reason}"
        rows["for example"] = str(found.difference or "")
    elif found.act == "checked" and found.can_be_rerun and found.sound:
        rows["reason"] = "not rerun, as --no-rerun demands"
    notes = [f"{name}: its arguments were assumed, as they could not be recorded" for name in found.assumed]
    if found.left_out:
        notes.append(
            f"{counted(found.left_out, 'step')} left out: the random generators before them are not known"
        )
    if found.cut_off:
        notes.append(f"the last {counted(found.cut_off, 'step')} left out: their resets were not written")
    rows["note"] = "\n".join([*notes, *found.notes])
    if found.sound:
        rows["digest"] = found.content_digest or f"{UNKNOWN} (written when a run ends properly)"
        rows["not compared"] = found.not_compared
    if found.verdict == "differs" or (found.act == "retrained" and found.environment == "installed"):
        rows["changed"] = "\n".join(
            f"{key}: {then or 'unknown'} then, {now or 'unknown'} here"
            for key, (then, now) in found.changes.items()
        )
        rows["changed"] = rows["changed"] or "nothing: the same code, packages and platform as recorded"
    return rows


def _verdict(found: Verification) -> str:
    """Return a verdict, with what was compared, in a sentence."""
    steps = counted(found.steps, "step")
    if found.verdict == "damaged":
        return found.verdict
    if found.verdict == "interrupted" and not found.train_steps + found.eval_steps:
        compared = "nothing was recorded yet"
    elif found.act == "retrained":
        compared = f"retrained with the {found.environment} environment"
        if found.sound:
            compared += f": {counted(found.episodes, 'episode')}, {steps} with evaluations, every byte"
    elif found.act == "rerun":
        of = found.of_episodes
        episodes = counted(found.episodes, "episode")
        if of is not None:
            episodes = f"{found.episodes:,} of {counted(of, 'episode')}"
        if found.unfinished:
            episodes += f" ({found.unfinished:,} unfinished)"
        exactness = f"within {found.tolerance:g}" if found.tolerance else "every byte"
        compared = f"reran {episodes}, {steps}, {exactness}"
    else:
        compared = "only the file was checked, which agrees with itself"
    return f"{found.verdict}: {compared}"


def _as_json(found: Verification) -> dict[str, object]:
    """Return a verdict and all that belongs to it, as JSON."""
    left_out = ("composition", "can_be_rerun", "if_rerun")
    texts = ("reason", "finding", "content_digest", "not_compared")
    plain = (str, int, float, list, dict, type(None))
    return {
        **{name: value for name, value in vars(found).items() if name not in left_out},
        **{name: getattr(found, name) or None for name in texts},
        "path": str(found.path.absolute()),
        "environment": None if found.composition is None else found.composition.as_json(),
        "difference": found.difference
        and {
            key: value if isinstance(value, plain) else str(value)
            for key, value in vars(found.difference).items()
        },
        "changes": {key: {"then": then, "here": here} for key, (then, here) in found.changes.items()},
    }


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
