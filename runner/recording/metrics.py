"""The metrics of a run: each measure of its evaluations and of its training, defined once, in one row.

The schema, summaries, frames, plots, comparisons, exports, the index of runs, pages and commands read these
tables: a new measure of an evaluation is a row of `METRICS`, one of the Q-tables a row of `TABLE_METRICS`,
and the rest follows from it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from runner.util.arrays import Flags, Floats, Records

Better = Literal["higher", "lower", "lower_to_goal", None]
"""Which values are better; `lower_to_goal` only where episodes have a goal, None where nobody can say."""
LARGEST: Final = 1e300
"""Values beyond it are left out of means: their sums, and the margins of an axis, would overflow."""


def _mean(values: NDArray[Any]) -> Any:
    return values.mean(axis=0)


@dataclass(frozen=True)
class Metric:
    """A value that is read at several moments of a run."""

    name: str
    """Its public name: in frames, plots, comparisons, exports, the index of runs and commands."""
    title: str
    unit: str
    better: Better = None
    per_agent: bool = False
    """Whether it has a value for each learner."""
    field: str = ""
    """Its field in a message of metrics; empty if it is derived from several."""


@dataclass(frozen=True, kw_only=True)
class TableMetric(Metric):
    """A value of each learner's Q-table, in every report of training."""

    per_agent: bool = True
    number: int
    """Number of its field in `TrainMetrics` and `EvalMetrics`."""
    is_count: bool = False
    """Whether it is a whole number."""
    of_table: Callable[[Floats], float]
    """Returns the value of a table, [states, actions]."""


@dataclass(frozen=True, kw_only=True)
class EvaluationMetric(Metric):
    """A value of the trials of an evaluation, combined to one: their mean unless it names another way."""

    number: int
    """Number of its field in `EvalMetrics`."""
    heading: str
    """Its short name, above a column."""
    suffix: str = ""
    """Its unit, after a number of it that stands alone."""
    requires: Literal["", "success_events", "penalty_below"] = ""
    """What the environment must define for the metric to be known."""
    lowest: float = -math.inf
    highest: float = math.inf
    of_trials: Callable[[Records], NDArray[Any]]
    """Returns the value of each trial, [trials] or [trials, agents], from its `Episode` records."""
    combine: Callable[[NDArray[Any]], Any] = _mean
    """Combines the values of all trials: to a number, or [agents]."""

    @property
    def key(self) -> str:
        """Its name in a record of an evaluation: `mean_returns` maps agents to their own values."""
        return f"{self.name}s" if self.per_agent else self.name

    def of_usable(self, values: NDArray[Any]) -> float | None:
        """Return the metric of the values of trials, [trials], that are usable; None without any."""
        usable = values[is_usable(values)]
        return float(self.combine(usable)) if usable.size else None


METRICS: Final = (
    EvaluationMetric(
        name="success_percent",
        title="Evaluation trials that succeed",
        unit="percent of trials",
        better="higher",
        field="success_percent",
        number=14,
        heading="success %",
        suffix=" %",
        requires="success_events",
        lowest=0,
        highest=100,
        of_trials=lambda trials: 100.0 * trials["success"],
    ),
    EvaluationMetric(
        name="mean_length",
        title="Length of evaluation trials",
        unit="steps, mean",
        better="lower_to_goal",
        field="eval_mean_length",
        number=15,
        heading="mean length",
        suffix=" steps",
        lowest=0,
        of_trials=lambda trials: trials["length"],
    ),
    EvaluationMetric(
        name="mean_penalties",
        title="Penalties in evaluation trials",
        unit="per trial, mean",
        better="lower",
        field="mean_penalties",
        number=16,
        heading="mean penalties",
        suffix=" per trial",
        requires="penalty_below",
        lowest=0,
        of_trials=lambda trials: trials["penalties"],
    ),
    EvaluationMetric(
        name="mean_return",
        title="Return of evaluation trials",
        unit="summed reward, mean",
        better="higher",
        per_agent=True,
        field="mean_returns",
        number=18,
        heading="mean return",
        of_trials=lambda trials: trials["returns"],
    ),
)
"""The measures of an evaluation, in the order they are shown."""

