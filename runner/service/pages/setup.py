"""The page of how a run was made: its configuration, provenance and log."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Final, NamedTuple

from fastapi import APIRouter, Response

from runner.analysis.summary import describe_run
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.messages import log_level
from runner.recording.reader import open_recording
from runner.service.dependencies import FoundRun, SettingsOf
from runner.service.pages.frame import RunPage
from runner.util.plugins import EXPORTS, plugin_names

router = APIRouter(prefix="/runs/{run}", include_in_schema=False)

MAX_LINES: Final = 500
"""Lines at the end of a run's log that its page shows."""


class LogLine(NamedTuple):
    """A line of a run's log."""

    step: int
    level: str
    message: str


@router.get("/config")
def config(run: FoundRun, settings: SettingsOf) -> Response:
    """Show configuration, provenance and log."""
    log: list[LogLine] = []
    details = describe_run(run, with_results=False)
    try:
        with open_recording(run.recording) as recording:
            log = [
                LogLine(
                    line["log_time"] // schema.STEP_NANOSECONDS,
                    log_level(line["level"]).lower(),
                    line["message"],
                )
                for line in deque(recording.table(schema.LOG_TOPIC).decoded(), MAX_LINES)
            ]
    except RecordingError as error:
        details = replace(details, damage=details.damage or str(error))
    sections = [
        replace(each, facts={name: settings.without_folders(text) for name, text in each.facts.items()})
        for each in details.origin_sections()
    ]
    values = {"origin": sections, "log": log, "exports": list(plugin_names(EXPORTS))}
    return RunPage(run, "config", "run_config.html", values)
