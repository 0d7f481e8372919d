"""`dualtaxi diff`: what differs between two runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from runner.cli.options import (
    RunName,
    all_option,
    json_option,
    markdown_option,
    recordings_option,
    target_option,
)
from runner.cli.output import print_json, print_sections, require_one_form, require_page, say
from runner.cli.runs import find_recorded
from runner.errors import ExitCode
from runner.util.humanize import size

if TYPE_CHECKING:
    from runner.analysis.diff import RunDiff
    from runner.recording.reader import Recording


@click.command("diff")
@click.argument("a", metavar="A", type=RunName())
@click.argument("b", metavar="B", type=RunName())
@recordings_option
@json_option
@markdown_option
@click.option("--html", type=click.Path(path_type=Path), metavar="FILE", help="Write an HTML page instead.")
@click.option("--force", is_flag=True, help="Replace the page if it exists.")
@click.option(
    "--ignore",
    multiple=True,
    metavar="GLOB",
    help="Ignore settings and provenance whose path matches this pattern.",
)
@all_option
@click.option(
    "--first",
    is_flag=True,
    help="Compare only settings and where training first diverges, not the tables.",
)
@target_option(multiple=True)
@click.pass_context
def command(
    ctx: click.Context,
    a: str,
    b: str,
    recordings: Path | None,
    as_json: bool,
    as_markdown: bool,
    html: Path | None,
    force: bool,
    ignore: tuple[str, ...],
    everything: bool,
    first: bool,
    targets: tuple[str, ...],
) -> None:
    """Show what differs between the runs A and B, down to the first step at which they diverge, and why.

    Exit code 0 if both have the same content, 1 if not.

    \b
    Examples:
      dualtaxi diff k3v9m2xq p7 --ignore 'package.*'
      dualtaxi diff tutorial_cooperative cooperative --target success_percent=80
      dualtaxi diff first second --html difference.html
    """  # noqa: D301 - Click wants the backspace itself
    from runner.analysis import diff as differences
    from runner.analysis.series import parse_target
    from runner.cli.progress import stage_line
    from runner.recording.reader import open_recording

    require_one_form(as_json, as_markdown)
    levels = dict(parse_target(target) for target in targets)
    if html is not None:
        require_page(html, force)
    left, right = find_recorded(a, recordings), find_recorded(b, recordings)
    with open_recording(left.recording) as recording_a, open_recording(right.recording) as recording_b:
        with stage_line("comparing") as stage:
            difference = differences.diff(recording_a, recording_b, levels, first)
            difference = difference if first else differences.with_seconds(difference, left, right)
            difference = differences.without_ignored(difference, ignore, everything)
            if html is not None:
                stage("drawing the page")
                page = _write_page(html, force, difference, recording_a, recording_b)
        if html is not None:
            (say if as_json or as_markdown else click.echo)(page)
    if as_json:
        print_json(differences.as_json(difference))
    elif html is None or as_markdown:
        _print(difference, everything, as_markdown)
    ctx.exit(ExitCode.OK if difference.same_content else ExitCode.DIFFERENT)


def _write_page(path: Path, force: bool, difference: RunDiff, a: Recording, b: Recording) -> str:
    """Write the page; return what there is to say of it."""
    from runner.export.places import write_text_new
    from runner.export.reports.diff import render_diff

    write_text_new(path, force, render_diff(difference, a, b))
    return f"{path}: {size(path.stat().st_size)}"


def _print(difference: RunDiff, everything: bool, as_markdown: bool) -> None:
    from runner.analysis.diff.sections import sections

    print_sections(sections(difference, everything), as_markdown)
