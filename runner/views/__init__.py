"""Views: questions about recorded runs, each asked once. Commands, routes and pages are derived from them.

A view is a module with a `VIEW`. It imports heavy packages in its function, so that help is quick. Installed
packages add views by entry points, see `runner.util.extras`.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from importlib import import_module
from typing import Final

from runner.util import extras
from runner.views.view import View

NAMES: Final = (
    "episodes",
    "evaluations",
    "qtable",
    "when",
    "why",
    "checkpoints",
    "system",
    "console",
    "code",
    "diff",
    "compare",
    "show",
    "verify",
    "values",
    "du",
    "ls",
    "find",
    "sql",
    "table",
    "sweep show",
    "sweep ls",
)
"""The shipped views, each the module of its name with `_`; those of one run in the order of their tabs."""


def shipped_views() -> Iterator[View]:
    """Yield the shipped views."""
    return map(view_named, NAMES)


@cache  # reading the metadata of all packages takes 0.1 s
def view_named(name: str) -> View:
    """Return the view of this name, shipped or added by an installed package.

    Raises:
        RunnerError: it cannot be imported.
    """
    if name not in NAMES:
        return extras.load_plugin(extras.VIEWS, name, View)
    view: View = import_module(f"runner.views.{name.replace(' ', '_')}").VIEW
    return view
