"""Views: questions about a recording, each asked once; commands, API routes and pages are derived of them.

A view is a module with a `VIEW`. It imports heavy packages in its function, so that help is quick.
"""

from __future__ import annotations

from typing import Final

from runner.views import qtable, when, why

VIEWS: Final = {module.VIEW.name: module.VIEW for module in (qtable, when, why)}
"""Name of a view -> the view."""
