"""An explanation as pictures, and as HTML for notebooks and pages."""

from __future__ import annotations

from runner.debugging.explanation import Explanation, sections
from runner.export.reports.rendering import partials


def explanation_html(explanation: Explanation) -> str:
    """Return the sections of an explanation as HTML."""
    found = sections(explanation)
    return "".join(str(partials().section(f"explain-{i}", each.title, each)) for i, each in enumerate(found))
