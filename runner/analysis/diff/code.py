"""How the code of two runs differs, and in a few words how else they were made."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from runner.recording.code import patch_parts, unified_diff
from runner.recording.reader import Recording
from runner.util.differences import Change
from runner.util.humanize import counted

MAX_LINES: Final = 200
"""The most lines of a file's diff that are shown."""
MAX_FILES: Final = 20
"""The most files whose lines are shown."""
_MAX_COMPARED: Final = 10_000
"""Longer files are not compared line by line."""
_MAX_NAMED: Final = 4
"""Files, and packages, that are named in a sentence."""
_SHOWN_COMMIT: Final = 10


@dataclass(frozen=True)
class FileChange:
    """A file of the user's code that is not the same in two runs."""

    path: str
    added: int
    """Lines of B that A does not have."""
    removed: int
    """Lines of A that B does not have."""
    lines: list[str]
    """A unified diff from A to B, without secrets; its first lines if it is long."""
    left_out: int
    """Lines of the diff that are not in `lines`."""

    @property
    def words(self) -> str:
        """What differs, in words: `14 lines of ppo.py`."""
        return f"{counted(self.added + self.removed, 'line')} of `{self.path}`"


def code_changes(a: Recording, b: Recording) -> list[FileChange]:
    """Return the recorded files that differ; none if a run did not record its code.

    A file that one of the runs neither loaded nor changed since its commit is not compared.
    """
    ours, theirs = a.code, b.code
    if not (ours.files or ours.patch) or not (theirs.files or theirs.patch):
        return []
    commits = [run.provenance.get("git", "").removesuffix("-dirty") for run in (a, b)]
    parts = patch_parts(ours.patch), patch_parts(theirs.patch)
    changes: list[FileChange] = []
    for path in sorted({*ours.files, *theirs.files, *parts[0], *parts[1]}):
        left, right = ours.files.get(path), theirs.files.get(path)
        is_added = left is None and path in theirs.new
        is_removed = right is None and path in ours.new
        lines = []
        if is_added or is_removed or (left is not None and right is not None):
            lines = [] if left == right else _compared(left, right, path)
        elif commits[0] == commits[1] and parts[0].get(path) != parts[1].get(path):
            lines = _patches(parts[0].get(path), parts[1].get(path))
        if lines:
            first = next((i for i, line in enumerate(lines) if line.startswith("@@ ")), 0)
            signs = Counter(line[:1] for line in lines[first:])  # the lines before also begin with signs
            kept_lines = lines[: MAX_LINES if len(changes) < MAX_FILES else 0]
            changes.append(FileChange(path, signs["+"], signs["-"], kept_lines, len(lines) - len(kept_lines)))
    return changes


def _compared(a: str | None, b: str | None, path: str) -> list[str]:
    """Return the unified diff of two texts; of very long ones that all lines differ."""
    ours, theirs = a or "", b or ""
    if max(ours.count("\n"), theirs.count("\n")) < _MAX_COMPARED:
        return unified_diff(a, b, path)
    return [f"-{line}" for line in ours.splitlines()] + [f"+{line}" for line in theirs.splitlines()]


def _patches(a: str | None, b: str | None) -> list[str]:
    """Return how one run's changes since the same commit differ from the other's."""
    if a is None:
        return (b or "").removesuffix("\n").split("\n")
    if b is not None:
        return unified_diff(a, b, "changes since the commit")
    head, _, hunks = a.removesuffix("\n").partition("\n@@ ")
    lines = head.split("\n")
    if not hunks:
        return lines  # a file without lines, or another mode
    opposite = {"+": "-", "-": "+"}
    undone = [f"--- {lines[-1][4:]}", f"+++ {lines[-2][4:]}"]
    for line in f"@@ {hunks}".split("\n"):
        if line.startswith("@@ "):
            undone.append(re.sub(r"^@@ -(\S+) \+(\S+) @@", r"@@ -\2 +\1 @@", line))
        else:
            undone.append(opposite.get(line[:1], line[:1]) + line[1:])
    return undone


def made_in_words(files: Sequence[FileChange], provenance: Sequence[Change]) -> list[str]:
    """Return what differs in how two runs were made, in a few words each.

    For example `14 lines of ppo.py`, `torch 2.9.0 to 2.10.0`, `another GPU: A100 to H100`.
    """
    texts = {
        change.path: " to ".join(
            _short(str(value or "none")) if change.path == "git" else str(value or "none")
            for value in (change.a, change.b)
        )
        for change in provenance
    }
    words = _first([change.words for change in files], "files")
    for key, name in (("git", "commit"), ("python", "Python"), ("dualtaxi", "dualtaxi")):
        if key in texts:
            words.append(f"{name} {texts[key]}")
    packages = [
        f"{path.removeprefix('package.')} {text}"
        for path, text in texts.items()
        if path.startswith("package.") and path != "package.dualtaxi"
    ]
    words += _first(packages, "packages")
    gpus = [text for path, text in texts.items() if re.fullmatch(r"gpu\.\d+", path)]
    if gpus:
        words.append(f"another GPU: {gpus[0]}")
    for key, name in (("processor", "processor"), ("gpu.driver", "driver"), ("torch.cuda", "CUDA")):
        if key in texts:
            words.append(f"another {name}: {texts[key]}")
    return words


def _first(words: list[str], nouns: str) -> list[str]:
    more = len(words) - _MAX_NAMED
    return words[:_MAX_NAMED] + ([f"{more} more {nouns}"] if more > 0 else [])


def _short(commit: str) -> str:
    text, _, dirty = commit.partition("-")
    return text[:_SHOWN_COMMIT] + (" with changes" if dirty else "")
