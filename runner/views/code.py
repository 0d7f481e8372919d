"""`code`: the code that ran, with the packages that it used."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Final

from runner.analysis.sections import Section, SourceFile
from runner.errors import RecordingError
from runner.util.humanize import counted
from runner.views.view import ReadyAnswer, View

if TYPE_CHECKING:
    from runner.recording.code import Code
    from runner.recording.reader import Recording

_MAX_LINES: Final = 5000
"""Lines of the changes that people see; the file has all."""
_MAX_FILES: Final = 100
_NAMES: Final = {
    "git": "Commit",
    "git.branch": "Branch",
    "git.remote": "Remote",
    "git.not_recorded": "Git",
    "command": "Command",
    "code.script": "Script",
    "code.not_recorded": "Not recorded",
    "code.left_out": "Left out",
}
_PACKAGE: Final = "package."
_ABOUT_CODE: Final = ("git", "code.")
_NOTHING: Final = "The code of this run was not recorded."


def code(recording: Recording) -> ReadyAnswer:
    """Show the code that ran RUN: commit, script, changes since the commit, and files.

    `git checkout COMMIT && dualtaxi code RUN -o - | git apply` restores it; without a commit the patch has
    all files. With --json, `files` has the text of each recorded file, `new` those that the commit does not
    have, `patch` the changes since the commit, and `packages` the installed packages.

    Examples:
      dualtaxi code @latest
      dualtaxi code k3v9m2xq -o changes.patch
      dualtaxi code k3v9m2xq -o - | git apply
      dualtaxi code k3v9m2xq --json
    """
    from runner.recording.code import Code

    provenance, recorded, problem = recording.provenance, Code(), ""
    try:
        recorded = recording.code
    except RecordingError as error:
        problem = str(error).removeprefix(f"{recording.path}: ")
    facts = {key: text for key, text in provenance.items() if key.startswith(_ABOUT_CODE) or key == "command"}
    packages = {
        key.removeprefix(_PACKAGE): text for key, text in provenance.items() if key.startswith(_PACKAGE)
    }
    files = {"files": dict(recorded.files), "new": recorded.new, "patch": recorded.patch}
    data = {**facts, **files, "packages": packages}
    return ReadyAnswer(
        data, _text(facts, packages, recorded, problem), lambda: _patch(facts, recorded, problem)
    )


def _text(
    facts: Mapping[str, str], packages: Mapping[str, str], recorded: Code, problem: str
) -> Iterator[Section]:
    """Yield facts, packages, the changes since the commit, and the files."""
    if facts:
        named = {_NAMES.get(key, key): text for key, text in facts.items()}
        yield Section("Commit and command", facts=named)
    if packages:
        sentence = f"{counted(len(packages), 'package')}."
        yield Section("Installed packages", [sentence], facts=packages, is_folded=True)
    if lines := recorded.patch.splitlines():
        more = f"{len(lines) - _MAX_LINES:,} more lines: `dualtaxi code RUN -o FILE.patch` writes all."
        left_out = [more] * (len(lines) > _MAX_LINES)
        yield Section("Changes since the commit", left_out, diffs=[lines[:_MAX_LINES]])
    script = facts.get("code.script")
    names = sorted(recorded.files, key=lambda path: path != script)
    new = recorded.new if "git" in facts else ()
    sources = [
        SourceFile(path, "not in the commit" if path in new else "", recorded.files[path])
        for path in names[:_MAX_FILES]
    ]
    if sources:
        more = f"{len(names) - _MAX_FILES:,} more files: `dualtaxi code RUN --json` has all."
        left_out = [more] * (len(names) > _MAX_FILES)
        yield Section("Files", left_out, sources=sources)
    elif problem or not any(key.startswith(_ABOUT_CODE) for key in facts):
        yield Section("Files", [problem or _NOTHING])


def _patch(facts: Mapping[str, str], recorded: Code, problem: str) -> str:
    """Return the facts as comments, which `git apply` ignores, and a patch.

    Raises:
        RecordingError: the files cannot be read.
    """
    if problem:
        raise RecordingError(problem)
    about = (facts or {"code.not_recorded": _NOTHING}).items()
    comments = [f"# {key}: {' '.join(text.split())}\n" for key, text in about]
    return "".join(comments) + recorded.to_patch()


VIEW: Final = View(
    "code",
    "Code",
    code,
    has_default=True,
    file_ending=".patch",
    file_help="Write a patch for `git apply` that makes this code of the commit.",
)