EXACT_METRICS: Final = (
    Metric(
        "exact.success_percent", "Start states that succeed, exactly", "percent of start states", "higher"
    ),
    Metric(
        "exact.mean_length", "Length of an episode, exactly", "steps, mean over start states", "lower_to_goal"
    ),
    Metric("exact.value", "Value of the greedy policy", "discounted, mean", "higher"),
    Metric("exact.to_gain", "To gain by a best response", "discounted, mean", "lower", per_agent=True),
)
"""The measures of a greedy policy that are computed from the environment's transition table."""

TABLE_METRICS: Final = (
    TableMetric(
        name="training.percent_filled",
        title="Q-table filled",
        unit="percent of its cells",
        field="percent_filled",
        number=7,
        of_table=lambda table: 100.0 * int((table != 0).sum()) / table.size,
    ),
    TableMetric(
        name="training.zero_cells",
        title="Q-table cells still zero",
        unit="cells",
        field="zero_cells",
        number=6,
        is_count=True,
        of_table=lambda table: int((table == 0).sum()),
    ),
)
"""The measures of the Q-tables."""

SHARES: Final = "training.reward"
"""The metric whose lines are shares of a whole."""
TRAINING_METRICS: Final = (
    Metric(
        "training.mean_length",
        "Length of training episodes",
        "steps, mean",
        "lower_to_goal",
        field="mean_length",
    ),
    Metric(
        "training.mean_return",
        "Return of training episodes",
        "summed reward, mean",
        "higher",
        per_agent=True,
    ),
    Metric("training.mean_reward", "Reward in training", "per step, running mean", "higher"),
    *TABLE_METRICS,
    Metric("training.schedule", "Schedules", "value"),
    Metric(SHARES, "Training steps by reward", "percent of recent steps"),
)
"""The measures of training."""

METRIC_OF: Final[dict[str, Metric]] = {
    metric.name: metric for metric in (*METRICS, *EXACT_METRICS, *TRAINING_METRICS)
}
"""Name to metric, in the order they are shown; events come after the evaluation's, logged values last."""


def is_higher_better(name: str, has_goal: bool) -> bool | None:
    """Return whether higher values of a metric, or of a line such as `mean_return.taxi_1`, are better.

    None where neither is, in general. `has_goal`: episodes have a goal, which is better reached sooner.
    """
    metric = METRIC_OF.get(name) or METRIC_OF.get(name.rpartition(".")[0])
    if metric is None or metric.better is None or (metric.better == "lower_to_goal" and not has_goal):
        return None
    return metric.better == "higher"


def defined_metrics(has_success: bool, has_penalties: bool) -> tuple[EvaluationMetric, ...]:
    """Return the measures of an evaluation that an environment defines."""
    defined = {"": True, "success_events": has_success, "penalty_below": has_penalties}
    return tuple(metric for metric in METRICS if defined[metric.requires])


RECENT_EPISODES: Final = 100
"""Training episodes that the summary of a loop averages, the last ones."""


def is_usable(values: Floats) -> Flags:
    """Return which values are finite and small enough that sums of them stay finite."""
    return abs(values) <= LARGEST  # false for NaN


def spread_of(values: Floats) -> dict[str, float]:
    """Return the sample's standard deviation, lowest and highest value; nothing for fewer than two values."""
    usable = values[is_usable(values)]
    if len(usable) < 2:
        return {}
    lowest, highest = float(usable.min()), float(usable.max())
    return {"standard_deviation": float(usable.std(ddof=1)), "lowest": lowest, "highest": highest}


def finite_mean(values: Floats) -> float | None:
    """Return the mean of the values that are finite and no larger than `LARGEST`; None without any."""
    if not values.size:
        return None
    usable = is_usable(values)
    return float(values[usable].mean()) if usable.any() else None
