"""JSON: values that it can hold; small files of it beside a recording, read within bounds, replaced whole."""

from __future__ import annotations

import json
import math
import os
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from runner.util.opening import open_regular

_BINARY: Final = getattr(os, "O_BINARY", 0)
"""What Windows needs to leave line ends as they are."""


def finite(value: Any) -> Any:
    """Return a value as JSON can hold it: NaN and infinity, for which it has no word, as None."""
    if isinstance(value, Mapping):
        return {str(key): finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def read_object(path: str | os.PathLike[str], most: int) -> dict[str, Any]:
    """Return the JSON object in a file; what JSON has no word for (NaN) as None.

    Args:
        path: the file; a link is followed.
        most: the most bytes that are read.

    Raises:
        OSError: it cannot be read.
        ValueError: it is too long, or holds no JSON object.
    """
    with open_regular(path) as stream:
        data = stream.read(most + 1)
    if len(data) > most:
        raise ValueError(f"it is longer than {most:,} bytes")
    try:
        found = with_plain_texts(json.loads(data, parse_constant=lambda _: None), data)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    if not isinstance(found, dict):
        raise ValueError("it holds no JSON object")
    return found


def with_plain_texts(found: Any, data: str | bytes) -> Any:
    r"""Return what was parsed from JSON, with texts that UTF-8 can hold.

    An escape such as `\ud800` gives half a character, which no page, file or terminal can show; it is
    replaced by a question mark.

    Args:
        found: what was parsed.
        data: what from.
    """
    escape = b"\\ud" if isinstance(data, bytes) else "\\ud"
    return _replaced(found) if escape in data.lower() else found  # type: ignore[operator]


def _replaced(value: Any) -> Any:
    if isinstance(value, str):
        return value.encode(errors="replace").decode()
    if isinstance(value, list):
        return [_replaced(item) for item in value]
    if isinstance(value, dict):
        return {_replaced(key): _replaced(item) for key, item in value.items()}
    return value


def write_whole(path: Path, value: dict[str, Any], mode: int = 0o666) -> None:
    """Replace a file whole: a reader sees the old one or the new one.

    Args:
        path: the file.
        value: what it will hold.
        mode: who may read and write it, less what the process's mask takes away.

    Raises:
        OSError: it cannot be written; it is as before.
    """
    data = (json.dumps(value, indent=1, ensure_ascii=False) + "\n").encode()
    fresh = path.with_suffix(f".{secrets.token_hex(4)}.tmp")
    try:
        with os.fdopen(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL | _BINARY, mode), "wb") as stream:
            stream.write(data)
        fresh.replace(path)
    except BaseException:
        fresh.unlink(missing_ok=True)
        raise


def sync(path: Path) -> None:
    """Ask the system to put a file, or the names in a folder, on disk.

    Raises:
        OSError: it could not.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
