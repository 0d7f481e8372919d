"""A run's measures, episodes and steps under readable names: as plain records, and as pandas frames.

    import runner

    run = runner.run("quick")
    runner.frames.evaluations(run).plot("episode", "success_percent")

A run is a `Run`, an open `Recording`, or the path of a recording. pandas comes with the extra `frames`;
the records need nothing.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from runner.errors import RecordingError
from runner.recording.metrics import METRICS, defined_metrics, finite_mean, is_usable
from runner.runs.run import Run
from runner.util.extras import require
from runner.util.values import flatten

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd
    from numpy.typing import NDArray

    from runner.environments.mdp import Mdp
    from runner.recording.reader import Recording

    Source = Run | Recording | str | os.PathLike[str]

Phase = Literal["train", "eval"]

RECENT_EPISODES: Final = 100
"""Training episodes that the summary of a loop averages, the last ones."""

_BEFORE: Final = ("step", "episode", "t", "state", "action", "next_state", "next_observation")
_BEHIND: Final = ("terminated", "truncated", "explored", "acted", "agents_terminated", "agents_truncated")
"""The fields of a step in the order of its columns: those before the rewards, and those behind them."""


def evaluations(run: Source) -> pd.DataFrame:
    """Return a row for each evaluation: how the greedy policy did, and how training stood.

    Columns: episode, success_percent (NaN where the environment does not say what success is),
    mean_length, mean_penalties, ...; a column for each event, such as `taxi_1.drop_off`: how often it came
    in all trials; `mean_return.AGENT` and `training.…` for training at that moment.

    Raises:
        MissingExtra: pandas is not installed.
        RecordingError: the recording cannot be read.
    """
    with _opened(run) as recording:
        records = [_flat(record) for record in evaluation_records(recording)]
        return _frame([{_evaluation_column(key): value for key, value in each.items()} for each in records])


def training(run: Source) -> pd.DataFrame:
    """Return a row for each report of training: mean length, rewards, fill of the tables, schedules.

    Raises:
        MissingExtra: pandas is not installed.
        RecordingError: the recording cannot be read.
    """
    with _opened(run) as recording:
        return _frame([_flat(record) for record in training_records(recording)])


def episodes(
    run: Source,
    phase: Phase = "train",
    start: int = 0,
    stop: int | None = None,
) -> pd.DataFrame:
    """Return a row for each episode of a phase, number `start` up to `stop`.

    Columns: episode, length, penalties, success, terminated, truncated, last_step, `return.AGENT`, and a
    column for each event.

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

    Columns: step, episode, t, state, action (joint), next_state, `reward.AGENT`, terminated, truncated,
    explored (bit i: agent i); in spaces that are not `Discrete` action and next_observation, a column for
    each part of a `Dict`, with an array in a cell where a value is several numbers. All steps of a long run
    take some 70 bytes of memory each.

    Raises:
        MissingExtra: pandas is not installed.
        RecordingError: the recording cannot be read, or has no such episode.
    """
    with _opened(run) as recording:
        columns = step_columns(recording, phase, episode=episode, start=start, stop=stop)
        return _frame({name: list(each) if each.ndim > 1 else each for name, each in columns.items()})


def transition_table(
    env_id: str = "dualtaxi:DualTaxi-v1", kwargs: Mapping[str, Any] | None = None, rewards: str = "team"
) -> pd.DataFrame:
    """Return an environment's transition table in words: a row for each outcome that can happen.

    Columns: state, action, probability, next_state, reward (of all agents together), is_over, and
    `reward.AGENT` where `rewards` is `individual`.

    Raises:
        MissingExtra: pandas is not installed.
        EnvironmentNotUsable: the environment is unknown, or has no transition table.
    """
    from runner.environments.loading import load_mdp

    return _frame(transition_columns(load_mdp(env_id, kwargs or {}, rewards)))


def transition_columns(mdp: Mdp) -> dict[str, NDArray[Any]]:
    """Return the columns of `transition_table`, a value for each outcome with a probability above 0."""
    import numpy as np

    from runner.environments.naming import actions_in_words, states_in_words

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
    shared = mdp.rewards.shape[-1] == 1
    own = {} if shared else _by_name(mdp.rewards[at], [f"reward.{agent}" for agent in mdp.agents])
    return columns | own


# --- columns ------------------------------------------------------------------------------------------


def episode_columns(
    recording: Recording, phase: Phase = "train", start: int = 0, stop: int | None = None
) -> dict[str, NDArray[Any]]:
    """Return the columns of `episodes`, an array each.

    Raises:
        RecordingError: the recording cannot be read.
    """
    records = recording.episodes(phase, start, stop)
    columns = _plain_columns(records, ("episode", "length", "penalties", "success"))
    columns |= _plain_columns(records, ("terminated", "truncated", "last_step"))
    columns |= _by_name(records["returns"], [f"return.{agent}" for agent in recording.agents])
    return columns | _by_name(records["events"], recording.event_names)


def step_columns(
    recording: Recording,
    phase: Phase = "train",
    *,
    episode: int | None = None,
    start: int = 0,
    stop: int | None = None,
) -> dict[str, NDArray[Any]]:
    """Return the columns of `steps`, an array each.

    Raises:
        RecordingError: the recording cannot be read, or has no such episode.
    """
    import numpy as np

    topic = recording.topic(f"/{phase}/step")
    if topic not in recording.dtypes:
        raise RecordingError(
            f"{recording.path}: its observations vary in size, so its steps are no columns; "
            "`Recording.transitions` reads them one by one."
        )
    if episode is None:
        blocks = [block.copy() for block in recording.blocks(topic, start, stop)]
        records = np.concatenate(blocks) if blocks else np.empty(0, recording.dtypes[topic])
    else:
        records = recording.episode_steps(phase, episode)
    names = records.dtype.names or ()
    columns = _spread(_plain_columns(records, [name for name in _BEFORE if name in names]))
    columns |= _by_name(records["rewards"], [f"reward.{agent}" for agent in recording.agents])
    return columns | _plain_columns(records, [name for name in _BEHIND if name in names])


# --- plain records ------------------------------------------------------------------------------------


def evaluation_records(recording: Recording) -> list[dict[str, Any]]:
    """Return the evaluations of a recording, in order, as JSON can hold them.

    Each has `episode` (training episodes before it), `success_percent` (None where the environment does
    not say what success is), `mean_length`, `mean_penalties`, ..., `events` by name, summed over the
    trials, and under `training` what `training_records` has.

    The evaluations of a loop are its evaluation episodes between two training episodes. They have no `step`
    and no `training`; `mean_penalties` is None where the environment does not define penalties; returns that
    are not finite are left out of `mean_returns` and counted in `not_finite`.
    """
    agents, events = recording.agents, recording.event_names
    if not recording.is_job:
        return _loop_evaluations(recording, agents, events)
    return [evaluation_record(metrics, agents, events) for metrics in recording.metrics("eval")]


def loop_summary(recording: Recording) -> dict[str, Any]:
    """Return the last results of a loop, computed from its recording.

    Keys: `last_evaluation` (None if there was none) with `episode`, `trials`, `success_percent`,
    `mean_length`, `mean_penalties` and `mean_return` (summed over agents); `recent_training` with
    `episodes`, `mean_length` and `mean_return` of the last `RECENT_EPISODES`; `logged`, the last value logged
    under each name. A value that is unknown or not finite is None.
    """
    from runner.recording import schema

    total = recording.count(schema.TRAIN_EPISODE)
    evaluations = evaluation_records(recording)
    recent = recording.episodes("train", max(0, total - RECENT_EPISODES), total)
    return {
        "last_evaluation": evaluation_summary(evaluations[-1]) if evaluations else None,
        "recent_training": {
            "episodes": len(recent),
            "mean_length": finite_mean(recent["length"]),
            "mean_return": finite_mean(recent["returns"].sum(axis=1)),
        },
        "logged": _last_logged(recording),
    }


def _last_logged(recording: Recording) -> dict[str, float | None]:
    """Return the last value logged under each name, from the result if that carries them."""
    from runner.recording import schema

    if "logged" in recording.result:
        return dict(recording.result.logged)
    return {
        scalar["name"]: scalar["value"] if math.isfinite(scalar["value"]) else None
        for scalar in recording.decoded(schema.SCALAR_TOPIC)
    }


def trained_before(recording: Recording) -> NDArray[np.int64]:
    """Return for each evaluation episode of a loop how many training episodes had ended before it."""
    import numpy as np

    from runner.recording import schema

    trained, tested = (
        np.concatenate([np.empty(0, np.uint64), *(block["log_time"] for block in recording.blocks(topic))])
        for topic in (schema.TRAIN_EPISODE, schema.EVAL_EPISODE)
    )
    return np.searchsorted(trained, tested)


def training_records(recording: Recording) -> list[dict[str, Any]]:
    """Return the reports of training of a recording, in order, as JSON can hold them."""
    agents = recording.agents
    return [
        {"episode": metrics["episode"], "step": metrics["step"]} | _training_side(metrics, agents)
        for metrics in recording.metrics("train")
    ]


def evaluation_record(
    metrics: Mapping[str, Any], agents: Sequence[str], events: Sequence[str]
) -> dict[str, Any]:
    """Return an evaluation's metrics, as recorded, under the names of `evaluation_records`."""
    known = metrics["successes"] >= 0
    return {
        "evaluation": metrics["evaluation"],
        "episode": metrics["episode"],
        "step": metrics["step"],
        "trials": metrics["trials"],
        "successes": metrics["successes"] if known else None,
        **{each.key: _known(metrics[each.field], agents) for each in METRICS},
        "terminations": metrics["terminations"],
        "events": dict(zip(events, metrics["events"], strict=True)),
        "training": _training_side(metrics, agents),
    }


