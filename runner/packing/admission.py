"""Taking in a recording that came from elsewhere by itself, without a pack around it: proved right first."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from runner.errors import RecordingError
from runner.packing.packing import facts_bytes, run_facts
from runner.packing.present import Occupied, known, link, met, settled
from runner.packing.unpacking import workplace
from runner.recording.integrity import is_merely_cut_off
from runner.recording.reader import Recording, open_recording
from runner.recording.rewriting import content_of
from runner.recording.run_file import parse_run_file
from runner.runs.labels import LABELS_FILE, RUN_NAME_EXPECTED, RUN_NAME_PATTERN, Labels, as_json
from runner.runs.run import MADE_BY, RECORDING_FILE, RUN_FILE, Run, run_at
from runner.util.files import sync, write_whole


@dataclass(frozen=True)
class Admitted:
    """What came of taking in a recording."""

    run: Run
    content_digest: str
    already: bool
    """Whether the same run was there before, with this content or as far and further; nothing was written."""


def admit(recording: Path, said: Mapping[str, Any], labels: Labels, recordings: Path) -> Admitted:
    """Take a recording into a folder of runs; on the same disk without copying it. The file stays.

    A run that is there already, but did not come to its end, is gone on with: a recording that continues
    its own takes that one's place, and what people say of either is kept. When this returns, the run is on
    disk, also should the power fail now.

    Args:
        recording: the file, which nobody writes to any more.
        said: what `run.json` said of the run where it comes from; what the recording does not confirm, or
            cannot know, is left out.
        labels: what people say of it.
        recordings: the folder of runs; made if it is missing.

    Raises:
        RecordingError: the recording is damaged or makes no sense; nothing was written.
        Occupied: another run of this id is there, which this does not go on with.
        RunnerError: another process is at work on the run that is there.
        StorageError: the recordings folder cannot be written.
    """
    with open_recording(recording) as opened:
        facts = _checked_facts(opened, said)
        finished = opened.finished
    if not finished and not is_merely_cut_off(recording):
        raise RecordingError(f"{recording}: is damaged, not merely cut off; `dualtaxi repair` mends it.")
    digest, run_id = content_of(recording), str(facts["run_id"])
    try:
        run = known(run_id, digest, recordings)
    except Occupied as occupied:
        there, already = met(occupied, recording, facts, labels)
        return Admitted(there, digest, already)
    if run is not None:
        return Admitted(settled(run, facts), digest, already=True)
    with workplace(recordings) as folder:
        link(recording, folder / RECORDING_FILE)
        (folder / RUN_FILE).write_bytes(facts_bytes(facts))
        if labels != Labels():
            write_whole(folder / LABELS_FILE, as_json(labels))
        for path in (*folder.iterdir(), folder):
            sync(path)
        folder.rename(recordings / run_id)
        sync(recordings)
    return Admitted(run_at(recordings / run_id), digest, already=False)


def _checked_facts(recording: Recording, said: Mapping[str, Any]) -> dict[str, Any]:
    """Return what `run.json` shall say.

    Raises:
        RecordingError: the recording says what no run can be.
    """
    try:
        facts = run_facts(recording, said)
        problems = parse_run_file(facts).problems
        made_by = recording.provenance
    except (ValueError, TypeError, KeyError) as error:
        raise RecordingError(
            f"{recording.path}: what it says of its run makes no sense ({error})."
        ) from error
    if problems:
        raise RecordingError(
            f"{recording.path}: what it says of its run makes no sense ({'; '.join(problems)})."
        )
    named = all(re.fullmatch(RUN_NAME_PATTERN, facts[key]) for key in ("run_id", "name"))
    if not named or not 0 <= facts["seed"] < 1 << 64:
        raise RecordingError(
            f"{recording.path}: found the run {facts['run_id'][:100]!r} ({facts['name'][:100]!r}, seed "
            f"{facts['seed']}), expected {RUN_NAME_EXPECTED}; a seed of 64 bits."
        )
    return facts | {"provenance": {key: made_by[key] for key in MADE_BY if key in made_by}}
