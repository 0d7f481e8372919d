"""How a run is compared with a golden one: byte for byte, in its environment, or by scores of seeds."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np

from runner.analysis.diff import RunDiff, diff
from runner.analysis.diff.sections import sections
from runner.environments.gym_types import Env
from runner.errors import CannotRedo, ConfigError
from runner.execution.verify import OUTSIDE
from runner.export.reports.comparisons import render_diff
from runner.loops.env import record
from runner.loops.makers import maker_of
from runner.recording.maker import EnvironmentMaker
from runner.recording.reader import Recording, open_recording
from runner.replay.engine import Difference
from runner.replay.environment import rerun
from runner.runs.run import Run
from runner.util.arrays import Array
from runner.util.differences import changes_in
from runner.util.extras import require
from runner.util.humanize import setting

MIN_SCORES: Final = 6
"""The fewest seeds whose interquartile mean has a spread that can be estimated."""
_TRIM: Final = 0.25
_SHARES: Final = 501
"""Golden proportions at which an exact test looks for the greatest p-value."""
_SAMPLES: Final = 4_000
"""Samples by which error rates are estimated, to about 1 %."""
_MAX_CHANGES: Final = 8
_CIRCUMSTANCES: Final = frozenset({"command", "created", "directory", "host", "user"})
"""Entries of provenance that cannot explain a difference."""


@dataclass(frozen=True)
class ByteDifference:
    """A run whose content is not that of its golden run."""

    text: str
    """What differs first, and which settings and versions differ."""
    page: str
    """The whole difference as an HTML page."""


def compare_bytes(golden: Path, recording: Path) -> ByteDifference | None:
    """Return how the content of a recording differs from a golden one; None if it is the same."""
    with open_recording(golden) as a, open_recording(recording) as b:
        difference = diff(a, b)
        if difference.same_content:
            return None
        return ByteDifference(_in_words(difference), render_diff(difference, a, b))


def _in_words(difference: RunDiff) -> str:
    """Return the outcome, where the runs diverge, and what may be the cause: environment, versions."""
    lines = ["A is the golden run, B the new one."]
    for section in sections(difference):
        if section.title in ("Runs", "Environment", "Training", "Evaluation"):
            lines += section.sentences
    versions = [
        change
        for change in difference.provenance
        if change.path not in _CIRCUMSTANCES and not change.path.endswith(".state")
    ]
    for change in (*difference.environment.description, *versions)[:_MAX_CHANGES]:
        lines.append(f"  {change.path}: {setting(change.a)} in A, {setting(change.b)} in B")
    return "\n".join(lines)


def record_environment(make: Callable[[], Env], episodes: int, max_steps: int, recordings: Path) -> Run:
    """Record episodes of random actions in an environment, each with its number as seed."""
    with record(make(), recordings, name="golden", seed=0) as env:
        env.action_space.seed(0)
        for episode in range(episodes):
            env.reset(seed=episode)
            for _ in range(max_steps):
                _, _, terminated, truncated, _ = env.step(env.action_space.sample())
                if terminated or truncated:
                    break
    return env.run


def compare_environment(golden: Path, make: Callable[[], Env], tolerance: float) -> str:
    """Return where an environment first differs from a golden run of it, and why; empty if it does not.

    Raises:
        RecordingError: the golden run cannot be read.
        CannotRedo: the actions cannot be taken in this environment, or it depends on more than its seed.
    """
    with open_recording(golden) as recording:
        first = _first_difference(recording, make, tolerance)
        if first is None:
            return ""
        if _first_difference(recording, make, tolerance) != first:
            raise CannotRedo(f"{OUTSIDE}\n{first}")
        with closing(make()) as env:
            here = maker_of(env)
        return "\n".join([str(first), *_changes(recording.maker, here)])


def _first_difference(recording: Recording, make: Callable[[], Env], tolerance: float) -> Difference | None:
    steps = rerun(recording, make=make, tolerance=tolerance)
    return next((block.difference for block in steps if block.difference is not None), None)


def _changes(recorded: EnvironmentMaker | None, here: EnvironmentMaker) -> list[str]:
    """Return what differs in how an environment was made: arguments, wrappers, versions."""
    made = [
        {"spec": json.loads(maker.spec or "{}"), "packages": dict(maker.packages), "platform": maker.platform}
        for maker in (recorded, here)
        if maker is not None
    ]
    changes = changes_in(*made) if len(made) == 2 else []
    return [
        f"  {change.path}: recorded {setting(change.a)}, here {setting(change.b)}"
        for change in changes[:_MAX_CHANGES]
    ]


@dataclass(frozen=True)
class NonInferiority:
    """Whether new scores are shown to be no worse than golden ones by more than a margin.

    The test is one-sided: if the true centre is worse by the margin or more, it passes with a probability of
    at most `error_rate`.
    """

    golden: float
    """Centre of the golden scores."""
    new: float
    """Centre of the new scores."""
    margin: float
    error_rate: float
    p_value: float
    measure: str
    """The centre: `IQM`, the interquartile mean, or `mean` where a score has one of two values."""

    @property
    def is_shown(self) -> bool:
        """Whether the new scores pass."""
        return self.p_value < self.error_rate

    def __str__(self) -> str:
        return (
            f"{self.measure} {self.new:.6g}, golden {self.golden:.6g}, margin {self.margin:.6g}: "
            f"p = {self.p_value:.3g} for being worse by the margin or more, error rate {self.error_rate:g}"
        )


def non_inferiority(
    golden: Sequence[float], new: Sequence[float], margin: float, error_rate: float = 0.05
) -> NonInferiority:
    """Test whether new scores are no worse than golden ones by a margin or more.

    The test is Yuen's for means trimmed by a quarter at each end, which are interquartile means, with
    unequal variances (K. K. Yuen, "The two-sample trimmed t for unequal population variances", Biometrika
    61, 1974). Where all scores have one of two values, such as solved or not, trimming hides the rarer one:
    their means are compared by an exact test for two proportions (I. S. F. Chan, "Exact tests of equivalence
    and efficacy with a non-zero lower bound for comparative studies", Statistics in Medicine 17, 1998).
    Scores without any spread are compared as they are.

    Args:
        golden: a score of each seed, higher is better.
        new: a score of each seed; the seeds need not be the same.
        margin: the loss of IQM, or of the mean of two values, that is accepted, above 0.
        error_rate: the greatest probability to pass although it is worse by the margin or more.

    Raises:
        ConfigError: there are fewer than six finite scores on a side, or another argument cannot be used.
        MissingExtra: SciPy is not installed.
    """
    for name, scores in (("golden", golden), ("new", new)):
        if len(scores) < MIN_SCORES or not np.isfinite(scores).all():
            raise ConfigError(
                f"{name} scores: found {list(scores)!r:.200}, expected {MIN_SCORES} finite numbers or more, "
                "one of each seed"
            )
    if not (np.isfinite(margin) and margin > 0):
        raise ConfigError(f"margin: found {margin!r}, expected a number above 0")
    if not 0 < error_rate < 0.5:
        raise ConfigError(f"error_rate: found {error_rate!r}, expected a number above 0 and below 0.5")
    values = np.unique([*golden, *new])
    if len(values) == 2:
        high = [int(np.count_nonzero(np.asarray(scores) == values[1])) for scores in (golden, new)]
        loss = margin / float(values[1] - values[0])
        p_value = float(_proportion_p_values(len(golden), len(new), loss)[high[0], high[1]])
        return NonInferiority(
            float(np.mean(golden)), float(np.mean(new)), margin, error_rate, p_value, "mean"
        )
    stats = require("scipy.stats", extra="stats", purpose="comparing scores of seeds")
    means = [float(stats.trim_mean(scores, _TRIM)) for scores in (golden, new)]
    p_value = float(_trimmed_p_values(np.asarray(golden), np.asarray(new) + margin))
    return NonInferiority(means[0], means[1], margin, error_rate, p_value, "IQM")


def _trimmed_p_values(golden: Array, new: Array) -> Array:
    """Return Yuen's p-values for the last axis of [..., golden scores] and [..., new scores]."""
    stats = require("scipy.stats", extra="stats", purpose="comparing scores of seeds")
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # scores without spread
        test = stats.ttest_ind(new, golden, axis=-1, equal_var=False, alternative="greater", trim=_TRIM)
    is_better = stats.trim_mean(new, _TRIM, axis=-1) > stats.trim_mean(golden, _TRIM, axis=-1)
    return np.where(np.isnan(test.pvalue), np.where(is_better, 0.0, 1.0), test.pvalue)


@cache
def _proportion_p_values(golden: int, new: int, loss: float) -> Array:
    """Return exact p-values [golden + 1, new + 1] of every pair of counts, for a proportion less by `loss`.

    Pairs are ordered by the z-score of A. Agresti and B. Caffo (The American Statistician 54, 2000); a
    p-value is the probability of a pair at least as good, at the golden proportion where that is greatest.
    """
    stats = require("scipy.stats", extra="stats", purpose="comparing scores of seeds")
    if loss >= 1:
        return np.zeros((golden + 1, new + 1))
    counts = np.arange(golden + 1)[:, np.newaxis], np.arange(new + 1)
    shares = (counts[0] + 1) / (golden + 2), (counts[1] + 1) / (new + 2)
    variance = shares[0] * (1 - shares[0]) / (golden + 2) + shares[1] * (1 - shares[1]) / (new + 2)
    z = ((shares[1] - shares[0] + loss) / np.sqrt(variance)).round(12)  # equal scores, whatever the rounding
    order = np.argsort(-z, axis=None)
    last = np.searchsorted(-z.ravel()[order], -z.ravel()[order], side="right") - 1
    worst = np.zeros(z.size)
    for share in np.linspace(loss, 1, _SHARES):
        chances = stats.binom.pmf(counts[0], golden, share) * stats.binom.pmf(counts[1], new, share - loss)
        np.maximum(worst, np.cumsum(chances.ravel()[order]), out=worst)
    p_values = np.empty(z.size)
    p_values[order] = worst[last]
    return p_values.reshape(z.shape)


def error_rates(scores: Sequence[float], margin: float, error_rate: float) -> tuple[float, float]:
    """Return how often scores like these would fail unchanged, and would pass though worse by the margin.

    Both are shares of samples of as many scores, drawn from these with a fixed seed.
    """
    random = np.random.default_rng(0)
    values = np.unique(scores)
    golden, new = random.choice(scores, (2, _SAMPLES, len(scores)))
    if len(values) == 2:
        loss = margin / float(values[1] - values[0])
        p_values = _proportion_p_values(len(scores), len(scores), loss)
        share = float(np.mean(scores == values[1]))
        high = np.count_nonzero(golden == values[1], axis=1), np.count_nonzero(new == values[1], axis=1)
        worse = random.binomial(len(scores), max(share - loss, 0), _SAMPLES)
        tests = p_values[high], p_values[high[0], worse]
    else:
        tests = _trimmed_p_values(golden, new + margin), _trimmed_p_values(golden, new)
    return float(np.mean(tests[0] >= error_rate)), float(np.mean(tests[1] < error_rate))
