"""The shards of a run: what processes that joined it record, until it is over and they are folded into it.

    recordings/k3v9m2xq/shards/worker-1/run.json, recording.mcap

A shard is laid out as a run. Its name determines its place in the run, not the time at which it began.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from runner.errors import ConfigError, RunnerError, RunNotFound
from runner.runs.resolve import find_run
from runner.runs.run import SHARDS_FOLDER, Run, new_run, require_trained, run_at, run_entries, run_in
from runner.util.files import storage_errors
from runner.util.humanize import counted, size
from runner.util.values import JsonView

RUN_VARIABLE: Final = "DUALTAXI_RUN"
"""The folder of the run that this process recorded last, which its child processes can join."""
ENDS_AS: Final = "ends_as"
"""In `run.json` after the process that began the run has ended: the status that the run will have."""
_NAME: Final = re.compile(r"[\w-][\w.-]{0,79}")  # a folder that begins with a dot is no run
_LOCK: Final = "shards.lock"


def find_joined(join: object, recordings: str | os.PathLike[str] | None) -> Run:
    """Return the run that a process wants to join, which is running.

    Args:
        join: a run, or its id, the beginning of its id, its name or the path of its folder; True for the one
            in $DUALTAXI_RUN.

    Raises:
        RunNotFound: there is no such run.
    """
    if join is True:
        join = os.environ.get(RUN_VARIABLE, "")
        if not join:
            raise ConfigError(
                f"join=True: found no {RUN_VARIABLE} in the environment, expected a process that was started "
                "by the one that records the run. Pass the run's id or folder: join=run.folder."
            )
    if isinstance(join, Run):
        run = run_at(join.folder)
    elif isinstance(join, str | os.PathLike) and os.fspath(join):
        run = find_run(os.fspath(join), recordings)
    else:
        raise ConfigError(f"join: found {join!r}, expected a run, its id or its folder, or True")
    _require_open(run)
    return run


def _require_open(run: Run) -> None:
    is_job = f"join: run {run.run_id} is a job, which the runner trains; expected one of runner.record."
    require_trained(run, is_trained=False, refusal=is_job)
    if (steps := run.file.config.get("recording", {}).get("steps", "all")) != "all":
        raise RunnerError(f"join: run {run.run_id} is recorded with steps {steps!r}, expected all.")
    if is_ended(run):
        status = run.facts.get(ENDS_AS) or run.status
        raise RunnerError(
            f"join: run {run.run_id} is {status}, expected one that is still being recorded. "
            "Processes join while the process that began the run has it open."
        )


def new_shard(joined: Run, name: str | None, config: JsonView, seed: int | None, **more: Any) -> Run:
    """Create the folder of a new shard; where the name is taken, `-2`, `-3` ... is added.

    Args:
        name: of letters, digits and `_.-`; that of the process in `multiprocessing` by default.
        more: further facts for its `run.json`.

    Raises:
        ConfigError: the name is not valid.
    """
    if name is None:
        import multiprocessing

        process = multiprocessing.current_process().name
        name = re.sub(r"[^\w.]+", "-", process).strip("-.")[:60] or "process"
    if not isinstance(name, str) or not _NAME.fullmatch(name) or not name.strip("."):
        raise ConfigError(f"shard: found {name!r}, expected 1 to 80 letters, digits, _, . and -, no . first")
    names = itertools.chain([name], (f"{name}-{n}" for n in itertools.count(2)))
    with shards_locked(joined):
        _require_open(run_at(joined.folder))
        return new_run(joined.folder / SHARDS_FOLDER, config, seed, name, ids=names, **more)


def shards_of(run: Run) -> list[Run]:
    """Return the shards of a run that are not folded into it yet, ordered by name, w2 before w10."""
    return [shard for folder in shard_folders(run) if (shard := run_in(folder)) is not None]


def shard_folders(run: Run) -> list[Path]:
    """Return the folders of the shards of a run, whether they can be read or not, in the same order."""
    folder = run.folder / SHARDS_FOLDER
    names = [] if run.stands_alone else run_entries(folder)
    return [folder / name for name in sorted(names, key=_order)]


def _order(name: str) -> list[tuple[int, str]]:
    """Return a sort key by which w2 comes before w10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def is_ended(run: Run) -> bool:
    """Return whether the process that began a run has ended."""
    return ENDS_AS in run.facts or run.status != "running"


def are_over(run: Run) -> bool:
    """Return whether no process records into a run or its shards any more."""
    return is_ended(run) and all(shard.status != "running" for shard in shards_of(run))


def handed_over(run: Run) -> Run:
    """Return a run that lasts until its shards end; it is owned by a process that still records one."""
    if not is_ended(run):
        return run
    ends_as = run.facts.get(ENDS_AS) or ("interrupted" if run.file.status == "running" else run.file.status)
    others = (shard.file.owner for shard in shards_of(run) if shard.status == "running")
    return run.update(status="running", owner=dict(next(others, run.file.owner)), **{ENDS_AS: ends_as})


def shards_in_words(run: Run) -> str:
    """Return how many shards of a run are not folded into it yet, and their size; empty if there are none."""
    shards = shards_of(run)
    if not shards:
        return ""
    parts = [shard.recording for shard in shards if shard.recording.exists()]
    recorded = size(sum(part.stat().st_size for part in parts))
    return f"{counted(len(shards), 'shard')} ({recorded})"


@contextlib.contextmanager
def shards_locked(run: Run) -> Iterator[None]:
    """Keep other processes from joining a run, and from folding its shards, while the block runs.

    Raises:
        RunNotFound: the run is gone.
    """
    from filelock import FileLock

    if not Path(run.folder).is_dir():
        raise RunNotFound(f"run {run.run_id} was removed just now.")
    with storage_errors(run.folder), FileLock(run.folder / _LOCK):
        yield
