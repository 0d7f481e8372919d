"""Runs by configuration: those belong together whose configurations differ in nothing but the seed."""

from __future__ import annotations

import json
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from runner.analysis.series import RunSeries, is_loop
from runner.util.humanize import listed
from runner.util.values import flatten


@dataclass(frozen=True)
class Group:
    """Runs of one configuration."""

    label: str
    runs: tuple[RunSeries, ...]
    left_out: tuple[str, ...] = ()
    """The ids of runs that are one of these once more."""

    @property
    def described(self) -> str:
        """Its label, and which runs they are: `quick, 3 runs (k3v9m2xq seed 0, ...)`."""
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
    """Return the runs by configuration, in the order given, labelled by name and by what differs.

    A run that was recorded twice counts once, lest it weigh twice in a median: of a job's runs of one seed
    the finished and then the last given counts; of somebody's own loops, which a seed need not tell apart,
    the last of those of one content.
    """
    found: dict[str, list[RunSeries]] = {}
    for run in series:
        content = {key: value for key, value in run.config.items() if key not in ("seeds", "recording")}
        found.setdefault(f"{run.name} {json.dumps(content, sort_keys=True)}", []).append(run)
    flat = [flat_config(runs[0].config) for runs in found.values()]
    names = [runs[0].name for runs in found.values()]
    labels = [label_of(i, names, flat) for i in range(len(names))]
    once = [each_once(runs, sameness) for runs in found.values()]
    return [
        Group(label, tuple(kept), tuple(run.run_id for run in runs if run not in kept))
        for label, kept, runs in zip(labels, once, found.values(), strict=True)
    ]


def each_once(runs: Sequence[RunSeries], same: Callable[[RunSeries], Hashable]) -> list[RunSeries]:
    """Return of the runs that are the same one run: a finished one if there is one, the last given."""
    best: dict[Hashable, RunSeries] = {}
    for run in runs:
        key = same(run)
        if key not in best or run.finished >= best[key].finished:
            best[key] = run
    return list(best.values())


def left_out(groups: Sequence[Group]) -> list[str]:
    """Return what is to be said of runs that are there twice: a sentence, or nothing."""
    twice = [run_id for group in groups for run_id in group.left_out]
    return [f"left out, as the same run is there: {listed(twice)}"] if twice else []


def sameness(run: RunSeries) -> Hashable:
    """Return what is equal for two runs of one configuration only if one repeats the other.

    A job follows from its seed. Of loops only the content tells: workers of one training share a seed.
    """
    return run.content_digest or run.run_id if is_loop(run) else run.seed


def label_of(own: int, names: Sequence[str], flat: Sequence[Mapping[str, Any]]) -> str:
    """Return a group's name, with the values in which it differs from others of that name."""
    same = [flat[i] for i, name in enumerate(names) if name == names[own]]
    keys = sorted({key for other in same for key in other if key not in ("name", "seeds")})
    differing = [key for key in keys if any(other.get(key) != same[0].get(key) for other in same)]
    told = ", ".join(f"{key}={flat[own].get(key)}" for key in differing if not key.startswith("recording."))
    return f"{names[own]}, {told}" if told else names[own]


def flat_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a configuration by dotted key, without name and seeds."""
    return flatten({key: value for key, value in config.items() if key not in ("seeds", "name")})
