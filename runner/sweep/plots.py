"""What the plots of a sweep show: trials along each parameter, and how the best and the median learned."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from runner.analysis.compare.statistics import NEVER
from runner.analysis.groups import Group
from runner.analysis.series import read_series
from runner.archive.places import at_hand
from runner.errors import RunnerError
from runner.export.plots.metrics import Panel, panels_of
from runner.recording.reader import open_recording
from runner.runs.resolve import find_run
from runner.sweep.model import Range
from runner.sweep.results import Ranked, Results, spoken


@dataclass(frozen=True)
class Axis:
    """A parameter, as what is drawn along it stands."""

    path: str
    choices: tuple[str, ...]
    """Of a list, in words; empty for a range."""
    log: bool
    values: tuple[float, ...]
    """Where each trial of the picture stands: its number, or which choice it took."""


@dataclass(frozen=True)
class Picture:
    """Trials that came to something, and their parameters."""

    trials: tuple[Ranked, ...]
    """The best first."""
    axes: tuple[Axis, ...]
    objective: str
    """What is drawn upwards."""
    lower_is_better: bool
    log: bool
    """Whether the objective's values lie over magnitudes."""
    left_out: int
    """Trials without a value that can be drawn."""

    @property
    def values(self) -> tuple[float, ...]:
        """The median of each trial."""
        return tuple(float(trial.median or 0.0) for trial in self.trials)

    @property
    def ranges(self) -> tuple[tuple[float, float], ...]:
        """The lowest and the highest seed of each trial."""
        return tuple((float(trial.low or 0.0), float(trial.high or 0.0)) for trial in self.trials)

    @property
    def footnote(self) -> str:
        """What dots and bars are, and what is missing."""
        pruned = any(trial.state == "pruned" for trial in self.trials)
        hollow = " A hollow one was given up: it stands where it was then." if pruned else ""
        left = f" {self.left_out} trials without a value are left out." if self.left_out else ""
        return (
            "A dot is a trial: the median over its seeds; the bar goes from its lowest to its highest."
            f"{hollow}{left}"
        )


def picture_of(results: Results) -> Picture:
    """Return what the plots of a sweep show.

    Raises:
        RunnerError: no trial came to anything yet.
    """
    drawn = tuple(entry for entry in results.ranking if _drawable(entry))
    if not drawn:
        raise RunnerError(_nothing_to_draw(results))
    axes = tuple(_axis(path, parameter, drawn) for path, parameter in results.sweep.file.parameters.items())
    values = [value for entry in drawn for value in (entry.low, entry.high) if value is not None]
    objective = results.sweep.objective
    at = f"first at {objective.level:g}, episodes" if objective.at == "first_over" else objective.at
    return Picture(
        drawn,
        axes,
        f"{objective.metric}, {at}",
        objective.direction == "minimize",
        min(values) > 0 and max(values) > 30 * min(values),
        len(results.ranking) - len(drawn),
    )


def learning(results: Results, recordings: Path) -> tuple[list[Group], list[Panel]]:
    """Return the runs of the median and of the best trial, and their metrics over episodes.

    Raises:
        RunnerError: no trial is finished yet, or a run cannot be read.
    """
    finished = [entry for entry in results.ranking if entry.state == "finished"]
    if not finished:
        raise RunnerError(_nothing_to_draw(results))
    chosen = {"median": finished[len(finished) // 2], "best": finished[0]}
    groups = [_group(told, entry, recordings) for told, entry in chosen.items()]
    return groups, panels_of(groups)


def panel_of(objective: str, panels: Sequence[Panel]) -> Panel:
    """Return the panel of an objective's metric; the first one if it has none of its own."""
    alike = [panel for panel in panels if objective.startswith(panel.metric)]
    return max(alike, key=lambda panel: len(panel.metric)) if alike else panels[0]


def _group(told: str, entry: Ranked, recordings: Path) -> Group:
    series = []
    for run_id in entry.runs.values():
        with open_recording(at_hand(find_run(run_id, recordings)).recording) as recording:
            series.append(read_series(recording))
    values = ", ".join(f"{path} {spoken(value)}" for path, value in entry.values.items())
    return Group(f"{told}, trial {entry.number}: {values}", tuple(series))


def _nothing_to_draw(results: Results) -> str:
    finished = sum(entry.state == "finished" for entry in results.ranking)
    objective = results.sweep.objective
    why = (
        f"none of its {finished:,} finished trials came to {objective.description}"
        if finished
        else "it has no finished trial yet"
    )
    return f"the sweep {results.sweep.name!r}: nothing to draw, as {why}."


def _drawable(entry: Ranked) -> bool:
    known = [value for value in (entry.median, entry.low, entry.high) if value is not None]
    return len(known) == 3 and all(math.isfinite(value) and abs(value) < NEVER for value in known)


def _axis(path: str, parameter: Range | list[Any], trials: Sequence[Ranked]) -> Axis:
    if isinstance(parameter, Range):
        return Axis(path, (), parameter.log, tuple(float(entry.values[path]) for entry in trials))
    choices = [json.dumps(choice) for choice in parameter]
    places = tuple(float(choices.index(json.dumps(entry.values[path]))) for entry in trials)
    return Axis(path, tuple(map(spoken, parameter)), False, places)
