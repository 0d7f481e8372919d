"""`dualtaxi branch` and `explain`: change a step or settings, and see where that leads."""

from __future__ import annotations

import contextlib
import dataclasses
import signal
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click
from click.core import ParameterSource

from runner.analysis.sections import Grid, Section
from runner.cli.command import Command, argument, option
from runner.cli.options import (
    job_option,
    ray_option,
    recordings_option,
    set_option,
    trust_option,
    workers_option,
)
from runner.cli.output import Remark, Reply, say
from runner.cli.parameter_types import COUNT, INDEX, STEP, Number
from runner.cli.progress import steps_line, total_line
from runner.cli.runs import compilation_notice, recorded_run, run_facts, run_reply
from runner.runs.run import Run, command_for
from runner.util.humanize import counted, duration, number

if TYPE_CHECKING:
    from runner.analysis.episodes import EpisodeRef
    from runner.debugging.branch import Branch
    from runner.debugging.game import SamplingPlan
    from runner.execution.branching import TrainingBranch


@click.command("branch", cls=Command)
@job_option
def branch_command(
    run: Run = recorded_run,
    at: EpisodeRef | None = option(
        "--at",
        type=STEP,
        metavar="STEP",
        help="The step: EPISODE:T, or step:N by its number in training; eval:N:TRIAL:T of an evaluation; or "
        "typical, best, worst or last.",
    ),
    actions: tuple[str, ...] = option(
        "--action",
        multiple=True,
        metavar="VALUE",
        help="The action: a number, a name or all; of one agent of several AGENT=VALUE, may be repeated.  "
        "[default: as recorded; of a trial of an evaluation all]",
    ),
    overrides: tuple[str, ...] = set_option,
    episodes: int | None = option(
        "--episodes", type=COUNT, help="Training episodes in all.  [default: as many as RUN]"
    ),
    policy: str = option(
        "--policy",
        default="recorded",
        show_default=True,
        metavar="recorded|random|constant|MODULE:FUNCTION",
        help="For a loop: what acts after the step.",
    ),
    seed: int = option(
        "--seed",
        type=INDEX,
        default=0,
        show_default=True,
        metavar="S",
        help="For a loop: seed of the random policy.",
    ),
    name: str | None = option("--name", help="Name of the new run.  [default: RUN.branch]"),
    max_steps: int = option(
        "--max-steps",
        type=COUNT,
        default=100_000,
        show_default=True,
        help="For a loop: stop after N steps.",
    ),
    trust: bool = trust_option,
    recordings: Path | None = recordings_option,
) -> Reply:
    """Change one step of RUN, and record what follows as a run of its own, with the same draws.

    A run that was trained here is retrained, the same up to the step. There the agents take other
    actions, or settings change (--set: step size, discount, epsilon, exploration, quirks and the parameters
    of the algorithm); every random draw that this does not affect stays the same. The branch can be verified,
    resumed, compared and branched like any run.

    With --action all, and at a trial of an evaluation, nothing is trained: the episode is played on from the
    step with each joint action, or with those that --action selects, by the tables of that moment.

    For a loop, an episode is played on from the step. The environment is made again and takes the recorded
    reset and actions up to the step; each result is compared with the recording. Then --policy acts: the
    recorded actions, until they run out; random ones; the same action every time; or a function of yours,
    from an observation to an action. An action is a number or a name, numbers separated by commas, or JSON
    where the space is a Dict or Tuple.

    Examples:
      dualtaxi branch cooperative --at 120:5 --action taxi_1=north
      dualtaxi branch cooperative --at step:400000 --set epsilon=0.3 --name curious
      dualtaxi branch cooperative --at eval:3000:7:5 --action all
      dualtaxi branch cartpole --at 12:40 --action 1
      dualtaxi branch taxi --at eval:3000:7:5 --action north --policy random --seed 3
      dualtaxi branch lander --at 4:100 --action 0.5,-0.2 --policy agent:act
      dualtaxi branch spread --at 0:10 --action agent_0=1 --action agent_2=4
    """
    if at is None:
        raise click.UsageError("expected --at EPISODE:T, the step to branch at")
    if not run.can_train_again and "all" in actions:
        raise click.UsageError(
            f"--action all is for runs that were trained here, and run {run.run_id} is a loop: each action "
            "is a branch of its own, recorded as a run. Give one action, and repeat the command for others: "
            f"`dualtaxi branch {run.run_id} --at {at} --action VALUE`."
        )
    if run.can_train_again and ("all" in actions or at.after is not None):
        _refuse_what_training_takes()
        return _what_if(run, at, actions)
    from runner.api import Interrupt, interruptible
    from runner.debugging.branch import branch
    from runner.execution.branching import TrainingBranch

    action, stop = _action(actions, run), Interrupt()
    if not (actions or overrides or episodes or policy != "recorded"):
        say(
            f"Note: nothing is changed, so the branch repeats run {run.run_id}. --action changes a step, "
            f"{'--set and --episodes what follows' if run.can_train_again else '--policy what follows'}."
        )
    with contextlib.ExitStack() as stack:
        report = stack.enter_context(steps_line("training" if run.can_train_again else "branching"))
        if run.can_train_again:
            stack.enter_context(compilation_notice())
            stop = stack.enter_context(interruptible(second=signal.SIG_DFL))
        branched_run = branch(
            run,
            at=at,
            action=action,
            overrides=overrides,
            episodes=episodes,
            policy=policy,
            seed=seed,
            name=name,
            recordings=recordings,
            max_steps=max_steps,
            trust=trust,
            report=report,
            stop=stop,
        )
    if actions and _repeats(run, branched_run):
        say(f"Note: {' and '.join(actions)} is the recorded action at {at}; nothing is changed by it.")
    if isinstance(branched_run, TrainingBranch):
        return _trained(run, branched_run)
    return _played(run, branched_run)


