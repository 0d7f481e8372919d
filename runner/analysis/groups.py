"""Groups of runs whose configurations differ in nothing but the seed."""

from __future__ import annotations

import json
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from runner.analysis.axes import Axis
from runner.analysis.series import RunSeries
from runner.errors import RunnerError, nearest
from runner.recording.metrics import METRICS, SHARES
from runner.util.humanize import listed, setting
from runner.util.values import flatten

_NOT_CONTENT: Final = ("seeds", "recording", "name")
_TRAINING_METRICS: Final = ("training.mean_return", "training.mean_reward", "training.mean_length")


@dataclass(frozen=True)
class Group:
    """Runs of one configuration."""

    label: str
    runs: tuple[RunSeries, ...]
    left_out: tuple[str, ...] = ()
    """The ids of runs that repeat one of these."""

    @property
    def axis(self) -> Axis:
        """The axis over which its runs were read."""
        return self.runs[0].axis

    @property
    def described(self) -> str:
        """The label and the runs: `quick, 3 runs (k3v9m2xq seed 0, ...)`."""
        shown = listed(
            [
                run.run_id
                + ("" if run.seed is None else f" seed {run.seed}")
                + ("" if run.finished else f", {run.status}")
                for run in self.runs
            ]
        )
        count = f"{len(self.runs)} runs: " if len(self.runs) > 1 else "run "
        again = f"; left out, as they are the same: {listed(self.left_out)}" if self.left_out else ""
        return f"{self.label} ({count}{shown}{again})"


def groups_of(series: Sequence[RunSeries]) -> list[Group]:
    """Return the runs by name and configuration, in the order given, labelled by name and by what differs.

    A run that was recorded twice counts once, or it would weigh twice in a median: of a job's runs of one
    seed the finished and then the last given counts; of loops, which a seed need not distinguish, the last of
    those of one content.
    """
    by_content: dict[Hashable, list[RunSeries]] = {}
    for run in series:
        by_content.setdefault((run.name, _content(run)), []).append(run)
    runs_of = list(by_content.values())
    return _labelled(runs_of, [runs[0].name for runs in runs_of])


def grouped(
    series: Sequence[RunSeries], by: str | None = None, across_tasks: bool = False
) -> tuple[list[Group], list[str]]:
    """Return runs in groups for a comparison, and notes on them, a sentence each.

    A group has the runs whose configurations differ in nothing but the seed, whatever their names and however
    they were recorded; or, with `by`, those that have the same value there. A job that was run twice
    counts once, as in `groups_of`. Several loops of one configuration and seed, such as the workers of one
    training, all count: the value of their seed is the mean over them.

    Args:
        series: the runs.
        by: path of a configuration's value, such as `quirks.epsilon_exploits`.
        across_tasks: whether runs in different environments are one group, if nothing else differs.

    Raises:
        RunnerError: no run has a value of that path.
    """
    by_value: dict[str, list[RunSeries]] = {}
    content = _content_without_task if across_tasks else _content
    key = content if by is None else _value_at(by, series)
    for run in series:
        by_value.setdefault(key(run), []).append(run)
    if by is None:
        names = [" / ".join(dict.fromkeys(run.name for run in runs)) for runs in by_value.values()]
        groups = _labelled(list(by_value.values()), names)
    else:
        groups = [_group(f"{by} = {value}", runs) for value, runs in by_value.items()]
    notes = duplicates(groups)
    for group in groups:
        if (count := len({content(run) for run in group.runs})) > 1:
            notes.append(f"{group.label} has runs of {count} configurations")
    return groups, notes


def require_two(groups: Sequence[Group], by: str | None = None) -> None:
    """Refuse a single group.

    Raises:
        RunnerError: there are not two groups.
    """
    if len(groups) > 1:
        return
    (group,) = groups
    count = len(group.runs)
    if count == 1:
        raise RunnerError(
            f"found one run, {group.runs[0].run_id}, expected at least two to compare; a job that "
            "was run twice counts once, and runner.record's `config` distinguishes loops."
        )
    if by is not None:
        raise RunnerError(f"found {count} runs, all with {group.label}, expected two values at least.")
    raise RunnerError(
        f"found {count} runs of one configuration, {group.label}, expected two configurations at "
        "least; `dualtaxi plot` draws them as one line, `dualtaxi ls` lists what there is."
    )


def duplicates(groups: Sequence[Group]) -> list[str]:
    """Return a sentence about the runs that are left out because they repeat others, if there are any."""
    left_out = [run_id for group in groups for run_id in group.left_out]
    return [f"left out, as the same run is there: {listed(left_out)}"] if left_out else []


