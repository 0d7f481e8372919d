"""The recordings folder: a folder a run, with its recording and a small file that says what it is.

    recordings/k3v9m2xq/run.json         id, name, configuration, owner, status, summary
    recordings/k3v9m2xq/recording.mcap   the truth

`run.json` stands before anything heavy is imported and is only ever replaced whole. Its status is what
the owner last said; whether a `running` run still has a living owner is looked at when asked.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import shutil
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from runner.errors import RecordingError, RunNotFound, StorageError, nearest

if TYPE_CHECKING:  # listing runs is to be quick
    from runner.config import ExperimentConfig

RUN_FILE: Final = "run.json"
RECORDING_FILE: Final = "recording.mcap"
HEARTBEAT_SECONDS: Final = 15.0
"""On another host, a run without a heartbeat for this long counts as interrupted."""
RECORDINGS_VARIABLE: Final = "DUALTAXI_RECORDINGS"

_ALPHABET: Final = "abcdefghjkmnpqrstvwxyz23456789"
_ID_LENGTH: Final = 8
_LATEST: Final = "@latest"


@dataclass(frozen=True)
class Run:
    """A run in a recordings folder."""

    folder: Path
    facts: dict[str, Any]
    """The contents of `run.json`."""

    @property
    def run_id(self) -> str:
        """Its id, unique."""
        return str(self.facts["run_id"])

    @property
    def name(self) -> str:
        """Its name, not unique."""
        return str(self.facts["name"])

    @property
    def seed(self) -> int:
        """Its job's seed."""
        return int(self.facts["seed"])

    @property
    def recording(self) -> Path:
        """The MCAP file."""
        return self.folder / str(self.facts.get("recording", RECORDING_FILE))

    @property
    def created(self) -> datetime:
        """When it began, in UTC."""
        return datetime.fromisoformat(self.facts["created"]).astimezone(UTC)

    @property
    def summary(self) -> dict[str, Any]:
        """What its owner said at the end; empty before."""
        return dict(self.facts.get("summary", {}))

    @property
    def status(self) -> str:
        """`running`, `finished`, `interrupted` or `failed`; a dead owner's run is interrupted."""
        said = str(self.facts["status"])
        return "interrupted" if said == "running" and not self._owner_lives() else said

    def _repr_html_(self) -> str:
        """Return how the run shows itself in a notebook."""
        from runner.notebook import run_html

        return run_html(self)

    def _owner_lives(self) -> bool:
        owner = self.facts.get("owner", {})
        if owner.get("host") == socket.gethostname() and owner.get("boot_id") == boot_id():
            started = process_start(owner.get("pid", 0))
            return started is not None and started == owner.get("process_started")
        with contextlib.suppress(OSError):
            return time.time() - (self.folder / RUN_FILE).stat().st_mtime < HEARTBEAT_SECONDS
        return False

    def beat(self) -> None:
        """Say that the owner lives."""
        with contextlib.suppress(OSError):
            os.utime(self.folder / RUN_FILE)

    def update(self, **facts: Any) -> Run:
        """Return the run with these facts, written to its file.

        Raises:
            StorageError: the file cannot be written; it is as before.
        """
        changed = Run(self.folder, self.facts | facts)
        try:
            _write_whole(self.folder / RUN_FILE, changed.facts)
        except OSError as error:
            raise StorageError(
                f"{self.folder / RUN_FILE}: cannot be written ({error.strerror}); free some disk."
            ) from error
        return changed


def create_run(recordings: Path, config: ExperimentConfig, seed: int, name: str | None = None) -> Run:
    """Make a folder for a new run and write what it is; an id is never used twice.

    Args:
        recordings: the folder to make it in; made if it is missing.
        config: what is run.
        seed: the one seed that is run.
        name: what the run is called; the configuration's name unless given.

    Raises:
        StorageError: the recordings folder cannot be written.
    """
    try:
        recordings.mkdir(parents=True, exist_ok=True)
        while True:
            run_id = "".join(secrets.choice(_ALPHABET) for _ in range(_ID_LENGTH))
            folder = recordings / run_id
            try:
                folder.mkdir()
                break
            except FileExistsError:
                continue
        run = Run(
            folder,
            {
                "run_id": run_id,
                "name": name or config.name,
                "seed": seed,
                "status": "running",
                "created": datetime.now(UTC).isoformat(timespec="milliseconds"),
                "owner": owner(),
                "config": config.to_mapping(),
            },
        )
        _write_whole(folder / RUN_FILE, run.facts)
    except OSError as error:
        raise StorageError(
            f"{recordings}: cannot be written ({error.strerror}); "
            f"choose another folder by --recordings or {RECORDINGS_VARIABLE}."
        ) from error
    return run


@contextlib.contextmanager
def unless_empty(run: Run) -> Iterator[None]:
    """Remove the run's folder if what is done here fails before there is a recording; the error says so."""
    try:
        yield
    except BaseException as error:
        if not run.recording.exists():
            shutil.rmtree(run.folder, ignore_errors=True)
            error.add_note(f"Nothing was recorded; the empty run {run.run_id} was removed.")
        raise


def recordings_folder(chosen: str | os.PathLike[str] | None = None) -> Path:
    """Return the recordings folder: the chosen one, else the variable's, else ./recordings."""
    return Path(chosen or os.environ.get(RECORDINGS_VARIABLE) or "recordings")


