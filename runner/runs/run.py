"""The recordings folder: a folder a run, with its recording and a small file that says what it is.

    recordings/k3v9m2xq/run.json         id, name, configuration, owner, status, summary
    recordings/k3v9m2xq/labels.json      what people say of it: another name, tags, a note
    recordings/k3v9m2xq/recording.mcap   the truth

`run.json` stands before anything heavy is imported and is only ever replaced whole. Its status is what
the owner last said; whether a `running` run still has a living owner is looked at when asked.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from runner.errors import RecordingError, RunnerError, RunNotFound, StorageError
from runner.recording.labels import Labels, change_labels, read_labels
from runner.recording.liveness import lives, owner
from runner.recording.run_file import RUN_ID, ArchiveReference, RunFile, Summary, parse_run_file, run_title
from runner.util.files import read_object, storage_errors, write_object
from runner.util.values import as_utf8, checked_run_name, is_utf8

if TYPE_CHECKING:  # listing runs is to be quick
    from runner.config import ExperimentConfig

RUN_FILE: Final = "run.json"
RECORDING_FILE: Final = "recording.mcap"
MAX_RUN_FILE_BYTES: Final = 8 << 20
MADE_BY: Final = ("host", "git", "dualtaxi")
"""What `run.json` says of where and by what a run was made; its recording says it all."""
RECORDINGS_VARIABLE: Final = "DUALTAXI_RECORDINGS"

_ALPHABET: Final = "abcdefghjkmnpqrstvwxyz23456789"
_ID_LENGTH: Final = 8


@dataclass(frozen=True, repr=False)
class Run:
    """A run in a recordings folder."""

    folder: Path
    facts: dict[str, Any]
    """The contents of `run.json`."""
    restored: Path | None = None
    """Where its recording was restored to, if it is in an archive alone."""

    def __repr__(self) -> str:
        """Return id, first name and folder; `facts` has the rest."""
        return (
            f"Run({str(self.facts.get('run_id'))!r}, {str(self.facts.get('name'))!r}, {str(self.folder)!r})"
        )

    @cached_property
    def file(self) -> RunFile:
        """The contents of `run.json`, checked."""
        return parse_run_file(self.facts)

    @property
    def problem(self) -> str:
        """What of `run.json` does not fit, and what to do; empty if all does."""
        if not self.file.problems:
            return ""
        return (
            f"run {self.run_id} is damaged: {self.folder / RUN_FILE}: "
            f"{'; '.join(self.file.problems)}. Correct that file, or remove the run by "
            f"`dualtaxi rm {self.run_id}`."
        )

    @property
    def run_id(self) -> str:
        """Its id, unique."""
        return self.file.run_id

    @property
    def name(self) -> str:
        """What it is called now, not unique."""
        return self.labels.name or self.file.name

    @property
    def file_stem(self) -> str:
        """What files made from it are called by default: its name and its id."""
        name = re.sub(r"[^\w.+=@ -]", "_", self.name)
        return f"{name}-{self.run_id}"

    @property
    def tags(self) -> tuple[str, ...]:
        """The tags it was given, in alphabetical order."""
        return self.labels.tags

    @property
    def note(self) -> str:
        """The note that was written on it, or nothing."""
        return self.labels.note

    @cached_property
    def labels(self) -> Labels:
        """What people say of it, read when first asked."""
        return Labels() if self.stands_alone else read_labels(self.folder)

    @property
    def seed(self) -> int:
        """Its job's seed; 0 for a loop that was given none."""
        return self.file.seed or 0

    @property
    def has_seed(self) -> bool:
        """Whether it was given a seed; every job has one."""
        return self.facts.get("seeded") is not False

    @property
    def title(self) -> str:
        """Its name, and its seed if it has one: `patient, seed 3`."""
        return run_title(self.name, self.seed if self.has_seed else None)

    @property
    def recording(self) -> Path:
        """The MCAP file."""
        return self.restored or self.folder / Path(self.file.recording or RECORDING_FILE).name

    @property
    def stands_alone(self) -> bool:
        """Whether it is a recording by itself, not one in a folder of its own."""
        return (self.file.recording or RECORDING_FILE) != RECORDING_FILE

    @property
    def created(self) -> datetime:
        """When it began, in UTC; if its file does not say, when its folder was last changed."""
        return self.file.created or _folder_time(self.folder)

    @property
    def created_text(self) -> str:
        """When it began, in ISO 8601, as recordings have it."""
        return self.created.isoformat(timespec="milliseconds")

    @property
    def summary(self) -> Summary:
        """What its owner wrote at the end; empty before."""
        return self.file.summary

    @property
    def status(self) -> str:
        """`running`, `finished`, `interrupted` or `failed`; a dead owner's run is interrupted.

        `damaged` if its file holds what cannot be, and `archived` if its recording is in an archive alone,
        and not at hand.
        """
        said = self.file.status
        if said == "running" and lives(self.file.owner, self.folder / RUN_FILE):
            return said
        if self.file.problems:
            return "damaged"
        if self.archive and not self.recording.exists():
            return "archived"
        return "interrupted" if said == "running" else said

    @property
    def episodes_to_do(self) -> int | None:
        """The training episodes that its configuration asks for; None if it is not a job's."""
        episodes = self.file.config.get("episodes")
        return episodes if type(episodes) is int and 0 < episodes < 2**62 else None

    @property
    def archive(self) -> ArchiveReference:
        """Where else its recording is kept; false if nowhere."""
        return self.file.archive

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
        with storage_errors(self.folder / RUN_FILE, "free some disk"):
            write_object(self.folder / RUN_FILE, changed.facts)
        return changed


