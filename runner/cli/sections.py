"""What comparing commands share: sections printed as text or as Markdown, and whether a page can be made."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from runner.cli.output import console, draw, table, title

if TYPE_CHECKING:
    from runner.analysis.sections import Section


def print_sections(made: Sequence[Section], as_markdown: bool) -> None:
    """Print sections on stdout."""
    from runner.analysis.sections import markdown

    if as_markdown:
        click.echo("\n".join(markdown(made)))
        return
    for section in made:
        _draw(section)


def require_one_form(as_json: bool, as_markdown: bool) -> None:
    """Refuse to print in two forms at once."""
    if as_json and as_markdown:
        raise click.UsageError("--json and --markdown are two ways to print; choose one.")


def require_page(path: Path, force: bool) -> None:
    """Refuse to begin where the page could not be made in the end."""
    from runner.export.places import require_new
    from runner.export.reports.report import require_packages

    require_packages()
    require_new(path, force)


def _draw(section: Section) -> None:
    draw(title(section.title), *section.sentences)
    for grid in section.grids:
        made = table(
            *grid.headings, left=grid.headings, shrinking=grid.headings if console().is_terminal else ()
        )
        for row in grid.rows:
            made.add_row(*row)
        draw(made)
