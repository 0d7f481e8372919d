"""Where a Q-value comes from, as HTML: for the pages of a server, and for notebooks."""

from __future__ import annotations

from html import escape
from typing import Final

from runner.analysis.step_reference import StepRef
from runner.debugging.why import Why
from runner.debugging.why_text import facts_of, sections_of
from runner.errors import MissingExtra
from runner.export.reports.rendering import page_style, partials

HEIGHT: Final = 760
"""Height of a notebook's frame in pixels."""
KEY: Final = (
    "An arrow is as wide as the weight of all steps that made this move; a ring stands for staying in the "
    "cell, as after a move into a wall, or a pickup. Things are drawn where they are in the value's state."
)


def why_body(found: Why, linked: bool) -> str:
    """Return the part of a page that shows a Q-value as a sum.

    Args:
        found: the sum.
        linked: link each step to its replay on a server.

    Raises:
        MissingExtra: Jinja2 is not installed.
    """
    parts = partials()
    *sections, steps = sections_of(found)
    steps_at = [StepRef.parse(step.at) for step in found.steps]
    links = [at.replay_address(found.run_id) for at in steps_at] if linked else []
    picture = ""
    if found.picture:
        picture = f'<figure class="moves">{found.picture}<figcaption>{escape(KEY)}</figcaption></figure>'
    first, *others = [parts.section(f"why-{k}", body.title, body) for k, body in enumerate(sections)]
    listed = "".join(str(parts.grid(grid, steps.title, "list", links)) for grid in steps.grids)
    return (
        f'{parts.pairs("The value", facts_of(found))}<div class="why">{picture}<div>{first}</div></div>'
        f'<section id="why-steps"><h2>{escape(steps.title)}</h2>'
        f"{parts.paragraphs(steps.sentences)}{listed}</section>"
        f"{''.join(map(str, others))}"
    )


def why_frame(found: Why) -> str:
    """Return a Q-value as a sum in a frame of its own; the value alone if packages are missing."""
    try:
        page = f"<style>{page_style()}</style><main>{why_body(found, linked=False)}</main>"
    except MissingExtra as error:
        facts = "; ".join(f"{name} {text}" for name, text in facts_of(found).items())
        return f"<p>{escape(facts)}</p><p>{escape(str(error))}</p>"
    title = f"Why the value of action {found.action_in_words} in state {found.state} is {found.value:.4g}"
    return (
        f'<iframe title="{escape(title)}" srcdoc="{escape(page)}" width="100%" height="{HEIGHT}" '
        'style="border: 1px solid #8888; border-radius: 6px" sandbox></iframe>'
    )
