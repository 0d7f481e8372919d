"""The table of a run's evaluations, for any environment, as wide as the terminal allows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Final, NamedTuple

from runner.analysis.evaluations import metric_columns
from runner.cli.output import UNBOUNDED, table
from runner.environments.naming import spoken

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from runner.analysis.evaluations import EvaluationRecord

MAX_SHOWN: Final = 20
"""Evaluations in the summary of a run."""
_DISPENSABLE: Final = ("pickup",)
"""Events left out first where a terminal is narrow, because they follow from others."""

Columns = dict[str, list[str]]
"""Heading to cells."""


class _Event(NamedTuple):
    """A kind of event, with the name it has for each agent, such as `taxi_1.pickup`."""

    kind: str
    names: tuple[str, ...]
    is_success: bool


def spread(records: Sequence[EvaluationRecord]) -> list[EvaluationRecord]:
    """Return at most `MAX_SHOWN` evaluations, evenly spread, with the first and the last."""
    if len(records) <= MAX_SHOWN:
        return list(records)
    return [records[round(i * (len(records) - 1) / (MAX_SHOWN - 1))] for i in range(MAX_SHOWN)]


def evaluation_table(
    records: Sequence[EvaluationRecord], success_events: Sequence[str], console: Console
) -> Table:
    """Return the table of evaluations.

    Successes are shown for each agent (`12/9`), other events summed over the agents. Events that do not fit
    the terminal are left out, and named in the caption.
    """
    measures = metric_columns(records, is_narrow=True)
    if records[0].training is not None:  # the returns of a job would leave no room for its events
        measures = {heading: own for heading, own in measures.items() if heading != "mean return"}
    events = _events(records[0].events, success_events)
    unbounded = console.options.update(width=UNBOUNDED)
    left_out: list[str] = []
    while True:
        grid = _drawn(measures | _counts(records, events) | _fill(records))
        if left_out:
            grid.caption = f"No room for: {', '.join(left_out)}."
            grid.caption_justify = "left"
        if not events or console.measure(grid, options=unbounded).maximum <= console.width:
            return grid
        spare = next((event for event in events if event.kind in _DISPENSABLE), events[-1])
        events.remove(spare)
        left_out.append(spoken(spare.kind))


def _events(names: Iterable[str], success_events: Sequence[str]) -> list[_Event]:
    """Return the kinds of events: successes, then those of all agents together, then the others."""
    kinds: dict[str, list[str]] = {}
    for name in names:
        kinds.setdefault(name.rpartition(".")[2], []).append(name)
    events = [_Event(kind, tuple(own), own[0] in success_events) for kind, own in kinds.items()]
    return sorted(events, key=lambda event: (not event.is_success, len(event.names)))


def _counts(records: Sequence[EvaluationRecord], events: Sequence[_Event]) -> Columns:
    """Return how often each kind of event occurred."""
    columns = {}
    for event in events:
        counts = [[record.events[name] for name in event.names] for record in records]
        if event.is_success and len(event.names) > 1:
            agents = [name.rpartition(".")[0].rpartition("_")[2] for name in event.names]
            heading = f"{spoken(event.kind)} {'/'.join(agents)}"
            columns[heading] = ["/".join(map(str, own)) for own in counts]
        else:
            columns[spoken(event.kind)] = [str(sum(own)) for own in counts]
    return columns


def _fill(records: Sequence[EvaluationRecord]) -> Columns:
    """Return the share of non-zero table cells, in whole percent of several tables; empty for a loop."""
    filled = [list(record.training.percent_filled.values()) for record in records if record.training]
    if not filled:
        return {}
    digits = 0 if len(filled[0]) > 1 else 1
    return {"filled %": ["/".join(f"{percent:.{digits}f}" for percent in own) for own in filled]}


def _drawn(columns: Columns) -> Table:
    headings = (heading.replace(" ", "\n", 1) for heading in columns)
    grid = table(*headings, rows=zip(*columns.values(), strict=True))
    grid.padding = (0, 1, 0, 0)
    return grid
