"""`evaluations`: what the policy achieved in each evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from runner.analysis.sections import Answer, Paging, Section
from runner.views.view import START, STOP, View, rows_in

if TYPE_CHECKING:
    from runner.analysis.evaluations import EvaluationRecord
    from runner.recording.reader import Recording
    from runner.util.values import Json

_ROWS: Final = 500


@dataclass(frozen=True)
class EvaluationRows(Answer):
    """Some evaluations of a run."""

    run_id: str
    start: int
    total: int
    """Number of all evaluations."""
    records: Sequence[EvaluationRecord]
    table: Section

    def as_json(self) -> Json:
        """Return the evaluations, and how many there are."""
        records = [record.as_json() for record in self.records]
        return {"run_id": self.run_id, "start": self.start, "total": self.total, "records": records}

    def sections(self) -> list[Section]:
        """Return a table with a row for each evaluation."""
        return [self.table]


def evaluations(
    recording: Recording, start: Any = START, stop: Any = STOP, *, newest_first: bool = False
) -> EvaluationRows:
    """Show the evaluations of RUN: returns, lengths, successes, and every event counted.

    The evaluations of a loop are its evaluation episodes between two training episodes.

    Examples:
      dualtaxi evaluations @latest
      dualtaxi evaluations k3v9m2xq --start 10 --stop 20 --json
    """
    from runner.analysis.evaluations import evaluation_records, evaluations_section

    every, rows = evaluation_records(recording), rows_in(start, stop)
    if newest_first:
        every.reverse()
    records = every[rows.start : rows.stop]
    table = Section("Evaluations", ["No evaluation was recorded."])
    if records:
        paging = Paging(rows.start // _ROWS + 1, len(every), _ROWS, VIEW.name)
        table = evaluations_section(recording, records, paging)
        table.sentences.extend(["The newest come first."] * newest_first)
    elif every:
        table = Section("Evaluations", [f"There are {len(every):,} evaluations, from 0."])
    return EvaluationRows(recording.run_id, rows.start, len(every), records, table)


VIEW: Final = View(
    "evaluations",
    "Evaluations",
    evaluations,
    page_values=(("newest_first", True),),
    has_default=True,
    is_live=True,
    needs="episodes",
    rows_per_page=_ROWS,
)