def _known(value: float | list[float], agents: Sequence[str]) -> float | dict[str, float] | None:
    """Return a recorded value, by agent if each has its own; NaN, which stands for unknown, as None."""
    if isinstance(value, list):
        return dict(zip(agents, value, strict=True))
    return None if math.isnan(value) else value


def _loop_evaluations(
    recording: Recording, agents: Sequence[str], events: Sequence[str]
) -> list[dict[str, Any]]:
    """Return a record for each group of evaluation episodes with no training episode between them."""
    import numpy as np

    from runner.recording import schema

    before, first = trained_before(recording), 0
    found: dict[int, list[NDArray[np.void]]] = {}
    for block in recording.blocks(schema.EVAL_EPISODE):
        after, first = before[first : first + len(block)], first + len(block)
        for episodes in np.unique(after).tolist():
            found.setdefault(episodes, []).append(block[after == episodes])
    environment = recording.environment
    defined = defined_metrics(bool(environment["success_events"]), environment["penalty_below"] is not None)
    records = []
    for number, episode in enumerate(sorted(found)):
        trials = np.concatenate(found[episode])
        values = {each.key: each.of_trials(trials) for each in defined}
        records.append(
            {
                "evaluation": number,
                "episode": episode,
                "trials": len(trials),
                "successes": int(trials["success"].sum()) if environment["success_events"] else None,
                **dict.fromkeys(each.key for each in METRICS),
                **{key: _mean(of_trials, agents) for key, of_trials in values.items()},
                "terminations": int(trials["terminated"].sum()),
                "not_finite": sum(int((~is_usable(of_trials)).sum()) for of_trials in values.values()),
                "events": dict(zip(events, trials["events"].sum(axis=0, dtype=int).tolist(), strict=True)),
            }
        )
    return records


