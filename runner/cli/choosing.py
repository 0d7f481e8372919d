"""What `view` and `export rerun` share: the options that choose steps, and telling what was chosen."""

from __future__ import annotations

from typing import TYPE_CHECKING

from runner.cli.output import say

if TYPE_CHECKING:
    from runner.export.rerun.selection import Request, Selection


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
    if selection.exported:
        say("Exported: all metrics; " + "; ".join(selection.exported) + ".")
    for left in selection.left_out:
        say(f"Left out: {left}.")
