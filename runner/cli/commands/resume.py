"""`dualtaxi resume`, `rerecord`, `evaluate` and `repair`: retrain, rerun, play or repair a recorded run."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from runner.cli.command import Command, option
from runner.cli.options import (
    accept_changes_option,
    checkpoint_option,
    job_option,
    policy_option,
    trust_option,
)
from runner.cli.output import Reply, say
from runner.cli.parameter_types import COUNT, INDEX, Number
from runner.cli.progress import bytes_line, count_line
from runner.cli.runs import (
    folded,
    found_run,
    job_progress,
    recorded_run,
    recording_and_run,
    run_as_json,
    run_facts,
    run_reply,
    runs_folder,
)
from runner.errors import ExitCode, RecordingError
from runner.runs.run import Run, command_for, locked, require_over
from runner.runs.shards import shards_of
from runner.util.humanize import counted, number, size

if TYPE_CHECKING:
    from runner.execution.rerecord import Start
    from runner.recording.repair import Repair


@click.command("resume", cls=Command)
@job_option
def resume_command(
    run: Run = found_run,
    accept_changes: bool = accept_changes_option,
    trust: bool = trust_option,
) -> Reply:
    """Resume RUN, which was interrupted or failed, as if it had never stopped.

    The run is retrained without recording, which is quick, and compared byte for byte with its recording;
    what is missing is then recorded. The content digest is that of an uninterrupted run. A recording that
    lost something in its middle is written again and replaced at the end. Nothing is done for a finished run.

    A run that was started with another version of the code, the environment or a numerical library is
    refused, with a list of what differs. --accept-changes resumes it anyway, and the recording notes that.

    Examples:
      dualtaxi resume @latest
      dualtaxi resume k3v9m2xq --json
    """
    from runner.execution.resume import is_finished, resume

    was_finished = is_finished(run)
    if not was_finished and run.status != "running" and run.can_train_again:
        _announce(run)
    with job_progress("", run.episodes_to_do or 0) as (report, interrupt):
        run = resume(run, accept_changes, report, interrupt, trust)
    if was_finished:
        return Reply(run_as_json(run), notes=[f"Run {run.run_id} is finished; there is nothing to do."])
    again = f"Interrupted again; `{command_for(run, 'resume')}` continues from there."
    is_interrupted = interrupt.came and run.status == "interrupted"
    return run_reply(run, {"next": command_for(run, "show")}, again if is_interrupted else "")


def _announce(run: Run) -> None:
    """Print where a run is resumed, if its recording can be read."""
    from runner.recording.reader import open_recording

    with contextlib.suppress(RecordingError), open_recording(run.recording) as recording:
        episodes = counted(recording.done()["episodes"], "episode")
        say(f"Resumed after {episodes}: what was recorded is trained again first, and compared.")


@click.command("rerecord", cls=Command)
def rerecord_command(run: Run = found_run, trust: bool = trust_option) -> Reply:
    """Record the steps of RUN, which was recorded without them.

    A job (recording.steps: none) is retrained. The environment of a loop (steps="actions") takes the
    recorded actions again, in a process with limits. The full recording replaces the old one once it is
    complete and has the same content digest, which proves that these are its steps. Nothing is done for a
    run that has its steps.

    Example:
      dualtaxi run quick --set recording.steps=none
      dualtaxi rerecord @latest
    """
    from runner.execution.rerecord import holds_steps, is_rerun, rerecord

    require_over(run)
    is_loop = is_rerun(run)
    had_steps = (is_loop or run.status == "finished") and holds_steps(run)
    if is_loop:
        steps = (run.summary.train_steps or 0) + (run.summary.eval_steps or 0)
        with count_line("steps rerun", steps) as count:
            run = rerecord(run, trust=trust, count=count)
    else:
        with job_progress("", run.episodes_to_do or 0) as (report, interrupt):
            run = rerecord(run, report, interrupt, trust=trust)
    if had_steps:
        note = f"Run {run.run_id} has all its steps already; there is nothing to do."
        return Reply(run_as_json(run), notes=[note])
    proof = "the content digest is the one that the run had"
    return run_reply(run, {"proof": proof, "next": command_for(run, "play")})


TRIALS: Final = 200
LOOP_TRIALS: Final = 20
"""Episodes of an evaluation of a checkpoint, whose environment may be slow."""


@click.command("evaluate", cls=Command)
def evaluate_command(
    source: Run = recorded_run,
    step: int | None = option("--step", type=INDEX, help="After N training steps.  [default: the last]"),
    trials: int | None = option(
        "--trials",
        type=COUNT,
        metavar="K",
        help=f"Number of episodes.  [default: {TRIALS}, for a loop {LOOP_TRIALS}]",
    ),
    start: str = option(
        "--start",
        default="random",
        show_default=True,
        metavar="random|each|STATE",
        help="Start states: random ones, each one once, or this one.",
    ),
    seed: int = option(
        "--seed",
        type=Number(0, 2**64 - 1),
        default=0,
        show_default=True,
        metavar="S",
        help="Seed of the new episodes.",
    ),
    checkpoint: str | None = checkpoint_option,
    policy: str | None = policy_option,
    trust: bool = trust_option,
    folder: Path = runs_folder,
) -> Reply:
    """Evaluate the trained Q-table of RUN greedily in new episodes.

    The table at any step can be evaluated. The episodes are recorded as a separate run, whose configuration
    names the run and the step of the table.

    For a loop, a checkpoint is evaluated in its environment, which is made again. --policy names a function
    of yours that takes the checkpoint's content (arrays by name, or bytes) and the spaces of observations and
    actions, and returns a function from an observation to an action. Trial K resets with the seed S + K.

    Examples:
      dualtaxi evaluate @latest
      dualtaxi evaluate cartpole --checkpoint @20000 --policy agent:policy --trials 50
      dualtaxi evaluate k3v9m2xq --step 50000 --trials 1000 --seed 7
      dualtaxi evaluate k3v9m2xq --start each
    """
    if start not in ("random", "each") and not start.isdecimal():
        raise click.UsageError(f"--start: found {start!r}, expected random, each, or a state from 0.")
    if start == "each" and trials is not None:
        raise click.UsageError("--start each plays one episode per state: leave out --trials.")
    from runner.analysis.evaluations import evaluation_records, evaluations_grid
    from runner.execution.rerecord import evaluate
    from runner.recording.reader import open_recording

    if not source.can_train_again or checkpoint is not None or policy is not None:
        if checkpoint is None or policy is None:
            raise click.UsageError(
                "a loop is evaluated by --checkpoint [NAME]@STEP and --policy module:function; "
                f"`{command_for(source, 'checkpoints')}` lists its checkpoints."
            )
        if step is not None or start != "random":
            raise click.UsageError("--step and --start are for runs that were trained here, not for loops.")
        return _evaluate_checkpoint(source, folder, checkpoint, policy, trials or LOOP_TRIALS, seed, trust)
    to_play = None if start == "each" else trials or TRIALS
    start_state: Start = int(start) if start.isdecimal() else "random"
    with job_progress("", 0) as (report, interrupt):
        run = evaluate(source, folder, step, to_play, start_state, seed, report, interrupt, trust)
    origin = run.file.config["initial_q"]
    values = run_as_json(run) | {"origin": origin}
    if run.status != "finished":
        note = f"Interrupted: the episodes so far are kept; `{command_for(run, 'resume')}` plays the rest."
        return Reply(values, notes=[note], exit_code=ExitCode.INTERRUPTED)
    with open_recording(run.recording) as recording:
        successes = recording.environment["success_events"]
        grid = evaluations_grid(evaluation_records(recording), successes)
    table = f"of run {origin['run']} after {origin['step']:,} training steps"
    play = command_for(run, "play", "--eval 0:0")
    return Reply(values, [grid, "", run_facts(run) | {"table": table, "next": play}])


def _evaluate_checkpoint(
    source: Run,
    folder: Path,
    reference: str,
    policy: str,
    trials: int,
    seed: int,
    trust: bool,
) -> Reply:
    """Play a checkpoint of a loop, and return the run that it was recorded in."""
    from runner.loops.policies import play_checkpoint
    from runner.recording.metrics import spread_of
    from runner.recording.reader import open_recording
    from runner.runs.checkpoints import find_checkpoint

    checkpoint = find_checkpoint(source.checkpoints(), reference, f"run {source.run_id}")
    with count_line("episodes", trials) as report:
        run = play_checkpoint(source, checkpoint, policy, folder, trials, seed, trust, report)
    origin = run.file.config["config"]["origin"]
    with open_recording(run.recording) as recording:
        played = recording.eval.episodes.array()
    spreads = {"return": spread_of(played["returns"].sum(axis=1)), "length": spread_of(played["length"])}
    spread = {
        name: f", standard deviation {number(figures['standard_deviation'])}, "
        f"{number(figures['lowest'])} to {number(figures['highest'])}"
        for name, figures in spreads.items()
        if figures
    }
    evaluation = run.summary.last_evaluation
    means = {} if evaluation is None else evaluation.values
    results = {
        "played": f"{checkpoint.reference} of run {source.run_id}, {checkpoint.digest[:16]}, by {policy}",
        "mean return": number(means.get("mean_return")) + spread.get("return", ""),
        "mean length": number(means.get("mean_length")) + spread.get("length", ""),
        "next": command_for(run, "show"),
    }
    return run_reply(run, results, origin=origin, spread=spreads)


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
    for part, owner in parts:
        lock = contextlib.nullcontext() if owner is None else locked(owner)
        with lock, bytes_line("repairing") as report:
            repaired = repair(part, report, owner.summary if owner is not None else None)
            if owner is not None and repaired.lost and owner.status == "finished":
                # Resuming the run must arrive at the digest that it had. What a process of it states it holds
                # is compared when its recording is added to the run; of the run, the recording says it now.
                left = ("seconds", "error", "unfolded") if owner is run else tuple(owner.summary)
                summary = {key: owner.summary[key] for key in left if key in owner.summary}
                owner.update(status="interrupted", proof=owner.summary.content_digest, summary=summary)
        done.append((repaired, owner))
    first, *others = [_repair_as_json(repaired) for repaired, _ in done]
    value = first | ({"shards": others} if others else {})
    text = [_repair_facts(repaired, owner) for repaired, owner in done]
    whole = run if run is None else folded(run)
    has_losses = not all(repaired.lossless for repaired, _ in done) or (whole and whole.summary.unfolded)
    return Reply(value, text, exit_code=ExitCode.DIFFERENT if has_losses else ExitCode.OK)


def _repair_as_json(repaired: Repair) -> dict[str, object]:
    keys = ("was_whole", "lossless", "kept", "lost", "torn_steps", "lost_bytes")
    original = repaired.original and str(repaired.original.absolute())
    values = {key: getattr(repaired, key) for key in keys}
    return {"path": str(repaired.path.absolute()), **values, "original": original}


def _repair_facts(repaired: Repair, run: Run | None) -> dict[str, str]:
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
