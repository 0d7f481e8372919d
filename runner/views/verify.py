"""`verify`: whether a recording is what its run, or its environment, gives when it is made again."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from runner.analysis.sections import Section
from runner.errors import ExitCode, RunnerError
from runner.runs.run import Run, command_for, require_over
from runner.util.humanize import UNKNOWN, counted
from runner.views.view import NO_PROGRESS, ONLY_HERE, ReadyAnswer, ShownProgress, View, view_input

if TYPE_CHECKING:
    from runner.execution.verify import Verification
    from runner.util.values import Json


def verify(
    file: tuple[Path, Run | None],
    rerun: bool | None = view_input(
        "rerun",
        "Rerun or retrain it in the installed environment; by default loops only, where possible.",
        kind=bool,
    ),
    sample: int | None = view_input(
        "sample", "Rerun only N episodes of a loop, evenly spread.", kind=int, minimum=1
    ),
    tolerance: float = view_input(
        "tolerance",
        "Accept this absolute and relative difference of a loop's observations and rewards.",
        kind=float,
        default=0.0,
        maximum=1,
        metavar="X",
    ),
    trust: bool = ONLY_HERE,
    progress: ShownProgress = NO_PROGRESS,
) -> ReadyAnswer:
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
    from runner.runs.shards import shards_in_words

    path, run = file
    if run is not None:
        require_over(run)
        if shards := shards_in_words(run):
            raise RunnerError(f"run {run.run_id} is not complete: {shards} of it could not be added.")
    with progress.bytes("reading") as report:
        damage = damage_of(path, report)
    with progress.episodes("verifying", (run.episodes_to_do or 0) if run else 0) as report:
        verification = check(path, damage, bool(rerun), report, trust)
    if verification.can_be_rerun and rerun is not False:
        with progress.count(
            "steps rerun", 0 if sample else verification.train_steps + verification.eval_steps
        ) as report:
            verification = rerun_loop(verification, sample, tolerance, trust, report)
    code = ExitCode.DIFFERENT if not verification.sound or (rerun and verification.reason) else ExitCode.OK
    return ReadyAnswer(_as_json(verification), [Section("", facts=_rows(verification, run))], exit_code=code)


def _rows(verification: Verification, run: Run | None) -> dict[str, str]:
    """Return a verdict and all that belongs to it, as text by name."""
    rows = {
        "recording": str(verification.path),
        "verdict": _verdict(verification),
        "first": verification.finding,
    }
    rows["environment"] = str(verification.composition or "")
    if verification.verdict == "interrupted" and run is not None and run.can_train_again:
        rows["next"] = f"`{command_for(run, 'resume')}` continues from there"
    if verification.reason:
        rows["reason"] = f"cannot be rerun: {verification.reason}"
        rows["for example"] = str(verification.difference or "")
    elif verification.act == "checked" and verification.can_be_rerun and verification.sound:
        rows["reason"] = "not rerun, as --no-rerun demands"
    notes = [
        f"{name}: its arguments were assumed, as they could not be recorded" for name in verification.assumed
    ]
    if verification.left_out:
        notes.append(
            f"{counted(verification.left_out, 'step')} left out: "
            "the random generators before them are not known"
        )
    if verification.cut_off:
        notes.append(
            f"the last {counted(verification.cut_off, 'step')} left out: their resets were not written"
        )
    rows["note"] = "\n".join([*notes, *verification.notes])
    if verification.sound:
        rows["digest"] = verification.content_digest or f"{UNKNOWN} (written when a run ends properly)"
        rows["not compared"] = verification.not_compared
    if verification.verdict == "differs" or (
        verification.act == "retrained" and verification.environment == "installed"
    ):
        rows["changed"] = "\n".join(
            f"{key}: {then or 'unknown'} then, {now or 'unknown'} here"
            for key, (then, now) in verification.changes.items()
        )
        rows["changed"] = rows["changed"] or "nothing: the same code, packages and platform as recorded"
    return rows


def _verdict(verification: Verification) -> str:
    """Return a verdict, with what was compared, in a sentence."""
    steps = counted(verification.steps, "step")
    if verification.verdict == "damaged":
        return verification.verdict
    if verification.verdict == "interrupted" and not verification.train_steps + verification.eval_steps:
        compared = "nothing was recorded yet"
    elif verification.act == "retrained":
        compared = f"retrained with the {verification.environment} environment"
        if verification.sound:
            compared += f": {counted(verification.episodes, 'episode')}, {steps} with evaluations, every byte"
    elif verification.act == "rerun":
        of = verification.of_episodes
        episodes = counted(verification.episodes, "episode")
        if of is not None:
            episodes = f"{verification.episodes:,} of {counted(of, 'episode')}"
        if verification.unfinished:
            episodes += f" ({verification.unfinished:,} unfinished)"
        exactness = f"within {verification.tolerance:g}" if verification.tolerance else "every byte"
        compared = f"reran {episodes}, {steps}, {exactness}"
    else:
        compared = "only the file was checked, which agrees with itself"
    return f"{verification.verdict}: {compared}"


def _as_json(verification: Verification) -> Json:
    """Return a verdict and all that belongs to it, as JSON."""
    left_out = ("composition", "can_be_rerun", "if_rerun")
    texts = ("reason", "finding", "content_digest", "not_compared")
    plain = (str, int, float, list, dict, type(None))
    return {
        **{name: value for name, value in vars(verification).items() if name not in left_out},
        **{name: getattr(verification, name) or None for name in texts},
        "path": str(verification.path.absolute()),
        "environment": None if verification.composition is None else verification.composition.as_json(),
        "difference": verification.difference
        and {
            key: value if isinstance(value, plain) else str(value)
            for key, value in vars(verification.difference).items()
        },
        "changes": {key: {"then": then, "here": here} for key, (then, here) in verification.changes.items()},
    }


VERIFY: Final = View("verify", "Verification", verify, subject="file")
