"""The table of a run's evaluations, for any environment, as wide as the terminal allows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from runner.cli.output import UNBOUNDED, number, table
from runner.environments.naming import spoken
from runner.recording.metrics import METRICS

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

AT_MOST: Final = 20
"""Evaluations in the summary of a run."""

_DISPENSABLE: Final = ("pickup",)
"""Events to be left out first where there is no room: what follows from others."""


@dataclass(frozen=True)
class _Column:
    heading: str
    cells: list[str]


def some(records: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return evaluations evenly spread over all of them, the first and the last among them."""
    if len(records) <= AT_MOST:
        return list(records)
    return [records[round(i * (len(records) - 1) / (AT_MOST - 1))] for i in range(AT_MOST)]


def evaluation_table(
    records: Sequence[Mapping[str, Any]], success_events: Sequence[str], console: Console
) -> Table:
    """Return the table of these evaluations.

    Successes are shown for each agent (`12/9`), other events summed over the agents. Columns of events that
    do not fit are left out, and the caption says which.
    """
    events = _events(records[0]["events"], success_events)
    unbounded = console.options.update(width=UNBOUNDED)
    left_out: list[str] = []
    while True:
        made = _drawn([*_measures(records), *[event.column(records) for event in events], *_fill(records)])
        if left_out:
            made.caption = f"No room for: {', '.join(left_out)}."
            made.caption_justify = "left"
        if not events or console.measure(made, options=unbounded).maximum <= console.width:
            return made
        spare = next((event for event in events if event.kind in _DISPENSABLE), events[-1])
        events.remove(spare)
        left_out.append(spoken(spare.kind))


@dataclass(frozen=True)
class _Event:
    """A kind of event: one that every agent can have (`taxi_1.pickup`, `taxi_2.pickup`), or all together."""

    kind: str
    names: tuple[str, ...]
    succeeds: bool

    def column(self, records: Sequence[Mapping[str, Any]]) -> _Column:
        """Return how often it came in each evaluation."""
        counts = [[record["events"][name] for name in self.names] for record in records]
        if self.succeeds and len(self.names) > 1:
            agents = [name.rpartition(".")[0].rpartition("_")[2] for name in self.names]
            heading = f"{spoken(self.kind)} {'/'.join(agents)}"
            return _Column(heading, ["/".join(map(str, own)) for own in counts])
        return _Column(spoken(self.kind), [str(sum(own)) for own in counts])


def _events(names: Iterable[str], success_events: Sequence[str]) -> list[_Event]:
    """Return the kinds of events: successes, then what concerns all agents, then the others."""
    kinds: dict[str, list[str]] = {}
    for name in names:
        kinds.setdefault(name.rpartition(".")[2], []).append(name)
    events = [_Event(kind, tuple(own), own[0] in success_events) for kind, own in kinds.items()]
    return sorted(events, key=lambda event: (not event.succeeds, len(event.names)))


def _measures(records: Sequence[Mapping[str, Any]]) -> list[_Column]:
    """Return the columns of the measures that the environment defines; of a loop also the return."""
    columns = [_Column("episode", [f"{record['episode']:,}" for record in records])]
    is_job = all("training" in record for record in records)
    if not is_job:
        columns.append(_Column("trials", [f"{record['trials']:,}" for record in records]))
    for metric in METRICS:
        values = [record[metric.key] for record in records]
        if metric.per_agent and not is_job:
            cells = ["/".join(number(value) for value in by_agent.values()) for by_agent in values]
            columns.append(_Column(metric.heading, cells))
        elif not metric.per_agent and (is_job or any(value is not None for value in values)):
            columns.append(_Column(metric.heading, [number(value) for value in values]))
    return columns


def _fill(records: Sequence[Mapping[str, Any]]) -> list[_Column]:
    """Return how full the tables are, each of several to the percent; nothing for a loop."""
    if not all("training" in record for record in records):
        return []
    filled = [list(record["training"]["percent_filled"].values()) for record in records]
    digits = 0 if len(filled[0]) > 1 else 1
    return [_Column("filled %", ["/".join(f"{percent:.{digits}f}" for percent in own) for own in filled])]


def _drawn(columns: Sequence[_Column]) -> Table:
    """Return the table of these columns, their headings on two lines where they have two words."""
    made = table(*(column.heading.replace(" ", "\n", 1) for column in columns))
    made.padding = (0, 1, 0, 0)
    for row in zip(*(column.cells for column in columns), strict=True):
        made.add_row(*row)
    return made
