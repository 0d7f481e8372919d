"""The user's code, collected while a run has begun already: repository, script, modules, notebook cells.

It is read in a thread of its own, within limits on time and size, so that neither a run's start nor its end
waits for a repository that is huge or on a disk that hangs.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Final

from runner.errors import StorageError
from runner.recording.code import CODE_ATTACHMENT, CODE_RECORD, MAX_CODE_BYTES, MAX_FILES, Code, patch_parts
from runner.recording.writer import RecordingFile, writing
from runner.runs.git import GIT_SECONDS, NotRecorded, Repository, read_repository
from runner.runs.provenance import is_code_wanted
from runner.runs.redaction import SETTINGS_FILES, is_secret_file, redacted_text
from runner.runs.run import Run
from runner.util.files import is_installed, open_regular
from runner.util.humanize import listed
from runner.util.values import as_utf8

MAX_FILE_BYTES: Final = 256 << 10
"""Larger files are left out."""
WAIT_SECONDS: Final = GIT_SECONDS + 1
"""How long after its start a run waits at its end for the code."""
_FRESH_SECONDS: Final = 10.0
"""Runs that begin within this time of each other in one process share what was read."""
_SOURCES: Final = frozenset(
    {
        *SETTINGS_FILES,
        ".py",
        ".pyx",
        ".pyi",
        ".c",
        ".cc",
        ".cpp",
        ".cu",
        ".h",
        ".hpp",
        ".rs",
        ".jl",
        ".sh",
        ".gin",
    }
)
"""Suffixes of untracked files that are recorded."""
_CELLS: Final = "notebook-cells.py"
_MAX_CELL_BYTES: Final = 256 << 10
_MAX_NAMED: Final = 10
"""The most files that are named among those left out."""


@dataclass
class _Sources:
    """What is recorded so far, within the limit, and what is left out."""

    files: dict[str, str] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)
    budget: int = MAX_CODE_BYTES

    def has_room(self, name: str, size: int) -> bool:
        """Return whether this number of bytes fits; else note that they are left out."""
        if size <= min(self.budget, MAX_FILE_BYTES):
            return True
        self.left_out.append(f"{name} ({size:,} bytes)")
        return False

    def add(self, path: str, text: str) -> None:
        """Add a file without its secrets, or note that it does not fit."""
        text = redacted_text(text)
        size = len(text.encode(errors="replace"))
        if self.has_room(path, size):
            self.files[path] = text
            self.budget -= size

    def add_file(self, root: Path, path: str) -> None:
        """Add a regular file of UTF-8 text, or note why not; a link is not followed."""
        if path in self.files or not path.isprintable():
            return
        if is_secret_file(path):
            self.left_out.append(f"{path} (it has the name of a secret)")
            return
        if self.budget <= 0 or len(self.files) == MAX_FILES:
            self.left_out.append(path)
            return
        try:
            with open_regular(root / path, follow_link=False) as stream:
                if not self.has_room(path, os.fstat(stream.fileno()).st_size):
                    return
                data = stream.read(MAX_FILE_BYTES + 1)
        except OSError:
            return  # it was removed, is a link or a pipe, or may not be read
        if b"\0" not in data:
            self.add(path, data.decode(errors="replace"))


@dataclass(frozen=True)
class RecordedCode:
    """What a recording gets: the entries of its metadata record, and the sources if there are any."""

    entries: dict[str, str]
    attachment: bytes = b""


_recent: dict[tuple[object, ...], tuple[float, RecordedCode]] = {}
"""The code that was read last, by what it was read for, and the time of `time.monotonic`."""


class CodeCollector:
    """Reads the code in a thread, and writes it into the recording as soon as it is known.

    Args:
        recordings: the folder of runs, in which nothing is code.
    """

    def __init__(self, recordings: Path, is_wanted: bool = True) -> None:
        self.entries: dict[str, str] = {}
        """The entries of the metadata record; empty until it is written."""
        self._is_wanted = is_wanted and is_code_wanted()
        self._found: RecordedCode | None = None
        self._commit: dict[str, str] = {}
        """The entries of commit, branch and remote, which are known before the rest."""
        self._deadline = time.monotonic() + WAIT_SECONDS
        if self._is_wanted:
            with contextlib.suppress(OSError):  # there is no current folder: the thread notes it
                recordings = recordings.absolute()
            self._thread = threading.Thread(
                target=self._collect, args=(_cells(), recordings), name="recording-code", daemon=True
            )
            self._thread.start()

    def _collect(self, cells: str, recordings: Path) -> None:
        try:
            script = user_script()
            folder = Path.cwd() if script is None else script.parent
            key = folder, script, cells, recordings
            read_at, code = _recent.get(key, (0.0, None))
            if code is None or time.monotonic() - read_at > _FRESH_SECONDS:
                code = collect(folder, script, cells, recordings, self._commit.update)
                _recent.clear()
                _recent[key] = time.monotonic(), code
            self._found = code
        except Exception as error:  # a run is worth more than what is known of its code
            self._found = RecordedCode({"code.not_recorded": f"{type(error).__name__}: {error}"[:500]})

    def beat(self, run: Run, file: RecordingFile) -> Callable[[], None]:
        """Return what a recorder calls now and then: it marks the run as alive, and writes the code once."""

        def beat() -> None:
            run.beat()
            with contextlib.suppress(StorageError):  # tried again at the end
                self.write(file)

        return beat

    def made_by(self, run: Run) -> dict[str, str]:
        """Return the provenance in `run.json`, with the commit if it is known."""
        provenance = run.facts.get("provenance")  # of a resumed run, whose file may hold anything
        recorded = provenance.items() if isinstance(provenance, dict) else ()
        git = {"git": self.entries["git"]} if "git" in self.entries else {}
        return {key: text for key, text in recorded if isinstance(text, str)} | git

    def write(self, file: RecordingFile, wait: bool = False) -> None:
        """Write the code into a recording, once, if it is known; nothing else may write into it meanwhile.

        Args:
            wait: wait for it, up to `WAIT_SECONDS` after the start; then write that it is not known, except
                for commit, branch and remote if these are.
        """
        if not self._is_wanted or self.entries:
            return
        if wait and self._found is None:
            self._thread.join(max(0.0, self._deadline - time.monotonic()))
        code = self._found
        if code is None:
            if not wait:
                return
            entries = {"code.not_recorded": f"reading it took more than {WAIT_SECONDS:g} s"}
            if self._commit:
                missing = f"what differs from the commit: reading it took more than {WAIT_SECONDS:g} s"
                entries |= self._commit | {"git.not_recorded": missing}
            code = RecordedCode(entries)
        with writing(file):
            file.add_metadata(CODE_RECORD, code.entries)
            self.entries = code.entries  # from here on it is not tried again
            if code.attachment:
                file.add_attachment(CODE_ATTACHMENT, "application/zstd", code.attachment)


# --- what is collected --------------------------------------------------------------------------------------


def collect(
    folder: Path,
    script: Path | None = None,
    cells: str = "",
    recordings: Path | None = None,
    on_commit: Callable[[dict[str, str]], None] = lambda _: None,
) -> RecordedCode:
    """Return the code in a folder.

    Args:
        cells: the cells of a notebook that were executed.
        recordings: a folder whose untracked files are no code.
        on_commit: called with the entries of commit, branch and remote before the rest is read.
    """

    def used(root: Path) -> list[str]:
        """Return the paths of the script and of the loaded modules in a folder."""
        first = "" if script is None else _within(root, script)
        return ([first] if first else []) + [path for path in _modules(root) if path != first]

    repository = Repository(folder)
    problems = []
    try:
        repository = read_repository(folder, used, on_commit=lambda found: on_commit(_place_in_git(found)))
        problems += repository.problems + ([] if repository.commit else ["there is no commit yet"])
    except NotRecorded as reason:
        problems.append(str(reason))
    root = repository.root.resolve()
    sources = _Sources()
    outputs = "" if recordings is None else _within(root, recordings)
    untracked = [path for path in repository.untracked if not (outputs and path.startswith(f"{outputs}/"))]
    paths = used(root)
    others = [path for path in untracked if Path(path).suffix in _SOURCES]
    changed = [path for path in repository.changed if Path(path).suffix in _SOURCES or is_secret_file(path)]
    if script is not None and paths:
        sources.add_file(root, paths[0])
    if cells:
        sources.add(_CELLS, cells)
    patch = _fitting_patch(repository, sources)
    for path in (*paths, *changed, *others):
        sources.add_file(root, path)
    new = set(sources.files) & {*untracked, _CELLS} if repository.commit else set(sources.files)
    is_dirty = repository.commit and (repository.changed or others)
    entries = _place_in_git(repository) | {
        "git": repository.commit + ("-dirty" if is_dirty else ""),
        "code.script": "" if script is None else _within(root, script),
        "git.not_recorded": "; ".join(problems),
        "code.left_out": listed(list(dict.fromkeys(sources.left_out)), _MAX_NAMED),
    }
    code = Code(sources.files, tuple(sorted(new)), patch)
    return RecordedCode(
        {key: as_utf8(text) for key, text in entries.items() if text},
        code.to_attachment() if code.files or code.patch else b"",
    )


def _place_in_git(repository: Repository) -> dict[str, str]:
    """Return the entries of commit, branch and remote, where there is one."""
    entries = {
        "git": repository.commit,
        "git.branch": repository.branch,
        "git.remote": redacted_text(repository.remote),
    }
    return {key: as_utf8(text) for key, text in entries.items() if text}


def _fitting_patch(repository: Repository, sources: _Sources) -> str:
    """Return the parts of the patch that fit, and note the others as left out."""
    fitting = []
    for path, part in patch_parts(repository.patch).items():
        name = f"the changes of {path}"
        if sources.has_room(name, len(part)):  # redaction takes seconds for megabytes
            redacted = redacted_text(part)
            size = len(redacted.encode())
            if sources.has_room(name, size):
                fitting.append(redacted)
                sources.budget -= size
    return "".join(fitting)


def user_script() -> Path | None:
    """Return the script that runs, unless it is installed, as `dualtaxi` and `jupyter` are."""
    file = getattr(sys.modules.get("__main__"), "__file__", None)
    if not isinstance(file, str) or not file:
        return None
    path = Path(file).absolute()
    return None if is_installed(str(path), is_script=True) or not path.is_file() else path


def _modules(root: Path) -> Iterator[str]:
    """Yield the paths of the loaded modules in a folder, without installed ones and this project's."""
    for name, module in sorted(sys.modules.items()):
        if not isinstance(module, ModuleType) or name.partition(".")[0] in ("runner", "dualtaxi"):
            continue
        file = vars(module).get("__file__")  # getattr may import a lazy module
        if isinstance(file, str) and file.endswith(".py") and not is_installed(file):
            path = _within(root, Path(file))
            if path:
                yield path


def _within(root: Path, path: Path) -> str:
    """Return the path relative to a folder; empty if it is not in it."""
    with contextlib.suppress(OSError, ValueError):
        return path.resolve().relative_to(root).as_posix()
    return ""


def _cells() -> str:
    """Return the cells that a notebook executed so far; empty elsewhere."""
    with contextlib.suppress(Exception):  # it is not loaded, or of a version without such a history
        cells = sys.modules["IPython"].get_ipython().history_manager.input_hist_raw
        text = "".join(f"# %% [{number}]\n{cell}\n" for number, cell in enumerate(cells) if cell)
        return text[-_MAX_CELL_BYTES:]
    return ""
