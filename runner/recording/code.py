"""The user's code as a run recorded it: its sources and what was changed since the commit.

Nothing here executes or imports anything; anyone may have written what is read.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Final

import zstandard
from msgspec import Meta

from runner.errors import RecordingError
from runner.recording.metadata import json_object, unpacked
from runner.recording.records import MAX_METADATA_BYTES
from runner.util.stored import require_keys, stored_as
from runner.util.values import is_utf8

CODE_RECORD: Final = "provenance/code"
"""The metadata record with the commit, the script and what was left out; part of the provenance."""
CODE_ATTACHMENT: Final = "code.json.zst"
MAX_CODE_BYTES: Final = 1 << 20
"""The most bytes of sources and patch that are recorded, and the most that are read."""
MAX_FILES: Final = 2_000


@dataclass(frozen=True)
class Code:
    """The sources of a run, without secrets."""

    files: Annotated[Mapping[str, str], Meta(max_length=MAX_FILES)] = field(default_factory=dict)
    """Path, relative to the repository or to the script's folder, to text."""
    new: tuple[str, ...] = ()
    """The paths in `files` that the commit does not have; all of them without a commit."""
    patch: str = ""
    """What `git diff HEAD` gave: the changes since the commit."""

    def to_patch(self) -> str:
        """Return a patch that makes these sources of the commit, or of an empty folder without a commit."""
        return self.patch + "".join(_new_file(path, self.files[path]) for path in self.new)

    def to_attachment(self) -> bytes:
        """Return the content of the attachment."""
        values = {"files": dict(self.files), "new": self.new, "patch": self.patch}
        text = json.dumps(values, sort_keys=True, ensure_ascii=False)
        return zstandard.ZstdCompressor().compress(text.encode(errors="replace"))


def parse_code(data: bytes, where: str) -> Code:
    """Return the code in an attachment.

    Raises:
        RecordingError: it is damaged, or too large.
    """
    what = f"{where}: {CODE_ATTACHMENT}"
    where = f"{what} is damaged"
    try:
        text = unpacked(data, MAX_METADATA_BYTES + 1)
    except zstandard.ZstdError as error:
        raise RecordingError(f"{where} ({error}).") from error
    values = json_object(text, what)
    require_keys(values, ("files", "new", "patch"), where)
    code = stored_as(Code, values, where)
    if not all(map(_is_path, code.files)):
        raise RecordingError(f"{where}: found a path that is not relative.")
    if not set(code.new) <= code.files.keys():
        raise RecordingError(f"{where}: found a new file without its text.")
    return code


def _is_path(path: str) -> bool:
    """Return whether this is a relative path that stays in its folder, printable on one line."""
    parts = path.split("/")
    return bool(path) and path.isprintable() and is_utf8(path) and not {"", ".", ".."} & set(parts)


def _new_file(path: str, text: str) -> str:
    name = f'"b/{path}"' if " " in path or '"' in path or "\\" in path else f"b/{path}"
    head = f"diff --git {name.replace('b/', 'a/', 1)} {name}\nnew file mode 100644\n"
    if not text:
        return head
    lines = text.removesuffix("\n").split("\n")
    body = "".join(f"+{line}\n" for line in lines)
    ending = "" if text.endswith("\n") else "\\ No newline at end of file\n"
    return f"{head}--- /dev/null\n+++ {name}\n@@ -0,0 +1,{len(lines)} @@\n{body}{ending}"


def patch_parts(patch: str) -> dict[str, str]:
    """Return the parts of a patch by the path of the file that they change."""
    parts: dict[str, list[str]] = {}
    path = ""
    for line in patch.splitlines(keepends=True):
        if line.startswith("diff --git "):
            path = line.rstrip("\n").rpartition(" b/")[2]
        parts.setdefault(path, []).append(line)
    return {path: "".join(lines) for path, lines in parts.items()}


def unified_diff(a: str | None, b: str | None, path: str) -> list[str]:
    """Return the lines by which two texts differ, with their context, as a unified diff of a file.

    `git apply` and `patch -p1` accept it; None is a file that is not there.
    """
    names = ["/dev/null" if text is None else f"{side}/{path}" for side, text in (("A", a), ("B", b))]
    texts = [(text or "").split("\n") for text in (a, b)]
    lines = [[f"{line}\n" for line in text[:-1]] + [last for last in text[-1:] if last] for text in texts]
    result = []
    for line in difflib.unified_diff(lines[0], lines[1], names[0], names[1]):
        result.append(line.removesuffix("\n"))
        if not line.endswith("\n"):
            result.append("\\ No newline at end of file")
    return result
