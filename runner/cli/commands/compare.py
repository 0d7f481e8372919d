"""`dualtaxi compare` and `dualtaxi diff`: groups of runs, and two runs, against each other."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click

from runner.cli.command import Command, argument, option
from runner.cli.options import (
    all_option,
    axis_option,
    compared_argument,
    force_option,
    html_option,
    normalise_option,
    recordings_option,
    target_option,
)
from runner.cli.output import Reply, require_page
from runner.cli.parameter_types import INDEX, RunName
from runner.cli.progress import stage_line
from runner.cli.runs import compilation_notice, find_all_recorded, find_recorded
from runner.errors import ExitCode
from runner.export.places import write_text_new
from runner.util.humanize import counted, size

if TYPE_CHECKING:
    from collections.abc import Sequence

    from runner.analysis.axes import Axis
    from runner.analysis.compare import Comparison
    from runner.analysis.compare.moments import Moment
    from runner.analysis.compare.tasks import TaskComparison
    from runner.analysis.sections import Section
    from runner.analysis.series import RunSeries


@click.command("compare", cls=Command)
def compare_command(
    run_names: tuple[str, ...] = compared_argument,
    by: str | None = option(
        "--by", metavar="PATH", help="Group by a value of the configuration, such as discount."
    ),
    metrics: tuple[str, ...] = option(
        "--metric",
        multiple=True,
        metavar="METRIC",
        help="A metric; may be repeated.  [default: those of evaluations]",
    ),
    moment: str = option(
        "--moment",
        default="last",
        show_default=True,
        metavar="last|best|area|N",
        help="Compare at the last evaluation, at each run's best, the mean over all, or after N on the axis. "
        "Values of training are means over a window, which a note states.",
    ),
    axis: Axis = axis_option,
    at_step: int | None = option(
        "--at-step", type=INDEX, metavar="N", help="Compare after N training steps: --axis steps --moment N."
    ),
    target: tuple[str, float] | None = target_option(multiple=False),
    normalise: str | None = normalise_option,
    html: Path | None = html_option,
    force: bool = force_option,
    recordings: Path | None = recordings_option,
) -> Reply:
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
    from runner.analysis.axes import EPISODES, STEPS
    from runner.analysis.compare.moments import moment_of
    from runner.analysis.compare.statistics import require_scipy
    from runner.analysis.series import series_of

    require_scipy()
    if html is not None:
        require_page(html, force)
    if at_step is not None:
        if moment != "last" or axis is not EPISODES:
            raise click.UsageError(
                "--at-step stands for --axis steps --moment N, so it excludes --axis and --moment; "
                "drop it or them."
            )
        moment, axis = str(at_step), STEPS
    read_at, chosen = moment_of(moment, target, metrics, axis)
    runs = find_all_recorded(run_names, recordings)
    with stage_line("reading runs") as stage:
        series = series_of((run.recording for run in runs), axis, chosen)
        stage("computing intervals")
        made = _compare(series, by, chosen, read_at, normalise, html is not None)
        if html is not None:
            write_text_new(html, force, made.page)
    if html is None:
        return Reply(dataclasses.asdict(made.result), made.sections)
    notes = [f"Note: {note}." for note in made.result.notes]
    return Reply(dataclasses.asdict(made.result), made.sections, page=f"{html}: {made.contents}", notes=notes)


class _Made(NamedTuple):
    """A comparison, as it is printed or written."""

    result: Comparison | TaskComparison
    sections: list[Section]
    contents: str
    page: str = ""


def _compare(
    series: list[RunSeries],
    by: str | None,
    chosen: Sequence[str],
    moment: Moment,
    normalise: str | None,
    with_page: bool,
) -> _Made:
    """Return the comparison of groups of runs, or of algorithms over environments."""
    from runner.analysis.compare import compare
    from runner.analysis.compare.score_table import scores_of
    from runner.analysis.compare.sections import sections
    from runner.analysis.compare.task_sections import task_sections
    from runner.analysis.compare.tasks import compare_algorithms
    from runner.analysis.groups import grouped, metrics_of, require_two
    from runner.export.reports.compare import render_comparison, render_tasks

    if normalise is not None:
        tasks = compare_algorithms(series, scores_of(normalise), by, chosen, moment)
        contents = f"{len(tasks.algorithms)} groups in {len(tasks.tasks)} environments"
        return _Made(tasks, task_sections(tasks), contents, render_tasks(tasks) if with_page else "")
    groups, notes = grouped(series, by)
    require_two(groups, by)
    comparison = compare(groups, metrics_of(groups, chosen), moment, notes)
    runs = sum(len(group.runs) for group in groups)
    contents = f"{counted(len(comparison.metrics), 'metric')} of {runs} runs in {len(groups)} groups"
    return _Made(
        comparison, sections(comparison), contents, render_comparison(comparison, groups) if with_page else ""
    )


@click.command("diff", cls=Command)
def diff_command(
    a: str = argument(metavar="A", type=RunName()),
    b: str = argument(metavar="B", type=RunName()),
    recordings: Path | None = recordings_option,
    html: Path | None = html_option,
    force: bool = force_option,
    ignore: tuple[str, ...] = option(
        "--ignore",
        multiple=True,
        metavar="GLOB",
        help="Ignore settings and provenance whose path matches this pattern.",
    ),
    everything: bool = all_option,
    first: bool = option(
        "--first",
        is_flag=True,
        help="Compare only settings and where training first diverges, not the tables.",
    ),
    targets: tuple[tuple[str, float], ...] = target_option(multiple=True),
) -> Reply:
    """Show what differs between the runs A and B, down to the first step at which they diverge, and why.

    --all also shows what is equal. Exit code 0 if both have the same content, 1 if not.

    Examples:
      dualtaxi diff k3v9m2xq p7 --ignore 'package.*'
      dualtaxi diff tutorial_cooperative cooperative --target success_percent=80
      dualtaxi diff first second --html difference.html
    """
    from runner.analysis import diff as differences
    from runner.analysis.diff.sections import sections
    from runner.recording.reader import open_recording

    if html is not None:
        require_page(html, force)
    left, right = find_recorded(a, recordings), find_recorded(b, recordings)
    with (
        open_recording(left.recording) as recording_a,
        open_recording(right.recording) as recording_b,
        compilation_notice(),
        stage_line("comparing") as stage,
    ):
        difference = differences.diff(recording_a, recording_b, dict(targets), first)
        difference = difference if first else differences.with_seconds(difference, left, right)
        difference = differences.without_ignored(difference, ignore, everything)
        if html is not None:
            from runner.export.reports.diff import render_diff

            stage("drawing the page")
            write_text_new(html, force, render_diff(difference, recording_a, recording_b))
    return Reply(
        differences.as_json(difference),
        sections(difference, everything),
        page="" if html is None else f"{html}: {size(html.stat().st_size)}",
        exit_code=ExitCode.OK if difference.same_content else ExitCode.DIFFERENT,
    )