def create_run(
    recordings: Path, config: ExperimentConfig, seed: int, name: str | None = None, run_id: str | None = None
) -> Run:
    """Make a folder for a new run and write what it is; an id is never used twice.

    Args:
        recordings: the folder to make it in; made if it is missing.
        config: what is run.
        seed: the one seed that is run.
        name: what the run is called; the configuration's name unless given.
        run_id: its id, from `new_run_id`, if that had to be known before; another if it is taken by now.

    Raises:
        StorageError: the recordings folder cannot be written.
    """
    return new_run(recordings, config.to_mapping(), seed, name or config.name, run_id)


def new_run(
    recordings: Path,
    config: Mapping[str, Any],
    seed: int | None,
    name: str,
    run_id: str | None = None,
    **more: Any,
) -> Run:
    """Make a folder for a new run of this configuration, as `create_run` does; `more` are further facts.

    Raises:
        StorageError: the recordings folder cannot be written.
    """
    check_folder_name(recordings)
    try:
        recordings.mkdir(parents=True, exist_ok=True)
        while True:
            run_id = run_id or new_run_id(recordings)
            folder = recordings / run_id
            try:
                folder.mkdir()
                break
            except FileExistsError:
                run_id = None
        run = Run(
            folder,
            {
                "run_id": run_id,
                "name": name,
                "seed": seed or 0,
                **({"seeded": False} if seed is None else {}),
                "status": "running",
                "created": datetime.now(UTC).isoformat(timespec="milliseconds"),
                "owner": owner(),
                "config": dict(config),
                **more,
            },
        )
        write_object(folder / RUN_FILE, run.facts)
    except OSError as error:
        raise StorageError(
            f"{recordings}: cannot be written ({error.strerror}); "
            f"choose another folder by --recordings or {RECORDINGS_VARIABLE}."
        ) from error
    return run


def new_run_id(recordings: Path) -> str:
    """Return an id that no run in the folder has."""
    while (recordings / (run_id := "".join(secrets.choice(_ALPHABET) for _ in range(_ID_LENGTH)))).exists():
        continue
    return run_id


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


