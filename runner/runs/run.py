"""The recordings folder: each run has a folder with its recording and a small file that describes it.

    recordings/k3v9m2xq/run.json         id, name, configuration, owner, status, summary
    recordings/k3v9m2xq/labels.json      another name, tags, a note
    recordings/k3v9m2xq/marks.json       marks at steps
    recordings/k3v9m2xq/trust.json       the mark of a run that this user recorded: `runner.runs.trust_marks`
    recordings/k3v9m2xq/recording.mcap   everything else

`run.json` is written before anything heavy is imported, and only ever replaced as a whole. Its status was
written by the owner; whether the owner of a `running` run is still alive is checked at each access.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import shlex
import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Final

from runner.errors import RecordingError, RunnerError, RunNotFound, StorageError
from runner.recording.labels import LABELS_FILE, Labels, change_labels, read_labels
from runner.recording.run_file import (
    MAX_RUN_FILE_BYTES,
    RUN_ID,
    ArchiveReference,
    RunFile,
    Summary,
    is_alive,
    owner,
    parse_run_file,
    run_title,
)
from runner.util.files import read_object, storage_errors, write_object
from runner.util.values import Json, JsonView, as_utf8, checked_run_name, is_utf8

if TYPE_CHECKING:  # listing runs must be quick
    from filelock import FileLock

    from runner.config import ExperimentConfig
    from runner.recording.marks import Mark
    from runner.runs.checkpoints import Checkpoint

RUN_FILE: Final = "run.json"
RUN_LOCK: Final = "owner.lock"
RECORDING_FILE: Final = "recording.mcap"
PREVIEW: Final = "upload"
"""The fact of a run that is being uploaded, and not verified yet: the id of its upload."""
STOP_FILE: Final = "stop"
"""Its presence requests that the loop stops."""
SHARDS_FOLDER: Final = "shards"
"""The subfolder of a run for what joined processes record until the run is over."""
UNFOLDED_FOLDER: Final = "unfolded"
"""The subfolder of a run for shards whose content is not all in the run's recording."""
UNLISTED: Final = Path(".explain", "runs")
"""The subfolder of recordings for the runs of explanations, which are found by their ids alone."""
_MADE_BY: Final = ("host", "git", "dualtaxi")
RECORDINGS_VARIABLE: Final = "DUALTAXI_RECORDINGS"

_ID_ALPHABET: Final = "abcdefghjkmnpqrstvwxyz23456789"
_ID_LENGTH: Final = 8


