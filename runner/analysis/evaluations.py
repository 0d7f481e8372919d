"""The evaluations of a run, numbered by the training episodes before them, and its reports of training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from runner.analysis.sections import Grid, Paging, Section
from runner.environments.naming import event_in_words, spoken
from runner.errors import NotInRecording
from runner.recording import schema
from runner.recording.messages import Message
from runner.recording.metrics import METRICS, TABLE_METRICS, defined_metrics, is_usable
from runner.recording.reader import Recording
from runner.recording.run_file import EvaluationMetrics, Summary
from runner.util import humanize
from runner.util.arrays import Ints, Records
from runner.util.values import Json, finite

MAX_SPREAD: Final = 20
"""Evaluations printed after a training."""


@dataclass(frozen=True)
class TrainingRecord:
    """A report of training, or how far training was at an evaluation."""

    episode: int
    """Training episodes before it."""
    step: int
    """Training steps before it."""
    mean_length: float | None
    """None before the first episode ends."""
    reward_counts: tuple[tuple[float, int], ...]
    """Each reward of the last steps, and the number of steps that it was paid for."""
    of_tables: Mapping[str, Mapping[str, float]]
    """Fields of `TABLE_METRICS`, by learner, without measures that the recording is older than."""
    epsilon: float
    step_size: float
    discount: float

    def as_json(self) -> Json:
        """Return the record as JSON can hold it."""
        values = {**vars(self), **self.of_tables}
        del values["of_tables"]
        rewards = [{"reward": reward, "steps": steps} for reward, steps in self.reward_counts]
        return {**values, "reward_counts": rewards}


@dataclass(frozen=True)
class EvaluationRecord:
    """The results of an evaluation; a loop's evaluation is its trials between two training episodes."""

    number: int
    episode: int
    """Training episodes before it."""
    step: int
    """Training steps before it."""
    trials: int
    successes: int | None
    """None if the environment does not define success."""
    values: Mapping[str, Mapping[str, float | None]]
    """Metric to its values by agent, or to one value under the empty name; None where unknown."""
    terminations: int
    events: Mapping[str, int]
    """Event to its count over all trials."""
    training: TrainingRecord | None = None
    """How far training was; None for a loop."""
    not_finite: int = 0
    """Number of values of a loop that are left out of the means, because they are not finite."""

    def value(self, metric: str) -> float | None:
        """Return the value of a metric, summed over agents; None if any is unknown."""
        values = self.values[metric].values()
        numbers = [value for value in values if value is not None]
        return sum(numbers) if len(numbers) == len(values) else None

    def summary(self) -> EvaluationMetrics:
        """Return the figures that people quote."""
        return EvaluationMetrics(
            self.episode, self.trials, {metric.name: self.value(metric.name) for metric in METRICS}
        )

    def as_json(self) -> Json:
        """Return the record as JSON can hold it, each metric under its `key`."""
        training = self.training.as_json() if self.training else {}
        for position in ("episode", "step"):
            training.pop(position, None)
        return {
            "evaluation": self.number,
            "episode": self.episode,
            "step": self.step,
            "trials": self.trials,
            "successes": self.successes,
            **{
                metric.key: dict(self.values[metric.name])
                if metric.per_agent
                else self.values[metric.name][""]
                for metric in METRICS
            },
            "terminations": self.terminations,
            **({} if training else {"not_finite": self.not_finite}),
            "events": dict(self.events),
            **({"training": training} if training else {}),
        }


@dataclass(frozen=True)
class Evaluation:
    """The trials of one evaluation."""

    after: int
    """Training episodes before it."""
    train_step: int
    """Training steps before it."""
    start: int
    """First trial, counted over all evaluations."""
    stop: int
    number: int = 0
    """Number of the evaluation from 0, also where a repair lost others."""

    @property
    def trials(self) -> int:
        """How many trials it has."""
        return self.stop - self.start

    @property
    def episodes(self) -> Ints:
        """The numbers of its trials."""
        return np.arange(self.start, self.stop)

    def trial(self, number: int, where: str) -> int:
        """Return the number of a trial, counted from 0, among those of all evaluations."""
        if not 0 <= number < self.trials:
            raise NotInRecording(
                f"{where}: found no trial {number:,} of the evaluation after {self.after:,} episodes; "
                f"it has {self.trials:,}, from 0."
            )
        return self.start + number


def evaluations_of(recording: Recording) -> list[Evaluation]:
    """Return a run's evaluations: those with metrics; of a loop, its trials between training episodes."""
    if recording.eval.has_metrics:
        return [
            Evaluation(
                after=int(metrics["episode"]),
                train_step=int(metrics["step"]),
                start=int(metrics["evaluation"] * metrics["trials"]),
                stop=int((metrics["evaluation"] + 1) * metrics["trials"]),
                number=int(metrics["evaluation"]),
            )
            for metrics in recording.eval.all_metrics()
        ]
    trained, tested = (
        np.concatenate([np.empty(0, np.uint64), *(block["log_time"] for block in phase.episodes.blocks())])
        for phase in recording.phases
    )
    ends = [block["last_step"].astype(np.int64) + 1 for block in recording.train.episodes.blocks()]
    steps = np.concatenate([np.zeros(1, np.int64), *ends])
    episodes = np.searchsorted(trained, tested)
    distinct = np.unique(episodes, return_index=True, return_counts=True)
    return [
        Evaluation(after, int(steps[after]), start, start + trials, number)
        for number, (after, start, trials) in enumerate(
            zip(*(column.tolist() for column in distinct), strict=True)
        )
    ]