def list_runs(recordings: Path) -> list[Run]:
    """Return the runs of a folder, the newest first; what is no run is left alone.

    Raises:
        StorageError: the folder is there and cannot be read.
    """
    try:
        folders = [Path(entry.path) for entry in os.scandir(recordings) if entry.is_dir()]
    except FileNotFoundError:
        return []
    except OSError as error:
        raise StorageError(f"{recordings}: cannot be read as a folder of runs ({error.strerror}).") from error
    runs = [run for folder in folders for run in _runs_in(folder)]
    return sorted(runs, key=lambda run: (run.facts["created"], run.run_id), reverse=True)


def find_run(name: str, recordings: Path, but: str = "") -> Run:
    """Return the one run that answers to an id, a unique prefix of it, a name, a path or `@latest`.

    `NAME@latest` is the newest run of that name.

    Args:
        name: what it must answer to.
        recordings: the folder to look in.
        but: the id of a run that does not answer: the one that is asking.

    Raises:
        RunNotFound: none does, or several do.
    """
    if os.sep in name or name.endswith(".mcap") or (os.altsep and os.altsep in name):
        return _run_at(Path(name))
    runs = [run for run in list_runs(recordings) if run.run_id != but]
    if name.endswith(_LATEST):
        stem = name.removesuffix(_LATEST)
        newest = next((run for run in runs if stem in ("", run.name)), None)
        if newest is not None:
            return newest
    exact = [run for run in runs if run.run_id == name]
    found = exact or [run for run in runs if run.name == name or run.run_id.startswith(name)]
    if len(found) == 1:
        return found[0]
    if found:
        several = "\n".join(
            f"  {run.run_id}  {run.name}  seed {run.seed}  {run.created:%Y-%m-%d %H:%M}" for run in found
        )
        raise RunNotFound(f"{name!r} answers to {len(found)} runs; name one by its id:\n{several}")
    if not runs:
        raise RunNotFound(
            f"no run {name!r}: there are no runs in {recordings} yet. `dualtaxi run` makes one."
        )
    hint = nearest(name, [run.name for run in runs] + [run.run_id for run in runs])
    raise RunNotFound(
        f"no run {name!r} in {recordings}.{hint} `dualtaxi ls` lists the {len(runs)} there are."
    )


def _run_at(path: Path) -> Run:
    """Return the run in a folder, or of a recording that may stand alone."""
    if path.is_dir():
        for run in _runs_in(path):
            return run
        raise RunNotFound(f"{path}: found a folder without {RUN_FILE} or {RECORDING_FILE}, expected a run.")
    if not path.is_file():
        raise RunNotFound(f"{path}: no such file or folder.")
    if path.name == RECORDING_FILE and (path.parent / RUN_FILE).is_file():
        return _run_at(path.parent)
    return _from_recording(path)


def _runs_in(folder: Path) -> Iterator[Run]:
    """Yield the run in a folder, if there is one; from its recording when `run.json` is gone."""
    try:
        facts = json.loads((folder / RUN_FILE).read_bytes())
        if _is_run(facts):
            yield Run(folder, facts)
            return
    except (OSError, ValueError):
        pass
    if (folder / RECORDING_FILE).is_file():
        with contextlib.suppress(RecordingError):
            yield _from_recording(folder / RECORDING_FILE)


def _is_run(facts: Any) -> bool:
    """Return whether these are the facts of a run: a file may hold anything."""
    if not isinstance(facts, dict):
        return False
    kinds = {"run_id": str, "name": str, "seed": int, "status": str, "created": str}
    sound = all(isinstance(facts.get(key), kind) for key, kind in kinds.items())
    parts = all(isinstance(facts.get(key, {}), dict) for key in ("owner", "config", "summary"))
    return sound and parts and bool(datetime.fromisoformat(facts["created"]))


def _from_recording(path: Path) -> Run:
    """Return the run that a recording says it is."""
    from runner.recording.reader import open_recording

    with open_recording(path) as recording:
        return Run(path.parent, {**recording.run_facts(), "recording": path.name})


def owner() -> dict[str, Any]:
    """Return who this process is: host, boot, process id and its start."""
    pid = os.getpid()
    return {
        "host": socket.gethostname(),
        "boot_id": boot_id(),
        "pid": pid,
        "process_started": process_start(pid),
    }


def boot_id() -> str:
    """Return what tells this start of the machine from any other."""
    with contextlib.suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    import psutil

    return f"{psutil.boot_time():.0f}"


def process_start(pid: int) -> float | None:
    """Return when a process began; None if there is none. To be compared within one start of the machine.

    On Linux it is counted in ticks since the machine started, so that setting the clock changes nothing.
    """
    if not isinstance(pid, int) or isinstance(pid, bool):
        return None  # a file may say anything
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return None if fields[0] == "Z" else float(fields[19])
    except (OSError, ValueError, IndexError):
        return None if Path("/proc/self/stat").exists() else _process_start_elsewhere(pid)


def _process_start_elsewhere(pid: int) -> float | None:
    import psutil

    try:
        process = psutil.Process(pid)
        return None if process.status() == psutil.STATUS_ZOMBIE else process.create_time()
    except (psutil.Error, ValueError, TypeError, OverflowError):
        return None


def _write_whole(path: Path, facts: dict[str, Any]) -> None:
    """Replace a file whole: a reader sees the old one or the new one."""
    fresh = path.with_suffix(f".{secrets.token_hex(4)}.tmp")
    try:
        fresh.write_text(json.dumps(facts, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        fresh.replace(path)
    except OSError:
        fresh.unlink(missing_ok=True)
        raise
