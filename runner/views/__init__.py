"""Views: questions about recorded runs, each asked once; commands, API routes and pages are derived of them.

A view is a module with a `VIEW`. It imports heavy packages in its function, so that help is quick. Installed
packages add views by entry points, see `runner.util.plugins`.
"""

from __future__ import annotations

from functools import cache
from typing import Final

from runner.util import plugins
from runner.views import (
    checkpoints,
    code,
    compare,
    console,
    diff,
    du,
    episodes,
    evaluations,
    qtable,
    show,
    system,
    values,
    verify,
    when,
    why,
)
from runner.views.view import View

VIEWS: Final = {
    module.VIEW.name: module.VIEW
    for module in (
        episodes,
        evaluations,
        qtable,
        when,
        why,
        checkpoints,
        system,
        console,
        code,
        diff,
        compare,
        show,
        verify,
        values,
        du,
    )
}
"""Name of a view -> the view; those of one run in the order of their tabs."""


@cache  # reading the metadata of all packages takes 0.1 s
def view_named(name: str) -> View:
    """Return the view of this name, shipped or added by an installed package.

    Raises:
        RunnerError: it cannot be imported.
    """
    return VIEWS[name] if name in VIEWS else plugins.load_plugin(plugins.VIEWS, name, View)
