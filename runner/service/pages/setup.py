"""The page of how a run was made: its configuration, provenance and log."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Final

from fastapi import APIRouter, Request, Response

from runner.analysis.sections import Grid, Link, Section
from runner.analysis.summary import describe_run
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.messages import log_level
from runner.recording.reader import open_recording
from runner.service.dependencies import FoundRun, SettingsOf
from runner.service.pages.frame import RunPage
from runner.service.pages.rendering import viewer_of
from runner.util.plugins import EXPORTS, plugin_names

router = APIRouter(prefix="/runs/{run}", include_in_schema=False)

MAX_LINES: Final = 500
"""Lines at the end of a run's log that its page shows."""


@router.get("/config")
def config(request: Request, run: FoundRun, settings: SettingsOf) -> Response:
    """Show configuration, provenance and log."""
    log: list[tuple[str, ...]] = []
    details = describe_run(run, with_results=False)
    try:
        with open_recording(run.recording) as recording:
            log = [
                (
                    f"{line['log_time'] // schema.STEP_NANOSECONDS:,}",
                    log_level(line["level"]).lower(),
                    line["message"],
                )
                for line in deque(recording.table(schema.LOG_TOPIC).decoded(), MAX_LINES)
            ]
    except RecordingError as error:
        details = replace(details, damage=details.damage or str(error))
    origin = [
        replace(each, facts={name: settings.without_folders(text) for name, text in each.facts.items()})
        for each in details.origin_sections()
    ]
    files = {
        "Download the recording": "recording",
        "For Rerun": "replay.rrd",
        "Report": "report.html",
        **{f"As {name}": f"exports/{name}" for name in plugin_names(EXPORTS)},
    }
    links = [Link(text, f"/api/v1/runs/{run.run_id}/{path}") for text, path in files.items()]
    if viewer_of(request).can_write and "made_by" not in run.file.config:  # a loop cannot be submitted
        links.insert(0, Link("Submit a variation", f"/submit?from={run.run_id}"))
    lines = Grid(("step", "level", "message"), log, left=("level", "message"))
    sections = [
        Section("", parts=origin, layout="tables"),
        Section("", links=links),
        Section("Log", grids=[lines]) if log else Section("Log", ["The run logged no texts."]),
    ]
    return RunPage(run, "config", "run_config.html", {"setup": sections})
