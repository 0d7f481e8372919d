"""The head of every page of a run, and how a metric is shown."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from typing import Annotated, Final

from fastapi import Query

from runner.analysis.qtable import recorded_tables
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.metrics import EvaluationMetric
from runner.recording.reader import open_recording
from runner.recording.run_file import EvaluationMetrics, has_environment
from runner.runs.run import Run
from runner.service.pages.rendering import Page, Values, made
from runner.util import extras, humanize
from runner.views import NAMES, shipped_views, view_named

StatusName = Annotated[str, Query(max_length=20, description="The status that the page shows.")]

TABS: Final = (
    ("", "Overview", ""),
    ("replay", "Replay", "episodes"),
    ("learned", "What was learned", "tables"),
    *((view.name, view.title, view.needs) for view in shipped_views() if view.has_tab),
    ("config", "Configuration", ""),
    ("pictures", "Pictures", "pictures"),
    ("rerun", "Rerun", "episodes"),
)
"""Paths and titles of the pages of a run, and what a run needs for each."""


def installed_names() -> list[str]:
    """Return the names of the views that installed packages add, except names of shipped pages."""
    shipped = {*NAMES, *(path for path, *_ in TABS)}
    return [name for name in extras.plugin_names(extras.VIEWS) if name not in shipped]


@dataclass(frozen=True)
class RunHead:
    """The facts of a run that all of its pages show."""

    id: str
    name: str
    seed: int | None
    status: str
    created: str
    tags: tuple[str, ...]
    note: str
    tabs: tuple[tuple[str, str], ...]
    lacking: Mapping[str, str]
    """The tabs that it does not have, and what they need."""
    steps: str
    """Which steps it records: `all`, `actions` or `none`."""


class RunPage(Page):
    """A page of a run; `here` is the path of its tab."""

    def __init__(
        self, run: Run, here: str, template: str, values: Values, status: HTTPStatus | None = None
    ) -> None:
        super().__init__(template, lambda: {"run": head_of(run), "here": here, **made(values)}, status)


def head_of(run: Run) -> RunHead:
    """Return the facts of a run that all of its pages show."""
    has_episodes = has_environment(run.file.config)
    has_tables = run.can_train_again or _has_recorded_tables(run)
    status, messages = run.status, run.summary.messages
    packing = run.file.config.get("recording")
    is_running_loop = status == "running" and not run.can_train_again
    has = {
        "": True,
        "checkpoints": bool(messages.get(schema.CHECKPOINT_TOPIC.name)) or is_running_loop,
        "episodes": has_episodes,
        "pictures": bool(messages.get(schema.IMAGE_TOPIC.name)) or is_running_loop,
        "tables": has_tables,
        "training": run.can_train_again,
    }
    missing = {
        "episodes": "recorded steps",
        "tables": "Q-tables",
        "training": "training that the runner can repeat" if has_tables else "Q-tables",
    }
    installed = [view for view in map(view_named, installed_names()) if view.has_tab]
    return RunHead(
        id=run.run_id,
        name=run.name,
        seed=run.seed if run.has_seed else None,
        status=status,
        created=run.created.isoformat(),
        tags=run.tags,
        note=run.note,
        tabs=(
            *((path, title) for path, title, need in TABS if has[need]),
            *((view.name, view.title) for view in installed),
        ),
        lacking={path: missing[need] for path, _, need in TABS if need in missing and not has[need]},
        steps=str(packing.get("steps", "all")) if isinstance(packing, Mapping) else "all",
    )


def _has_recorded_tables(run: Run) -> bool:
    """Return whether a loop recorded tables that can be drawn as maps; only one with arrays is opened."""
    if not run.summary.messages.get(schema.ARRAY_TOPIC.name):
        return False
    with contextlib.suppress(RecordingError), open_recording(run.recording) as recording:
        return recording.tabular and next(recorded_tables(recording), None) is not None
    return False


def result_of(metric: EvaluationMetric, evaluation: EvaluationMetrics) -> tuple[str, str]:
    """Return the name of a metric in the last evaluation, and its value with its unit."""
    value = evaluation.values.get(metric.name)
    heading = metric.heading.removesuffix(metric.suffix).capitalize()
    return f"{heading} in the last evaluation", humanize.number(value) + metric.suffix * (value is not None)
