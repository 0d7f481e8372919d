"""`dualtaxi qtable` and `dualtaxi table`: a learned table at any step, and an environment's."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from runner.cli.command import Command, option
from runner.cli.options import (
    force_option,
    json_option,
    recordings_option,
    require_one,
    run_argument,
    set_option,
)
from runner.cli.output import draw, echo_csv, facts, files_written, print_json, say, table, title
from runner.cli.parameter_types import FILE, INDEX
from runner.cli.progress import stage_line
from runner.cli.runs import compilation_notice, find_recorded
from runner.export.places import new_file, require_new
from runner.util.humanize import UNKNOWN, number

if TYPE_CHECKING:
    from rich.console import RenderableType
    from rich.table import Table

    from runner.analysis.qtable import ActionValue, TablesDescription

ROWS_AT_ONCE = 50_000


@click.command("qtable", cls=Command)
def qtable_command(
    run_name: str = run_argument,
    step: int | None = option(
        "--step", type=INDEX, metavar="N", help="After N training steps.  [default: the last]"
    ),
    episode: int | None = option("--episode", type=INDEX, metavar="N", help="After N training episodes."),
    state: str | None = option(
        "--state", metavar="S", help="The state: a number or a name; shows its values and their history."
    ),
    output: Path | None = option(
        "-o",
        "--output",
        type=FILE,
        metavar="FILE.npy",
        help="Write the whole table: float64 [states, actions], of several agents [agents, states, actions].",
    ),
    force: bool = force_option,
    recordings: Path | None = recordings_option,
    as_json: bool = json_option,
) -> None:
    """Show the exact Q-table of RUN at any step: the nearest snapshot, with the recorded steps replayed.

    For your own loop it is the latest snapshot before the step: each array of [states, actions] that
    rec.snapshot() recorded, which the output names with its step.

    --state shows its values, the policy if the algorithm learns one, the greedy action (ties go to the
    first), how often each action was taken there so far, and which step last changed each value. In Python:
    runner.replay.tables.tables_at().

    Examples:
      dualtaxi qtable @latest --episode 500
      dualtaxi qtable k3v9m2xq --step 50000 --state 17
      dualtaxi qtable k3v9m2xq --step 50000 -o table.npy
    """
    require_one("step", "episode")
    import numpy as np

    from runner.analysis.qtable import describe_tables
    from runner.recording.reader import open_recording

    if output is not None:
        require_new(output, force)
    run = find_recorded(run_name, recordings)
    with (
        open_recording(run.recording) as recording,
        compilation_notice(),
        stage_line("replaying recorded steps"),
    ):
        values, array = describe_tables(recording, step, episode, state)
    if output is not None:
        with new_file(output, force) as temporary, temporary.open("wb") as stream:
            np.save(stream, array)  # it would append .npy to a path
    if as_json:
        print_json(values if output is None else {**values, "files": files_written(output)})
        return
    _draw(values)
    if output is not None:
        say(f"Written: {output.absolute()}")


def _draw(values: TablesDescription) -> None:
    head = {"run": values["run_id"], "step": f"after {values['step']:,} training steps"}
    for each in values["tables"]:
        head[each["agent"]] = (
            f"{each['states']:,} states, {each['actions']} actions, {each['percent_filled']:.1f} % filled, "
            f"values from {each['lowest']:.4g} to {each['highest']:.4g}"
        )
        if "snapshot_step" in each:
            head[each["agent"]] += f"; the latest snapshot, after {each['snapshot_step']:,} steps"
    if "state" in values:
        head["state"] = f"{values['state']}: {values['state_in_words']}"
        head["visits"] = _count(values["visits"])
    parts: list[RenderableType] = [facts(head)]
    for each in values["tables"] if "state" in values else ():
        rows = [row for row in values["values"] if row["agent"] == each["agent"]]
        parts += [title(each["agent"]), _state_table(rows)]
    draw(*parts)


def _state_table(rows: list[ActionValue]) -> Table:
    """Return the table of a state's actions."""
    policy = ("policy",) if "policy" in rows[0] else ()
    headings = ("action", "", "value", *policy, "greedy", "visits", "changed\nby step", "in\nepisode")
    grid = table(*headings, left=("", "greedy"), shrinking=("",))
    for row in rows:
        grid.add_row(
            str(row["action"]),
            row["action_in_words"],
            number(row["value"], 4),
            *([number(row["policy"], 4)] if policy else []),
            "greedy" if row["greedy"] else "",
            *map(_count, (row["visits"], row["changed_step"], row["changed_episode"])),
        )
    return grid


def _count(count: int | None) -> str:
    return UNKNOWN if count is None else f"{count:,}"


@click.command("table", cls=Command)
def table_command(
    env_id: str = option(
        "--env",
        default="dualtaxi:DualTaxi-v1",
        show_default=True,
        metavar="ID",
        help="Gymnasium's id of the environment; before a colon, the module to import for it.",
    ),
    overrides: tuple[str, ...] = set_option,
    as_json: bool = json_option,
) -> None:
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

    if as_json:
        for row in rows():
            print_json(dict(zip(columns, row, strict=True)), indent=None)
    else:
        echo_csv(columns, rows())
