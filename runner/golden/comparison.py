"""How a run is compared with a golden one: byte for byte, in its environment, or by scores of seeds."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from runner.analysis.diff import RunDiff, diff
from runner.analysis.diff.sections import sections
from runner.analysis.diff.settings import changes_in
from runner.environments.gym_types import Env
from runner.errors import ConfigError
from runner.export.reports.diff import render_diff
from runner.loops.env import record
from runner.loops.makers import maker_of
from runner.recording.maker import EnvironmentMaker
from runner.recording.reader import open_recording
from runner.replay.environment import redo
from runner.runs.run import Run
from runner.util.extras import require
from runner.util.humanize import setting

MIN_SCORES: Final = 6
"""The fewest seeds whose interquartile mean has a spread that can be estimated."""
_TRIM: Final = 0.25
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
        CannotRedo: the actions cannot be taken in this environment.
    """
    with open_recording(golden) as recording:
        for steps in redo(recording, make=make, tolerance=tolerance):
            if steps.difference is not None:
                with closing(make()) as env:
                    here = maker_of(env)
                return "\n".join([str(steps.difference), *_changes(recording.maker, here)])
    return ""


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

    The test is one-sided: if the true interquartile mean (IQM) is worse by the margin or more, it passes
    with a probability of at most `error_rate`.
    """

    golden: float
    """IQM of the golden scores."""
    new: float
    """IQM of the new scores."""
    margin: float
    error_rate: float
    p_value: float

    @property
    def is_shown(self) -> bool:
        """Whether the new scores pass."""
        return self.p_value < self.error_rate

    def __str__(self) -> str:
        return (
            f"IQM {self.new:.6g}, golden {self.golden:.6g}, margin {self.margin:.6g}: "
            f"p = {self.p_value:.3g} for being worse by the margin or more, error rate {self.error_rate:g}"
        )


def non_inferiority(
    golden: Sequence[float], new: Sequence[float], margin: float, error_rate: float = 0.05
) -> NonInferiority:
    """Test whether new scores are no worse than golden ones by a margin or more.

    The test is Yuen's for means trimmed by a quarter at each end, which are interquartile means, with
    unequal variances (K. K. Yuen, "The two-sample trimmed t for unequal population variances", Biometrika
    61, 1974). Scores without any spread are compared as they are.

    Args:
        golden: a score of each seed, higher is better.
        new: a score of each seed; the seeds need not be the same.
        margin: the loss of IQM that is accepted, above 0.
        error_rate: the greatest probability to pass although the IQM is worse by the margin or more.

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
    stats = require("scipy.stats", extra="stats", purpose="comparing scores of seeds")
    means = [float(stats.trim_mean(scores, _TRIM)) for scores in (golden, new)]
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):  # scores without spread
        test = stats.ttest_ind(
            np.asarray(new) + margin, golden, equal_var=False, alternative="greater", trim=_TRIM
        )
    p_value = float(test.pvalue)
    if np.isnan(p_value):
        p_value = 0.0 if means[1] + margin > means[0] else 1.0
    return NonInferiority(means[0], means[1], margin, error_rate, p_value)
