"""`code`: the code that ran, with the packages that it used."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, BinaryIO, Final

from runner.analysis.sections import Answer, Section, SourceFile
from runner.errors import RecordingError
from runner.util.humanize import counted
from runner.views.view import View

if TYPE_CHECKING:
    from runner.recording.code import Code
    from runner.recording.reader import Recording
    from runner.util.values import Json

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


@dataclass(frozen=True)
class RunCode(Answer):
    """The code of a run, and the facts of its provenance that are about code."""

    facts: Mapping[str, str]
    packages: Mapping[str, str]
    """Version of each installed package."""
    code: Code
    problem: str
    """Why the files cannot be read; empty if they can."""

    def as_json(self) -> Json:
        """Return the facts, the text of each file, those that the commit does not have, and the changes."""
        files = {"files": dict(self.code.files), "new": self.code.new, "patch": self.code.patch}
        return {**self.facts, **files, "packages": dict(self.packages)}

    def sections(self) -> list[Section]:
        """Return facts, packages, the changes since the commit, and the files."""
        facts = {_NAMES.get(key, key): text for key, text in self.facts.items()}
        sections = [Section("Commit and command", facts=facts)] if facts else []
        if self.packages:
            sentence = f"{counted(len(self.packages), 'package')}."
            sections.append(Section("Installed packages", [sentence], facts=self.packages, is_folded=True))
        if lines := self.code.patch.splitlines():
            more = f"{len(lines) - _MAX_LINES:,} more lines: `dualtaxi code RUN -o FILE.patch` writes all."
            left_out = [more] * (len(lines) > _MAX_LINES)
            sections.append(Section("Changes since the commit", left_out, diffs=[lines[:_MAX_LINES]]))
        script = self.facts.get("code.script")
        names = sorted(self.code.files, key=lambda path: path != script)
        new = self.code.new if "git" in self.facts else ()
        sources = [
            SourceFile(path, "not in the commit" if path in new else "", self.code.files[path])
            for path in names[:_MAX_FILES]
        ]
        if sources:
            more = f"{len(names) - _MAX_FILES:,} more files: `dualtaxi code RUN --json` has all."
            left_out = [more] * (len(names) > _MAX_FILES)
            sections.append(Section("Files", left_out, sources=sources))
        elif self.problem or not any(key.startswith(_ABOUT_CODE) for key in self.facts):
            sections.append(Section("Files", [self.problem or _NOTHING]))
        return sections

    def write(self, stream: BinaryIO) -> None:
        """Write the facts as comments, which `git apply` ignores, and a patch.

        Raises:
            RecordingError: the files cannot be read.
        """
        if self.problem:
            raise RecordingError(self.problem)
        for key, text in (self.facts or {"code.not_recorded": _NOTHING}).items():
            stream.write(f"# {key}: {' '.join(text.split())}\n".encode(errors="replace"))
        stream.write(self.code.to_patch().encode(errors="replace"))


def code(recording: Recording) -> RunCode:
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
    return RunCode(
        {key: text for key, text in provenance.items() if key.startswith(_ABOUT_CODE) or key == "command"},
        {key.removeprefix(_PACKAGE): text for key, text in provenance.items() if key.startswith(_PACKAGE)},
        recorded,
        problem,
    )


VIEW: Final = View(
    "code",
    "Code",
    code,
    has_default=True,
    file_ending=".patch",
    file_help="Write a patch for `git apply` that makes this code of the commit.",
)
