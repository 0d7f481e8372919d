"""`dualtaxi qtable`: the Q-table of any moment."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from runner.cli.options import find_recorded, json_option, recordings_option, run_argument
from runner.cli.output import UNKNOWN, draw, facts, number, print_json, say, table, title
from runner.errors import RunnerError, StorageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from runner.recording.reader import Recording


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
    "--out",
    type=click.Path(dir_okay=False, path_type=Path),
    metavar="FILE.npy",
    help="Write the whole table: float64 [states, actions], of several agents [agents, states, actions].",
)
@recordings_option
@json_option
def command(
    run_name: str,
    step: int | None,
    episode: int | None,
    state: int | None,
    out: Path | None,
    recordings: Path | None,
    as_json: bool,
) -> None:
    """Tell the exact Q-table of RUN at any step: the nearest snapshot, with the recorded steps replayed.

    With --state: its values, the policy if the algorithm learns one, the greedy action (ties go to the
    first), how often each action was taken there so far, and which step last changed each value. In Python:
    runner.analysis.tables.tables_at().

    \b
    Examples:
      dualtaxi qtable @latest --episode 500
      dualtaxi qtable k3v9m2xq --step 50000 --state 17
      dualtaxi qtable k3v9m2xq --step 50000 --out table.npy
    """  # noqa: D301 - Click wants the backspace itself
    if step is not None and episode is not None:
        raise click.UsageError("--step and --episode exclude each other: choose one.")
    from runner.analysis.tables import TableReplay, last_step, step_of_episode
    from runner.recording.reader import open_recording

    with open_recording(find_recorded(run_name, recordings).recording) as recording:
        if episode is not None:
            step = step_of_episode(recording, episode)
        replay = TableReplay(recording, last_step(recording) if step is None else step)
        agents, tables = replay.agents, replay.tables
        told: dict[str, Any] = {"run": recording.run["run_id"], "step": replay.step}
        told["tables"] = [_summary(agent, values) for agent, values in zip(agents, tables, strict=True)]
        if state is not None:
            told |= _state(recording, replay, state)
    if out is not None:
        _write(out, tables)
        told["out"] = str(out.absolute())
    if as_json:
        print_json(told)
    else:
        _draw(told)


def _summary(agent: str, values: NDArray[Any]) -> dict[str, Any]:
    zeros = int(values.size - (values != 0).sum())
    return {
        "agent": agent,
        "states": values.shape[0],
        "actions": values.shape[1],
        "zero_cells": zeros,
        "percent_filled": 100.0 * (values.size - zeros) / values.size,
        "lowest": float(values.min()),
        "highest": float(values.max()),
    }


def _state(recording: Recording, replay: Any, state: int) -> dict[str, Any]:
    """Return the values of a state, their history, and its words."""
    from runner.analysis.tables import history_of
    from runner.words import action_names, actions_in_words, states_in_words

    mdp = recording.mdp
    if state >= mdp.states:
        raise RunnerError(f"--state: found {state}, expected one of 0 to {mdp.states - 1}.")
    history = history_of(recording, state, replay.step)
    joint, own = actions_in_words(mdp), action_names(mdp)
    values = []
    for i, (agent, held) in enumerate(zip(replay.agents, replay.held, strict=True)):
        q = held["q"]
        names = joint if q.shape[1] == mdp.joint_actions else own[i] if own else range(q.shape[1])
        for action, name in enumerate(names):
            changed = int(history.changed_step[i, action])
            values.append(
                {
                    "agent": agent,
                    "action": action,
                    "action_in_words": str(name),
                    "value": float(q[state, action]),
                    **({"policy": float(held["policy"][state, action])} if "policy" in held else {}),
                    "greedy": bool(replay.greedy[i, state] == action),
                    "visits": int(history.visits[i, action]),
                    "changed_step": None if changed < 0 else changed,
                    "changed_episode": None if changed < 0 else int(history.changed_episode[i, action]),
                }
            )
    words = str(states_in_words(mdp)[state])
    return {"state": state, "state_in_words": words, "visits": int(history.visits[0].sum()), "values": values}


def _write(path: Path, tables: list[NDArray[Any]]) -> None:
    """Write the tables as one array; where agents differ in actions, the places left over are nan."""
    import numpy as np

    shape = (len(tables), len(tables[0]), max(values.shape[1] for values in tables))
    whole = np.full(shape, np.nan)
    for i, values in enumerate(tables):
        whole[i, :, : values.shape[1]] = values
    try:
        with path.open("wb") as stream:
            np.save(stream, whole[0] if len(tables) == 1 else whole)
    except OSError as error:
        raise StorageError(f"{path}: cannot be written ({error.strerror}).") from error


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
    if "out" in told:
        say(f"Written: {told['out']}")


def _drawn(rows: list[dict[str, Any]]) -> Any:
    policy = ("policy",) if "policy" in rows[0] else ()
    drawn = table(
        *("action", "", "value", *policy, "greedy", "visits", "last changed by step", "in episode"),
        left=("", "greedy"),
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
