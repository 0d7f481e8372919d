"""`dualtaxi when`: the training steps after which something holds."""

from __future__ import annotations

from pathlib import Path

import click

from runner.cli.command import Command, argument, option
from runner.cli.options import json_option, recordings_option, run_argument
from runner.cli.output import draw, facts, print_json, print_sections
from runner.cli.progress import steps_line
from runner.cli.runs import command_for, compilation_notice, find_recorded


@click.command("when", cls=Command)
def when_command(
    run_name: str = run_argument,
    expression: str = argument(metavar="EXPRESSION"),
    everything: bool = option(
        "--all",
        is_flag=True,
        help="Include everything, not only a selection: every interval in which it holds, with its end.",
    ),
    first: str | None = option(
        "--from", metavar="STEP", help="The first training step: EPISODE:T, or step:N by its number."
    ),
    last: str | None = option("--to", metavar="STEP", help="The last training step, as for --from."),
    recordings: Path | None = recordings_option,
    as_json: bool = json_option,
) -> None:
    """Find the first training step of RUN after which EXPRESSION holds, exactly: every step is replayed.

    --all lists every interval in which it holds.

    In an expression:
      q[S, A], max(q[S])   a Q-value; the highest in a state, or the lowest: min(q[S])
      greedy[S]            the greedy action, compared with a name or a number
      greedy_success[S]    whether the greedy path from S succeeds within the step limit
      visits[S]            how often a step began in S; visits[S, A] with action A
      step, episode        numbers of the training step and of its episode
      reward, epsilon      of the training step

    S and A are numbers or names, as `dualtaxi table` prints them. There are and, or, not, comparisons, also
    chained, + - * / // %, max(), min() and abs(). Where each agent has a table of its own, q.taxi_1[S, A] and
    reward.taxi_1 say whose; greedy[S] and visits[S, A] are of joint actions.

    Examples:
      dualtaxi when @latest 'greedy[300] == "pickup + east"'
      dualtaxi when k3v9m2xq 'q[300, "north + east"] > q[300, "west + east"]' --all
      dualtaxi when k3v9m2xq 'greedy_success[300] and visits[300] < 100' --from 2000:0
      dualtaxi when rivals 'max(q.taxi_1[300]) > max(q.taxi_2[300]) > 0' --to step:50000
    """
    from runner.debugging.when import section_of, when

    run = find_recorded(run_name, recordings)
    with compilation_notice(), steps_line("searched") as report:
        result = when(run, expression, every=everything, first=first, last=last, report=report)
    if as_json:
        print_json(result.as_json())
        return
    print_sections([section_of(result)], as_markdown=False)
    if result.first is not None:
        draw(facts({"next": command_for(run, "view", "--at", str(result.first.at))}))