@dataclass(frozen=True, repr=False)
class Run:
    """A run in a recordings folder."""

    folder: Path
    facts: Json
    """The contents of `run.json`."""
    restored: Path | None = None
    """The path of its restored recording, if it is archived."""

    def __repr__(self) -> str:
        """Return id, first name and folder; `facts` has the rest."""
        run_id, name = (str(self.facts.get(key)) for key in ("run_id", "name"))
        return f"Run({run_id!r}, {name!r}, {str(self.folder)!r})"

    @cached_property
    def file(self) -> RunFile:
        """The contents of `run.json`, checked."""
        return parse_run_file(self.facts)

    @property
    def problem(self) -> str:
        """What is invalid in `run.json`, and what to do; empty if nothing is."""
        if not self.file.problems:
            return ""
        return (
            f"run {self.run_id} is damaged: {self.folder / RUN_FILE}: "
            f"{'; '.join(self.file.problems)}. Correct that file, or remove the run by "
            f"`dualtaxi rm {self.run_id}`."
        )

    @property
    def run_id(self) -> str:
        """The unique id."""
        return str(self.facts["run_id"])

    @property
    def name(self) -> str:
        """The present name, which is not unique."""
        return self.labels.name or self.file.name

    @property
    def file_stem(self) -> str:
        """The default stem of files made from the run: its name and its id."""
        return re.sub(r"[^\w.+=@ -]", "_", self.name) + f"-{self.run_id}"

    @property
    def tags(self) -> tuple[str, ...]:
        """The tags, in alphabetical order."""
        return self.labels.tags

    @property
    def note(self) -> str:
        """The note; empty if there is none."""
        return self.labels.note

    @cached_property
    def labels(self) -> Labels:
        """Name, tags and note given by users, read at the first access."""
        return Labels() if self.stands_alone else read_labels(self.folder)

    @property
    def marks(self) -> tuple[Mark, ...]:
        """The marks at steps, in the order of the steps."""
        from runner.recording.marks import read_marks

        return () if self.stands_alone else read_marks(self.folder).marks

    @property
    def seed(self) -> int:
        """The seed; 0 for a loop without one."""
        return self.file.seed or 0

    @property
    def has_seed(self) -> bool:
        """Whether it has a seed; every job has one."""
        return self.facts.get("seeded") is not False

    @property
    def title(self) -> str:
        """The name, and the seed if it has one: `patient, seed 3`."""
        return run_title(self.name, self.seed if self.has_seed else None)

    @property
    def recording(self) -> Path:
        """The MCAP file."""
        return self.restored or self.folder / Path(self.file.recording or RECORDING_FILE).name

    def require_folder(self) -> None:
        """Refuse a recording without a folder for labels and marks.

        Raises:
            RunnerError: it stands alone.
        """
        if self.stands_alone:
            raise RunnerError(f"{self.recording}: stands alone; expected a run in a folder of its own.")

    @property
    def stands_alone(self) -> bool:
        """Whether it is a recording by itself, not one in a folder of its own."""
        return (self.file.recording or RECORDING_FILE) != RECORDING_FILE

    @property
    def created(self) -> datetime:
        """When it began, in UTC; if unknown, when its folder was last changed."""
        if self.file.created:
            return self.file.created
        try:
            return datetime.fromtimestamp(self.folder.stat().st_mtime, UTC)
        except OSError:  # it is gone
            return datetime.fromtimestamp(0, UTC)

    @property
    def created_text(self) -> str:
        """When it began, in ISO 8601."""
        return self.created.isoformat(timespec="milliseconds")

    @property
    def summary(self) -> Summary:
        """The summary written at the end; empty before."""
        return self.file.summary

    @property
    def status(self) -> str:
        """`running`, `finished`, `interrupted`, `failed`, `damaged` or `archived`.

        A run whose owner died is interrupted; a run is `damaged` if `run.json` is invalid, and `archived` if
        its recording is in an archive alone, and not restored.
        """
        status = self.file.status
        if status == "running" and is_alive(self.file.owner, self.folder / RUN_FILE):
            return status
        if self.file.problems:
            return "damaged"
        if self.archive and not self.recording.exists():
            return "archived"
        return "interrupted" if status == "running" else status

    @property
    def episodes_to_do(self) -> int | None:
        """The training episodes in its configuration; None for a loop."""
        episodes = self.file.config.get("episodes")
        return episodes if type(episodes) is int and 0 < episodes < 2**62 else None

    @property
    def archive(self) -> ArchiveReference:
        """The archive of its recording; false if it has none."""
        return self.file.archive

    def checkpoints(self) -> list[Checkpoint]:
        """Return the checkpoints that a loop recorded, in order; each has `load`.

        Raises:
            RecordingError: the recording cannot be read.
        """
        from runner.recording.reader import open_recording
        from runner.runs.checkpoints import read_checkpoints

        with open_recording(self.recording) as recording:
            return read_checkpoints(recording, self.folder.parent)

    def beat(self) -> None:
        """Record that the owner is alive."""
        with contextlib.suppress(OSError):
            os.utime(self.folder / RUN_FILE)

    @property
    def can_train_again(self) -> bool:
        """Whether its configuration determines all of it, as the runner trained it; a loop's does not."""
        return "made_by" not in self.file.config

    @property
    def is_stop_requested(self) -> bool:
        """Whether the loop that records it was requested to stop."""
        with contextlib.suppress(OSError):  # of a network file system, perhaps for a moment
            return (self.folder / STOP_FILE).exists()
        return False

    def request_stop(self) -> None:
        """Request that the loop which records the run stops: `should_stop` of its environment becomes True.

        Raises:
            RunnerError: no loop records it now.
            StorageError: its folder cannot be written.
        """
        made_by_job = f"run {self.run_id} is made by a job; cancel the job, or press Ctrl-C there."
        require_trained(self, is_trained=False, refusal=made_by_job)
        if self.status != "running":
            raise RunnerError(
                f"run {self.run_id} is {self.status}; only a run that is running can be stopped."
            )
        with storage_errors(self.folder / STOP_FILE):
            (self.folder / STOP_FILE).touch()

    def update(self, **facts: object) -> Run:
        """Write facts to `run.json`, and return the run with them.

        Raises:
            StorageError: the file cannot be written; it is as before.
        """
        changed = Run(self.folder, self.facts | facts)
        with storage_errors(self.folder / RUN_FILE, "free some disk"):
            write_object(self.folder / RUN_FILE, changed.facts)
        return changed


