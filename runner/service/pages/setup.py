"""The pages of how a run was made: its configuration, provenance and log, its code and packages."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Final, NamedTuple

from fastapi import APIRouter, Request, Response

from runner.analysis.summary import brief_provenance
from runner.config.document import write_yaml
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.code import Code
from runner.recording.messages import log_level
from runner.recording.reader import open_recording
from runner.service.dependencies import FoundRun, OpenRecording, RecordedRun, SettingsOf
from runner.service.pages.frame import RunPage
from runner.service.pages.rendering import message_of
from runner.util import humanize
from runner.util.plugins import EXPORTS, plugin_names

router = APIRouter(prefix="/runs/{run}", include_in_schema=False)

MAX_LINES: Final = 500
"""Lines at the end of a run's log that its page shows."""
MAX_PATCH_LINES: Final = 5000
MAX_CODE_FILES: Final = 100
"""Lines of the changes, and files, on the page of a run's code."""
CODE_FACTS: Final = {
    "git": "Commit",
    "git.branch": "Branch",
    "git.remote": "Remote",
    "git.not_recorded": "Git",
    "command": "Command",
    "code.script": "Script",
    "code.not_recorded": "Not recorded",
    "code.left_out": "Left out",
}


class CodeFile(NamedTuple):
    """A recorded source."""

    path: str
    state: str
    """How it relates to the commit, if it is not as the commit has it."""
    text: str


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


@router.get("/code")
def code(request: Request, run: RecordedRun, recording: OpenRecording) -> Response:
    """Show the user's code and the installed packages."""
    provenance, problem, recorded = recording.provenance, None, Code()
    try:
        recorded = recording.code
    except RecordingError as error:
        problem = message_of(error, request)
    patch = recorded.patch.splitlines()
    files = [
        CodeFile(path, "not in the commit" if path in recorded.new else "", text)
        for path, text in sorted(
            recorded.files.items(), key=lambda file: file[0] != provenance.get("code.script")
        )
    ]
    is_code = ("git", "code.")
    values = {
        "facts": {
            CODE_FACTS.get(key, key): text
            for key, text in provenance.items()
            if key.startswith(is_code) or key == "command"
        },
        "packages": {
            key.removeprefix("package."): text
            for key, text in provenance.items()
            if key.startswith("package.")
        },
        "patch": patch[:MAX_PATCH_LINES],
        "patch_left_out": max(0, len(patch) - MAX_PATCH_LINES),
        "files": files[:MAX_CODE_FILES],
        "files_left_out": max(0, len(files) - MAX_CODE_FILES),
        "problem": problem,
    }
    return RunPage(run, "code", "run_code.html", values)
