"""Patches of recorded code: git applies what a diff shows."""

from __future__ import annotations

import subprocess
from types import SimpleNamespace
from typing import Any, cast

import pytest

from runner.analysis.diff.code import code_changes
from runner.recording.code import Code


def of(files: dict[str, str], new: tuple[str, ...] = (), patch: str = "") -> Any:
    """Return a recording as far as its code is compared."""
    return cast(Any, SimpleNamespace(code=Code(files, new, patch), provenance={"git": "c0ffee"}))


BEFORE = "".join(f"line {k}\n" for k in range(30))
AFTER = BEFORE.replace("line 28\n", "other\n\n").replace("line 3\n", "")


@pytest.mark.parametrize(
    ("a", "b"),
    [
        ({"train.py": BEFORE}, {"train.py": AFTER}),
        ({"my train.py": BEFORE, "x.py": "1\n"}, {"my train.py": BEFORE + "without an end", "x.py": "2\n"}),
        ({"x.py": "1"}, {"x.py": "1\n"}),
        ({"x.py": "1\n"}, {"x.py": "1\n", "src/new.py": "a\n\nb\n"}),
        ({"x.py": "1\n", "old.py": "a\n"}, {"x.py": "1\n"}),
    ],
)
def test_git_applies_the_code_that_a_diff_shows(a, b, tmp_path):
    changes = code_changes(of(a, tuple(a.keys() - b.keys())), of(b, tuple(b.keys() - a.keys())))
    apply(tmp_path, a, [line for change in changes for line in change.lines])
    assert files_in(tmp_path) == b


def test_git_applies_changes_since_a_commit_that_one_run_has(tmp_path):
    patch = (
        "diff --git a/lib.py b/lib.py\nindex 1..2 100644\n--- a/lib.py\n+++ b/lib.py\n"
        "@@ -1,2 +1,3 @@\n 1\n--- 2\n+++ 3\n+4\n"
    )
    runs = of({"x.py": "1\n"}, patch=patch), of({"x.py": "1\n"})
    committed, changed = {"lib.py": "1\n-- 2\n"}, {"lib.py": "1\n++ 3\n4\n"}
    for k, (before, after) in enumerate([(changed, committed), (committed, changed)]):
        (change,) = code_changes(runs[k], runs[1 - k])
        assert (change.added, change.removed) == [(1, 2), (2, 1)][k]
        apply(tmp_path / str(k), before, change.lines)
        assert files_in(tmp_path / str(k)) == after


def apply(folder, files, lines):
    folder.mkdir(exist_ok=True)
    for path, text in files.items():
        (folder / path).write_text(text)
    subprocess.run(["git", "init", "-q"], cwd=folder, check=True)
    patch = "\n".join(lines) + "\n"
    subprocess.run(["git", "apply", "-"], input=patch, text=True, cwd=folder, check=True)


def files_in(folder):
    paths = (path for path in folder.rglob("*") if path.is_file() and ".git" not in path.parts)
    return {path.relative_to(folder).as_posix(): path.read_text() for path in paths}