def create_run(
    recordings: Path,
    config: ExperimentConfig,
    seed: int,
    name: str | None = None,
    run_id: str | None = None,
    parent: Run | None = None,
) -> Run:
    """Create the folder of a new run with its `run.json`; an id is never used twice.

    Args:
        name: the name of the run; the configuration's name by default.
        run_id: an id from `new_run_id`; replaced if it is taken by now.
        parent: the run that the configuration is from: if it has no mark, neither has the new one.
    """
    from runner.runs.trust_marks import environment_of_job, mark, merge_marks

    values = config.to_mapping()
    run = new_run(recordings, values, seed, name or config.name, run_id)
    if parent is None:
        mark(run.folder, environment_of_job(values))
    else:
        merge_marks(run.folder, [parent.folder])
    return run


def new_run(
    recordings: Path,
    config: JsonView,
    seed: int | None,
    name: str,
    run_id: str | None = None,
    labels: Labels | None = None,
    ids: Iterator[str] | None = None,
    **more: object,
) -> Run:
    """Create the folder of a new run; `more` are further facts, the rest is as for `create_run`.

    Of `ids`, if they are given, the first that is not taken becomes its id.
    """
    check_folder_name(recordings)
    with storage_errors(recordings, f"choose another folder by --recordings or {RECORDINGS_VARIABLE}"):
        recordings.mkdir(parents=True, exist_ok=True)
        while True:
            run_id = run_id or (next(ids) if ids else _random_id())
            try:
                (folder := recordings / run_id).mkdir()
                break
            except FileExistsError:
                run_id = None
        facts = {
            "run_id": run_id,
            "name": name,
            "seed": seed or 0,
            **({"seeded": False} if seed is None else {}),
            "status": "running",
            "created": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "owner": owner(),
            "config": dict(config),
            **more,
        }
        if labels is not None:  # before the run is listed, so that it always has them
            write_object(folder / LABELS_FILE, labels.as_json())
        write_object(folder / RUN_FILE, facts)
    return Run(folder, facts)


def new_run_id(recordings: Path) -> str:
    """Return a new id that no run in the folder has."""
    while (recordings / (run_id := _random_id())).exists():
        continue
    return run_id


def _random_id() -> str:
    number = secrets.randbelow(len(_ID_ALPHABET) ** _ID_LENGTH)
    letters = []
    for _ in range(_ID_LENGTH):
        number, letter = divmod(number, len(_ID_ALPHABET))
        letters.append(_ID_ALPHABET[letter])
    return "".join(letters)


@contextlib.contextmanager
def unless_empty(run: Run) -> Iterator[None]:
    """Remove the run's folder if the block fails before there is a recording, and add a note to the error."""
    try:
        yield
    except BaseException as error:
        if not run.recording.exists():
            shutil.rmtree(run.folder, ignore_errors=True)
            error.add_note(f"Nothing was recorded; the empty run {run.run_id} was removed.")
        raise


