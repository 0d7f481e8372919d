"""The explanations of differences that `dualtaxi explain` left in a recordings folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from fastapi import APIRouter, Request, Response

from runner.analysis.sections import Section
from runner.analysis.step_reference import StepRef
from runner.debugging.explanation import Explanation, plots, sections
from runner.export.plots.curves import Plot
from runner.export.reports.rendering import Link, View
from runner.service.api.comparing import Part, found_explanation
from runner.service.dependencies import SettingsOf
from runner.service.pages.rendering import page

router = APIRouter(prefix="/sweeps/explanations", include_in_schema=False)


@dataclass(frozen=True)
class _ExplanationView(View):
    TEMPLATE: ClassVar = "explanation.html"
    title: str
    lead: list[str]
    links: Sequence[Link]
    plots: Sequence[Plot]
    parts_of_answer: Sequence[Section]


@router.get("/{pair}/{metric}")
def explanation(request: Request, pair: Part, metric: Part, settings: SettingsOf) -> Response:
    """Show an explanation."""
    found = found_explanation(pair, metric, settings)
    first, *others = sections(found)
    return page(request, _ExplanationView(first.title, first.sentences, _links(found), plots(found), others))


def _links(found: Explanation) -> list[Link]:
    """Return the replays of the first step that the strongest setting changed, without and with it."""
    first = found.first_step
    if first is None or first.episode is None:
        return []
    step = StepRef(first.episode, first.t or 0)
    runs = (("without", first.run_a), ("with", first.run_b))
    return [Link(f"Replay {word} {first.setting}", step.replay_address(run)) for word, run in runs]
