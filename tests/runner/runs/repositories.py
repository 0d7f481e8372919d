"""Git repositories for the tests of the code of runs."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path


def git(folder: Path, *arguments: str) -> str:
    """Run git as a user would, with a name and without the user's own settings."""
    settings = ("-c", "user.name=n", "-c", "user.email=n@example.org", "-c", "init.defaultBranch=main")
    variables = {**os.environ, "GIT_CONFIG_GLOBAL": os.devnull, "GIT_CONFIG_NOSYSTEM": "1"}
    command = ["git", *settings, "-C", str(folder), *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True, env=variables).stdout.strip()


def new_project(folder: Path) -> Path:
    """Return a new repository with one script, in one commit."""
    folder.mkdir()
    git(folder, "init", "-q")
    (folder / "train.py").write_text("rate = 1\nsteps = 10\n")
    (folder / ".gitignore").write_text("ignored.py\n")
    git(folder, "add", "-A")
    git(folder, "commit", "-qm", "Begin")
    return folder
