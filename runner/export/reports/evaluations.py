"""The evaluations of a run as a table of text, for reports and pages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from runner.analysis.evaluations import EvaluationRecord
from runner.analysis.sections import Grid
from runner.environments.naming import event_in_words, spoken
from runner.recording.metrics import METRICS
from runner.util import humanize


@dataclass(frozen=True)
class EvaluationTable:
    """The evaluations of a run as text."""

    explanation: str
    grid: Grid


def evaluation_table(
    records: Sequence[EvaluationRecord], agents: Sequence[str], event_names: Sequence[str], has_reports: bool
) -> EvaluationTable:
    """Return records of evaluations as a table; one of a loop leaves out metrics that it does not know."""
    metrics = [
        metric
        for metric in METRICS
        if has_reports or any(record.value(metric.name) is not None for record in records)
    ]
    headings = ["episode"] if has_reports else ["episode", "trials"]
    for metric in metrics:
        whose = [f" {spoken(agent)}" for agent in agents] if metric.per_agent and len(agents) > 1 else [""]
        headings += [f"{metric.heading}{agent}" for agent in whose]
    headings += [_event_heading(name) for name in event_names]
    rows = []
    for record in records:
        cells = [f"{record.episode:,}"] if has_reports else [f"{record.episode:,}", f"{record.trials:,}"]
        for metric in metrics:
            cells += map(humanize.number, record.values[metric.name].values())
        cells += [f"{count:,}" for count in record.events.values()]
        if record.training:
            cells.append("/".join(map(humanize.number, record.training.percent_filled.values())))
        rows.append(tuple(cells))
    explanation = (
        f"Each row: {records[0].trials} trials with the greedy policy after that number of training "
        "episodes. Events are counted over all trials."
        if has_reports
        else "Each row: the evaluation episodes of the loop after that number of training episodes. Events "
        "are counted over all of them."
    )
    return EvaluationTable(explanation, Grid((*headings, *(["filled %"] if has_reports else [])), rows))


def _event_heading(event: str) -> str:
    """Return an event as the heading of a column, the agent on a line of its own."""
    agent, dot, _ = event.rpartition(".")
    words = event_in_words(event)
    return f"{words[: len(agent)]}\n{words[len(agent) + 1 :]}" if dot else words