def check_folder_name(recordings: str | os.PathLike[str]) -> None:
    """Refuse a recordings folder whose path is not UTF-8: neither the index nor JSON can hold it.

    Raises:
        StorageError: it is one.
    """
    path = os.path.abspath(recordings)  # noqa: PTH100 - links stay what they are
    if not is_utf8(path):
        raise StorageError(
            f"{as_utf8(path)}: found a path that is not UTF-8; rename the folder, or choose another by "
            f"--recordings or {RECORDINGS_VARIABLE}."
        )


def list_runs(recordings: str | os.PathLike[str] | None = None) -> list[Run]:
    """Return the runs of a folder, the newest first; what is no run is left alone.

    Args:
        recordings: the folder: $DUALTAXI_RECORDINGS, or ./recordings, unless given.

    Raises:
        StorageError: the folder is there and cannot be read.
    """
    folder = recordings_folder(recordings)
    runs = [run for entry in run_entries(folder) for run in runs_in(folder / entry)]
    return sorted(runs, key=lambda run: (run.created, run.run_id), reverse=True)


def run_entries(recordings: Path) -> list[str]:
    """Return the names of the folders in which there may be a run: all but the hidden ones.

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
    """Return the run in a folder, or of a recording that may stand alone.

    Raises:
        RunNotFound: there is none.
        RecordingError: it stands alone, and cannot be read.
    """
    if path.is_dir():
        for run in runs_in(path):
            return run
        raise RunNotFound(f"{path}: found a folder without {RUN_FILE} or {RECORDING_FILE}, expected a run.")
    if not path.is_file():
        raise RunNotFound(f"{path}: no such file or folder.")
    if path.name == RECORDING_FILE and (path.parent / RUN_FILE).is_file():
        return run_at(path.parent)
    return _from_recording(path)


def run_of_id(run_id: str, recordings: Path) -> Run | None:
    """Return the run in the folder called like this id; None if there is none, or the text is no id."""
    if not RUN_ID.fullmatch(run_id) or not run_id.strip("."):
        return None
    return next((run for run in runs_in(recordings / run_id) if run.run_id == run_id), None)


def runs_in(folder: Path) -> Iterator[Run]:
    """Yield the run in a folder, if there is one; from its recording when `run.json` is gone."""
    try:
        facts = read_object(folder / RUN_FILE, MAX_RUN_FILE_BYTES)
        if _is_run(facts):
            yield Run(folder, facts)
            return
    except (OSError, ValueError):
        pass
    if (folder / RECORDING_FILE).is_file():
        with contextlib.suppress(RecordingError):
            yield _from_recording(folder / RECORDING_FILE)


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
    if run.stands_alone:
        raise RunnerError(
            f"{run.recording}: found a recording that stands alone, expected a run in a folder of its own."
        )
    if name:
        checked_run_name(name)

    def change(labels: Labels) -> Labels:
        return Labels(
            labels.name if name is None else "" if name == run.file.name else name,
            tuple(sorted({*labels.tags, *tag} - {*untag})),
            labels.note if note is None else note.strip(),
        )

    return change_labels(run.folder, change)


def _is_run(facts: dict[str, Any]) -> bool:
    """Return whether these are the facts of a run: with an id, they are, however damaged."""
    run_id = facts.get("run_id")
    return isinstance(run_id, str) and RUN_ID.fullmatch(run_id) is not None and run_id.strip(".") != ""


def _folder_time(folder: Path) -> datetime:
    """Return when a folder was last changed; the beginning of 1970 if it is gone."""
    with contextlib.suppress(OSError):
        return datetime.fromtimestamp(folder.stat().st_mtime, UTC)
    return datetime.fromtimestamp(0, UTC)


def _from_recording(path: Path) -> Run:
    """Return the run that a recording says it is."""
    from runner.recording.reader import open_recording

    with open_recording(path) as recording:
        facts = {**recording.run_facts(), "recording": path.name}
        with contextlib.suppress(RecordingError):
            made_by = recording.provenance
            facts["provenance"] = {key: made_by[key] for key in MADE_BY if key in made_by}
    if not _is_run(facts):
        raise RecordingError(f"{path}: is damaged: what it says of its run makes no sense.")
    return Run(path.parent, facts)
