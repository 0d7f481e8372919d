"""Every metric of a run as Rerun time series, and how their lines are drawn."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from typing import Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from runner.drawing import palette
from runner.environments.naming import spoken
from runner.recording import schema
from runner.recording.messages import Message
from runner.recording.metrics import METRICS
from runner.recording.reader import Recording

SCHEDULES: Final = ("epsilon", "step_size", "discount")
TRAINING_MEANS: Final = ("mean_length", "mean_penalties", "mean_return")
"""The metrics of evaluations that training has as well."""
_ONE_PHASE: Final = ("filled_percent", "reward_percent", "events", "episodes")
"""Metrics of several lines whose view shows one phase alone."""

Rows = Sequence[Message]
Colour = tuple[int, int, int]


class MetricWriter:
    """Sends the metrics of a run below an entity path.

    `tint` and `label`, a base colour and a name, tell the lines of runs apart where several are compared.
    """

    def __init__(
        self,
        stream: rr.RecordingStream,
        root: str,
        learners: Sequence[str],
        event_names: Sequence[str],
        tint: str | None = None,
        label: str = "",
    ) -> None:
        self._stream = stream
        self._root = root
        self._learners = [spoken(name) for name in learners]
        self._events = list(event_names)
        self._tint = tint
        self._label = f"{label} " if label else ""
        self.paths: set[str] = set()
        """The entities that were sent, below the root."""

    def send_recorded(self, recording: Recording) -> None:
        """Send every metric of a recording."""
        evaluations = recording.metrics("eval")
        reports = sorted([*recording.metrics("train"), *evaluations], key=lambda row: int(row["log_time"]))
        self.send_training(reports)
        self.send_reward_shares(reports, sorted({reward for row in reports for reward in row["rewards"]}))
        self.send_evaluations(evaluations)
        ends = np.array([row["step"] for row in reports], np.int64)
        # The last row is for episodes that ended after the last report.
        sums = np.zeros((len(reports) + 1, 2 + len(self._learners) + len(self._events)))
        for phase, (_, topic) in schema.PHASES.items():
            for block in recording.blocks(topic):
                self._send_episodes(phase, block)
                if phase == "train":
                    report = np.searchsorted(ends, block["last_step"].astype(np.int64) + 1)
                    ones = np.ones((len(block), 1))
                    parts = (block["penalties"][:, None], ones, block["returns"], block["events"])
                    np.add.at(sums, report, np.concatenate(parts, axis=1))
        self._send_training_means(reports, sums[:-1])

    def send_training(self, rows: Rows) -> None:
        """Send the metrics of training, which both kinds of metrics messages have."""
        if rows:
            self._series("train/metrics/mean_length", rows, [[r["mean_length"]] for r in rows], ["training"])
            filled = self._learners if len(self._learners) > 1 else ["filled"]
            self._series("train/metrics/filled_percent", rows, [r["percent_filled"] for r in rows], filled)
            for name in SCHEDULES:
                self._series(f"train/metrics/{name}", rows, [[r[name]] for r in rows], [spoken(name)])

    def send_reward_shares(self, rows: Rows, rewards: Sequence[float]) -> None:
        """Send the share of each of these rewards in the window of each report."""
        if not rows or not rewards:
            return
        shares = np.zeros((len(rows), len(rewards)))
        for k, row in enumerate(rows):
            total = max(sum(row["reward_counts"]), 1)
            for reward, count in zip(row["rewards"], row["reward_counts"], strict=True):
                shares[k, rewards.index(reward)] = 100.0 * count / total
        self._series("train/metrics/reward_percent", rows, shares, [f"{reward:g}" for reward in rewards])

    def send_evaluations(self, rows: Rows) -> None:
        """Send the results of evaluations, as series and as text."""
        if not rows:
            return
        for metric in METRICS:
            values = np.array([row[metric.field] for row in rows], np.float64).reshape(len(rows), -1)
            names = self._learner_lines("evaluation") if metric.per_agent else ["evaluation"]
            if not np.isnan(values).all():
                self._series(f"eval/metrics/{metric.name}", rows, values, names)
        trials = np.array([[row["trials"]] for row in rows], float)
        counts = np.array([row["events"] for row in rows], float).reshape(len(rows), -1) / trials
        if self._events:
            self._series("eval/metrics/events", rows, counts, [spoken(event) for event in self._events])
        self._send_shared_events("eval", rows, counts, ["evaluation"])
        texts = [
            f"evaluation after {row['episode']:,} episodes: "
            + (f"{row['success_percent']:.1f} % success, " if row["successes"] >= 0 else "")
            + f"{row['eval_mean_length']:.1f} steps and {row['mean_penalties']:.1f} penalties per trial"
            for row in rows
        ]
        columns = rr.TextLog.columns(text=texts, level=["INFO"] * len(texts))
        self._stream.send_columns(f"{self._root}/eval/events", _times(rows), columns)

    def _send_episodes(self, phase: str, block: NDArray[np.void]) -> None:
        """Send length, penalties, returns and events of single episodes."""
        parts = (block["length"][:, None], block["penalties"][:, None], block["returns"], block["events"])
        names = ["length", "penalties", *(f"return {name}" for name in self._learners), *self._events]
        number = "episode" if phase == "train" else "trial"
        times = [
            rr.TimeColumn("step", sequence=block["log_time"].astype(np.int64) // schema.STEP_NANOSECONDS),
            rr.TimeColumn(number, sequence=block["episode"].astype(np.int64)),
        ]
        if len(block):
            self._send(f"{phase}/episodes", times, np.concatenate(parts, axis=1).astype(np.float64), names)

    def _send_training_means(self, rows: Rows, sums: NDArray[np.float64]) -> None:
        """Send means over the training episodes that ended between reports.

        The sums are the penalties, number, returns and events of those episodes, [reports, 2 + learners +
        events].
        """
        some = np.flatnonzero(sums[:, 1] > 0)
        if not len(some):
            return
        rows, means = [rows[k] for k in some.tolist()], sums[some] / sums[some, 1:2]
        self._series("train/metrics/mean_penalties", rows, means[:, :1], ["training"])
        first_event = 2 + len(self._learners)
        returns = means[:, 2:first_event]
        self._series("train/metrics/mean_return", rows, returns, self._learner_lines("training"))
        self._send_shared_events("train", rows, means[:, first_event:], ["training"])

    def _send_shared_events(
        self, phase: str, rows: Rows, counts: NDArray[np.float64], names: Sequence[str]
    ) -> None:
        """Send the events that concern all agents, such as collisions; `counts` is [rows, events]."""
        for k, event in enumerate(self._events):
            if "." not in event:
                self._series(f"{phase}/metrics/{event}s", rows, counts[:, k : k + 1], names)

    def _learner_lines(self, phase: str) -> list[str]:
        return [f"{phase} {name}" for name in self._learners] if len(self._learners) > 1 else [phase]

    def _series(self, path: str, rows: Rows, values: object, names: Sequence[str]) -> None:
        self._send(path, _times(rows), np.asarray(values, np.float64), names)

    def _send(
        self, path: str, times: list[rr.TimeColumn], values: NDArray[np.float64], names: Sequence[str]
    ) -> None:
        entity = f"{self._root}/{path}"
        if path not in self.paths:
            self.paths.add(path)
            self._stream.log(entity, self._style(path, names), static=True)
        self._stream.send_columns(entity, times, rr.Scalars.columns(scalars=values))

    def _style(self, path: str, names: Sequence[str]) -> rr.SeriesLines:
        phase, name = path.split("/", maxsplit=1)[0], path.rsplit("/", maxsplit=1)[-1]
        width = 1.2 if phase == "train" else 2.2
        if name in SCHEDULES:
            number = SCHEDULES.index(name)
            colours = [line_colours(1 + len(SCHEDULES), self._tint)[1 + number]]
            width = 3.0 - number  # visible on top of each other where their values are equal
        elif name in _ONE_PHASE and len(names) > 1:
            colours = line_colours(len(names), self._tint)
        else:
            colours = phase_colours(phase, len(names), self._tint)
        return series_lines([self._label + name for name in names], colours, width)


def line_colours(count: int, tint: str | None = None) -> list[Colour]:
    """Return distinct colours for the lines of a view: shades of a tint if runs are compared, else hues."""
    if tint is not None and count == 1:
        return [palette.rgb(tint)]
    if tint is None and count <= len(palette.SERIES):
        return [palette.rgb(colour) for colour in palette.SERIES[:count]]
    if tint is None:
        shades = [(k / count, (0.4, 0.6)[k % 2], 0.75) for k in range(count)]
    else:
        hue, _, saturation = colorsys.rgb_to_hls(*(part / 255 for part in palette.rgb(tint)))
        shades = [(hue, lightness, saturation) for lightness in np.linspace(0.3, 0.8, count)]
    colours = (colorsys.hls_to_rgb(*shade) for shade in shades)
    return [(round(255 * red), round(255 * green), round(255 * blue)) for red, green, blue in colours]


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


def _times(rows: Rows) -> list[rr.TimeColumn]:
    return [
        rr.TimeColumn("step", sequence=[row["log_time"] // schema.STEP_NANOSECONDS for row in rows]),
        rr.TimeColumn("episode", sequence=[row["episode"] for row in rows]),
    ]
