"""A run as one MCAP file to share: the recording, with the run's labels and marks in its metadata."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Final, NamedTuple

from runner.errors import RecordingError, RunnerError
from runner.recording.code import CODE_ATTACHMENT, CODE_RECORD
from runner.recording.labels import Labels
from runner.recording.reader import open_recording
from runner.recording.rewriting import rewrite
from runner.recording.schema import CONSOLE_TOPIC
from runner.runs.importing import EXPORT_RECORD, import_record
from runner.runs.run import Run
from runner.util.files import new_file

PRIVATE: Final = ("host", "user", "command", "directory")
"""The entries of provenance that identify persons and places."""
LEFT_OUT: Final = "left out"


class McapExport(NamedTuple):
    """The result of an export."""

    path: Path
    warnings: list[str]
    """What an anonymous file still contains of persons or places."""


def export_mcap(run: Run, target: Path, anonymous: bool = False, force: bool = False) -> McapExport:
    """Write a run that is over into one MCAP file for `import_recording`; the same run gives the same bytes.

    An anonymous file leaves out host, user, command line, folder, code and output, and the text of an error.

    Raises:
        RunnerError: the run is running or only in an archive, or the file exists.
    """
    if run.status == "running":
        raise RunnerError(f"run {run.run_id} is running; wait until it has finished, or interrupt it.")
    if run.status == "archived":
        raise RunnerError(f"run {run.run_id} is only in an archive; `dualtaxi restore` brings it back.")
    if not target.absolute().parent.is_dir():
        raise RunnerError(f"{target}: its folder does not exist; choose another place by -o.")
    facts = import_record(run) | {"anonymous": anonymous}
    if anonymous and "error" in facts["summary"]:
        facts["summary"]["error"] = LEFT_OUT
    record = {"json": json.dumps(facts, sort_keys=True, ensure_ascii=False)}

    def change(name: str, entries: dict[str, str]) -> dict[str, str] | None:
        if name == EXPORT_RECORD or (anonymous and name == CODE_RECORD):
            return None
        return _without_names(name, entries, run.recording) if anonymous else entries

    left_out = (CODE_ATTACHMENT, CONSOLE_TOPIC.name) if anonymous else ()
    with new_file(target, force) as temporary:
        rewrite(run.recording, temporary, change, {EXPORT_RECORD: record}, left_out)
    return McapExport(target, list(_warnings(run)) if anonymous else [])


def _without_names(name: str, entries: dict[str, str], recording: Path) -> dict[str, str]:
    """Return the entries of a metadata record without host, user, command line and folders.

    Raises:
        RecordingError: the record cannot be parsed.
    """
    if name in {"provenance", "rerecord"} or name.startswith("resume/"):
        return {
            key: text
            for key, text in entries.items()
            if key not in PRIVATE and not (key.startswith("env.") and re.search(r"[/\\]", text))
        }
    if name == "result" and "json" in entries:
        try:
            result = json.loads(entries["json"])
        except (ValueError, RecursionError):
            result = None
        if not isinstance(result, dict):
            raise RecordingError(
                f"{recording}: the metadata 'result' holds no JSON object, so names cannot be removed from "
                "it; export without --anonymous."
            )
        if "error" in result:
            return entries | {"json": json.dumps(result | {"error": LEFT_OUT}, sort_keys=True)}
    return entries


def _warnings(run: Run) -> Iterator[str]:
    """Yield a sentence for each part of an anonymous file that may identify a person or a place."""
    with open_recording(run.recording) as recording:
        for key, text in _texts(recording.config, ""):
            if PurePosixPath(text).is_absolute() or PureWindowsPath(text).is_absolute():
                yield f"The configuration contains a path, which is part of the job and stays: {key}: {text}"
    if run.labels != Labels() or run.marks:
        yield "The labels of the run (name, tags and note) and its marks stay as they are."


def _texts(value: object, place: str) -> Iterator[tuple[str, str]]:
    """Yield every text in a configuration with its path."""
    if isinstance(value, str):
        yield place, value
    elif isinstance(value, Mapping):
        for key, part in value.items():
            yield from _texts(part, f"{place}.{key}" if place else str(key))
    elif isinstance(value, list):
        for k, part in enumerate(value):
            yield from _texts(part, f"{place}[{k}]")