def evaluation_after(evaluations: Sequence[Evaluation], episodes: int, where: str) -> Evaluation:
    """Return the evaluation after a number of training episodes."""
    by_episodes = {evaluation.after: evaluation for evaluation in evaluations}
    if episodes in by_episodes:
        return by_episodes[episodes]
    available = "it has none at all."
    if by_episodes:
        nearest = min(by_episodes, key=lambda after: abs(after - episodes))
        available = f"it has {len(by_episodes):,}, the nearest after {nearest:,}."
    raise NotInRecording(f"{where}: found no evaluation after {episodes:,} episodes; {available}")


def evaluation_records(recording: Recording) -> list[EvaluationRecord]:
    """Return the evaluations of a recording, in order.

    The evaluations of a loop are its evaluation episodes between two training episodes; values that are not
    finite are left out of their means.
    """
    agents = recording.agents
    events = recording.environment["event_names"]
    if recording.eval.has_metrics:
        return [evaluation_record(metrics, agents, events) for metrics in recording.eval.all_metrics()]
    trials = recording.eval.episodes.array()
    return [
        _loop_record(recording, evaluation, trials[evaluation.start : evaluation.stop])
        for evaluation in evaluations_of(recording)
    ]


def evaluation_record(metrics: Message, agents: Sequence[str], events: Sequence[str]) -> EvaluationRecord:
    """Return the record of a job's evaluation from its message, in which NaN stands for unknown."""
    unknown = [None] * len(agents)  # of a measure that the recording is older than
    return EvaluationRecord(
        number=metrics["evaluation"],
        episode=metrics["episode"],
        step=metrics["step"],
        trials=metrics["trials"],
        successes=metrics["successes"] if metrics["successes"] >= 0 else None,
        values={
            metric.name: dict(zip(agents, map(finite, metrics[metric.field] or unknown), strict=True))
            if metric.per_agent
            else {"": finite(metrics[metric.field])}
            for metric in METRICS
        },
        terminations=metrics["terminations"],
        events=dict(zip(events, metrics["events"], strict=True)),
        training=_training_record(metrics, agents),
    )


def _loop_record(recording: Recording, evaluation: Evaluation, trials: Records) -> EvaluationRecord:
    agents, environment = recording.agents, recording.environment
    defined = defined_metrics(bool(environment["success_events"]), environment["penalty_below"] is not None)
    of_trials = {metric.name: metric.of_trials(trials) for metric in defined}
    unknown = np.empty(0)
    values = {
        metric.name: dict(zip(agents, map(metric.of_usable, of_trials[metric.name].T), strict=True))
        if metric.per_agent
        else {"": metric.of_usable(of_trials.get(metric.name, unknown))}
        for metric in METRICS
    }
    counts = trials["events"].sum(axis=0, dtype=int).tolist()
    return EvaluationRecord(
        number=evaluation.number,
        episode=evaluation.after,
        step=evaluation.train_step,
        trials=len(trials),
        successes=int(trials["success"].sum()) if environment["success_events"] else None,
        values=values,
        terminations=int(trials["terminated"].sum()),
        events=dict(zip(environment["event_names"], counts, strict=True)),
        not_finite=sum(int((~is_usable(numbers)).sum()) for numbers in of_trials.values()),
    )


def training_records(recording: Recording) -> list[TrainingRecord]:
    """Return the reports of training of a job, in order."""
    agents = recording.agents
    return [_training_record(metrics, agents) for metrics in recording.train.all_metrics()]


def _training_record(metrics: Message, agents: Sequence[str]) -> TrainingRecord:
    return TrainingRecord(
        episode=metrics["episode"],
        step=metrics["step"],
        mean_length=finite(metrics["mean_length"]),
        reward_counts=tuple(zip(metrics["rewards"], metrics["reward_counts"], strict=True)),
        of_tables={
            metric.field: dict(zip(agents, values, strict=True))
            for metric in TABLE_METRICS
            if (values := metrics[metric.field])
        },
        epsilon=metrics["epsilon"],
        step_size=metrics["step_size"],
        discount=metrics["discount"],
    )


def loop_summary(recording: Recording) -> Summary:
    """Return the last results of a loop, computed from its recording.

    It has `last_evaluation` (None without one), `recent_training`, and `logged`, the last value logged under
    each name. A value that is unknown or not finite is None.
    """
    last = None
    for evaluation in evaluations_of(recording)[-1:]:
        trials = recording.eval.episodes.array(evaluation.start, evaluation.stop)
        last = _loop_record(recording, evaluation, trials).summary()
    logged = recording.result.logged
    if "logged" not in recording.result:  # the loop did not finish
        scalars = recording.table(schema.SCALAR_TOPIC).decoded()
        logged = {scalar["name"]: finite(scalar["value"]) for scalar in scalars}
    return Summary(last_evaluation=last, recent_training=recording.train.recent_means(), logged=logged)


