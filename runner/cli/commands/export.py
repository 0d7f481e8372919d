"""`dualtaxi export`: a run in another form; the command of each form is imported on demand."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from runner.cli.output import say
from runner.cli.runs import find_recorded
from runner.errors import nearest

if TYPE_CHECKING:
    from runner.recording.reader import Recording
    from runner.runs.run import Run

FORMS: Final[dict[str, tuple[str, str]]] = {
    "rerun": ("runner.cli.commands.export_rerun", "For the Rerun viewer: every view of selected episodes."),
    "mcap": ("runner.cli.commands.export_mcap", "One file with everything, for `dualtaxi import`."),
    "parquet": ("runner.cli.commands.export_tables:parquet", "Steps, episodes and metrics as Parquet."),
    "csv": ("runner.cli.commands.export_tables:csv", "Steps, episodes and metrics as CSV."),
    "minari": ("runner.cli.commands.export_minari", "A Minari dataset, for offline learning."),
    "tensorboard": ("runner.cli.commands.export_tensorboard", "An event file for TensorBoard."),
    "mlflow": ("runner.cli.commands.export_mlflow", "A run in an MLflow store."),
    "gif": ("runner.cli.commands.export_gif", "A short film of an episode, for slides and READMEs."),
}
"""Form to module, with the name of the command unless it is `command`, and short help."""


class _Forms(click.Group):
    """The commands of `FORMS`, imported one by one."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        """Return the forms."""
        return list(FORMS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a form's command."""
        if cmd_name not in FORMS:
            if not ctx.resilient_parsing:
                ctx.fail(f"there is no export {cmd_name!r}.{nearest(cmd_name, FORMS)}")
            return None
        module, _, name = FORMS[cmd_name][0].partition(":")
        command: click.Command = getattr(importlib.import_module(module), name or "command")
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:  # noqa: ARG002
        """Write the forms with their short help."""
        with formatter.section("Forms"):
            formatter.write_dl([(name, text) for name, (_, text) in FORMS.items()])


@click.group("export", cls=_Forms)
def export_command() -> None:
    """Export a run for other programs.

    Example:
      dualtaxi export rerun @latest
    """


@contextlib.contextmanager
def opened_run(
    run_name: str, recordings: Path | None, needs_steps: bool = False
) -> Iterator[tuple[Run, Recording]]:
    """Open a run to export it, and print what its recording lacks when that is done."""
    from runner.export.contents import require_steps, shortcomings
    from runner.recording.reader import open_recording

    run = find_recorded(run_name, recordings)
    with open_recording(run.recording) as recording:
        if needs_steps:
            require_steps(recording, "export")
        yield run, recording
        for shortcoming in shortcomings(recording):
            say(shortcoming)
