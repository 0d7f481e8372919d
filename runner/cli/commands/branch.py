"""`dualtaxi branch`: take another action at a recorded step, and see where it leads."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from runner.cli import Command
from runner.cli.options import COUNT, INDEX, STEP, json_option, recordings_option, run_argument, trust_option
from runner.cli.output import draw, facts, print_json, table
from runner.cli.progress import steps_line
from runner.cli.runs import find_recorded, run_facts
from runner.util.humanize import number

if TYPE_CHECKING:
    from runner.analysis.step_reference import StepRef


@click.command("branch", cls=Command)
@run_argument
@click.option(
    "--at",
    type=STEP,
    metavar="STEP",
    help="The step: EPISODE:T of training, or eval:N:TRIAL:T of an evaluation.",
)
@click.option(
    "--action",
    "actions",
    multiple=True,
    metavar="VALUE",
    help="The action there; of a game AGENT=VALUE, may be repeated.  [default: the recorded one]",
)
@click.option(
    "--policy",
    default="recorded",
    show_default=True,
    metavar="recorded|random|constant|MODULE:FUNCTION",
    help="What acts after it.",
)
@click.option("--seed", type=INDEX, default=0, show_default=True, help="Seed of the random policy.")
@click.option("--name", help="Name of the new run.  [default: RUN.branch]")
@click.option(
    "--max-steps", type=COUNT, default=100_000, show_default=True, metavar="N", help="Stop after N steps."
)
@trust_option
@recordings_option
@json_option
def branch_command(
    run_name: str,
    at: StepRef | None,
    actions: tuple[str, ...],
    policy: str,
    seed: int,
    name: str | None,
    max_steps: int,
    trust: bool,
    recordings: Path | None,
    as_json: bool,
) -> None:
    """Take another action at a step of an episode of RUN, a loop, and play on to the end of the episode.

    The environment is made again and brought to the step by the recorded reset and actions, compared with the
    recording on the way, so that its luck is the same too. The branch is recorded as a run of its own.

    An action is a number or a name, numbers separated by commas, or JSON where the space is a Dict or Tuple.
    After it act the recorded actions, until they run out; random ones; the same action again and again; or a
    function of yours, from an observation to an action.

    Examples:
      dualtaxi branch cartpole --at 12:40 --action 1
      dualtaxi branch taxi --at eval:3000:7:5 --action north --policy random --seed 3
      dualtaxi branch lander --at 4:100 --action 0.5,-0.2 --policy agent:act
      dualtaxi branch spread --at 0:10 --action agent_0=1 --action agent_2=4
    """
    run = find_recorded(run_name, recordings)
    if at is None:
        raise click.UsageError("expected --at EPISODE:T or --at eval:N:TRIAL:T, the step to branch at")
    if run.can_train_again:
        from runner.cli.what_if import print_what_if

        print_what_if(run, at, actions, as_json)
        return
    from runner.loops.branch import Outcome, branch

    action: Any = actions[0] if len(actions) == 1 else None
    if len(actions) > 1:
        pairs = [text.partition("=") for text in actions]
        if not all(equals for _, equals, _ in pairs):
            raise click.UsageError("--action: several are for the agents of a game: AGENT=VALUE each.")
        action = {agent: value for agent, _, value in pairs}
    with steps_line("branching") as report:
        found = branch(
            run,
            at=at,
            action=action,
            policy=policy,
            seed=seed,
            name=name,
            recordings=recordings,
            max_steps=max_steps,
            trust=trust,
            report=report,
        )
    if as_json:
        outcomes = {"parent": asdict(found.parent), "branch": asdict(found.outcome)}
        print_json({"run_id": found.run.run_id, "origin": asdict(found.origin)} | outcomes)
        return

    def returns(outcome: Outcome) -> str:
        several = len(outcome.returns) > 1
        return ", ".join(
            f"{agent} {number(value)}" if several else number(value)
            for agent, value in outcome.returns.items()
        )

    grid = table("", "run", "return", "length", "end", left=("run", "return", "end"))
    for title, run_id, each in (
        ("parent", run.run_id, found.parent),
        ("branch", found.run.run_id, found.outcome),
    ):
        grid.add_row(title, run_id, returns(each), f"{each.length:,}", each.end)
    rows = run_facts(found.run) | {"branched": f"run {run.run_id} {found.origin}"}
    draw(facts(rows), grid, facts({"next": f"dualtaxi diff {run.run_id} {found.run.run_id}"}))
