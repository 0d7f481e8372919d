"""The trials of a sweep as charts: along each parameter, in parallel coordinates, on a sheet, in a page."""

from __future__ import annotations

import itertools
import json
import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np

from runner.analysis.groups import Group, Panel
from runner.analysis.sections import Figure, LegendEntry, Section, SourceFile
from runner.analysis.series import series_of
from runner.analysis.statistics import NEVER
from runner.archive.places import at_hand
from runner.drawing import palette
from runner.errors import RunnerError
from runner.export.plots.chart import SMALL, Canvas, Chart, Scale, labelled, series_colour
from runner.export.plots.curves import HEIGHT, WIDTH, curves_section, panel_chart
from runner.export.reports.rendering import render
from runner.runs.resolve import find_run
from runner.sweep.model import Parameter, Range
from runner.sweep.results import Ranked, Results, value_text, values_text
from runner.util.arrays import Floats

_TRIAL: Final = series_colour(0)
_BEST: Final = series_colour(1)
_MAX_NOTE_LENGTH: Final = 175
"""Characters of a note that fit on a line of a sheet."""


@dataclass(frozen=True, eq=False)
class ParameterAxis:
    """A parameter of a sweep, and the values that its trials have."""

    path: str
    choices: tuple[str, ...]
    """The values of a list as text; empty for a range."""
    log: bool
    values: Floats
    """The value of each trial, or the number of its choice; NaN where its algorithm does not use it."""


@dataclass(frozen=True, eq=False)
class DrawnTrials:
    """The trials that charts show, and their parameters."""

    trials: tuple[Ranked, ...]
    """The best first."""
    axes: tuple[ParameterAxis, ...]
    values: Floats
    """The median of each trial."""
    ranges: Floats
    """[trials, 2]: the lowest and the highest seed of each trial."""
    objective: str
    lower_is_better: bool
    log: bool
    """Whether the objective is drawn on a logarithmic scale."""
    left_out: int
    """Number of trials without a value that can be drawn."""

    @property
    def footnote(self) -> str:
        """The meaning of dots and bars, and the trials that are not drawn."""
        text = "A dot is a trial: the median over its seeds; the bar goes from its lowest to its highest."
        if any(trial.state == "pruned" for trial in self.trials):
            text += " A hollow one was pruned: it shows the value at that time."
        if self.left_out:
            text += f" {self.left_out} trials without a value are left out."
        return text


def drawn_trials(results: Results) -> DrawnTrials:
    """Return the trials of a sweep that can be drawn.

    Raises:
        RunnerError: no trial has a result yet.
    """
    figures = np.array([(trial.median, trial.low, trial.high) for trial in results.ranking], np.float64)
    figures = figures.reshape(-1, 3)
    is_drawn = np.all(np.abs(figures) < NEVER, axis=1)  # None is NaN, and not drawn
    trials = tuple(itertools.compress(results.ranking, is_drawn.tolist()))
    if not trials:
        raise RunnerError(_nothing_to_draw(results))
    parameters = results.sweep.file.parameters
    objective = results.sweep.objective
    values = figures[is_drawn, 0]
    ranges = figures[is_drawn, 1:]
    at = f"first at {objective.level:g}, episodes" if objective.at == "first_over" else objective.at
    return DrawnTrials(
        trials=trials,
        axes=tuple(
            _axis(path, parameter, trials)
            for path, parameter in parameters.items()
            if any(path in trial.values for trial in trials)
        ),
        values=values,
        ranges=ranges,
        objective=f"{objective.metric}, {at}",
        lower_is_better=objective.direction == "minimize",
        log=bool(0 < 30 * ranges.min() < ranges.max()),
        left_out=len(results.ranking) - len(trials),
    )


