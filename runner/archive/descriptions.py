"""The descriptive tables: the run, and the meaning of its environment's numbers; for readers only."""

from __future__ import annotations

import json

import numpy as np
import pyarrow as pa

from runner.archive import layout
from runner.archive.columns import Shape
from runner.environments.mdp import Mdp
from runner.environments.naming import actions_in_words, states_in_words
from runner.errors import RecordingError
from runner.recording.reader import Recording


def run_table(recording: Recording) -> pa.Table:
    """Return the table with one row that describes a run."""
    facts, config = recording.run_facts(), recording.config
    summary = facts["summary"]
    columns: dict[str, tuple[pa.DataType, object]] = {
        "run_id": (pa.string(), facts["run_id"]),
        "name": (pa.string(), recording.name),
        "seed": (pa.uint64(), facts["seed"]),
        "job": (pa.string(), recording.job),
        "status": (pa.string(), facts["status"]),
        "created": (pa.timestamp("ms", tz="UTC"), recording.began),
        "content_digest": (pa.string(), summary.get("content_digest")),
        "episodes": (pa.int64(), summary.get("episodes")),
        "train_steps": (pa.int64(), summary.get("train_steps")),
        "eval_steps": (pa.int64(), summary.get("eval_steps")),
        "kind": (pa.string(), recording.kind),
        "env_id": (pa.string(), str(recording.environment.get("env_id"))),
        "environments": (pa.int32(), recording.environments),
        "spaces": (pa.string(), recording.run.get("spaces")),
        "config": (pa.string(), json.dumps(config)),
        "result": (pa.string(), json.dumps(recording.raw_result)),
        "provenance": (pa.string(), json.dumps(recording.provenance)),
    }
    try:
        return pa.table({name: pa.array([value], kind) for name, (kind, value) in columns.items()})
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
