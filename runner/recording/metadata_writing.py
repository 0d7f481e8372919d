"""What a recording tells of its run, its environment and its end: written. `facts` reads it back, checked."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

from numpy.typing import NDArray

from runner.recording import schema
from runner.recording.arrays import pack_array
from runner.recording.writer import RecordingFile, storage_error

Attachments = Mapping[str, tuple[str, bytes]]
"""Name -> media type and content."""


def run_facts(
    run_id: str, name: str, seed: int | None, job: str, created: str, agents: Sequence[str], events: int
) -> dict[str, str]:
    """Return what every recording says of its run.

    Args:
        run_id: its id.
        name: what it is called.
        seed: its job's seed; None for a loop that was given none.
        job: the identity of its job.
        created: when it began.
        agents: the learners: one reward each.
        events: number of event counters of an episode.
    """
    return {
        "format_version": str(schema.FORMAT_VERSION),
        "run_id": run_id,
        "name": name,
        "seed": str(seed or 0),
        "job": job,
        "created": created,
        "agents": json.dumps(agents),
        "learners": str(len(agents)),
        "events": str(events),
        **({"seeded": "false"} if seed is None else {}),
    }


def environment_attachments(said: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> Attachments:
    """Return the attachments that tell of an environment: what is said of it, and the arrays it has."""
    text = _indented(json.dumps({**said, "arrays": sorted(arrays)}, sort_keys=True))
    return {"environment.json": ("application/json", text.encode())} | {
        f"environment/{name}.npy.zst": ("application/zstd", pack_array(arrays[name]))
        for name in sorted(arrays)
    }


@lru_cache(32)
def _indented(text: str) -> str:
    """Return JSON with one value a line; cached, because a process often records one environment again."""
    return json.dumps(json.loads(text), indent=1, sort_keys=True)


def write_description(
    file: RecordingFile,
    run: Mapping[str, str],
    config: Mapping[str, Any],
    made_by: Mapping[str, str],
    environment: Attachments,
) -> None:
    """Write what makes a recording self-contained.

    Raises:
        StorageError: the disk is full or failing.
    """
    try:
        file.add_metadata("run", run)
        file.add_metadata("config", _as_entries(config))
        file.add_metadata("provenance", made_by)
        for name, (media_type, data) in environment.items():
            file.add_attachment(name, media_type, data)
    except OSError as error:
        file.cut_back()
        raise storage_error(file, error) from error


def write_result(file: RecordingFile, status: str, result: Mapping[str, Any]) -> None:
    """Write how it ended, the index and the summary; all of it, or nothing.

    Raises:
        StorageError: the disk is full or failing.
    """
    try:
        file.finish("result", _as_entries({"status": status, **result}))
    except OSError as error:
        raise storage_error(file, error) from error


def _as_entries(said: Mapping[str, Any]) -> dict[str, str]:
    return {"json": json.dumps(said, sort_keys=True)}
