"""`dualtaxi qtable` and `dualtaxi table`: a learned table at any step, and an environment's."""

from __future__ import annotations

from collections.abc import Iterator

import click

from runner.cli.command import Command, option
from runner.cli.options import set_option
from runner.cli.output import Reply
from runner.util.row_text import csv_lines, json_lines

ROWS_AT_ONCE = 50_000


@click.command("table", cls=Command, forms=("json",))
def table_command(
    env_id: str = option(
        "--env",
        default="dualtaxi:DualTaxi-v1",
        show_default=True,
        metavar="ID",
        help="Gymnasium's id of the environment; before a colon, the module to import for it.",
    ),
    overrides: tuple[str, ...] = set_option,
) -> Reply:
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
    from runner.config import from_mapping
    from runner.environments.loading import load_mdp

    config = from_mapping({"env": {"id": env_id}, "episodes": 1}, overrides)
    columns = transition_columns(load_mdp(config.env.id, config.env.kwargs, config.rewards))

    def rows() -> Iterator[tuple[object, ...]]:
        for start in range(0, len(columns["state"]), ROWS_AT_ONCE):
            part = [column[start : start + ROWS_AT_ONCE].tolist() for column in columns.values()]
            yield from zip(*part, strict=True)

    return Reply(
        json_lines(dict(zip(columns, row, strict=True)) for row in rows()), csv=csv_lines(columns, rows())
    )
