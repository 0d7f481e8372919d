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
from runner.service.upload import Upload
from runner.util.files import write_object
from runner.util.values import NAME_PATTERN

_DESCRIPTION_BYTES: Final = 64 << 20
"""A description of a run that takes more is not waited for."""


class Previews:
    """The runs of uploads that are being received into a recordings folder."""

    def __init__(self, recordings: Path) -> None:
        self._recordings = recordings

    def of(self, upload: Upload) -> Run | None:
        """Return the run that shows an upload; None if there is none."""
        if not upload.run_id or not re.fullmatch(NAME_PATTERN, upload.run_id):
            return None
        run = run_in(self._recordings / upload.run_id)
        return run if run is not None and run.facts.get(PREVIEW) == upload.id else None

    def update(self, upload: Upload, body: Path) -> None:
        """Show an upload whose sender still records, as soon as it describes a run; or note that it goes on.

        A run of another upload, or one that is stored, stays as it is.
        """
        if upload.digest is not None or upload.checkpoint_of or upload.state != "receiving":
            return
        if (run := self.of(upload)) is not None:
            run.beat()
            return
        if not 0 < upload.offset < _DESCRIPTION_BYTES or not re.fullmatch(NAME_PATTERN, upload.run_id):
            return
        target = self._recordings / upload.run_id
        if os.path.lexists(target):
            return
        with contextlib.suppress(RunnerError, OSError):  # its description is not complete, or no run's
            with open_recording(body) as recording:
                facts = checked_facts(recording, {})
            if facts["run_id"] != upload.run_id:
                return
            # The owner is no process of this machine, so the run counts as running by its heartbeat.
            facts |= {"status": "running", "owner": {"host": "upload"}, PREVIEW: upload.id}
            hidden = body.with_name("preview")
            shutil.rmtree(hidden, ignore_errors=True)
            hidden.mkdir()
            os.link(body, hidden / RECORDING_FILE)
            write_object(hidden / RUN_FILE, facts)
            hidden.rename(target)

    def remove(self, upload: Upload) -> None:
        """Remove the run that shows an upload, if there is one."""
        if (run := self.of(upload)) is not None:
            shutil.rmtree(run.folder, ignore_errors=True)
