"""The templates of reports and pages: one environment, its filters, and the style that all pages share."""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Callable, Sequence
from html import escape
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import TYPE_CHECKING, Any, Final

from runner.analysis.sections import LegendEntry, Section
from runner.drawing import palette, svg, svg_maps
from runner.recording.metrics import METRICS
from runner.util import humanize
from runner.util.extras import require

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

TEMPLATES: Final = files("runner.export") / "templates"


def partials() -> Any:
    """Return the macros of `parts.html`, which reports and pages share, as functions that return HTML."""
    return templates().get_template("parts.html").module


def render(
    title: str,
    lead: Sequence[str],
    sections: Sequence[Section],
    source: str,
    *,
    notes: Sequence[str] = (),
    legend: Sequence[LegendEntry] = (),
    replays: bool = False,
) -> str:
    """Return a self-contained page of sections; `replays` adds the script that plays episodes."""
    return (
        templates()
        .get_template("page.html")
        .render(
            title=title,
            lead=lead,
            sections=sections,
            source=source,
            notes=notes,
            legend=legend,
            replays=replays,
        )
    )


@functools.cache
def templates() -> Environment:
    """Return the templates of reports."""
    environment = environment_of((TEMPLATES,))
    environment.globals |= {"style": page_style, "script": (TEMPLATES / "replay.js").read_text}
    return environment


def environment_of(folders: Sequence[Traversable]) -> Environment:
    """Return an environment of templates, which are looked for in folders in their order."""
    require("jinja2", extra="plots", purpose="a report")
    import jinja2

    def source(name: str) -> str | None:
        file = next((folder / name for folder in folders if (folder / name).is_file()), None)
        return None if file is None else file.read_text("utf-8")

    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(source),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    filters: dict[str, Callable[..., str]] = {
        "number": humanize.number,
        "count": lambda value: humanize.number(value, 0),
        "counted": humanize.counted,
        "code": code,
        "duration": humanize.duration,
        "sentence": humanize.sentence,
    }
    environment.filters |= filters
    environment.globals["metrics"] = METRICS
    return environment


@functools.cache
def page_style() -> str:
    """Return the CSS of a page: its colours, its layout, and the pictures in it."""
    layout = (TEMPLATES / "report.css").read_text("utf-8")
    dark = f"@media (prefers-color-scheme:dark){{{svg.DARK_STYLE}}}"
    return "\n".join([palette.css_variables(), layout, svg.STYLE, svg_maps.STYLE, dark])


def framed(title: str, page: str, height: int, sandbox: str = "") -> str:
    """Return a page in a frame of its own, as HTML for a notebook; `sandbox` is what the page may do."""
    return (
        f'<iframe title="{escape(title)}" srcdoc="{escape(page)}" width="100%" height="{height}" '
        f'style="border: 1px solid #8888; border-radius: 6px" sandbox="{sandbox}"></iframe>'
    )


def code(text: str) -> Markup:
    """Return a text as HTML in which the parts between backticks are set as code."""
    from markupsafe import Markup
    from markupsafe import escape as marked

    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(marked(text))))


def embedded(data: object) -> str:
    """Return data as JSON that is safe inside a script element."""
    text = json.dumps(data, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
