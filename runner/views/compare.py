"""Views that compare runs: groups with statistics over seeds, or two runs step by step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from runner.errors import ConfigError, ExitCode
from runner.util.humanize import counted
from runner.views.view import EVERYTHING, NO_PROGRESS, PAGE, ReadyAnswer, ShownProgress, View, view_input

if TYPE_CHECKING:
    from runner.runs.run import Run

MAX_SCORES: Final = 10_000
"""Characters of a table of scores."""


def check_target(text: str) -> object:
    """Return what a target names, so that a wrong one is refused."""
    from runner.analysis.series import parse_target

    return parse_target(text)


AXIS: Final = view_input(
    "axis",
    "Read metrics over training episodes, training steps, updates as a loop logged them, or wall time.  "
    "[default: episodes]",
    default="episodes",
    metavar="episodes|steps|updates|time",
)
NORMALISE: Final = view_input(
    "normalise",
    "Compare over environments, by a table of random and expert scores, or the worst and best values.",
    metavar="FILE|minmax",
    max_length=MAX_SCORES,
    is_file=True,
)


def compare(
    runs: Sequence[Run],
    by: str | None = view_input(
        "by", "Group by a value of the configuration, such as discount.", metavar="PATH", max_length=200
    ),
    metrics: Sequence[str] = view_input(
        "metric",
        "A metric; may be repeated.  [default: those of evaluations]",
        metavar="METRIC",
        multiple=True,
        max_length=100,
    ),
    moment: str = view_input(
        "moment",
        "Compare at the last evaluation, at each run's best, the mean over all, or after N on the axis. "
        "Values of training are means over a window, which a note states.  [default: last]",
        default="last",
        metavar="last|best|area|N",
        max_length=20,
    ),
    axis: str = AXIS,
    at_step: int | None = view_input(
        "at-step", "Compare after N training steps: --axis steps --moment N.", kind=int
    ),
    target: str | None = view_input(
        "target",
        "Compare when this level is first reached, such as success_percent=80.",
        metavar="METRIC=LEVEL",
        max_length=200,
        check=check_target,
    ),
    normalise: str | Path | None = NORMALISE,
    progress: ShownProgress = NO_PROGRESS,
) -> ReadyAnswer:
    """Compare groups of runs: medians, interquartile means, intervals, probabilities of improvement.

    Runs that differ in nothing but the seed are one group; the name of several runs stands for all of them,
    and a filter, as in `dualtaxi ls`, for the runs that match it. Groups are compared seed by seed, as runs
    of one seed share their draws. For each metric: median and interquartile mean (IQM) with a 95 % bootstrap
    interval; for each pair of groups the differences, and the probability that a run of A is better than one
    of B; and the share of runs that reach a level.

    With --normalise, algorithms are compared over several environments by normalised scores: IQM, median,
    mean and optimality gap, the probability of improvement, performance profiles and sample-efficiency
    curves, with intervals by a bootstrap that resamples the seeds of each environment. A group then has the
    runs that differ in nothing but environment and seed, or have the same value of --by, such as name.

    Exit code 0 when groups were compared, 2 when there is nothing to compare.

    Examples:
      dualtaxi compare cooperative competitive
      dualtaxi compare first second third --metric mean_length --moment 10000
      dualtaxi compare ppo dqn --at-step 100000
      dualtaxi compare 'status == "finished" and 0.9 < config.discount < 1' --by discount
      dualtaxi compare sweep --by discount --target success_percent=80
      dualtaxi compare ppo dqn --normalise scores.csv --metric training.mean_return
      dualtaxi compare cooperative competitive --html comparison.html
    """
    if at_step is not None:
        if moment != "last" or axis != "episodes":
            raise ConfigError(
                "at-step: it stands for the axis steps and the moment N, so it excludes axis and moment; "
                "drop it or them."
            )
        moment, axis = str(at_step), "steps"
    from runner.analysis.axes import axis_of
    from runner.analysis.compare import compare
    from runner.analysis.compare.moments import moment_of
    from runner.analysis.compare.sections import sections, task_sections
    from runner.analysis.compare.tasks import compare_algorithms, scores_of
    from runner.analysis.groups import grouped, metrics_of, require_two
    from runner.analysis.series import parse_target, series_of
    from runner.analysis.statistics import require_scipy
    from runner.export.reports.comparisons import render_comparison, render_tasks

    require_scipy()
    over = axis_of(axis)
    read_at, metric_names = moment_of(moment, parse_target(target) if target else None, metrics, over)
    with progress.stage("reading runs") as report:
        series = series_of((run.recording for run in runs), over, metric_names)
        report("computing intervals")
        if normalise is not None:
            tasks = compare_algorithms(series, scores_of(normalise), by, metric_names, read_at)
            contents = f"{len(tasks.algorithms)} groups in {len(tasks.tasks)} environments"
            page = partial(render_tasks, tasks)
            return ReadyAnswer(asdict(tasks), task_sections(tasks), page, contents, tasks.notes)
        groups, notes = grouped(series, by)
        require_two(groups, by)
        compared = compare(groups, metrics_of(groups, metric_names), read_at, notes)
    count = sum(len(group.runs) for group in groups)
    contents = f"{counted(len(compared.metrics), 'metric')} of {count} runs in {len(groups)} groups"
    page = partial(render_comparison, compared, groups)
    return ReadyAnswer(asdict(compared), sections(compared), page, contents, compared.notes)


COMPARE: Final = View("compare", "Compare", compare, subject="runs", file_ending=PAGE)


def diff(
    runs: Sequence[Run],
    ignore: Sequence[str] = view_input(
        "ignore",
        "Ignore settings and provenance whose path matches this pattern.",
        metavar="GLOB",
        multiple=True,
        max_length=100,
    ),
    everything: bool = EVERYTHING,
    first: bool = view_input(
        "first",
        "Compare only settings and where training first diverges, not the tables.",
        kind=bool,
        default=False,
    ),
    targets: Sequence[str] = view_input(
        "target",
        "Compare when this level is first reached, such as success_percent=80; may be repeated.",
        metavar="METRIC=LEVEL",
        multiple=True,
        max_length=20,
        check=check_target,
    ),
    progress: ShownProgress = NO_PROGRESS,
) -> ReadyAnswer:
    """Show what differs between the runs A and B, down to the first step at which they diverge, and why.

    --all also shows what is equal. Exit code 0 if both have the same content, 1 if not.

    Examples:
      dualtaxi diff k3v9m2xq p7 --ignore 'package.*'
      dualtaxi diff tutorial_cooperative cooperative --target success_percent=80
      dualtaxi diff first second --html difference.html
    """
    from runner.analysis import diff as differences
    from runner.analysis.diff.sections import sections
    from runner.analysis.series import parse_target
    from runner.export.reports.comparisons import render_diff
    from runner.recording.reader import open_recording

    a, b = runs

    def page() -> str:
        with open_recording(a.recording) as ours, open_recording(b.recording) as theirs:
            return render_diff(difference, ours, theirs)

    with (
        progress.stage("comparing"),
        open_recording(a.recording) as ours,
        open_recording(b.recording) as theirs,
    ):
        difference = differences.diff(ours, theirs, dict(map(parse_target, targets)), first)
    difference = difference if first else differences.with_seconds(difference, a, b)
    difference = differences.without_ignored(difference, ignore, everything)
    return ReadyAnswer(
        differences.as_json(difference),
        sections(difference, everything),
        page,
        exit_code=ExitCode.OK if difference.same_content else ExitCode.DIFFERENT,
    )


DIFF: Final = View("diff", "Difference", diff, subject="pair", file_ending=PAGE)
