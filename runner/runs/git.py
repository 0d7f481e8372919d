"""The git repository of a folder, read within limits and without executing anything that it configures.

Hooks, file system monitors, external diff programs, filters (such as those of LFS), credential helpers and
transports are switched off; what belongs to another user is not read unless git itself trusts it.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from runner.runs.redaction import is_secret_file
from runner.util.humanize import size

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