def _mean(values: NDArray[Any], agents: Sequence[str]) -> float | dict[str, float | None] | None:
    """Return the mean over trials, by agent if each has its own, without what is not finite."""
    if values.ndim == 1:
        return finite_mean(values)
    return {agent: finite_mean(values[:, i]) for i, agent in enumerate(agents)}


def evaluation_summary(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the figures of an evaluation record, summed over agents; None for what is unknown of any."""
    summary = {"episode": record["episode"], "trials": record["trials"]}
    for metric in METRICS:
        value = record[metric.key]
        if metric.per_agent:
            value = None if None in value.values() else sum(value.values())
        summary[metric.name] = value
    return summary


def _training_side(metrics: Mapping[str, Any], agents: Sequence[str]) -> dict[str, Any]:
    """Return how training stood; a mean over no episodes yet is None."""
    length = metrics["mean_length"]
    return {
        "mean_length": None if math.isnan(length) else length,
        "reward_counts": [
            {"reward": reward, "steps": steps}
            for reward, steps in zip(metrics["rewards"], metrics["reward_counts"], strict=True)
        ],
        "zero_cells": dict(zip(agents, metrics["zero_cells"], strict=True)),
        "percent_filled": dict(zip(agents, metrics["percent_filled"], strict=True)),
        "epsilon": metrics["epsilon"],
        "step_size": metrics["step_size"],
        "discount": metrics["discount"],
    }


# --- inside -------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _opened(run: Source) -> Iterator[Recording]:
    """Give the run's recording, opened, if there is pandas; one that is open already stays open."""
    from runner.recording.reader import Recording, open_recording

    _frame([])
    if isinstance(run, Recording):
        yield run
        return
    with open_recording(_at_hand(run).recording if isinstance(run, Run) else Path(run)) as recording:
        yield recording


def _at_hand(run: Run) -> Run:
    """Return a run whose recording can be read, also if it is in an archive alone."""
    if run.status != "archived":
        return run
    from runner.archive.places import at_hand

    return at_hand(run)


def _frame(data: Any) -> pd.DataFrame:
    """Return a frame of columns by name, or of rows."""
    frame: pd.DataFrame = require("pandas", extra="frames", purpose="a frame").DataFrame(data)
    return frame


def _flat(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a record by dotted key; an unknown one (None) is NaN."""
    return {key: math.nan if value is None else value for key, value in flatten(record).items()}


def _evaluation_column(key: str) -> str:
    """Return the column of a value of an evaluation: events by their own names, measures by agent."""
    first, dot, rest = key.partition(".")
    names = {metric.key: metric.name for metric in METRICS}
    return rest if first == "events" else f"{names.get(first, first)}{dot}{rest}"


def _plain_columns(records: NDArray[np.void], names: Sequence[str]) -> dict[str, Any]:
    """Return fields of records as arrays of their own."""
    return {name: records[name].copy() for name in names}


def _spread(columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return columns of which those of composed values, such as a `Dict` space's, are a column a part."""
    spread: dict[str, NDArray[Any]] = {}
    for name, values in columns.items():
        if values.dtype.names is None:
            spread[name] = values
        else:
            spread |= _spread({f"{name}.{part}": values[part] for part in values.dtype.names})
    return spread


def _by_name(values: NDArray[Any], names: Sequence[str]) -> dict[str, Any]:
    """Return the columns of [N, names] by name."""
    return {name: values[:, i].copy() for i, name in enumerate(names)}
