"""The shards of a run, folded into its recording when no process records into it any more.

Each episode is kept whole, with the resets before it, and the episodes of all processes are put in one order:
by how many steps their processes had taken when they began, then by the names of the processes. So the run is
as if one loop had done all of it, and does not depend on which process was faster.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Final

from mcap.opcode import Opcode

from runner.client.outbox import forget_upload
from runner.errors import RecordingError
from runner.loops.fold import Fold, Report, ending_of_run
from runner.loops.shard_sources import Source
from runner.recording.metadata import json_object
from runner.recording.reader import open_recording
from runner.recording.repair import DamagedFile
from runner.runs.listing import run_at
from runner.runs.run import RECORDING_FILE, SHARDS_FOLDER, Run
from runner.runs.shards import ENDS_AS, are_over, handed_over, shards_locked, shards_of
from runner.util.files import open_regular, storage_errors

OWNER_WAITS: Final = 5.0
"""Seconds for which the process that began a run waits, at its end, for the others to end."""
_POLL_SECONDS: Final = 0.05


def fold_if_over(run: Run, seconds: float = 0.0, report: Report = lambda *_: None) -> Run:
    """Fold the shards of a run into its recording if no process records into it; return the run as it is.

    Args:
        seconds: how long to wait for the processes of its shards to end.

    Raises:
        RecordingError: a recording is damaged; all stay as they are.
        StorageError: the run's folder cannot be written; all stay as they are.
    """
    if not (run.folder / SHARDS_FOLDER).is_dir():
        return run
    deadline = time.monotonic() + seconds
    while not are_over(run_at(run.folder)) and time.monotonic() < deadline:
        time.sleep(_POLL_SECONDS)
    with shards_locked(run):
        run = run_at(run.folder)
        if not are_over(run):
            return handed_over(run)
        with storage_errors(run.folder, "free some disk; `dualtaxi repair` folds its shards in then"):
            return _fold(run, report)


def _fold(run: Run, report: Report) -> Run:
    fresh = run.folder / f".{RECORDING_FILE}.folding"
    fresh.unlink(missing_ok=True)
    summary: Mapping[str, object] | None = None
    with ExitStack() as stack:
        sources = _sources(run, stack)
        is_folded = bool(sources) and bool(sources[0].recording.shards)
        if sources and not is_folded:
            summary = Fold(run, sources, report).write(fresh)
        elif is_folded:  # by a process that was killed before it said so
            text = sources[0].recording.metadata("result").get("json")
            summary = json_object(text, f"{run.recording}: the result")
    if summary is not None:
        if not is_folded:
            fresh.replace(run.folder / RECORDING_FILE)
        forget_upload(run)
        facts = {key: value for key, value in run.facts.items() if key != ENDS_AS}
        summary = {**run.file.summary, **summary}
        run = Run(run.folder, facts).update(status=ending_of_run(run), summary=summary)
        shutil.rmtree(run.folder / SHARDS_FOLDER)
    return run


def _sources(run: Run, stack: ExitStack) -> list[Source]:
    """Open what each process recorded; leave out those that joined and recorded nothing."""
    sources: list[Source] = []
    first = 0
    for name, part in [("", run), *((shard.run_id, shard) for shard in shards_of(run))]:
        try:
            recording = stack.enter_context(open_recording(part.folder / RECORDING_FILE))
        except RecordingError:
            if _has_messages(part.folder / RECORDING_FILE):
                raise
            continue
        has_content = any(recording.has_messages(topic.name) for topic in recording.topics if topic.digested)
        if name and not has_content:
            continue
        sources.append(Source(name, recording, len(sources), first, part.facts.get("placed") is True))
        first += recording.environments
    return sources


def _has_messages(path: Path) -> bool:
    """Return whether a damaged recording holds any message."""
    if not path.is_file() or not path.stat().st_size:
        return False
    with open_regular(path) as stream:
        return any(opcode == Opcode.CHUNK for opcode, _, _ in DamagedFile(stream, path).good_records())
