"""`runner.branch`: take another action at a recorded step, or other settings, and see where that leads."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import Any

from runner.analysis.step_reference import StepRef, parse_step
from runner.errors import ConfigError
from runner.execution.branching import TrainingBranch, branch_training
from runner.loops.branch import MAX_STEPS, Branch, branch_episode
from runner.runs.run import Run


def branch(
    run: Run,
    *,
    at: str | int | StepRef,
    action: Any = None,
    overrides: Sequence[str] = (),
    episodes: int | None = None,
    policy: str = "recorded",
    seed: int = 0,
    name: str | None = None,
    recordings: str | os.PathLike[str] | None = None,
    max_steps: int = MAX_STEPS,
    trust: bool = False,
    report: Callable[[int], None] = lambda _: None,
    stop: Callable[[], bool] = lambda: False,
) -> Branch | TrainingBranch:
    """Change one step of a recorded run, and record what follows as a run of its own, with the same luck.

    The training of a job is changed at `at`, and goes on to its end: see
    `runner.execution.branching.branch_training`, which takes `overrides` and `episodes`. For a loop, one
    episode is played on: see `runner.loops.branch.branch_episode`, which takes `policy`, `seed`, `max_steps`
    and `trust`. Both take the other arguments; `runner.what_if` plays actions of a job on without training.

    Args:
        run: the parent.
        at: the step: `EPISODE:T`; of a job also its number or `step:N`; of a loop also `eval:N:TRIAL:T`.
        action: the action there; None for the recorded one.
        overrides: `KEY=VALUE` each: the settings from this step on.
        episodes: the training episodes in all; the parent's by default.
        policy: what acts after the step.
        seed: of the policy `random`.
        name: of the new run; `NAME.branch` by default.
        recordings: the folder of the new run.
        max_steps: the most steps to take from the step on.
        trust: whether to import what the recording names to make its environment again.
        report: called with the number of steps taken so far.
        stop: called every few milliseconds of training; return True to stop.

    Returns:
        Its `run`, and the `origin` of the branch; of a loop also where parent and branch led.

    Raises:
        ConfigError: an argument does not fit the run.
        RunnerError: as both functions raise.
    """
    if not run.can_train_again:
        place = parse_step(at) if isinstance(at, str) else at
        if isinstance(place, int):
            raise ConfigError(
                f"at: found the number {place:,} of a step, expected EPISODE:T: the steps of a loop are "
                "counted in its episodes."
            )
        if overrides or episodes is not None:
            raise ConfigError(
                f"run {run.run_id} is a loop, of which an episode is branched; overrides and episodes are "
                "for runs that were trained here."
            )
        return branch_episode(
            run,
            at=place,
            action=action,
            policy=policy,
            seed=seed,
            name=name,
            recordings=recordings,
            max_steps=max_steps,
            trust=trust,
            report=report,
        )
    if (policy, seed, max_steps) != ("recorded", 0, MAX_STEPS):
        raise ConfigError(
            f"run {run.run_id} was trained here, and a branch of it is trained as its "
            "configuration says: policy, seed and max_steps are for loops."
        )
    return branch_training(
        run,
        at=at,
        action=action,
        overrides=overrides,
        episodes=episodes,
        name=name,
        recordings=recordings,
        report=lambda progress: report(progress.train_steps),
        stop=stop,
    )