def _refuse_what_training_takes() -> None:
    """Refuse the options of a new run where nothing is trained or recorded."""
    names = ("overrides", "episodes", "policy", "seed", "name", "max_steps")
    source_of = click.get_current_context().get_parameter_source
    given = [name for name in names if source_of(name) is not ParameterSource.DEFAULT]
    if given:
        options = ["--set" if name == "overrides" else f"--{name.replace('_', '-')}" for name in given]
        raise click.UsageError(
            f"{' and '.join(options)}: nothing is trained or recorded where actions are compared, "
            "with --action all or at a trial of an evaluation. Leave this out, or branch at a step of "
            "training, with one action or none."
        )


def _repeats(parent: Run, branch: Branch | TrainingBranch) -> bool:
    """Return whether the action that was given is the recorded one."""
    from runner.execution.branching import TrainingBranch

    if not isinstance(branch, TrainingBranch):
        return branch.is_recorded_action
    digest = parent.summary.content_digest
    return digest is not None and branch.run.summary.content_digest == digest


def _action(actions: tuple[str, ...], run: Run) -> object:
    """Return the action that the options give: of one agent or all, or of some by their names."""
    pairs = [text.partition("=") for text in actions]
    if actions and all(equals for _, equals, _ in pairs) and (run.can_train_again or len(actions) > 1):
        by_agent = {agent: value for agent, _, value in pairs}
        if len(by_agent) < len(pairs):
            raise click.UsageError("--action: found an agent twice, expected one action of each agent.")
        return by_agent
    if len(actions) > 1:
        raise click.UsageError("--action: several are for the agents of a game: AGENT=VALUE each.")
    return actions[0] if actions else None


def _trained(parent: Run, branch: TrainingBranch) -> Reply:
    run = branch.run
    results = [trained.summary.last_evaluation for trained in (parent, run)]
    success = [
        None if evaluation is None else evaluation.values.get("success_percent") for evaluation in results
    ]
    rows = {"branched": f"run {parent.run_id} {branch.origin} (step {branch.at})"}
    if None not in success:
        rows["success"] = (
            f"{number(success[1])} % in the last evaluation, {number(success[0])} % in the parent"
        )
    more = run.file.config["episodes"] - parent.file.config["episodes"]
    if more:
        total = counted(run.file.config["episodes"], "episode")
        compared = "more" if more > 0 else "fewer"
        rows["trained"] = f"for {total} in all, {abs(more):,} {compared} than the parent"
    rows["next"] = command_for(parent, "diff", run.run_id)
    stopped = f"Interrupted: what was recorded is kept; `{command_for(run, 'resume')}` trains the rest."
    interrupted = stopped if run.status == "interrupted" else ""
    return run_reply(run, rows, interrupted, origin=asdict(branch.origin), at=str(branch.at))


def _played(parent: Run, branch: Branch) -> Reply:
    from runner.debugging.branch import RAN_OUT

    if branch.outcome.end == RAN_OUT:
        say(
            "The branch outlived the recorded actions, and stopped with the last of them. "
            "--policy random, constant or MODULE:FUNCTION plays on to an end."
        )
    outcomes = (("parent", parent.run_id, branch.parent), ("branch", branch.run.run_id, branch.outcome))
    played = [
        (name, run, outcome.returns_in_words, f"{outcome.length:,}", outcome.end)
        for name, run, outcome in outcomes
    ]
    grid = Grid(("", "run", "return", "length", "end"), played)
    rows = run_facts(branch.run) | {"branched": f"run {parent.run_id} {branch.origin}"}
    both = {"parent": asdict(branch.parent), "branch": asdict(branch.outcome)}
    return Reply(
        {"run_id": branch.run.run_id, "origin": asdict(branch.origin), **both},
        [rows, grid, {"next": command_for(parent, "diff", branch.run.run_id)}],
    )


