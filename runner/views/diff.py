"""`diff`: what differs between two runs, and where they diverge."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from runner.errors import ExitCode
from runner.views.compare import check_target
from runner.views.view import NO_PROGRESS, PAGE, ReadyAnswer, ShownProgress, View, view_input

if TYPE_CHECKING:
    from runner.runs.run import Run


def diff(
    runs: Sequence[Run],
    ignore: Sequence[str] = view_input(
        "ignore",
        "Ignore settings and provenance whose path matches this pattern.",
        metavar="GLOB",
        multiple=True,
        max_length=100,
    ),
    everything: bool = view_input(
        "all", "Include everything, not only a selection.", kind=bool, default=False
    ),
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
    from runner.export.reports.diff import render_diff
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


VIEW: Final = View("diff", "Difference", diff, subject="pair", file_ending=PAGE)
