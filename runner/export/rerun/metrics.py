"""Every metric of a job as Rerun time series, and how their lines are drawn."""

from __future__ import annotations

import colorsys
import contextlib
import itertools
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from runner.drawing import palette
from runner.environments.naming import spoken
from runner.errors import RecordingError
from runner.export.rerun.tracks import (
    OVERVIEW,
    PLOTS,
    Colour,
    Times,
    Track,
    TrackView,
    Writer,
    scalars,
    times_of,
)
from runner.recording import schema
from runner.recording.messages import Message
from runner.recording.metrics import METRICS
from runner.recording.reader import Recording
from runner.util.arrays import Array, Floats

SCHEDULES: Final = ("epsilon", "step_size", "discount")
EVENTS: Final = TrackView(
    "events",
    "Events",
    rrb.TextLogView,
    {"columns": rrb.TextLogColumns(timeline_columns=["step"], text_log_columns=["body"])},
)
_ONE_PHASE: Final = ("filled_percent", "reward_percent", "events", "episodes")
"""Metrics of several lines whose view shows one phase alone."""

_FIELDS: Final = {
    "train": {
        "mean_length": "mean_length",
        "filled_percent": "percent_filled",
        **{name: name for name in SCHEDULES},
    },
    "eval": {metric.name: metric.field for metric in METRICS},
}
"""The metrics of each phase, and the fields of a message with their values."""

Lines = tuple[str, Times, Array, Sequence[str]]
"""The path of an entity, its times, the values of its lines, [rows, lines], and their names.

Without names it is one line for the phase, or one for each learner.
"""


def metric_tracks(run: Writer) -> Iterator[Track]:
    """Yield the tracks of all metrics of a job."""
    recording = run.recording
    evaluations = run.recording.eval.all_metrics()
    reports = sorted([*recording.train.all_metrics(), *evaluations], key=lambda row: int(row["log_time"]))
    learners = [spoken(name) for name in recording.agents]
    lines = _reported_lines(reports, evaluations, list(recording.mdp.event_names))
    for path, times, values, given in itertools.chain(lines, _episode_lines(recording, reports, learners)):
        phase, *_, name = path.split("/")
        owners = [f" {learner}" for learner in learners] if values.shape[1] > 1 else [""]
        names = given or [schema.PHASE_NAMES[phase] + owner for owner in owners]
        width = 1.2 if phase == "train" else 2.2
        colours = phase_colours(phase, len(names), run.tint)
        if name in SCHEDULES:
            number = SCHEDULES.index(name)
            names = [spoken(name)]
            colours = [line_colours(1 + len(SCHEDULES), run.tint)[1 + number]]
            width = 3.0 - number  # visible on top of each other where their values are equal
        elif name == "filled_percent":
            names = learners if len(learners) > 1 else ["filled"]
        if name in _ONE_PHASE and len(names) > 1:
            colours = line_colours(len(names), run.tint)
        label = f"{recording.run_id} " if run.tint else ""
        static = [series_lines([label + name for name in names], colours, width)]
        legend = {"plot_legend": rrb.PlotLegend(visible=True)}
        view = TrackView(OVERVIEW, PLOTS[name], options=legend) if name in PLOTS else None
        yield Track(path, times, scalars(values), static, view)
    if evaluations:
        texts = [
            f"evaluation after {row['episode']:,} episodes: "
            + (f"{row['success_percent']:.1f} % success, " if row["successes"] >= 0 else "")
            + f"{row['eval_mean_length']:.1f} steps and {row['mean_penalties']:.1f} penalties per trial"
            for row in evaluations
        ]
        yield log_track("eval/events", _times(evaluations), texts)


def mark_tracks(run: Writer) -> Iterator[Track]:
    """Yield the marks of a run at their steps; those at steps that it does not have are left out."""
    lines, times = [], []
    for mark in run.marks:
        with contextlib.suppress(RecordingError):
            steps = run.recording.phase(mark.phase).episode(mark.episode)
            times.append(steps.one(min(mark.t, len(steps) - 1))["log_time"])
            lines.append(" ".join(["mark", mark.at, mark.text, *map("[{}]".format, mark.tags)]))
    if lines:
        yield log_track("marks", times_of(times), lines)


def log_track(entity: str, times: Times, lines: Sequence[str], levels: Sequence[str] = ()) -> Track:
    """Return a track of lines of the log, by default of the level INFO."""
    columns = rr.TextLog.columns(text=lines, level=levels or ["INFO"] * len(lines))
    return Track(entity, times, columns, view=EVENTS)


