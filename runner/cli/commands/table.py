"""`dualtaxi table`: an environment's transition table in words."""

from __future__ import annotations

import csv
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import click

from runner.cli.options import json_option, set_option
from runner.cli.output import print_json

if TYPE_CHECKING:
    from numpy.typing import NDArray

ROWS_AT_ONCE = 50_000


@click.command("table")
@click.option(
    "--env",
    "env_id",
    default="dualtaxi:DualTaxi-v1",
    show_default=True,
    metavar="ID",
    help="Gymnasium's id of the environment; before a colon, the module to import for it.",
)
@set_option
@json_option
def command(env_id: str, overrides: tuple[str, ...], as_json: bool) -> None:
    """Print an environment's transition table as CSV, with names.

    A row for each state, action and outcome that can happen: state, action, probability, next_state, reward,
    is_over. With --set mode=competitive also the reward of each agent. With --json, one line for each row. In
    Python: runner.frames.transition_table().

    \b
    Examples:
      dualtaxi table | head
      dualtaxi table --set env.kwargs.slip=0.1 > slippery.csv
      dualtaxi table --env FrozenLake-v1 --set env.kwargs.is_slippery=false
    """  # noqa: D301 - Click wants the backspace itself
    from runner.analysis.frames import transition_columns
    from runner.config import from_mapping
    from runner.environments.loading import load_mdp

    config = from_mapping({"env": {"id": env_id}, "episodes": 1}, overrides)
    columns = transition_columns(load_mdp(config.env.id, config.env.kwargs, config.rewards))
    if as_json:
        for row in _rows(columns):
            print_json(dict(zip(columns, row, strict=True)), indent=None)
    else:
        writer = csv.writer(sys.stdout, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(_rows(columns))


def _rows(columns: dict[str, NDArray[Any]]) -> Iterator[tuple[Any, ...]]:
    """Yield the rows as Python values, some thousands at a time."""
    count = len(columns["state"])
    for start in range(0, count, ROWS_AT_ONCE):
        part = [column[start : start + ROWS_AT_ONCE].tolist() for column in columns.values()]
        yield from zip(*part, strict=True)
