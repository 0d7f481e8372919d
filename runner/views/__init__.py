"""Views: questions about recorded runs, each asked once. Commands, routes and pages are derived from them.

A view is a function and a `View`. It imports heavy packages in its function, so that help is quick. Installed
packages add views by entry points, see `runner.util.extras`.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from importlib import import_module
from typing import Final

from runner.util import extras
from runner.views.view import View

_MODULES: Final = {
    "episodes": "recorded",
    "evaluations": "recorded",
    "qtable": "tables",
    "when": "tables",
    "why": "tables",
    "checkpoints": "recorded",
    "system": "recorded",
    "console": "recorded",
    "code": "recorded",
    "diff": "compare",
    "compare": "compare",
    "show": "runs",
    "verify": "verify",
    "values": "tables",
    "du": "runs",
    "ls": "runs",
    "find": "queries",
    "sql": "queries",
    "table": "tables",
    "sweep show": "runs",
    "sweep ls": "runs",
}
"""The shipped views, each in capitals in its module; those of one run in the order of their tabs."""
NAMES: Final = tuple(_MODULES)


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
    module = import_module(f"runner.views.{_MODULES[name]}")
    view: View = getattr(module, name.upper().replace(" ", "_"))
    return view
