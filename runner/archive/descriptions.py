"""The descriptive tables: the run, and the meaning of its environment's numbers; for readers only."""

from __future__ import annotations

import json
from typing import Final

import numpy as np
import pyarrow as pa

from runner.archive import layout
from runner.archive.columns import Shape
from runner.environments.mdp import Mdp
from runner.environments.naming import actions_in_words, states_in_words
from runner.errors import RecordingError
from runner.recording.description import recorded_facts
from runner.recording.metadata import kind_of
from runner.recording.reader import Recording

_RUN_TYPES: Final = {
    "seed": pa.uint64(),
    "created": pa.timestamp("ms", tz="UTC"),
    **dict.fromkeys(("episodes", "train_steps", "eval_steps"), pa.int64()),
    "environments": pa.int32(),
}
"""The types of the columns of a run that are no text."""


def run_table(recording: Recording) -> pa.Table:
    """Return the table with one row that describes a run."""
    facts = recorded_facts(recording)
    summary = facts["summary"]
    result = recording.file.metadata("result") if "result" in recording.file.metadata_names else {}
    columns = {
        "run_id": facts["run_id"],
        "name": recording.name,
        "seed": facts["seed"],
        "job": recording.run["job"],
        "status": facts["status"],
        "created": recording.created,
        **{key: summary.get(key) for key in ("content_digest", "episodes", "train_steps", "eval_steps")},
        "kind": kind_of(recording.run),
        "env_id": str(recording.environment.get("env_id")),
        "environments": recording.environments,
        "spaces": recording.run.get("spaces"),
        "config": json.dumps(recording.config),
        "result": result["json"] if result else "{}",
        "provenance": json.dumps(recording.provenance),
    }
    try:
        return pa.table(
            {name: pa.array([value], _RUN_TYPES.get(name, pa.string())) for name, value in columns.items()}
        )
    except (pa.ArrowException, OverflowError) as error:
        raise RecordingError(f"{recording.path}: its result is invalid ({error}).") from error


def description_tables(mdp: Mdp, shape: Shape) -> dict[str, pa.Table]:
    """Return transitions, states and actions as tables, by the name of their file."""
    return {
        layout.TRANSITIONS: _transitions(mdp, shape),
        layout.STATES: _states(mdp, shape),
        layout.ACTIONS: _actions(mdp, shape),
    }


def _transitions(mdp: Mdp, shape: Shape) -> pa.Table:
    possible = mdp.probability > 0
    state, action, _ = np.nonzero(possible)
    columns: dict[str, object] = {
        "state": state.astype(np.int32),
        "action": action.astype(np.int32),
        "next_state": mdp.next_state[possible],
        "probability": mdp.probability[possible],
        "reward": mdp.rewards.sum(axis=-1)[possible],
        "terminated": mdp.terminated[possible],
    }
    events = mdp.events[possible]
    for i, name in enumerate(shape.event_columns):
        columns[name] = ((events >> np.uint32(i)) & 1).astype(np.int32)
    return _table(columns, shape)


def _states(mdp: Mdp, shape: Shape) -> pa.Table:
    columns: dict[str, object] = {
        "state": np.arange(mdp.states, dtype=np.int32),
        "words": states_in_words(mdp).tolist(),
        "start_probability": mdp.start,
    }
    if mdp.scene is not None and mdp.scene_cells is not None:
        names = [f"{i + 1}" for i in range(mdp.scene_cells.shape[1])]
        given = [str(thing["name"]) for thing in mdp.scene["things"]]
        names = given if len(set(given)) == len(names) else names
        for i, name in enumerate(names):
            row, column = np.divmod(mdp.scene_cells[:, i], mdp.scene["columns"])
            columns |= {f"{name}_row": row.astype(np.int32), f"{name}_column": column.astype(np.int32)}
    return _table(columns, shape)


def _actions(mdp: Mdp, shape: Shape) -> pa.Table:
    action = np.arange(mdp.joint_actions, dtype=np.int32)
    columns: dict[str, object] = {"action": action, "words": actions_in_words(mdp).tolist()}
    if shape.own_actions:
        own = mdp.own_actions.T.astype(np.int32)
        columns |= dict(zip(shape.own_actions, own, strict=True))
    return _table(columns, shape)


def _table(columns: dict[str, object], shape: Shape) -> pa.Table:
    table = pa.table(columns)
    run_id = pa.array([shape.run_id] * len(table)).dictionary_encode().cast(layout.TEXT)
    return table.add_column(0, pa.field("run_id", layout.TEXT), run_id)
