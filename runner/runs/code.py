"""The user's code, collected while a run has begun already: repository, script, modules, notebook cells.

It is read in a thread of its own, within limits on time and size, so that neither a run's start nor its end
waits for a repository that is huge or on a disk that hangs.

Nothing that a git repository configures is executed: hooks, file system monitors, external diff programs,
filters (such as those of LFS), credential helpers and transports are switched off. What belongs to another
user is not read unless git itself trusts it.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Final

from runner.errors import StorageError
from runner.recording.code import CODE_ATTACHMENT, CODE_RECORD, MAX_CODE_BYTES, MAX_FILES, Code, patch_parts
from runner.recording.writer import RecordingFile, writing
from runner.runs.provenance import is_code_wanted
from runner.runs.redaction import SETTINGS_FILES, is_secret_file, redacted_text
from runner.runs.run import Run
from runner.util.files import is_installed, open_regular
from runner.util.humanize import listed, size
from runner.util.values import as_utf8

GIT_SECONDS: Final = 2.0
"""The time limit of all that is read of a repository."""
MAX_PATCH_BYTES: Final = 8 << 20
"""The most that is read of `git diff`."""
_MAX_STATUS_BYTES: Final = 32 << 20
_MAX_MESSAGE_BYTES: Final = 1 << 16
_SETTINGS: Final = (
    "core.fsmonitor=false",
    f"core.hooksPath={os.devnull}",
    "core.sshCommand=false",
    "core.pager=cat",
    "core.quotePath=false",
    "core.safecrlf=false",
    "credential.helper=",
    "protocol.allow=never",
    "diff.external=",
    "diff.noprefix=false",
    "diff.mnemonicPrefix=false",
    "diff.relative=false",
    "diff.submodule=short",
    "safe.bareRepository=explicit",
    "submodule.recurse=false",
    "status.relativePaths=false",
)
_VARIABLES: Final = {
    "GIT_OPTIONAL_LOCKS": "0",
    "GIT_NO_LAZY_FETCH": "1",
    "GIT_TERMINAL_PROMPT": "0",
    "GIT_ASKPASS": "",
    "LC_ALL": "C",
}
_IGNORE_SUBMODULES: Final = "--ignore-submodules=dirty"
"""Their commits are compared; looking into them would execute what they configure."""
_EMPTY_VALUES: Final = ("clean", "smudge", "process")


class NotRecorded(Exception):
    """The repository, or a part of it, cannot be read; the text says why."""


@dataclass
class Repository:
    """The state of a repository."""

    root: Path
    commit: str = ""
    """Empty if there is none yet."""
    branch: str = ""
    """Empty if the commit was checked out by itself."""
    remote: str = ""
    """The address of `origin`, or of the first remote, as it is configured."""
    changed: list[str] = field(default_factory=list)
    """Paths that differ from the commit, and are tracked."""
    untracked: list[str] = field(default_factory=list)
    """Paths that are neither tracked nor ignored, and those ignored ones that are used."""
    patch: str = ""
    """What `git diff HEAD` gives, without files that have names of secrets."""
    problems: list[str] = field(default_factory=list)
    """What could not be read, and why."""


def read_repository(
    folder: Path,
    used: Callable[[Path], Sequence[str]] = lambda _: (),
    seconds: float = GIT_SECONDS,
    on_commit: Callable[[Repository], None] = lambda _: None,
) -> Repository:
    """Return the state of the repository that a folder is in.

    Args:
        used: returns the paths of files in the repository, whose root it gets: those that are ignored count
            as untracked.
        on_commit: called as soon as commit, branch and remote are known, before changes are searched for.

    Raises:
        NotRecorded: there is none, or it cannot be read; after its commit is known, what cannot be read is
            listed in `problems` instead.
    """
    program = shutil.which("git")
    if program is None:
        raise NotRecorded("git is not installed")
    git = _Git(program, folder, time.monotonic() + seconds, seconds)
    done = git.run("rev-parse", "--show-toplevel", "HEAD", "--abbrev-ref", "HEAD", may_fail=True)
    lines = done.splitlines()
    if not lines or not Path(lines[0]).is_absolute():
        raise NotRecorded(_reason(git.message))
    root = Path(lines[0])
    if not folder.resolve().is_relative_to(root.resolve()):
        raise NotRecorded(f"the repository's working tree is elsewhere, in {root}")
    repository = Repository(root)
    if len(lines) >= 3:
        repository.commit = lines[1]
        repository.branch = "" if lines[2] == "HEAD" else lines[2]
    git.folder = root
    try:
        _read_remote_and_filters(git, repository)
        on_commit(repository)
        status = ("--porcelain=v1", "-z", "--untracked-files=all", "--no-renames", _IGNORE_SUBMODULES)
        # The names as they are, to be excluded by them below.
        text = git.run("status", *status, limit=_MAX_STATUS_BYTES, errors="surrogateescape")
        for entry in filter(None, text.split("\0")):
            (repository.untracked if entry[:2] == "??" else repository.changed).append(entry[3:])
        if paths := used(root):
            text = git.run("ls-files", "-z", "--", *(f":(literal){path}" for path in paths))
            tracked = {*text.split("\0"), *repository.untracked}
            repository.untracked += [path for path in paths if path not in tracked]
        if repository.commit and repository.changed:
            # Here, since no reader of a patch tells a hidden file from all that its lines may look like.
            hidden = [f":(exclude,literal){path}" for path in repository.changed if is_secret_file(path)]
            options = (
                "--no-color",
                "--no-ext-diff",
                "--no-textconv",
                "-U3",
                "--no-renames",
                "HEAD",
                "--",
                *hidden,
            )
            repository.patch = git.run("diff", _IGNORE_SUBMODULES, *options, limit=MAX_PATCH_BYTES)
    except NotRecorded as problem:
        repository.problems.append(str(problem))
    return repository


def _read_remote_and_filters(git: _Git, repository: Repository) -> None:
    """Read the address of the remote, and switch off the filters that are configured."""
    names = r"^(remote\..*\.url|filter\..*\.(clean|smudge|process))$"
    text = git.run("config", "--null", "--get-regexp", names, may_fail=True)
    entries = [entry.partition("\n")[::2] for entry in text.split("\0") if entry]
    remotes = {
        key.removeprefix("remote.").removesuffix(".url"): url for key, url in entries if key[:3] == "rem"
    }
    repository.remote = remotes.get("origin") or next(iter(remotes.values()), "")
    filters = {key.removeprefix("filter.").rpartition(".")[0] for key, _ in entries if key[:3] == "fil"}
    if any("=" in name or "\n" in name for name in filters):
        raise NotRecorded("a filter is configured whose name has a '='")
    for name in sorted(filters):
        git.settings += [f"filter.{name}.{key}=" for key in _EMPTY_VALUES] + [f"filter.{name}.required=false"]


def _reason(message: str) -> str:
    """Return why there is no repository, from what git wrote."""
    if "dubious ownership" in message or "unsafe repository" in message:
        return "git does not trust the repository, which belongs to another user (safe.directory)"
    if "must be run in a work tree" in message or "bare repository" in message:
        return "the repository is bare: it has no files"
    if "not a git repository" in message:
        return "there is no git repository"
    lines = [line for line in message.splitlines() if line.startswith(("fatal:", "error:"))] or [message]
    return f"git failed: {lines[0].strip()[:200]}"


class _Git:
    """Runs git in a folder, up to a deadline."""

    def __init__(self, program: str, folder: Path, deadline: float, seconds: float) -> None:
        self._program = program
        self._deadline = deadline
        self._seconds = seconds
        self.folder = folder
        self.settings = list(_SETTINGS)
        self.message = ""
        """What the last command wrote to stderr."""
        others = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
        self._variables = others | _VARIABLES

    def run(
        self,
        command: str,
        *arguments: str,
        limit: int = 1 << 20,
        may_fail: bool = False,
        errors: str = "replace",
    ) -> str:
        """Return the output of a command; `errors` says what becomes of bytes that are not UTF-8.

        Raises:
            NotRecorded: it takes too long, writes too much, or fails and may not.
        """
        options = [option for setting in self.settings for option in ("-c", setting)]
        line = [self._program, "-C", str(self.folder), "--no-pager", *options, command, *arguments]
        is_late = threading.Event()

        def stop() -> None:
            is_late.set()
            _kill(process)

        with tempfile.TemporaryFile() as log:
            try:
                process = subprocess.Popen(
                    line,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    env=self._variables,
                    start_new_session=True,
                )
            except OSError as error:
                raise NotRecorded(f"git cannot be run ({error.strerror})") from error
            timer = threading.Timer(max(0.0, self._deadline - time.monotonic()), stop)
            timer.daemon = True
            timer.start()
            with process:
                assert process.stdout is not None
                output = process.stdout.read(limit + 1)
                if len(output) > limit:
                    _kill(process)
            timer.cancel()
            log.seek(0)
            self.message = log.read(_MAX_MESSAGE_BYTES).decode(errors="replace")
        if is_late.is_set():
            raise NotRecorded(f"git {command} was stopped: reading the repository took {self._seconds:g} s")
        if len(output) > limit:
            raise NotRecorded(f"git {command} was stopped: it wrote more than {size(limit)}")
        if process.returncode and not may_fail:
            raise NotRecorded(_reason(self.message))
        return output.decode(errors=errors)


def _kill(process: subprocess.Popen[bytes]) -> None:
    with contextlib.suppress(OSError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()


# --- the code of a run --------------------------------------------------------------------------------

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