def _what_if(run: Run, at: EpisodeRef, actions: tuple[str, ...]) -> Reply:
    """Return where joint actions at a step lead: each of those that are named, or all."""
    from runner.debugging.what_if import what_if

    with compilation_notice():
        result = what_if(run, at=at, actions=actions)
    head = {"run": f"{run.run_id}  {run.title}"} | result.facts
    remarks = [Remark(f"Note: {note}.") for note in result.notes]
    return Reply(result.as_json(), [head, "", result.grid, *remarks])


class _Planned(Exception):
    """The plan, when nothing more than it was wanted."""

    def __init__(self, plan: SamplingPlan) -> None:
        super().__init__()
        self.plan = plan


@click.command("explain", cls=Command)
@job_option
def explain_command(
    a: str = argument(metavar="A"),
    b: str = argument(metavar="B"),
    metric: str | None = option(
        "--metric",
        metavar="METRIC",
        help="A metric; of evaluations.  [default: success_percent, or mean_return]",
    ),
    at: int | None = option(
        "--at",
        type=COUNT,
        metavar="EPISODE",
        help="Compare after this number of training episodes.  [default: the end of each]",
    ),
    seeds: int = option(
        "--seeds",
        type=Number(1, 10_000),
        default=20,
        show_default=True,
        help="Number of seeds of each mixture.",
    ),
    workers: int | None = workers_option("one per processor"),
    ray: str | None = ray_option,
    dry_run: bool = option(
        "--dry-run", is_flag=True, help="Show what would be trained and how long it takes, and stop."
    ),
    trust: bool = trust_option,
    recordings: Path | None = recordings_option,
) -> Reply:
    """Train mixtures of A and B to find which settings make the difference.

    A and B are runs, or configurations: files, or names of shipped ones. The same seeds and draws are
    trained with the settings of A and of B mixed: all mixtures of up to 8 settings; of up to 12, those that
    delta debugging needs. The answer is the share of each setting, which settings need each other, the
    smallest set that makes the difference, and the first step that the strongest setting changed.

    Two short runs are recorded, to show the first step that differs. All results are kept: after an
    interruption the same command continues, and with more --seeds it trains only the new ones.

    Examples:
      dualtaxi explain tutorial_cooperative tutorial_text_cooperative --at 5000 --dry-run
      dualtaxi explain tutorial_cooperative tutorial_text_cooperative --at 5000
      dualtaxi explain k3v9m2xq x7b2c4da --metric mean_length --seeds 40
    """
    from runner.api import interruptible
    from runner.debugging.explain import explain
    from runner.debugging.explanation import sections

    def planned(plan: SamplingPlan) -> None:
        if dry_run:
            raise _Planned(plan)
        say(_plan_in_words(plan))

    try:
        with (
            contextlib.redirect_stdout(sys.stderr),  # Ray prints messages about workers that died
            total_line() as report,
            interruptible(second=signal.SIG_DFL) as interrupt,
        ):
            explanation = explain(
                a,
                b,
                metric=metric,
                at=at,
                seeds=seeds,
                workers=workers,
                ray=ray,
                recordings=recordings,
                report=report,
                planned=planned,
                stop=interrupt,
                trust=trust,
            )
    except _Planned as stopped:
        plan = stopped.plan
        facts = {"settings": str(plan.settings), "runs": _plan_in_words(plan)}
        return Reply(dataclasses.asdict(plan), [Section("What would be trained", facts=facts)])
    except KeyboardInterrupt:
        say("Interrupted. What was trained is kept: the same command continues.")
        raise
    return Reply(explanation.as_json(), sections(explanation))


def _plan_in_words(plan: SamplingPlan) -> str:
    """Return what will be trained, and how long it takes."""
    runs, most = plan.mixtures * plan.seeds, plan.most_mixtures * plan.seeds
    reused = f", {plan.known:,} of them trained already" if plan.known else ""
    settings, seeds = counted(plan.settings, "setting"), counted(plan.seeds, "seed")
    if most != runs:
        text = f"from {runs:,} to {most:,} runs: delta debugging of {settings}, each mixture with {seeds}"
        return f"{text}{reused}; up to about {duration(plan.most_seconds)}"
    text = f"{runs:,} runs: {plan.mixtures:,} mixtures of {settings}, {seeds} each{reused}"
    return f"{text}; about {duration(plan.seconds)}" if plan.seconds else f"{text}: nothing to train"