def require_over(run: Run) -> None:
    """Refuse a run that is still running.

    Raises:
        RunnerError: it is.
    """
    if run.status == "running":
        raise RunnerError(f"run {run.run_id} is running; wait until it has finished, or interrupt it.")


def require_trained(run: Run, is_trained: bool, refusal: str) -> None:
    """Refuse a run of the wrong kind: trained here, or recorded from a loop.

    Args:
        is_trained: whether the run must have been trained here; else it must be a loop.

    Raises:
        RunnerError: it is the other kind; the message is `refusal`.
    """
    if run.can_train_again is not is_trained:
        raise RunnerError(refusal)


def made_by(provenance: Mapping[str, str]) -> dict[str, str]:
    """Return the provenance that `run.json` has; the recording has all of it."""
    return {key: provenance[key] for key in _MADE_BY if key in provenance}


def recordings_folder(chosen: str | os.PathLike[str] | None = None) -> Path:
    """Return the recordings folder: the chosen one, else $DUALTAXI_RECORDINGS, else ./recordings."""
    return Path(chosen or os.environ.get(RECORDINGS_VARIABLE) or "recordings")


def check_folder_name(recordings: str | os.PathLike[str]) -> None:
    """Refuse a recordings folder whose path is not UTF-8, which neither the index nor JSON can store.

    Raises:
        StorageError: it is not UTF-8.
    """
    path = os.path.abspath(recordings)  # noqa: PTH100 - links stay what they are
    if not is_utf8(path):
        raise StorageError(
            f"{as_utf8(path)}: found a path that is not UTF-8; rename the folder, or choose another by "
            f"--recordings or {RECORDINGS_VARIABLE}."
        )


def label(
    run: Run,
    name: str | None = None,
    note: str | None = None,
    tag: Iterable[str] = (),
    untag: Iterable[str] = (),
) -> Labels:
    """Change the labels of a run, and return them.

    Args:
        run: the run, in a folder of its own.
        name: its new name; empty restores the original one, None keeps the present one.
        note: its new note; empty removes it, None keeps the present one.
        tag: tags to add.
        untag: tags to remove.

    Raises:
        ConfigError: the name is not valid.
        RunnerError: the recording is not in a folder of its own, a tag is not valid, or there are too many.
        StorageError: the run's folder cannot be written.
    """
    run.require_folder()
    if name:
        checked_run_name(name)

    def change(labels: Labels) -> Labels:
        return Labels(
            labels.name if name is None else "" if name == run.file.name else name,
            tuple(sorted({*labels.tags, *tag} - {*untag})),
            labels.note if note is None else note.strip(),
        )

    return change_labels(run.folder, change)


def command_for(run: Run, verb: str, *options: str) -> str:
    """Return the command line of a verb for a run."""
    return command_in(run.folder.parent, verb, run.run_id, *options)


def command_in(folder: Path, *words: str) -> str:
    """Return a command line, with --recordings if the folder of runs is not the default."""
    is_default = folder.absolute() == recordings_folder().absolute()
    option = () if is_default else ("--recordings", shlex.quote(os.fspath(folder)))
    return " ".join(("dualtaxi", *words, *option))


# --- the runs of a folder, and the locks on them -------------------------------------------------------


def list_runs(recordings: str | os.PathLike[str] | None = None) -> list[Run]:
    """Return the runs of a recordings folder, the newest first.

    Args:
        recordings: the folder: $DUALTAXI_RECORDINGS, or ./recordings, by default.

    Raises:
        StorageError: the folder is there and cannot be read.
    """
    folder = recordings_folder(recordings)
    runs = [run for entry in run_entries(folder) if (run := run_in(folder / entry))]
    return sorted(runs, key=lambda run: (run.created, run.run_id), reverse=True)


