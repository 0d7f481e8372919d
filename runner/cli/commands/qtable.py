"""`dualtaxi qtable`: the Q-table of any moment."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from runner.cli.options import json_option, recordings_option, run_argument
from runner.cli.output import draw, facts, print_json, say, table, title
from runner.cli.runs import find_recorded
from runner.util.humanize import UNKNOWN, number

if TYPE_CHECKING:
    from numpy.typing import NDArray


@click.command("qtable")
@run_argument
@click.option(
    "--step", type=click.IntRange(0), metavar="N", help="After N training steps.  [default: the last]"
)
@click.option("--episode", type=click.IntRange(0), metavar="N", help="After N training episodes.")
@click.option(
    "--state", type=click.IntRange(0), metavar="S", help="The values of one state, with their history."
)
@click.option(
    "-o",
    "--output",
    "--out",
    "output",
    type=click.Path(dir_okay=False, path_type=Path),
    metavar="FILE.npy",
    help="Write the whole table: float64 [states, actions], of several agents [agents, states, actions].",
)
@click.option("--force", is_flag=True, help="Replace the file if it exists.")
@recordings_option
@json_option
def command(
    run_name: str,
    step: int | None,
    episode: int | None,
    state: int | None,
    output: Path | None,
    force: bool,
    recordings: Path | None,
    as_json: bool,
) -> None:
    """Show the exact Q-table of RUN at any step: the nearest snapshot, with the recorded steps replayed.

    With --state: its values, the policy if the algorithm learns one, the greedy action (ties go to the
    first), how often each action was taken there so far, and which step last changed each value. In Python:
    runner.replay.tables.tables_at().

    \b
    Examples:
      dualtaxi qtable @latest --episode 500
      dualtaxi qtable k3v9m2xq --step 50000 --state 17
      dualtaxi qtable k3v9m2xq --step 50000 -o table.npy
    """  # noqa: D301 - Click wants the backspace itself
    if step is not None and episode is not None:
        raise click.UsageError("--step and --episode exclude each other: choose one.")
    from runner.analysis.qtable import at_moment, told_of
    from runner.cli.progress import stage_line
    from runner.cli.runs import compilation_notice
    from runner.export.places import require_new
    from runner.recording.reader import open_recording

    if output is not None:
        require_new(output, force)
    run = find_recorded(run_name, recordings)
    with (
        open_recording(run.recording) as recording,
        compilation_notice(),
        stage_line("replaying recorded steps"),
    ):
        replay = at_moment(recording, step, episode)
        told = told_of(recording, replay, state)
        tables = replay.tables
    if output is not None:
        _write(output, force, tables)
        told["path"] = str(output.absolute())
    if as_json:
        print_json(told)
    else:
        _draw(told)


def _write(path: Path, force: bool, tables: list[NDArray[Any]]) -> None:
    import numpy as np

    from runner.analysis.qtable import one_array
    from runner.export.places import write_new

    def write(fresh: Path) -> None:
        with fresh.open("wb") as stream:  # of a name, NumPy would make another one
            np.save(stream, one_array(tables))

    write_new(path, force, write)


def _draw(told: dict[str, Any]) -> None:
    head = {"run": told["run"], "step": f"after {told['step']:,} training steps"}
    head |= {
        one[
            "agent"
        ]: f"{one['states']:,} states, {one['actions']} actions, {one['percent_filled']:.1f} % filled, "
        f"values from {one['lowest']:.4g} to {one['highest']:.4g}"
        for one in told["tables"]
    }
    if "state" in told:
        head["state"] = f"{told['state']}: {told['state_in_words']}"
        head["visits"] = f"{told['visits']:,}"
    parts: list[Any] = [facts(head)]
    for one in told["tables"] if "state" in told else ():
        rows = [row for row in told["values"] if row["agent"] == one["agent"]]
        parts += [title(one["agent"]), _drawn(rows)]
    draw(*parts)
    if "path" in told:
        say(f"Written: {told['path']}")


def _drawn(rows: list[dict[str, Any]]) -> Any:
    policy = ("policy",) if "policy" in rows[0] else ()
    drawn = table(
        *("action", "", "value", *policy, "greedy", "visits", "changed\nby step", "in\nepisode"),
        left=("", "greedy"),
        shrinking=("",),
    )
    for row in rows:
        changed = row["changed_step"] is not None
        drawn.add_row(
            str(row["action"]),
            row["action_in_words"],
            number(row["value"], 4),
            *(number(row[name], 4) for name in policy),
            "greedy" if row["greedy"] else "",
            f"{row['visits']:,}",
            f"{row['changed_step']:,}" if changed else UNKNOWN,
            f"{row['changed_episode']:,}" if changed else UNKNOWN,
        )
    return drawn
