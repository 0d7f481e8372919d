"""What `view` and `export rerun` share: the options that choose steps, and telling what was chosen."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import click

from runner.cli.options import all_option
from runner.cli.output import say
from runner.cli.parameters import EpisodeRanges, NumberList

if TYPE_CHECKING:
    from runner.export.rerun.selection import Request, Selection


def choice_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that choose steps."""
    for option in (
        all_option,
        click.option("--every", type=click.IntRange(1), metavar="N", help="Every Nth training episode."),
        click.option(
            "--evaluations",
            type=NumberList(),
            metavar="N[,N]",
            help="The trials of the evaluations after N training episodes.",
        ),
        click.option(
            "--episodes",
            type=EpisodeRanges(),
            metavar="RANGES",
            help="Training episodes, such as 0:20,49980:50000.",
        ),
    ):
        command = option(command)
    return command


def request_of(
    episodes: tuple[tuple[int, int | None], ...] | None,
    evaluations: tuple[int, ...] | None,
    every: int | None,
    everything: bool,
) -> Request:
    """Return what the options ask for."""
    from runner.export.rerun.selection import Request

    return Request(episodes or (), evaluations or (), every or 0, everything)


def tell(selection: Selection) -> None:
    """Say what is exported and what is not."""
    for warning in selection.warnings:
        say(warning)
    if selection.chosen:
        say("Exported: all metrics; " + "; ".join(selection.chosen) + ".")
    for left in selection.left_out:
        say(f"Left out: {left}.")
