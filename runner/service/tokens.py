"""Access tokens, and the browser sessions that stand for them.

A *token* is 256 random bits. A file of the user's has its SHA-256 and its scopes; slow hashes and limits on
attempts are for secrets that people choose. A *session* is 256 random bits in a cookie; a file next to that
of the tokens has their SHA-256, and the id of the token. So logins survive a restart, a session ends with its
token, and neither file gives anybody access.
"""

from __future__ import annotations

import dataclasses
import hashlib
import hmac
import re
import secrets
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Generic, TypeVar

from filelock import FileLock
from pydantic import Field, TypeAdapter

from runner.errors import RunnerError, StorageError
from runner.service.errors import Unauthorized, expecting
from runner.util.files import read_object, storage_errors, write_object

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Record = TypeVar("Record", bound="DataclassInstance")

READ: Final = "read"
WRITE: Final = "write"
SCOPES: Final = (READ, WRITE)
PREFIX: Final = "dualtaxi_"
"""What a token begins with, so that it is recognised where it does not belong."""
MAX_TOKENS: Final = 1000
SESSIONS_FILE: Final = "sessions.json"
COOKIE: Final = "dualtaxi_session"
SESSION_SECONDS: Final = 7 * 86_400
MAX_SESSIONS: Final = 1000
"""The oldest sessions end when there are more."""
_NAME: Final = re.compile(r"[\w.@ -]{1,64}")
_MAX_FILE_BYTES: Final = 1 << 20
_LOCK_SECONDS: Final = 10


Digest = Annotated[str, Field(pattern="^[0-9a-f]{64}$"), expecting("64 hexadecimal digits")]


@dataclass(frozen=True)
class Token:
    """What is stored of a token."""

    id: str
    name: str
    scopes: tuple[Annotated[str, Field(pattern=f"^({'|'.join(SCOPES)})$")], ...]
    created: str
    sha256: Digest

    @property
    def can_write(self) -> bool:
        """Whether it allows more than reading."""
        return WRITE in self.scopes

    def as_json(self) -> dict[str, object]:
        """Return its public fields: never the hash."""
        return {"id": self.id, "name": self.name, "scopes": list(self.scopes), "created": self.created}


@dataclass(frozen=True)
class LoginSession:
    """What is stored of a session."""

    sha256: Digest
    token_id: str
    expires: float
    """In seconds since 1970."""


class _RecordsFile(Generic[Record]):
    """A file `{"KEY": [record, ...]}`, readable by its owner only, that several processes may change."""

    def __init__(self, path: Path, key: str, kind: type[Record]) -> None:
        self.path = path
        self._key, self._adapter = key, TypeAdapter(tuple[kind, ...])  # type: ignore[valid-type]

    def all(self) -> tuple[Record, ...]:
        """Return the records.

        Raises:
            StorageError: the file exists and cannot be read as one of them.
        """
        try:
            return self._adapter.validate_python(read_object(self.path, _MAX_FILE_BYTES)[self._key])
        except FileNotFoundError:
            return ()
        except OSError as error:
            raise StorageError(f"{self.path}: cannot be read ({error.strerror}).") from error
        except (ValueError, KeyError):
            message = f"{self.path}: found no file of {self._key}; remove it, and create them again."
            raise StorageError(message) from None

    def change(self, change: Callable[[tuple[Record, ...]], Iterable[Record]]) -> None:
        """Replace the records by the result of a function, while no other process changes them."""
        with storage_errors(self.path):
            self.path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            with FileLock(self.path.with_suffix(".lock"), timeout=_LOCK_SECONDS):
                records = [dataclasses.asdict(record) for record in change(self.all())]
                write_object(self.path, {self._key: records}, mode=0o600)


class Tokens:
    """The tokens in a file."""

    def __init__(self, path: Path) -> None:
        self._file = _RecordsFile(path, "tokens", Token)
        self.path = path

    def all(self) -> tuple[Token, ...]:
        """Return all tokens, the oldest first."""
        return self._file.all()

    def find(self, secret: str) -> Token:
        """Return the token of a secret. Takes the same time if there is none.

        Raises:
            Unauthorized: there is none.
        """
        digest = _digest(secret)
        matching = [token for token in self.all() if hmac.compare_digest(token.sha256, digest)]
        if not matching:
            raise Unauthorized(
                "token: found one that is unknown, or was revoked; make one by `dualtaxi token create NAME`."
            )
        return matching[-1]

    def create(self, name: str, scopes: tuple[str, ...]) -> tuple[Token, str]:
        """Return a new token and its secret, which is not stored.

        Raises:
            RunnerError: the name is invalid or in use, or there are too many tokens.
        """
        if not _NAME.fullmatch(name):
            raise RunnerError(f"token: found the name {name!r}, expected 1 to 64 letters, digits, _ . @ -")
        secret = PREFIX + secrets.token_urlsafe(32)
        now = datetime.now(UTC).isoformat(timespec="seconds")
        token = Token(secrets.token_hex(4), name, scopes, now, _digest(secret))

        def add(tokens: tuple[Token, ...]) -> tuple[Token, ...]:
            if len(tokens) >= MAX_TOKENS:
                raise RunnerError(
                    f"token: there are {MAX_TOKENS} tokens; revoke some by `dualtaxi token revoke NAME`."
                )
            for other in tokens:
                if other.name == name:
                    raise RunnerError(
                        f"token: the name {name!r} is in use; choose another, or revoke that token by "
                        f"`dualtaxi token revoke {other.id}`."
                    )
            return (*tokens, token)

        self._file.change(add)
        return token, secret

    def revoke(self, name: str) -> Token:
        """Remove the token with an id or a name, at once also for a running service; return it.

        Raises:
            RunnerError: there is none, or there are several of the name.
        """
        matching = [token for token in self.all() if name in (token.id, token.name)]
        if len(matching) != 1:
            found = "several tokens have" if matching else "no token has"
            raise RunnerError(f"{found} the id or name {name!r}. `dualtaxi token ls` lists them.")
        self._file.change(lambda tokens: [token for token in tokens if token.id != matching[0].id])
        return matching[0]


class Sessions:
    """The browser sessions of the tokens in a file."""

    def __init__(self, tokens: Tokens) -> None:
        self._tokens = tokens
        self._file = _RecordsFile(tokens.path.with_name(SESSIONS_FILE), "sessions", LoginSession)

    def begin(self, token: Token) -> str:
        """Return the secret of a new session of a token."""
        secret = secrets.token_urlsafe(32)
        session = LoginSession(_digest(secret), token.id, time.time() + SESSION_SECONDS)
        self._file.change(lambda sessions: [*self._current(sessions), session][-MAX_SESSIONS:])
        return secret

    def token_of(self, secret: str) -> Token | None:
        """Return the token of a session; None if it has ended, or its token was revoked."""
        digest = _digest(secret)  # compared as a hash, so the time it takes reveals nothing of the secret
        for session in self._current(self._file.all()):
            if session.sha256 == digest:
                return next((token for token in self._tokens.all() if token.id == session.token_id), None)
        return None

    def end(self, secret: str) -> None:
        """End a session, if it exists."""
        digest = _digest(secret)
        self._file.change(lambda sessions: [old for old in self._current(sessions) if old.sha256 != digest])

    def _current(self, sessions: tuple[LoginSession, ...]) -> list[LoginSession]:
        """Return the sessions that have not ended and whose token exists."""
        ids = {token.id for token in self._tokens.all()}
        now = time.time()
        return [session for session in sessions if session.token_id in ids and session.expires > now]


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode(errors="replace")).hexdigest()