def learning(results: Results, recordings: Path) -> list[Group]:
    """Return the runs of the median and of the best trial.

    Raises:
        RunnerError: no trial is finished yet, or a run cannot be read.
    """
    finished = [trial for trial in results.ranking if trial.state == "finished"]
    if not finished:
        raise RunnerError(_nothing_to_draw(results))
    groups = []
    for name, trial in (("median", finished[len(finished) // 2]), ("best", finished[0])):
        runs = (at_hand(find_run(run_id, recordings)) for run_id in trial.runs.values())
        series = series_of(run.recording for run in runs)
        values = values_text(trial.values)
        groups.append(Group(f"{name}, trial {trial.number}: {values}", tuple(series)))
    return groups


def panel_of(objective: str, panels: Sequence[Panel]) -> Panel:
    """Return the panel of an objective's metric; the first one if it has no panel of its own."""
    matching = [panel for panel in panels if objective.startswith(panel.metric)]
    return max(matching, key=lambda panel: len(panel.metric)) if matching else panels[0]


def _nothing_to_draw(results: Results) -> str:
    finished = sum(trial.state == "finished" for trial in results.ranking)
    reason = "it has no finished trial yet"
    if finished:
        reason = f"none of its {finished:,} finished trials reached {results.sweep.objective.description}"
    return f"the sweep {results.sweep.name!r}: nothing to draw, as {reason}."


def _axis(path: str, parameter: Parameter, trials: Sequence[Ranked]) -> ParameterAxis:
    if isinstance(parameter, Range):
        return ParameterAxis(
            path, (), parameter.log, np.array([trial.values.get(path, np.nan) for trial in trials])
        )
    choices = list(map(json.dumps, parameter))
    numbers = [
        choices.index(json.dumps(trial.values[path])) if path in trial.values else np.nan for trial in trials
    ]
    return ParameterAxis(path, tuple(map(value_text, parameter)), False, np.array(numbers))


def sweep_sheet(title: str, drawn: DrawnTrials, groups: Sequence[Group], panel: Panel) -> Canvas:
    """Return one sheet: the objective along each parameter, parallel coordinates, and learning curves.

    The curves are those of groups of runs, in one panel.
    """
    parameters = [parameter_chart(drawn, axis) for axis in drawn.axes]
    columns = 2 if len(parameters) in (2, 4) else min(3, len(parameters))
    row_height = max(chart.height for chart in parameters)
    parallel = parallel_chart(drawn)
    curves = panel_chart(panel, len(groups))
    notes = [(line, palette.INK) for line in textwrap.wrap(drawn.footnote, _MAX_NOTE_LENGTH)]
    for number, group in enumerate(groups):
        lines = textwrap.wrap(group.label, _MAX_NOTE_LENGTH, subsequent_indent="    ")
        notes += [(line, series_colour(number)) for line in lines]
    rows = math.ceil(len(parameters) / columns)
    below = 32.0 + row_height * rows + parallel.height
    width = max(WIDTH * columns, parallel.width + WIDTH if columns == 3 else parallel.width)
    side_by_side = width >= parallel.width + WIDTH
    curves_at = (parallel.width, below - HEIGHT - 20) if side_by_side else (0.0, below)
    end = below if side_by_side else below + HEIGHT
    sheet = Canvas(width, end + 16 + 11 * len(notes), title)
    sheet.text(10, 20, title, size=13, bold=True)
    for number, chart in enumerate(parameters):
        row, column = divmod(number, columns)
        sheet.place(chart, WIDTH * column, 32 + row_height * row)
    sheet.place(parallel, 0, below - parallel.height)
    sheet.place(curves, *curves_at)
    for number, (line, colour) in enumerate(notes):
        sheet.text(10, end + 12 + 11 * number, line, size=SMALL, colour=colour)
    return sheet


def parameter_chart(drawn: DrawnTrials, axis: ParameterAxis) -> Chart:
    """Return the objective of the trials against a parameter, the best trial in another colour.

    Pruned trials are hollow.
    """
    is_used = ~np.isnan(axis.values)
    values, ranges, x = drawn.values[is_used], drawn.ranges[is_used], axis.values[is_used]
    labels = [textwrap.shorten(choice, 24) for choice in axis.choices]
    slanted = sum(map(len, labels)) > 28
    bottom, height = (144.0, 210.0) if slanted else (146.0, 187.0)
    across = Scale.around(x, 62.0, 280.0, log=axis.log)
    if labels:
        across = Scale(-0.5, len(labels) - 0.5, 62.0, 280.0)
    up = Scale.around(ranges, bottom, 24.0, log=drawn.log)
    chart = Chart(across, up, WIDTH, height, f"{drawn.objective} against {axis.path}")
    chart.x_ticks(list(enumerate(labels)) if labels else labelled(across.ticks), slanted)
    chart.y_ticks(labelled(up.ticks, float(np.abs(ranges).max()) >= 10_000))
    better = "lower" if drawn.lower_is_better else "higher"
    chart.frame(axis.path, 14.0, "", [*textwrap.wrap(drawn.objective, 30)[:2], f"({better} is better)"])
    for place, ends in zip(chart.x(x).tolist(), chart.y(ranges).tolist(), strict=True):
        chart.shape([(place, end) for end in ends], stroke=_TRIAL, width=0.8, opacity=0.25)
    is_best = (np.arange(len(is_used)) == 0)[is_used]
    is_finished = np.array([trial.state == "finished" for trial in drawn.trials])[is_used]
    for state, hollow in ((is_finished, False), (~is_finished, True)):
        selected = state & ~is_best
        chart.markers(x[selected], values[selected], _TRIAL, 0, 1.7, opacity=0.6, hollow=hollow)
    chart.markers(x[is_best], values[is_best], _BEST, 3, 4.0)
    return chart


def parallel_chart(drawn: DrawnTrials) -> Chart:
    """Return parallel coordinates: each trial a line over all parameters to its objective."""
    axes = [*drawn.axes, ParameterAxis(drawn.objective, (), drawn.log, drawn.values)]
    lines = np.array([_unit(axis.values, axis.log, axis.choices) for axis in axes]).T
    places = np.arange(len(axes), dtype=np.float64)
    x = Scale(-0.1, len(axes) - 0.75, 10.0, 580.0)
    chart = Chart(x, Scale(-0.05, 1.05, 186.0, 24.0), 590.0, 216.0, "The trials in parallel coordinates")
    for number, opacity in reversed(list(enumerate(np.linspace(0.9, 0.35, len(lines)).tolist()))):
        _trial_line(chart, lines[number], _TRIAL, 0.9, opacity)
    _trial_line(chart, lines[0], _BEST, 2.2, 1.0)
    title = "Each trial is a line, the best one thick; strong lines are better than faint ones"
    chart.text(10.0, 14.0, title, size=9.5, bold=True)
    for place, axis in zip(chart.x(places).tolist(), axes, strict=True):
        chart.shape([(place, 24), (place, 186)], stroke=palette.INK, width=0.7)
        for row, part in enumerate(textwrap.wrap(axis.path.replace(".", ". "), 24)[:2]):
            text = part.replace(". ", ".")
            side = "start" if place < 60 else "end" if place > 500 else "middle"
            chart.text({"start": 10.0, "end": 585.0}.get(side, place), 198.0 + 10 * row, text, side)
    for column, axis in enumerate(axes):
        _label_column(chart, column, axis)
    return chart


def _trial_line(chart: Chart, heights: Floats, colour: str, width: float, opacity: float) -> None:
    """Draw a trial over the parameters that it uses."""
    is_used = ~np.isnan(heights)
    places = np.flatnonzero(is_used).astype(np.float64)
    chart.line(places, heights[is_used], colour, width=width, opacity=opacity)


def _label_column(chart: Chart, column: int, axis: ParameterAxis) -> None:
    """Write the choices, or the lowest and the highest value, next to an axis of parallel coordinates."""
    if axis.choices:
        ends = np.arange(len(axis.choices), dtype=np.float64)
        texts = [textwrap.shorten(choice, 18) for choice in axis.choices]
    else:
        ends = np.array([np.nanmin(axis.values), np.nanmax(axis.values)])
        texts = [f"{end:,.4g}" for end in ends]
    heights = _unit(ends, axis.log, axis.choices).tolist()
    for height, text in dict(zip(heights, texts, strict=True)).items():
        chart.text(chart.x.at(column) + 5, chart.y.at(height) + 2.8, text, size=SMALL, halo=True)


def _unit(values: Floats, log: bool, choices: tuple[str, ...]) -> Floats:
    """Return the places of values between the lowest, 0, and the highest, 1."""
    if choices:
        return values / max(len(choices) - 1, 1)
    scaled = np.log(values) if log else values
    lowest, highest = np.nanmin(scaled), np.nanmax(scaled)
    if lowest == highest:
        return np.where(np.isnan(scaled), np.nan, 0.5)
    return np.asarray((scaled - lowest) / (highest - lowest))


# --- the page -----------------------------------------------------------------------------------------


def render_sweep(results: Results, recordings: Path) -> str:
    """Return the page of a sweep whose runs are in a recordings folder."""
    ranking, *others = results.sections()
    return render(
        ranking.title,
        ranking.sentences,
        [
            parameters_section(drawn_trials(results)),
            learning_section(learning(results, recordings)),
            replace(ranking, title="Ranking", sentences=[]),
            *others,
            best_section(results),
        ],
        f"the recordings of these runs, {datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
    )


def parameters_section(drawn: DrawnTrials) -> Section:
    """Return the trials for a page: along each parameter, and in parallel coordinates."""
    along = [Figure(parameter_chart(drawn, axis).svg()) for axis in drawn.axes]
    parallel = Figure(parallel_chart(drawn).svg(), is_wide=True)
    return Section("Parameters", [drawn.footnote], figures=[*along, parallel])


def learning_section(groups: Sequence[Group]) -> Section:
    """Return the learning curves of some trials for a page."""
    parts = (group.described.partition(", ") for group in groups)
    return curves_section(groups, legend=[LegendEntry(trial, rest) for trial, _, rest in parts])


def best_section(results: Results) -> Section:
    """Return the best configuration for a page."""
    how = (
        "Save it as a file, and `dualtaxi run FILE` runs it; `dualtaxi sweep show NAME --write-best FILE` "
        "writes it."
    )
    file = SourceFile(f"{results.sweep.name}_best.yaml", "", results.best_yaml or "No trial is finished yet.")
    return Section("The best configuration", [how], sources=[file])
