"""Every metric of a run as Rerun time series, over the whole run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from runner.environments.naming import spoken
from runner.export.rerun.events import evaluation_texts, send_text
from runner.export.rerun.lines import line_colours, phase_colours, series_lines
from runner.recording import schema
from runner.recording.metrics import METRICS, EvaluationMetric
from runner.recording.reader import Recording

SCHEDULES: Final = ("epsilon", "step_size", "discount")
TRAINING_MEANS: Final = ("mean_length", "mean_penalties", "mean_return")
"""The measures of an evaluation that training has as well."""
_ONE_PHASE: Final = ("filled_percent", "reward_percent", "events", "episodes")
"""Metrics of several lines whose view has one phase alone."""

Rows = list[dict[str, Any]]


class MetricWriter:
    """Sends the metrics of a run.

    Args:
        stream: to send to.
        root: entity path of the run; empty for the root.
        learners: their names.
        event_names: of the environment.
        tint: the colour whose shades its lines have, where runs are compared.
        label: name of the run, where runs are compared.
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
        self._named: set[str] = set()

    def training(self, rows: Rows) -> None:
        """Send what training measured of itself: of both kinds of metrics messages."""
        if not rows:
            return
        self._series("train/metrics/mean_length", rows, [[r["mean_length"]] for r in rows], ["training"])
        filled = [name if len(self._learners) > 1 else "filled" for name in self._learners]
        self._series("train/metrics/filled_percent", rows, [r["percent_filled"] for r in rows], filled)
        for name in SCHEDULES:
            self._series(f"train/metrics/{name}", rows, [[r[name]] for r in rows], [name.replace("_", " ")])

    def rewards(self, rows: Rows, known: Sequence[float]) -> None:
        """Send the shares of the rewards in the window of each report."""
        if not rows or not known:
            return
        shares = np.zeros((len(rows), len(known)))
        for k, row in enumerate(rows):
            total = max(sum(row["reward_counts"]), 1)
            for reward, count in zip(row["rewards"], row["reward_counts"], strict=True):
                shares[k, known.index(reward)] = 100.0 * count / total
        names = [f"{reward:g}" for reward in known]
        self._series("train/metrics/reward_percent", rows, shares, names)

    def evaluations(self, rows: Rows) -> None:
        """Send the results of evaluations, as series and as text."""
        if not rows:
            return
        for metric in known_metrics(rows):
            values = np.array([row[metric.field] for row in rows], np.float64).reshape(len(rows), -1)
            names = self._whose("evaluation") if metric.per_agent else ["evaluation"]
            self._series(f"eval/metrics/{metric.name}", rows, values, names)
        counts = np.array([row["events"] for row in rows], float).reshape(len(rows), -1)
        trials = np.array([[row["trials"]] for row in rows], float)
        if self._events:
            self._series(
                "eval/metrics/events", rows, counts / trials, [spoken(name) for name in self._events]
            )
        for name, column in self._collisions(counts):
            self._series(f"eval/metrics/{name}", rows, column / trials, ["evaluation"])
        send_text(
            self._stream,
            f"{self._root}/eval/events",
            _steps(rows),
            np.array([row["episode"] for row in rows]),
            evaluation_texts(rows),
        )

    def episodes(self, phase: str, block: NDArray[np.void]) -> None:
        """Send length, penalties, returns and events of single episodes."""
        if not len(block):
            return
        values = np.concatenate(
            (block["length"][:, None], block["penalties"][:, None], block["returns"], block["events"]), axis=1
        ).astype(np.float64)
        names = ["length", "penalties", *(f"return {name}" for name in self._learners), *self._events]
        times = {"step": block["log_time"].astype(np.int64) // schema.STEP_NANOSECONDS}
        times["episode" if phase == "train" else "trial"] = block["episode"].astype(np.int64)
        self._send(f"{phase}/episodes", times, values, names)

    def training_means(self, rows: Rows, sums: NDArray[np.float64]) -> None:
        """Send means over the episodes that ended between reports.

        Args:
            rows: the reports.
            sums: [reports, 2 + learners + events]: penalties, episodes, returns and events of those episodes.
        """
        some = np.flatnonzero(sums[:, 1] > 0)
        if not len(some):
            return
        rows, means = [rows[k] for k in some], sums[some] / sums[some, 1:2]
        learners = len(self._learners)
        self._series("train/metrics/mean_penalties", rows, means[:, :1], ["training"])
        self._series(
            "train/metrics/mean_return",
            rows,
            means[:, 2 : 2 + learners],
            self._whose("training"),
        )
        for name, column in self._collisions(means[:, 2 + learners :]):
            self._series(f"train/metrics/{name}", rows, column, ["training"])

    def _whose(self, phase: str) -> list[str]:
        """Return the name of each learner's series in a phase."""
        return [f"{phase} {name}" for name in self._learners] if len(self._learners) > 1 else [phase]

    def _collisions(self, counts: NDArray[np.float64]) -> list[tuple[str, NDArray[np.float64]]]:
        """Return the columns of the events that concern all agents."""
        return [(name + "s", counts[:, k : k + 1]) for k, name in enumerate(self._events) if "." not in name]

    def _series(self, path: str, rows: Rows, values: Any, names: Sequence[str]) -> None:
        times = {"step": _steps(rows), "episode": np.array([row["episode"] for row in rows], np.int64)}
        self._send(path, times, np.asarray(values, np.float64), names)

    def _send(
        self,
        path: str,
        times: dict[str, NDArray[np.int64]],
        values: NDArray[np.float64],
        names: Sequence[str],
    ) -> None:
        whole = f"{self._root}/{path}"
        if path not in self._named:
            self._named.add(path)
            self._stream.log(whole, self._style(path, names), static=True)
        columns = rr.Scalars.columns(scalars=values)
        self._stream.send_columns(whole, [rr.TimeColumn(t, sequence=at) for t, at in times.items()], columns)

    def _style(self, path: str, names: Sequence[str]) -> Any:
        phase, name = path.split("/", maxsplit=1)[0], path.rsplit("/", maxsplit=1)[-1]
        if name in SCHEDULES:
            colours = [line_colours(1 + len(SCHEDULES), self._tint)[1 + SCHEDULES.index(name)]]
        elif name in _ONE_PHASE and len(names) > 1:
            colours = line_colours(len(names), self._tint)
        else:
            colours = phase_colours(phase, len(names), self._tint)
        width = 1.2 if phase == "train" else 2.2
        if name in SCHEDULES:  # one over the other where their values are equal
            width = 3.0 - SCHEDULES.index(name)
        return series_lines([self._label + name for name in names], colours, width)


def known_metrics(rows: Rows) -> list[EvaluationMetric]:
    """Return the measures that are known of any of these evaluations."""
    return [metric for metric in METRICS if not np.isnan([row[metric.field] for row in rows]).all()]


def send_metrics(writer: MetricWriter, recording: Recording) -> None:
    """Send every metric of a recording."""
    evaluations = recording.metrics("eval")
    reports = sorted([*recording.metrics("train"), *evaluations], key=lambda row: int(row["log_time"]))
    writer.training(reports)
    writer.rewards(reports, sorted({reward for row in reports for reward in row["rewards"]}))
    writer.evaluations(evaluations)
    ends = np.array([row["step"] for row in reports], np.int64)
    learners, events = len(recording.agents), len(recording.event_names)
    sums = np.zeros((len(reports) + 1, 2 + learners + events))
    for phase, (_, topic) in schema.PHASES.items():
        for block in recording.blocks(topic):
            writer.episodes(phase, block)
            if phase == "train":
                report = np.searchsorted(ends, block["last_step"].astype(np.int64) + 1)
                ones = np.ones(len(block))[:, None]
                parts = (block["penalties"][:, None], ones, block["returns"], block["events"])
                np.add.at(sums, report, np.concatenate(parts, axis=1))
    if reports:
        writer.training_means(reports, sums[:-1])


def _steps(rows: Rows) -> NDArray[np.int64]:
    return np.array([row["log_time"] // schema.STEP_NANOSECONDS for row in rows], np.int64)
