"""Sections of sentences and tables, printed as text or as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
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


def _draw(section: Section) -> None:
    draw(title(section.title), *section.sentences)
    for grid in section.grids:
        made = table(
            *grid.headings, left=grid.headings, shrinking=grid.headings if console().is_terminal else ()
        )
        for row in grid.rows:
            made.add_row(*row)
        draw(made)
