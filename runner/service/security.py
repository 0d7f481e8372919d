"""Who may do what: tokens, the host that was asked for, same origin for writing.

A *token* is 256 random bits. Its SHA-256 is kept, with its scopes, in a file of the user's; a slow hash and
limits on attempts are for secrets that people choose. On a loopback host, reading needs none, and writing
needs the same origin or a token: no page of another site can write. On any other host everything needs one.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import re
import secrets
from dataclasses import dataclass
from datetime import UTC, datetime
from http import HTTPStatus
from pathlib import Path
from typing import Any, Final

from runner.errors import RunnerError
from runner.service.errors import Refused
from runner.service.records import RecordsFile

READ: Final = "read"
WRITE: Final = "write"
SCOPES: Final = (READ, WRITE)
PREFIX: Final = "dualtaxi_"
"""What a token begins with, so that it is recognised where it does not belong."""
SAFE_METHODS: Final = ("GET", "HEAD", "OPTIONS")
_NAME: Final = re.compile(r"[\w.@ -]{1,64}")
_MAX_TOKENS: Final = 1000


@dataclass(frozen=True)
class Token:
    """What is kept of a token."""

    id: str
    name: str
    scopes: tuple[str, ...]
    created: str
    sha256: str

    @property
    def can_write(self) -> bool:
        """Whether it allows more than reading."""
        return WRITE in self.scopes

    def as_json(self) -> dict[str, Any]:
        """Return what is told of it: never the hash."""
        return {"id": self.id, "name": self.name, "scopes": list(self.scopes), "created": self.created}


class Tokens:
    """The tokens in a file, read again when it changes."""

    def __init__(self, path: Path) -> None:
        self._file = RecordsFile(path, "tokens", _parsed)

    @property
    def path(self) -> Path:
        """Return the file of the tokens."""
        return self._file.path

    def all(self) -> tuple[Token, ...]:
        """Return the tokens there are, the oldest first.

        Raises:
            StorageError: the file is there and cannot be read as one of tokens.
        """
        return self._file.all()

    def find(self, secret: str) -> Token | None:
        """Return the token of a secret; None if there is none. Takes as long whichever it is."""
        digest = _digest(secret)
        found = None
        for token in self.all():
            if hmac.compare_digest(token.sha256, digest):
                found = token
        return found

    def create(self, name: str, scopes: tuple[str, ...]) -> tuple[Token, str]:
        """Return a new token and its secret, which is nowhere kept.

        Raises:
            RunnerError: the name or a scope cannot be one, or there are too many tokens.
            StorageError: the file cannot be written.
        """
        if not _NAME.fullmatch(name):
            raise RunnerError(f"token: found the name {name!r}, expected 1 to 64 letters, digits, _ . @ -")
        secret = PREFIX + secrets.token_urlsafe(32)
        now = datetime.now(UTC).isoformat(timespec="seconds")
        token = Token(secrets.token_hex(4), name, scopes, now, _digest(secret))
        self._file.change(lambda known: _bounded((*known, token)))
        return token, secret

    def revoke(self, which: str) -> Token:
        """Take the token of an id or a name away, at once also for a running service; return it.

        Raises:
            RunnerError: there is none, or several are called so.
            StorageError: the file cannot be written.
        """
        found = [token for token in self.all() if which in (token.id, token.name)]
        if len(found) != 1:
            known = ", ".join(f"{token.id} ({token.name})" for token in self.all()) or "none"
            raise RunnerError(f"token: {which!r} names {len(found)} tokens, expected one of {known}.")
        self._file.change(lambda known: tuple(token for token in known if token.id != found[0].id))
        return found[0]


def _bounded(tokens: tuple[Token, ...]) -> tuple[Token, ...]:
    if len(tokens) > _MAX_TOKENS:
        raise RunnerError(f"token: there are {_MAX_TOKENS} tokens; revoke some.")
    return tokens


def _parsed(entry: Any) -> Token:
    token = Token(**entry | {"scopes": tuple(entry["scopes"])})
    if not set(token.scopes) <= set(SCOPES) or len(token.sha256) != 64:
        raise ValueError("it is no token")
    return token


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode(errors="replace")).hexdigest()


def unauthorized(message: str) -> Refused:
    """Return the error that a token is missing or wrong."""
    return Refused(HTTPStatus.UNAUTHORIZED, message, {"www-authenticate": "Bearer"})


def is_allowed_host(header: str, hosts: tuple[str, ...]) -> bool:
    """Return whether a Host header names this service.

    An address is one: a site whose name was made to point at this machine still asks for its own name.
    """
    name = host_name(header)
    if name in ("localhost", *hosts):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def host_name(header: str) -> str:
    """Return the name in a Host header, without port, brackets and capitals."""
    name = re.sub(r":\d{1,5}$", "", header) if not header.endswith("]") else header
    return name.strip("[]").lower().rstrip(".")


def is_embedded_elsewhere(headers: dict[str, str]) -> bool:
    """Return whether a browser says that a page of another site loads this as a part of itself.

    It could not read what it gets, but have the service work for it; following a link is another thing.
    """
    site, mode = headers.get("sec-fetch-site"), headers.get("sec-fetch-mode")
    return site in ("cross-site", "same-site") and mode != "navigate"


def is_same_origin(headers: dict[str, str]) -> bool:
    """Return whether a browser says that a page of this service asks; or a program, by `Origin`.

    No page can make a browser send another `Origin` or `Sec-Fetch-Site` than is true.
    """
    site, origin = headers.get("sec-fetch-site"), headers.get("origin")
    if site is not None and site != "same-origin":
        return False
    if origin is not None:
        scheme, _, host = origin.partition("://")
        return scheme in ("http", "https") and host.lower() == headers.get("host", "").lower()
    return site == "same-origin"