def metric_columns(records: Sequence[EvaluationRecord], is_narrow: bool = False) -> dict[str, list[str]]:
    """Return position and metrics of evaluations as text, by heading, without metrics unknown of a loop.

    Narrow columns join the values of several agents: `-800.0/-812.5`.
    """
    columns = {"episode": [f"{record.episode:,}" for record in records]}
    metrics = list(METRICS)
    if records[0].training is None:  # of a job, the table's explanation states the trials
        columns["trials"] = [f"{record.trials:,}" for record in records]
        metrics = [m for m in metrics if any(record.value(m.name) is not None for record in records)]
    for metric in metrics:
        values = [record.values[metric.name] for record in records]
        texts = [list(map(humanize.number, by_agent.values())) for by_agent in values]
        if is_narrow or len(texts[0]) == 1:
            columns[metric.heading] = list(map("/".join, texts))
            continue
        for agent, *column in zip(values[0], *texts, strict=True):
            columns[f"{metric.heading} {spoken(agent)}"] = column
    return columns


def spread(records: Sequence[EvaluationRecord]) -> list[EvaluationRecord]:
    """Return at most `MAX_SPREAD` evaluations, evenly spread, with the first and the last."""
    if len(records) <= MAX_SPREAD:
        return list(records)
    return [records[round(i * (len(records) - 1) / (MAX_SPREAD - 1))] for i in range(MAX_SPREAD)]


def evaluations_grid(records: Sequence[EvaluationRecord], success_events: Sequence[str]) -> Grid:
    """Return evaluations, one at least, as a table for a terminal.

    Successes are shown for each agent (`12/9`), other events summed over the agents. Of the events, a narrow
    terminal leaves out those first that follow from others.
    """
    measures = metric_columns(records, is_narrow=True)
    if records[0].training is not None:  # the returns of a job would leave no room for its events
        measures.pop("mean return", None)
    columns = {heading.replace(" ", "\n", 1): cells for heading, cells in measures.items()}
    kinds: dict[str, list[str]] = {}
    for name in records[0].events:
        kinds.setdefault(name.rpartition(".")[2], []).append(name)
    fixed = len(columns)
    for kind, names in sorted(
        kinds.items(), key=lambda item: (item[1][0] not in success_events, len(item[1]))
    ):
        counts = [[record.events[name] for name in names] for record in records]
        heading = spoken(kind)
        cells = [str(sum(by_agent)) for by_agent in counts]
        if names[0] in success_events and len(names) > 1:
            agents = [name.rpartition(".")[0].rpartition("_")[2] for name in names]
            heading = f"{heading} {'/'.join(agents)}"
            cells = ["/".join(map(str, by_agent)) for by_agent in counts]
        columns[heading.replace(" ", "\n", 1)] = cells
    events = [*columns][fixed:]
    spare = sorted(events, key=lambda heading: (heading != "pickup", -events.index(heading)))
    filled = _percent_filled(records)
    if filled:
        digits = 0 if len(filled[0]) > 1 else 1
        columns["filled\n%"] = [
            "/".join(f"{percent:.{digits}f}" for percent in percents) for percents in filled
        ]
    rows = list(zip(*columns.values(), strict=True))
    return Grid(tuple(columns), rows, left=(), cut=(), spare=tuple(spare), gap=1)


def _percent_filled(records: Sequence[EvaluationRecord]) -> list[list[float]]:
    """Return the percent filled of each learner's table, [records, learners]; nothing for a loop."""
    trainings = [record.training for record in records if record.training]
    return [list(training.of_tables.get("percent_filled", {}).values()) for training in trainings]


def evaluations_section(
    recording: Recording, records: Sequence[EvaluationRecord], paging: Paging | None = None
) -> Section:
    """Return evaluations of a recording, one at least, as a table, without metrics unknown of a loop."""
    columns = list(metric_columns(records).items())
    for name in recording.environment["event_names"]:
        agent, dot, _ = name.rpartition(".")
        words = event_in_words(name)
        heading = f"{words[: len(agent)]}\n{words[len(agent) + 1 :]}" if dot else words
        columns.append((heading, [f"{record.events[name]:,}" for record in records]))
    explanation = (
        "Each row: the evaluation episodes of the loop after that number of training episodes. Events are "
        "counted over all of them."
    )
    filled = _percent_filled(records)
    if filled:
        columns.append(("filled %", ["/".join(map(humanize.number, shares)) for shares in filled]))
        explanation = (
            f"Each row: {records[0].trials} trials with the greedy policy after that number of training "
            "episodes. Events are counted over all trials."
        )
    headings, cells = zip(*columns, strict=True)
    links = [f"replay/eval/{record.episode}/0" for record in records]
    rows = list(zip(*cells, strict=True))
    grid = Grid(headings, rows, links=links, paging=paging, cut=(), spare=headings[:2:-1])
    return Section("Evaluations", [explanation], [grid])
