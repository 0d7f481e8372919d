"""`dualtaxi compare`: groups of runs against each other, with statistics over seeds."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import click

from runner.cli.options import json_option, markdown_option, recordings_option, runs_argument, target_option
from runner.cli.output import print_json, print_sections, require_one_form, require_page, say
from runner.cli.runs import find_all_recorded

if TYPE_CHECKING:
    from runner.analysis.compare import Comparison
    from runner.analysis.groups import Group
    from runner.analysis.series import RunSeries
    from runner.runs.run import Run


@click.command("compare")
@runs_argument
@click.option("--by", metavar="PATH", help="Group by a value of the configuration, such as discount.")
@click.option(
    "--metric",
    "chosen",
    multiple=True,
    metavar="METRIC",
    help="A metric; may be repeated.  [default: those of evaluations]",
)
@click.option(
    "--at",
    default="last",
    show_default=True,
    metavar="last|best|area|EPISODE",
    help="The point in training: the last evaluation, each run's best, the mean over all, or after EPISODE.",
)
@target_option(multiple=False)
@json_option
@markdown_option
@click.option("--html", type=click.Path(path_type=Path), metavar="FILE", help="Write an HTML page instead.")
@click.option("--force", is_flag=True, help="Replace the page if it exists.")
@recordings_option
def command(
    run_names: tuple[str, ...],
    by: str | None,
    chosen: tuple[str, ...],
    at: str,
    target: str | None,
    as_json: bool,
    as_markdown: bool,
    html: Path | None,
    force: bool,
    recordings: Path | None,
) -> None:
    """Compare groups of runs: medians, interquartile means, intervals, probabilities of improvement.

    Runs that differ in nothing but the seed are one group; the name of several runs stands for all of them.
    Groups are compared seed by seed, as runs of one seed share their draws. For each metric: median and
    interquartile mean (IQM) with a 95 % bootstrap interval; for each pair of groups the differences, and the
    probability that a run of A is better than one of B; and the share of runs that reach a level.

    Exit code 0 when groups were compared, 2 when there is nothing to compare.

    \b
    Examples:
      dualtaxi compare cooperative competitive
      dualtaxi compare first second third --metric mean_length --at 10000
      dualtaxi compare sweep --by discount --target success_percent=80
      dualtaxi compare cooperative competitive --html comparison.html
    """  # noqa: D301 - Click wants the backspace itself
    from runner.analysis.compare import compare
    from runner.analysis.compare.moments import moment_of
    from runner.analysis.compare.sections import sections
    from runner.analysis.compare.statistics import require_scipy
    from runner.analysis.groups import grouped, metrics_of, require_two
    from runner.cli.progress import stage_line

    require_one_form(as_json, as_markdown)
    require_scipy()
    if html is not None:
        require_page(html, force)
    moment, metrics = moment_of(at, target, chosen)
    runs = find_all_recorded(run_names, recordings)
    page = ""
    with stage_line("reading runs") as stage:
        groups, notes = grouped(_read(runs), by)
        require_two(groups, by)
        stage("computing intervals")
        comparison = compare(groups, metrics_of(groups, metrics), moment, notes)
        if html is not None:
            stage("drawing the page")
            page = _write_page(html, force, comparison, groups)
    if html is not None:
        for note in comparison.notes:
            say(f"Note: {note}.")
        (say if as_json else click.echo)(page)
    if as_json:
        print_json(dataclasses.asdict(comparison))
    elif html is None:
        print_sections(sections(comparison), as_markdown)


def _read(runs: list[Run]) -> list[RunSeries]:
    """Return the metrics of runs."""
    from runner.analysis.series import read_series
    from runner.recording.reader import open_recording

    found = []
    for run in runs:
        with open_recording(run.recording) as recording:
            found.append(read_series(recording))
    return found


def _write_page(path: Path, force: bool, comparison: Comparison, groups: list[Group]) -> str:
    """Write the page; return what there is to say of it."""
    from runner.export.places import write_text_new
    from runner.export.reports.compare import render_comparison

    page = render_comparison(comparison, groups)
    write_text_new(path, force, page)
    runs = sum(len(group.runs) for group in groups)
    return f"{path}: {len(comparison.metrics)} metrics of {runs} runs in {len(groups)} groups"
