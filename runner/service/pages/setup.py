"""The page of how a run was made: its configuration, provenance and log."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Final, NamedTuple

from fastapi import APIRouter, Response

from runner.analysis.summary import brief_provenance
from runner.config.document import write_yaml
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.messages import log_level
from runner.recording.reader import open_recording
from runner.service.dependencies import FoundRun, SettingsOf
from runner.service.pages.frame import RunPage
from runner.util import humanize
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
    steps = [humanize.number(run.summary.get(name), 0) for name in ("train_steps", "eval_steps")]
    facts = {
        "Run": run.run_id,
        "Begun": f"{run.created:%Y-%m-%d %H:%M:%S} UTC",
        "Content digest": run.summary.content_digest or "none: computed when a run ends properly",
        "Steps": f"{steps[0]} of training, {steps[1]} of evaluation",
    }
    provenance: Mapping[str, str] = {}
    log: list[LogLine] = []
    try:
        with open_recording(run.recording) as recording:
            facts |= {"Job hash": recording.run["job"], "Size": humanize.size(recording.file.size)}
            provenance = brief_provenance(recording.provenance)
            log = [
                LogLine(
                    line["log_time"] // schema.STEP_NANOSECONDS,
                    log_level(line["level"]).lower(),
                    line["message"],
                )
                for line in deque(recording.table(schema.LOG_TOPIC).decoded(), MAX_LINES)
            ]
    except RecordingError as error:
        facts["Recording"] = settings.without_folders(str(error))
    values = {
        "yaml": write_yaml(run.file.config),
        "facts": facts,
        "provenance": provenance,
        "log": log,
        "exports": list(plugin_names(EXPORTS)),
    }
    return RunPage(run, "config", "run_config.html", values)