def run_entries(recordings: Path) -> list[str]:
    """Return the names of the folders that may have a run: all but the hidden ones.

    Raises:
        StorageError: the recordings folder is there and cannot be read.
    """
    try:
        with os.scandir(recordings) as entries:
            return [entry.name for entry in entries if entry.name[0] != "." and entry.is_dir()]
    except FileNotFoundError:
        return []
    except OSError as error:
        raise StorageError(f"{recordings}: cannot be read as a folder of runs ({error.strerror}).") from error


def run_at(path: Path) -> Run:
    """Return the run in a folder, or of a recording outside a run's folder.

    Raises:
        RunNotFound: there is none.
    """
    if path.is_dir():
        if run := run_in(path):
            return run
        raise RunNotFound(f"{path}: found a folder without {RUN_FILE} or {RECORDING_FILE}, expected a run.")
    if not path.is_file():
        raise RunNotFound(f"{path}: no such file or folder.")
    if path.name == RECORDING_FILE and (path.parent / RUN_FILE).is_file():
        return run_at(path.parent)
    return _from_recording(path)


def run_in(folder: Path) -> Run | None:
    """Return the run in a folder, from its recording when `run.json` is gone; None if none can be read."""
    with contextlib.suppress(OSError, ValueError):
        facts = read_object(folder / RUN_FILE, MAX_RUN_FILE_BYTES)
        if _is_run(facts):
            return Run(folder, facts)
    with contextlib.suppress(PermissionError, RecordingError):
        if (folder / RECORDING_FILE).is_file():
            return _from_recording(folder / RECORDING_FILE)
    return None


def listed_run(folder: Path, run_id: str) -> Run:
    """Return the run in a folder, which had this id when the folder was listed.

    Raises:
        RunNotFound: it was removed in the meantime, or both of its files are damaged.
    """
    run = run_in(folder)
    if run is None:
        raise RunNotFound(
            f"run {run_id} was removed just now, or {folder} has neither a readable {RUN_FILE} nor "
            f"{RECORDING_FILE}."
        )
    return run


def _is_run(facts: dict[str, object]) -> bool:
    """Return whether facts have the id of a run; the others may be damaged."""
    run_id = facts.get("run_id")
    return isinstance(run_id, str) and RUN_ID.fullmatch(run_id) is not None and run_id.strip(".") != ""


def _from_recording(path: Path) -> Run:
    from runner.recording.description import recorded_facts
    from runner.recording.reader import open_recording

    with open_recording(path) as recording:
        facts = {**recorded_facts(recording), "recording": path.name}
        with contextlib.suppress(RecordingError):
            facts["provenance"] = made_by(recording.provenance)
    if not _is_run(facts):
        raise RecordingError(f"{path}: is damaged: its description of the run is invalid.")
    return Run(path.parent, facts)


@contextlib.contextmanager
def locked(run: Run, archived: bool = False) -> Iterator[Run]:
    """Lock the folder of a run, and yield the run as it is now.

    Raises:
        RunnerError: it is running or archived, or locked by another process.
        StorageError: the folder cannot be written.
    """
    busy = RunnerError(f"run {run.run_id} is locked by another process; try again when it has finished.")
    lock = acquired(run.folder / RUN_LOCK, busy)
    try:
        if not run.stands_alone:
            run = run_at(run.folder)
        if run.status == "running":
            owner = run.file.owner
            raise RunnerError(
                f"run {run.run_id} is running (process {owner.get('pid')} on {owner.get('host')}); "
                "try again when it has finished."
            )
        if run.status == "archived" and not archived:
            raise RunnerError(f"run {run.run_id} is archived; `dualtaxi restore {run.run_id}` restores it.")
        yield run
    finally:
        lock.release()


def acquired(path: Path, busy: RunnerError) -> FileLock:
    """Acquire the lock of a file without waiting; the caller releases it.

    Args:
        path: the lock file; its folder is created if it is missing.
        busy: raised if another process has the lock.
    """
    from filelock import FileLock, Timeout

    lock = FileLock(path, thread_local=False)
    with storage_errors(path.parent):
        try:
            lock.acquire(blocking=False)
        except Timeout as error:
            raise busy from error
    return lock
