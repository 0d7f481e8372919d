"""A run's evaluations, reports, episodes, steps and logged values as pandas frames, and as arrays by column.

    import runner

    run = runner.run("quick")
    runner.frames.evaluations(run).plot("episode", "success_percent")

A run is a `Run`, an open `Recording`, or the path of a run's folder or recording. pandas comes with the extra
`frames`.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Literal

import numpy as np

from runner.analysis.evaluations import evaluation_records, training_records
from runner.archive.places import opened
from runner.environments.loading import load_mdp
from runner.environments.mdp import Mdp
from runner.environments.naming import actions_in_words, states_in_words
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.extras import filled
from runner.recording.metrics import METRICS
from runner.recording.reader import Recording
from runner.recording.steps import taken
from runner.replay.steps import steps_of
from runner.runs.run import Run, run_at
from runner.util.arrays import Array, Records, leaves
from runner.util.extras import require
from runner.util.values import flatten

if TYPE_CHECKING:
    import pandas as pd

Source = Run | Recording | str | os.PathLike[str]
Phase = Literal["train", "eval"]


def evaluations(run: Source) -> pd.DataFrame:
    """Return a row for each evaluation: the results of the greedy policy, and the progress of training.

    Columns: episode, success_percent (NaN where the environment does not define success),
    mean_length, mean_penalties, ...; a column for each event, such as `taxi_1.drop_off`: its count
    over all trials; `mean_return.AGENT`; and `training.…` for the progress of training.

    Raises:
        MissingExtra: pandas is not installed.
        RecordingError: the recording cannot be read.
    """
    with _opened(run) as recording:
        records = [_flat(record.as_json()) for record in evaluation_records(recording)]
        return _frame(
            [{evaluation_column(key): value for key, value in record.items()} for record in records]
        )


def training(run: Source) -> pd.DataFrame:
    """Return a row for each report of training: mean length, rewards, fill of the tables, schedules.

    Raises:
        MissingExtra: pandas is not installed.
        RecordingError: the recording cannot be read.
    """
    with _opened(run) as recording:
        return _frame([_flat(record.as_json()) for record in training_records(recording)])


def episodes(run: Source, phase: Phase = "train", start: int = 0, stop: int | None = None) -> pd.DataFrame:
    """Return a row for each episode of a phase, number `start` up to `stop`.

    Columns: episode, environment (where there are several), first_step, last_step, length, penalties,
    success, terminated, truncated, `return.AGENT`, and a column for each event.

    Raises:
        MissingExtra: pandas is not installed.
        RecordingError: the recording cannot be read.
    """
    with _opened(run) as recording:
        return _frame(episode_columns(recording, phase, start, stop))


def steps(
    run: Source,
    phase: Phase = "train",
    *,
    episode: int | None = None,
    start: int = 0,
    stop: int | None = None,
) -> pd.DataFrame:
    """Return a row for each step of a phase: of one episode, or number `start` up to `stop`.

    Columns: step, episode, t, environment (where there are several), state, action (joint), next_state,
    `reward.AGENT`, explored (bit i: agent i), terminated, truncated; in spaces that are not `Discrete` action
    and next_observation, a column for each part of a `Dict`, with an array in a cell where a value is several
    numbers; `extra.NAME` for each value that a loop recorded with its steps, NaN where a step has none. All
    steps of a long run take some 70 bytes of memory each.

    Raises:
        MissingExtra: pandas is not installed.
        RecordingError: the recording cannot be read, or has no such episode.
    """
    with _opened(run) as recording:
        columns = step_columns(recording, phase, episode=episode, start=start, stop=stop)
        return _frame({name: list(values) if values.ndim > 1 else values for name, values in columns.items()})


def logged(run: Source) -> pd.DataFrame:
    """Return a row for each number that a loop logged, in the order logged.

        runner.frames.logged(run).pivot_table(index="step", columns="name", values="value")

    Columns: phase, step (steps of the phase before it; without an environment the script's own step),
    episode, name, value.

    Raises:
        MissingExtra: pandas is not installed.
        RecordingError: the recording cannot be read.
    """
    with _opened(run) as recording:
        return _frame(logged_columns(recording))


def transition_table(
    env_id: str = "dualtaxi:DualTaxi-v1", kwargs: Mapping[str, object] | None = None, rewards: str = "team"
) -> pd.DataFrame:
    """Return an environment's transition table, its states and actions described: a row for each outcome.

    Columns: state, action, probability, next_state, reward (of all agents together), is_over, and
    `reward.AGENT` where `rewards` is `individual`.

    Raises:
        MissingExtra: pandas is not installed.
        EnvironmentNotUsable: the environment is unknown, or has no transition table.
    """
    return _frame(transition_columns(load_mdp(env_id, kwargs or {}, rewards)))


def transition_columns(mdp: Mdp) -> dict[str, Array]:
    """Return the columns of `transition_table`, a value for each outcome with a probability above 0."""
    states, actions = states_in_words(mdp), actions_in_words(mdp)
    state, action, outcome = np.nonzero(mdp.probability)
    at = (state, action, outcome)
    columns = {
        "state": states[state],
        "action": actions[action],
        "probability": mdp.probability[at],
        "next_state": states[mdp.next_state[at]],
        "reward": mdp.summed_rewards[at],
        "is_over": mdp.terminated[at],
    }
    if mdp.rewards.shape[-1] > 1:  # else the agents share the reward
        columns |= _by_name(mdp.rewards[at], [f"reward.{agent}" for agent in mdp.agents])
    return columns


# --- columns ------------------------------------------------------------------------------------------


def episode_columns(recording: Recording, phase: Phase, start: int, stop: int | None) -> dict[str, Array]:
    """Return the columns of `episodes`, an array each."""
    return columns_of_episodes(recording, recording.phase(phase).episodes.array(start, stop))


def columns_of_episodes(recording: Recording, records: Records) -> dict[str, Array]:
    """Return the columns of episodes, an array each."""
    names = records.dtype.names or ()
    plain = [name for name in schema.EPISODE_COLUMNS if name in names and name not in ("returns", "events")]
    columns: dict[str, Array] = {name: records[name].copy() for name in plain}
    columns |= _by_name(records["returns"], [f"return.{agent}" for agent in recording.agents])
    return columns | _by_name(records["events"], recording.environment["event_names"])


def logged_columns(recording: Recording) -> dict[str, Sequence[object]]:
    """Return the columns of `logged`, a list each."""
    names = ("phase", "step", "episode", "name", "value")
    columns: dict[str, list[object]] = {name: [] for name in names}
    for scalar in recording.table(schema.SCALAR_TOPIC).decoded():
        for name in names:
            columns[name].append(scalar[name])
    return dict(columns)


def step_columns(
    recording: Recording,
    phase: Phase = "train",
    *,
    episode: int | None = None,
    start: int = 0,
    stop: int | None = None,
) -> dict[str, Array]:
    """Return the columns of `steps`, an array each.

    Raises:
        RecordingError: the recording cannot be read, or has no such episode.
    """
    steps = recording.phase(phase).steps
    if steps.dtype is None:
        raise RecordingError(
            f"{recording.path}: its observations vary in size, so its steps are no columns; "
            "`recording.train.transitions()` reads them one by one."
        )
    if episode is None:
        blocks = [taken(block).copy() for block in steps.blocks(start, stop)]
        records = np.concatenate([np.empty(0, steps.row_dtype), *blocks])
    else:
        records = steps_of(recording, phase, episode)
    names = records.dtype.names or ()
    columns: dict[str, Array] = {}
    for name in schema.STEP_COLUMNS:
        if name == "rewards":
            columns |= _by_name(records["rewards"], [f"reward.{agent}" for agent in recording.agents])
        elif name in names and name != "taken":
            columns |= dict(leaves(name, records[name].copy()))
    extras = recording.phase(phase).extras.at(records["step"])
    return columns | {f"extra.{name}": filled(values) for name, values in extras.items()}


# --- inside -------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _opened(run: Source) -> Iterator[Recording]:
    """Yield the run's open recording, if pandas is installed; one that is open already stays open."""
    _require_pandas()
    with opened(run if isinstance(run, Run | Recording) else run_at(Path(run))) as recording:
        yield recording


def _require_pandas() -> ModuleType:
    pandas: ModuleType = require("pandas", extra="frames", purpose="a frame")
    return pandas


def _frame(data: object) -> pd.DataFrame:
    """Return a frame of columns by name, or of rows."""
    frame: pd.DataFrame = _require_pandas().DataFrame(data)
    return frame


def _flat(record: Mapping[str, object]) -> dict[str, object]:
    """Return the values of a record by dotted key; an unknown one (None) is NaN."""
    return {key: math.nan if value is None else value for key, value in flatten(record).items()}


def evaluation_column(key: str) -> str:
    """Return the column of a value of an evaluation: events by their own names, measures by agent."""
    first, dot, rest = key.partition(".")
    names = {metric.key: metric.name for metric in METRICS}
    return rest if first == "events" else f"{names.get(first, first)}{dot}{rest}"


def _by_name(values: Array, names: Sequence[str]) -> dict[str, Array]:
    """Return the columns of [N, names] by name."""
    return {name: values[:, i].copy() for i, name in enumerate(names)}
