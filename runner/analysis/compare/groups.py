"""Which runs belong together, and which metrics they have."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import Any

from runner.analysis.groups import Group, each_once, flat_config, label_of, sameness
from runner.analysis.series import RunSeries
from runner.errors import RunnerError, nearest
from runner.recording.metrics import METRICS, SHARES

_NOT_COMPARED = ("seeds", "recording", "name")
_USUAL_OF_TRAINING = ("training.mean_return", "training.mean_reward", "training.mean_length")


def grouped(series: Sequence[RunSeries], by: str | None = None) -> tuple[list[Group], list[str]]:
    """Return runs in groups, and what is to be said of them, a sentence each.

    Runs belong together whose configurations differ in nothing but the seed, whatever they are called and
    however they are recorded; or, with `by`, those that have the same value there. Of a job that was run
    twice the finished and then the newer run counts. Several loops of one configuration and seed, such as the
    workers of one training, all count: the value of their seed is the mean over them.

    Args:
        series: the runs.
        by: path of a configuration's value, such as `quirks.epsilon_exploits`.

    Raises:
        RunnerError: no run has a value of that path.
    """
    found: dict[str, list[RunSeries]] = {}
    key = _content if by is None else _value_at(by, series)
    for run in series:
        found.setdefault(key(run), []).append(run)
    once = {name: each_once(runs, lambda run: (_content(run), sameness(run))) for name, runs in found.items()}
    twice = [run.run_id for name, runs in found.items() for run in runs if run not in once[name]]
    notes = [f"left out, as the same run is there once more: {', '.join(twice)}"] if twice else []
    if by is not None:
        groups = [Group(f"{by} = {name}", tuple(runs)) for name, runs in once.items()]
        notes += [note for group in groups for note in _mixed(group)]
        return groups, notes
    firsts = list(once.values())
    names = [" / ".join(dict.fromkeys(run.name for run in runs)) for runs in firsts]
    flat = [flat_config(runs[0].config) for runs in firsts]
    labels = [label_of(i, names, flat) for i in range(len(names))]
    return [Group(label, tuple(runs)) for label, runs in zip(labels, firsts, strict=True)], notes


def require_two(groups: Sequence[Group], by: str | None = None) -> None:
    """Refuse what is nothing to compare.

    Raises:
        RunnerError: there are not two groups.
    """
    if len(groups) < 2:
        raise RunnerError(_only_one(groups, by))


def metrics_of(groups: Sequence[Group], chosen: Sequence[str] = ()) -> list[tuple[str, str]]:
    """Return the (metric, line) pairs of these names; unless some are chosen, those of evaluation.

    Where there is no evaluation it is those of training.

    Args:
        groups: whose.
        chosen: a metric (`mean_return`, of all its agents), or one of its lines (`mean_return.taxi_1`).

    Raises:
        RunnerError: no run has one of them, or any at all.
    """
    known: dict[str, list[tuple[str, str]]] = {}
    for group in groups:
        for run in group.runs:
            for _, readings in (*run.evaluation, *run.training):
                for metric in readings:
                    for line in readings[metric] if metric != SHARES else ():
                        for name in {metric, f"{metric}.{line}" if line else metric}:
                            lines = known.setdefault(name, [])
                            if (metric, line) not in lines:
                                lines.append((metric, line))
    if not known:
        raise RunnerError(
            "found neither an evaluation nor a report of training in any run, so there is nothing to compare."
        )
    usual = [metric.name for metric in METRICS]
    if not any(metric.name in known for metric in METRICS if metric.requires == "success_events"):
        usual.sort(key=lambda name: name != "mean_return")  # without a goal the return says most
    names = list(chosen)
    for some in (usual, _USUAL_OF_TRAINING):
        names = names or [name for name in some if name in known]
    for name in names:
        if name not in known:
            listed = ", ".join(sorted(known))
            raise RunnerError(f"--metric: found {name!r}, expected one of {listed}.{nearest(name, known)}")
    return list(dict.fromkeys(pair for name in names for pair in known[name]))


def _content(run: RunSeries) -> str:
    return json.dumps({k: v for k, v in run.config.items() if k not in _NOT_COMPARED}, sort_keys=True)


def _value_at(path: str, series: Sequence[RunSeries]) -> Callable[[RunSeries], str]:
    """Return what gives a run's value at a path of the configuration, as JSON."""
    known = [_paths(run.config) for run in series]
    if not any(path in paths for paths in known):
        names = sorted({name for paths in known for name in paths})
        raise RunnerError(
            f"--by: found {path!r}, expected a path of the configuration such as discount or "
            f"evaluation.trials; `dualtaxi config check` prints all.{nearest(path, names)}"
        )
    return lambda run: json.dumps(_paths(run.config).get(path), sort_keys=True)


def _paths(values: Any, prefix: str = "") -> dict[str, Any]:
    """Return all values of a configuration by dotted path, mappings as well."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        found[f"{prefix}{key}"] = value
        if isinstance(value, dict):
            found |= _paths(value, f"{prefix}{key}.")
    return found


def _mixed(group: Group) -> list[str]:
    """Return a note if a group's runs differ in more than the seed, or several have the same seed."""
    configurations = {_content(run) for run in group.runs}
    if len(configurations) == 1:
        return []
    return [f"{group.label} has runs of {len(configurations)} configurations"]


def _only_one(groups: Sequence[Group], by: str | None) -> str:
    (group,) = groups
    if len(group.runs) == 1:
        return (
            f"found one run, {group.runs[0].run_id}, expected at least two to compare; a job that "
            "was run twice counts once, and runner.record's `config` tells loops apart."
        )
    if by is not None:
        return f"found {len(group.runs)} runs, all with {group.label}, expected two values at least."
    return (
        f"found {len(group.runs)} runs of one configuration, {group.label}, expected two configurations at "
        "least; `dualtaxi plot` draws their median, `dualtaxi ls` lists what there is."
    )
