"""Who may do what: tokens, the host that was asked for, same origin for writing.

A *token* is 256 random bits. Its SHA-256 is kept, with its scopes, in a file of the user's; a slow hash is
for secrets that people choose. On a loopback host, reading needs none, and writing needs the same origin or
a token: no page of another site can write. On any other host everything needs one.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import math
import re
import secrets
import time
from collections import OrderedDict
from dataclasses import dataclass
from datetime import UTC, datetime
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from runner.documents import read_object, write_whole
from runner.errors import RunnerError, StorageError
from runner.service.refused import Refused

if TYPE_CHECKING:
    from runner.service.settings import Limits

READ: Final = "read"
WRITE: Final = "write"
SCOPES: Final = (READ, WRITE)
PREFIX: Final = "dualtaxi_"
"""What a token begins with, so that it is recognised where it does not belong."""
COOKIE: Final = "dualtaxi_token"
SAFE_METHODS: Final = ("GET", "HEAD", "OPTIONS")
_NAME: Final = re.compile(r"[\w.@ -]{1,64}")
_MAX_FILE_BYTES: Final = 1 << 20
_MAX_TOKENS: Final = 1000
_ADDRESSES: Final = 10_000
"""Of which failures are remembered."""


@dataclass(frozen=True)
class Token:
    """What is kept of a token."""

    id: str
    name: str
    scopes: tuple[str, ...]
    created: str
    sha256: str

    def as_json(self) -> dict[str, Any]:
        """Return what is told of it: never the hash."""
        return {"id": self.id, "name": self.name, "scopes": list(self.scopes), "created": self.created}


class Tokens:
    """The tokens in a file, read again when it changes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._seen: tuple[int, int, int] | None = None
        self._known: tuple[Token, ...] = ()

    def all(self) -> tuple[Token, ...]:
        """Return the tokens there are, the oldest first.

        Raises:
            StorageError: the file is there and cannot be read as one of tokens.
        """
        try:
            facts = self.path.stat()
            seen = (facts.st_mtime_ns, facts.st_size, facts.st_ino)
            if seen != self._seen:
                self._known = _read(self.path)
                self._seen = seen
        except FileNotFoundError:
            self._known, self._seen = (), None
        except OSError as error:
            raise StorageError(f"{self.path}: cannot be read ({error.strerror}).") from error
        return self._known

    def scopes_of(self, secret: str) -> tuple[str, ...] | None:
        """Return what a token may do; None if there is no such one. Takes as long whichever it is."""
        digest = _digest(secret)
        found = None
        for token in self.all():
            if hmac.compare_digest(token.sha256, digest):
                found = token.scopes
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
        self._change(lambda known: (*known, token))
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
        self._change(lambda known: tuple(token for token in known if token.id != found[0].id))
        return found[0]

    def _change(self, change: Any) -> None:
        from filelock import FileLock

        try:
            self.path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            with FileLock(self.path.with_suffix(".lock"), timeout=10):
                after = change(self.all())
                if len(after) > _MAX_TOKENS:
                    raise RunnerError(f"token: there are {_MAX_TOKENS} tokens; revoke some.")
                kept = [token.as_json() | {"sha256": token.sha256} for token in after]
                write_whole(self.path, {"tokens": kept}, mode=0o600)
        except OSError as error:
            raise StorageError(f"{self.path}: cannot be written ({error.strerror}).") from error


def _read(path: Path) -> tuple[Token, ...]:
    try:
        found = read_object(path, _MAX_FILE_BYTES)["tokens"]
        tokens = tuple(Token(**entry | {"scopes": tuple(entry["scopes"])}) for entry in found)
        if all(set(token.scopes) <= set(SCOPES) and len(token.sha256) == 64 for token in tokens):
            return tokens
    except (ValueError, KeyError, TypeError, AttributeError):
        pass
    raise StorageError(f"{path}: found no file of tokens; remove it, and make them anew.")


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode(errors="replace")).hexdigest()


class Failures:
    """How often each address failed of late; who did too often must wait."""

    def __init__(self, limits: Limits) -> None:
        self._most, self._seconds = limits.failures, limits.failure_seconds
        self._by_address: OrderedDict[str, list[float]] = OrderedDict()

    def wait(self, address: str) -> int:
        """Return how many seconds an address must wait; 0 if it need not."""
        times = self._by_address.get(address, [])
        recent = [then for then in times if then > time.monotonic() - self._seconds]
        if len(recent) < self._most:
            return 0
        return math.ceil(recent[-self._most] + self._seconds - time.monotonic())

    def add(self, address: str) -> None:
        """Take note of a failure."""
        times = self._by_address.setdefault(address, [])
        self._by_address.move_to_end(address)
        times.append(time.monotonic())
        del times[: -self._most]
        if len(self._by_address) > _ADDRESSES:
            self._by_address.popitem(last=False)


class Access:
    """What tokens allow; who tries too many wrong ones must wait."""

    def __init__(self, tokens: Path, limits: Limits) -> None:
        self._tokens, self._failures = Tokens(tokens), Failures(limits)

    def scopes_of(self, secret: str, address: str) -> tuple[str, ...]:
        """Return what a token allows that came from an address.

        Raises:
            Refused: there is no such token, or there were too many wrong ones.
            StorageError: the file of tokens cannot be read.
        """
        if (seconds := self._failures.wait(address)) > 0:
            raise Refused(
                HTTPStatus.TOO_MANY_REQUESTS,
                f"token: too many wrong ones from {address}; try again in {seconds} s.",
                {"retry-after": str(seconds)},
            )
        scopes = self._tokens.scopes_of(secret)
        if scopes is None:
            self._failures.add(address)
            raise unauthorized("token: found one that is unknown, or was revoked.")
        return scopes


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
