"""`dualtaxi explain`: which settings make the difference between two runs or configurations."""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from runner.analysis.sections import Section
from runner.cli.command import Command, argument, option
from runner.cli.jobs import job_option
from runner.cli.options import (
    ray_option,
    recordings_option,
    trust_option,
    workers_option,
)
from runner.cli.output import Reply, say
from runner.cli.parameter_types import COUNT, Number
from runner.cli.progress import total_line
from runner.util.humanize import counted, duration

if TYPE_CHECKING:
    from runner.debugging.game import SamplingPlan


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
    delta debugging needs. Shown are the share of each setting, which settings need each other, the smallest
    set that makes the difference, and the first step that the strongest setting changed.

    Two short runs are recorded, to show the first step that differs. All results are kept: after an
    interruption the same command continues, and with more --seeds it trains only the new ones.

    Examples:
      dualtaxi explain tutorial_cooperative tutorial_text_cooperative --at 5000 --dry-run
      dualtaxi explain tutorial_cooperative tutorial_text_cooperative --at 5000
      dualtaxi explain k3v9m2xq x7b2c4da --metric mean_length --seeds 40
    """
    from runner.debugging.explain import explain
    from runner.debugging.explanation import sections

    def planned(plan: SamplingPlan) -> None:
        if dry_run:
            raise _Planned(plan)
        say(_in_words(plan))

    try:
        with (
            contextlib.redirect_stdout(sys.stderr),  # Ray prints messages about workers that died
            total_line() as report,
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
                trust=trust,
            )
    except _Planned as stopped:
        plan = stopped.plan
        facts = {"settings": str(plan.settings), "runs": _in_words(plan)}
        return Reply(dataclasses.asdict(plan), [Section("What would be trained", facts=facts)])
    except KeyboardInterrupt:
        say("Interrupted. What was trained is kept: the same command continues.")
        raise
    return Reply(explanation.as_json(), sections(explanation))


def _in_words(plan: SamplingPlan) -> str:
    """Return what will be trained, and how long it takes."""
    runs, most = plan.mixtures * plan.seeds, plan.most_mixtures * plan.seeds
    reused = f", {plan.known:,} of them trained already" if plan.known else ""
    settings, seeds = counted(plan.settings, "setting"), counted(plan.seeds, "seed")
    if most != runs:
        text = f"from {runs:,} to {most:,} runs: delta debugging of {settings}, each mixture with {seeds}"
        return f"{text}{reused}; up to about {duration(plan.most_seconds)}"
    text = f"{runs:,} runs: {plan.mixtures:,} mixtures of {settings}, {seeds} each{reused}"
    return f"{text}; about {duration(plan.seconds)}" if plan.seconds else f"{text}: nothing to train"
