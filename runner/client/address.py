"""Where a server is, and the token that lets one in."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from runner.errors import RunnerError

TOKEN_VARIABLE: Final = "DUALTAXI_TOKEN"
TOKEN_FILE_VARIABLE: Final = "DUALTAXI_TOKEN_FILE"
_MAX_TOKEN_FILE: Final = 4096


def checked_url(url: str) -> str:
    """Return the address of a server, without a slash at its end.

    Raises:
        RunnerError: it is none.
    """
    parts = urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.hostname or parts.query or parts.fragment:
        raise RunnerError(f"server: found {url!r}, expected an address such as http://localhost:8000.")
    if parts.username is not None or parts.password is not None:
        raise RunnerError(
            f"server: found a name or password in the address of {parts.hostname}, expected none: a token is "
            f"given by --token, ${TOKEN_VARIABLE} or a file named by ${TOKEN_FILE_VARIABLE}."
        )
    return url.rstrip("/")


def find_token(said: str | None = None, file: Path | None = None) -> str | None:
    """Return a token: what is said, or in a file; else what the variables say; None if there is none.

    Raises:
        RunnerError: it is none, or its file cannot be read.
    """
    if said is None and file is None:
        said, named = os.environ.get(TOKEN_VARIABLE), os.environ.get(TOKEN_FILE_VARIABLE)
        file = Path(named) if named else None
    if said:
        return _checked_token(said, "token")
    return None if file is None else _checked_token(_beginning_of(file), os.fspath(file))


def _beginning_of(file: Path) -> str:
    try:
        with file.open(encoding="utf-8") as stream:
            return stream.read(_MAX_TOKEN_FILE)
    except (OSError, ValueError) as error:
        raise RunnerError(f"{file}: cannot be read, expected a file with a token.") from error


def _checked_token(text: str, where: str) -> str:
    token = text.strip()
    if not token or not token.isascii() or not token.isprintable() or " " in token:
        raise RunnerError(f"{where}: found no token, expected one line of letters and digits.")
    return token
