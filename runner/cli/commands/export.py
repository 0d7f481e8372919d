"""`dualtaxi export`: a run in another form; each form is imported when it is asked for."""

from __future__ import annotations

import importlib
from typing import Final

import click

from runner.errors import nearest

FORMS: Final[dict[str, tuple[str, str]]] = {
    "rerun": ("runner.cli.commands.export_rerun", "For the Rerun viewer: every view of chosen episodes."),
    "mcap": ("runner.cli.commands.export_mcap", "One file with everything, for `dualtaxi import`."),
    "parquet": ("runner.cli.commands.export_tables:parquet", "Steps, episodes and measures as Parquet."),
    "csv": ("runner.cli.commands.export_tables:csv", "Steps, episodes and measures as CSV."),
    "minari": ("runner.cli.commands.export_minari", "A Minari dataset, for offline learning."),
    "tensorboard": ("runner.cli.commands.export_tensorboard", "An event file for TensorBoard."),
    "mlflow": ("runner.cli.commands.export_mlflow", "A run in an MLflow store."),
    "gif": ("runner.cli.commands.export_gif", "A short film of an episode, for slides and READMEs."),
}
"""Form -> its module, which has the command as `command` unless another name is said; and its short help."""


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
        """Write the forms, from their short help alone."""
        with formatter.section("Forms"):
            formatter.write_dl([(name, text) for name, (_, text) in FORMS.items()])


@click.group("export", cls=_Forms)
def export_command() -> None:
    """Export a run for other programs.

    Example:
      dualtaxi export rerun @latest
    """
