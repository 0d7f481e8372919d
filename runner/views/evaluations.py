"""`evaluations`: what the policy achieved in each evaluation."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from runner.analysis.sections import Paging, Section
from runner.views.view import START, STOP, ReadyAnswer, View, rows_in

if TYPE_CHECKING:
    from runner.recording.reader import Recording

_ROWS: Final = 500


def evaluations(
    recording: Recording, start: Any = START, stop: Any = STOP, *, newest_first: bool = False
) -> ReadyAnswer:
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
    data = {"run_id": recording.run_id, "start": rows.start, "total": len(every)}
    return ReadyAnswer(data | {"records": [record.as_json() for record in records]}, [table])


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
