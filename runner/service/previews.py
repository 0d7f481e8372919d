"""Runs that are pushed while they are recorded: listed as running before their upload is complete.

    recordings/k3v9m2xq/run.json          with the id of the upload
    recordings/k3v9m2xq/recording.mcap    a link to the bytes that have been received
    recordings/k3v9m2xq/stop              if the loop is requested to stop

Nothing of it is verified: readers take any recording as hostile input. When the upload is verified and
stored, its run replaces the preview.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from pathlib import Path
from typing import Final

from runner.errors import RunnerError
from runner.recording.reader import open_recording
from runner.runs.importing import checked_facts
from runner.runs.listing import run_in
from runner.runs.run import PREVIEW, RECORDING_FILE, RUN_FILE, Run
from runner.util.files import write_object
from runner.util.values import NAME_PATTERN

_DESCRIPTION_BYTES: Final = 64 << 20
"""A description of a run that takes more is not waited for."""


def preview_of(recordings: Path, upload_id: str, run_id: str) -> Run | None:
    """Return the run that shows an upload; None without one, or if the id is another run's."""
    run = run_in(recordings / run_id) if re.fullmatch(NAME_PATTERN, run_id) else None
    return run if run is not None and run.facts.get(PREVIEW) == upload_id else None


def update_preview(recordings: Path, upload_id: str, run_id: str, body: Path) -> Run | None:
    """Note that the sender of an upload goes on; return the run that shows it, if its bytes describe it.

    A run of another upload, or one that is stored, stays as it is.
    """
    if (run := preview_of(recordings, upload_id, run_id)) is not None:
        run.beat()
        return run
    target = recordings / run_id
    if not re.fullmatch(NAME_PATTERN, run_id) or os.path.lexists(target):
        return None
    with contextlib.suppress(RunnerError, OSError):  # its description is not complete, or no run's
        if body.stat().st_size > _DESCRIPTION_BYTES:
            return None
        with open_recording(body) as recording:
            facts = checked_facts(recording, {})
        if facts["run_id"] != run_id:
            return None
        # The owner is no process of this machine, so the run counts as running by its heartbeat.
        facts |= {"status": "running", "owner": {"host": "upload"}, PREVIEW: upload_id}
        hidden = body.with_name("preview")
        shutil.rmtree(hidden, ignore_errors=True)
        hidden.mkdir()
        os.link(body, hidden / RECORDING_FILE)
        write_object(hidden / RUN_FILE, facts)
        hidden.rename(target)
    return preview_of(recordings, upload_id, run_id)


def remove_preview(recordings: Path, upload_id: str, run_id: str) -> None:
    """Remove the run that shows an upload, if it exists."""
    if (run := preview_of(recordings, upload_id, run_id)) is not None:
        shutil.rmtree(run.folder, ignore_errors=True)
