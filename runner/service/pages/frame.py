"""The head of every page of a run, and the last results of loops."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from typing import Annotated, Final

from fastapi import Query

from runner.analysis.evaluations import loop_summary
from runner.analysis.qtable import recorded_tables
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.metrics import EvaluationMetric
from runner.recording.reader import open_recording
from runner.recording.run_file import EvaluationMetrics, Summary, has_environment
from runner.runs.run import Run
from runner.service.pages.rendering import Page, Values, made
from runner.util import humanize, plugins
from runner.views import VIEWS, view_named

StatusName = Annotated[str, Query(max_length=20, description="The status that the page shows.")]

TABS: Final = (
    ("", "Overview"),
    ("replay", "Replay"),
    ("learned", "What was learned"),
    *((view.name, view.title) for view in VIEWS.values() if view.has_tab),
    ("config", "Configuration"),
    ("pictures", "Pictures"),
    ("rerun", "Rerun"),
)


def installed_names() -> list[str]:
    """Return the names of the views that installed packages add, except names of shipped pages."""
    return [name for name in plugins.plugin_names(plugins.VIEWS) if name not in {**dict(TABS), **VIEWS}]


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
    is_running_loop = run.status == "running" and not run.can_train_again
    messages, packing = run.summary.messages, run.file.config.get("recording")
    met = {
        "": True,
        "checkpoints": bool(messages.get(schema.CHECKPOINT_TOPIC.name)) or is_running_loop,
        "episodes": has_episodes,
        "tables": has_tables,
        "training": run.can_train_again,
    }
    needs = {"learned": "tables"} | {view.name: view.needs for view in VIEWS.values()}
    has_tab = {
        **{name: met[need] for name, need in needs.items()},
        "replay": has_episodes,
        "rerun": has_episodes,
        "pictures": bool(messages.get(schema.IMAGE_TOPIC.name)) or is_running_loop,
    }
    return RunHead(
        id=run.run_id,
        name=run.name,
        seed=run.seed if run.has_seed else None,
        status=run.status,
        created=run.created.isoformat(),
        tags=run.tags,
        note=run.note,
        tabs=(
            *(tab for tab in TABS if has_tab.get(tab[0], True)),
            *((view.name, view.title) for view in map(view_named, installed_names()) if view.has_tab),
        ),
        lacking={
            name: "Q-tables" if not has_tables else "training that the runner can repeat"
            for name, need in needs.items()
            if not met[need] and need in ("tables", "training")
        },
        steps=str(packing.get("steps", "all")) if isinstance(packing, Mapping) else "all",
    )


def _has_recorded_tables(run: Run) -> bool:
    """Return whether a loop recorded tables that can be drawn as maps; only one with arrays is opened."""
    if not run.summary.messages.get(schema.ARRAY_TOPIC.name):
        return False
    with contextlib.suppress(RecordingError), open_recording(run.recording) as recording:
        return recording.tabular and next(recorded_tables(recording), None) is not None
    return False


def last_results(run: Run) -> Summary:
    """Return the last results of a run; a loop's are empty if its recording cannot be read."""
    if run.can_train_again:
        return run.summary
    with contextlib.suppress(RecordingError), open_recording(run.recording) as recording:
        return loop_summary(recording)
    return Summary()


def result_of(metric: EvaluationMetric, evaluation: EvaluationMetrics) -> tuple[str, str]:
    """Return the name of a metric in the last evaluation, and its value with its unit."""
    value = evaluation.values.get(metric.name)
    heading = metric.heading.removesuffix(metric.suffix).capitalize()
    return f"{heading} in the last evaluation", humanize.number(value) + metric.suffix * (value is not None)