def _reported_lines(
    reports: Sequence[Message], evaluations: Sequence[Message], events: Sequence[str]
) -> Iterator[Lines]:
    """Yield what reports state of training, and the results of evaluations."""
    for phase, rows in zip(_FIELDS, (reports, evaluations), strict=True):
        if rows:
            for name, field in _FIELDS[phase].items():
                values = _numbers(rows, field)
                if not np.isnan(values).all():
                    yield f"{phase}/metrics/{name}", _times(rows), values, ()
    counts = [dict(zip(row["rewards"], row["reward_counts"], strict=True)) for row in reports]
    if rewards := sorted({reward for row in counts for reward in row}):
        shares = [[100.0 * row.get(r, 0) / max(sum(row.values()), 1) for r in rewards] for row in counts]
        names = [f"{reward:g}" for reward in rewards]
        yield "train/metrics/reward_percent", _times(reports), np.array(shares), names
    if events and evaluations:
        happened = _numbers(evaluations, "events") / _numbers(evaluations, "trials")
        yield "eval/metrics/events", _times(evaluations), happened, [spoken(event) for event in events]
        yield from _shared_events("eval", _times(evaluations), events, happened)


def _episode_lines(
    recording: Recording, reports: Sequence[Message], learners: Sequence[str]
) -> Iterator[Lines]:
    """Yield every episode, and the means over the training episodes that ended between two reports."""
    events = list(recording.mdp.event_names)
    names = ["length", "penalties", *(f"return {name}" for name in learners), *events]
    ends = np.array([row["step"] for row in reports], np.int64)
    # The last row is for episodes that ended after the last report, the last column counts them.
    sums = np.zeros((len(reports) + 1, len(names) + 1))
    for phase in recording.phases:
        for block in phase.episodes.blocks():
            parts = [block[name] for name in ("length", "penalties", "returns", "events")]
            values = np.column_stack([*parts, np.ones(len(block))])
            is_training = phase.name == "train"
            number = {"episode" if is_training else "trial": block["episode"]}
            yield f"{phase.name}/episodes", times_of(block["log_time"], **number), values[:, :-1], names
            if is_training:
                np.add.at(sums, np.searchsorted(ends, block["last_step"].astype(np.int64) + 1), values)
    some = np.flatnonzero(sums[:-1, -1])
    if len(some):
        means = sums[some] / sums[some, -1:]
        times = _times([reports[k] for k in some.tolist()])
        _, penalties, returns, happened = np.split(means, (1, 2, 2 + len(learners)), axis=1)
        yield "train/metrics/mean_penalties", times, penalties, ()
        yield "train/metrics/mean_return", times, returns, ()
        yield from _shared_events("train", times, events, happened)


def _shared_events(phase: str, times: Times, events: Sequence[str], counts: Floats) -> Iterator[Lines]:
    """Yield the events that concern all agents, such as collisions; `counts` is [rows, events]."""
    for k, event in enumerate(events):
        if "." not in event:
            yield f"{phase}/metrics/{event}s", times, counts[:, [k]], ()


def line_colours(count: int, tint: str | None = None) -> list[Colour]:
    """Return distinct colours for the lines of a view: shades of a tint if runs are compared, else hues."""
    fixed = palette.SERIES if tint is None else (tint,)
    if count <= len(fixed):
        return [palette.rgb(colour) for colour in fixed[:count]]
    if tint is None:
        shades = [(k / count, (0.4, 0.6)[k % 2], 0.75) for k in range(count)]
    else:
        hue, _, saturation = colorsys.rgb_to_hls(*(part / 255 for part in palette.rgb(tint)))
        shades = [(hue, lightness, saturation) for lightness in np.linspace(0.3, 0.8, count)]
    return [tuple(round(255 * part) for part in colorsys.hls_to_rgb(*shade)) for shade in shades]


def phase_colours(phase: str, count: int, tint: str | None = None) -> list[Colour]:
    """Return the colours of the `count` lines that a phase has in a view of training and evaluation."""
    colours = line_colours(2 * count, tint)
    return colours[count:] if phase == "train" else colours[:count]


def series_lines(names: Sequence[str], colours: Sequence[Colour] = (), width: float = 1.2) -> rr.SeriesLines:
    """Return how the lines of an entity are drawn, by default in different hues.

    Where several values fall on one pixel, the lowest and the highest are drawn: Rerun's default, the
    average, is a number that never occurred.
    """
    return rr.SeriesLines(
        names=names,
        colors=colours or line_colours(len(names)),
        widths=[width] * len(names),
        aggregation_policy=rr.components.AggregationPolicy.MinMax,
    )


def _numbers(rows: Sequence[Message], field: str) -> Floats:
    return np.array([row[field] for row in rows], np.float64).reshape(len(rows), -1)


def _times(rows: Sequence[Message]) -> Times:
    return times_of([row["log_time"] for row in rows], episode=np.array([row["episode"] for row in rows]))