def metrics_of(groups: Sequence[Group], chosen: Sequence[str] = ()) -> list[tuple[str, str]]:
    """Return the (metric, line) pairs to compare: those chosen, or those of evaluations, or of training.

    Args:
        groups: the runs.
        chosen: metrics (`mean_return`, of all its agents), or single lines of them (`mean_return.taxi_1`).

    Raises:
        RunnerError: no run has one of them, or any at all.
    """
    by_name: dict[str, list[tuple[str, str]]] = {}
    pairs = {
        (metric, line): None
        for group in groups
        for run in group.runs
        for _, readings in (*run.evaluation, *run.training)
        for metric, lines in readings.items()
        for line in (lines if metric != SHARES else ())
    }
    for metric, line in pairs:
        for name in {metric, f"{metric}.{line}" if line else metric}:
            by_name.setdefault(name, []).append((metric, line))
    if not by_name:
        raise RunnerError(
            "found neither an evaluation nor a report of training in any run, so there is nothing to compare."
        )
    usual = [metric.name for metric in METRICS]
    if not any(metric.name in by_name for metric in METRICS if metric.requires == "success_events"):
        usual.sort(key=lambda name: name != "mean_return")  # without a goal the return says most
    names = list(chosen)
    for some in (usual, _TRAINING_METRICS):
        names = names or [name for name in some if name in by_name]
    for name in names:
        if name not in by_name:
            expected = ", ".join(sorted(by_name))
            raise RunnerError(f"metric: found {name!r}, expected one of {expected}.{nearest(name, by_name)}")
    return list(dict.fromkeys(pair for name in names for pair in by_name[name]))


def flat_config(config: Mapping[str, object]) -> dict[str, object]:
    """Return the values of a configuration by dotted key, but for its name and seeds."""
    return {key: value for key, value in flatten(config).items() if key not in ("seeds", "name")}


# --- inside -------------------------------------------------------------------------------------------


def _content(run: RunSeries) -> str:
    return json.dumps({k: v for k, v in run.config.items() if k not in _NOT_CONTENT}, sort_keys=True)


def _content_without_task(run: RunSeries) -> str:
    """Return the configuration without the environment, and without values that repeat its id."""
    names = {run.environment, run.config.get("env", {}).get("id", run.environment)}

    def stripped(value: object) -> object:
        if not isinstance(value, Mapping):
            return value
        return {
            key: stripped(own) for key, own in value.items() if not (isinstance(own, str) and own in names)
        }

    config = {k: stripped(v) for k, v in run.config.items() if k not in (*_NOT_CONTENT, "env")}
    return json.dumps(config, sort_keys=True)


def _group(label: str, runs: Sequence[RunSeries]) -> Group:
    """Return a group of these runs, each once: of repetitions the last given, finished ones first."""
    best: dict[Hashable, RunSeries] = {}
    for run in runs:
        # A job follows from its seed; loops need their content, as workers of one training share a seed.
        identity = run.seed if run.can_train_again else run.content_digest or run.run_id
        key = (_content(run), identity)
        if key not in best or run.finished >= best[key].finished:
            best[key] = run
    unique = tuple(best.values())
    return Group(label, unique, tuple(run.run_id for run in runs if run not in unique))


def _labelled(runs_of: Sequence[Sequence[RunSeries]], names: Sequence[str]) -> list[Group]:
    """Return a group for each sequence of runs, labelled by its name and the values in which it differs."""
    flat = [flat_config(runs[0].config) for runs in runs_of]
    groups = []
    for name, own, runs in zip(names, flat, runs_of, strict=True):
        same = [values for values, other in zip(flat, names, strict=True) if other == name]
        differing = [
            key
            for key in sorted({key for values in same for key in values})
            if not key.startswith("recording.")
            and any(values.get(key) != same[0].get(key) for values in same)
        ]
        if "env.id" in differing:  # the values that repeat it, such as config.env_id, say nothing more
            differing = [
                key
                for key in differing
                if key == "env.id"
                or any(
                    values.get(key) not in (env_id := str(values.get("env.id")), env_id.rpartition(":")[2])
                    for values in same
                )
            ]
        values = ", ".join(f"{key}={setting(own[key])}" for key in differing if key in own)
        groups.append(_group(f"{name}, {values}" if values else name, runs))
    return groups


def _value_at(path: str, series: Sequence[RunSeries]) -> Callable[[RunSeries], str]:
    """Return a function that returns a run's value at a path of the configuration, as JSON."""

    def paths(values: Mapping[str, object], prefix: str = "") -> dict[str, object]:
        by_path: dict[str, object] = {}
        for key, value in values.items():
            by_path[f"{prefix}{key}"] = value
            if isinstance(value, Mapping):
                by_path |= paths(value, f"{prefix}{key}.")
        return by_path

    all_paths = {name for run in series for name in paths(run.config)}
    if path not in all_paths:
        raise RunnerError(
            f"by: found {path!r}, expected a path of the configuration such as discount or "
            f"evaluation.trials; `dualtaxi config check` prints all.{nearest(path, sorted(all_paths))}"
        )
    return lambda run: json.dumps(paths(run.config).get(path), sort_keys=True)
