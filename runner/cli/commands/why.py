"""`dualtaxi why`: the rewards and initial values that a Q-value is the sum of."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from runner.cli.command import Command, option
from runner.cli.options import json_option, limit_option, recordings_option, run_argument
from runner.cli.output import draw, facts, print_json, print_sections
from runner.cli.parameter_types import STEP
from runner.cli.progress import steps_line
from runner.cli.runs import command_for, compilation_notice, find_recorded

if TYPE_CHECKING:
    from runner.analysis.episodes import EpisodeRef


@click.command("why", cls=Command)
def why_command(
    run_name: str = run_argument,
    state: str | None = option(
        "--state", metavar="S", help="The state: a number or a name.  [default: that of --at]"
    ),
    action: str | None = option(
        "--action", metavar="A", help="The action: a number or a name.  [default: that of --at]"
    ),
    agent: str | None = option(
        "--agent", metavar="NAME", help="The agent whose Q-table it is in, where each has its own."
    ),
    at: EpisodeRef | None = option(
        "--at",
        type=STEP,
        metavar="STEP",
        help="The step: EPISODE:T, step:N, or eval:N:TRIAL:T; T defaults to 0, so 120 is the start of "
        "episode 120. The value before the step is shown.  [default: the last]",
    ),
    limit: int = limit_option(10),
    recordings: Path | None = recordings_option,
    as_json: bool = json_option,
) -> None:
    """Show where a Q-value of RUN comes from: the recorded rewards and initial values that it is the sum of.

    Each update is linear in the tables once its greedy action is known, so a value is exactly a weighted sum
    of the rewards before it and of the initial values. It is listed by reward, by episode, and by the steps
    that add or take most. This is a decomposition along the path that training took, not a counterfactual:
    `dualtaxi branch` shows what would have happened otherwise. In Python: runner.why().

    Examples:
      dualtaxi why @latest --state 300 --action north+south
      dualtaxi why rivals --state 300 --action pickup --agent taxi_2 --at 2000:0
      dualtaxi why k3v9m2xq --at eval:3000:7:5 --limit 30
    """
    from runner.debugging.q_value import facts_of, sections_of
    from runner.debugging.why import why

    run = find_recorded(run_name, recordings)
    with compilation_notice(), steps_line("reading") as report:
        result = why(run, state=state, action=action, agent=agent, at=at, limit=limit, report=report)
    if as_json:
        print_json(result.as_json())
        return
    rows = facts_of(result)
    if result.steps:
        rows["next"] = command_for(run, "view", "--at", result.steps[0].at)
    draw(facts(rows))
    print_sections(sections_of(result), as_markdown=False)
