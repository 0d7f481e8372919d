"""`table`: the transition table of an environment."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

from runner.util.row_text import csv_lines, json_lines
from runner.views.view import ReadyAnswer, View

if TYPE_CHECKING:
    from runner.environments.mdp import Mdp

_ROWS_AT_ONCE: Final = 50_000


def table(mdp: Mdp) -> ReadyAnswer:
    """Print an environment's transition table as CSV, with names.

    A row for each state, action and outcome that can happen: state, action, probability, next_state, reward,
    is_over. --set mode=competitive adds the reward of each agent. --json prints one line for each row. In
    Python: runner.frames.transition_table().

    Examples:
      dualtaxi table | head
      dualtaxi table --set env.kwargs.slip=0.1 > slippery.csv
      dualtaxi table --env FrozenLake-v1 --set env.kwargs.is_slippery=false
    """
    from runner.analysis.frames import transition_columns

    columns = transition_columns(mdp)

    def rows() -> Iterator[tuple[object, ...]]:
        for start in range(0, len(columns["state"]), _ROWS_AT_ONCE):
            part = [column[start : start + _ROWS_AT_ONCE].tolist() for column in columns.values()]
            yield from zip(*part, strict=True)

    objects = (dict(zip(columns, row, strict=True)) for row in rows())
    return ReadyAnswer(lines={"text": csv_lines(columns, rows()), "json": json_lines(objects)})


VIEW: Final = View("table", "Transitions", table, subject="environment", forms=("json",))
