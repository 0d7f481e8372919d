"""Logins of browsers: a session stands for a token, ends with it, and is of no use anywhere else.

The cookie holds 256 random bits; their SHA-256 is kept, with the id of the token, in a file next to that of
the tokens. So logins survive a restart, and neither file gives anybody access.
"""

from __future__ import annotations

import hashlib
import secrets
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from runner.service.records import RecordsFile
from runner.service.security import Token, Tokens

FILE_NAME: Final = "sessions.json"
COOKIE: Final = "dualtaxi_session"
SESSION_SECONDS: Final = 7 * 86_400
MAX_SESSIONS: Final = 1000
"""The oldest ones end when there are more."""


@dataclass(frozen=True)
class Session:
    """What is kept of a session."""

    sha256: str
    token_id: str
    expires: float
    """In seconds since 1970."""


class Sessions:
    """The sessions of the tokens in a file.

    Args:
        tokens: the tokens that sessions stand for.
    """

    def __init__(self, tokens: Tokens) -> None:
        self._tokens = tokens
        self._file = RecordsFile(tokens.path.with_name(FILE_NAME), "sessions", _parsed)

    @property
    def path(self) -> Path:
        """Return the file of the sessions."""
        return self._file.path

    def begin(self, token: Token) -> str:
        """Return the secret of a new session of a token.

        Raises:
            StorageError: the file cannot be written.
        """
        secret = secrets.token_urlsafe(32)
        session = Session(_digest(secret), token.id, time.time() + SESSION_SECONDS)
        self._file.change(lambda all_: [*self._current(all_), session][-MAX_SESSIONS:])
        return secret

    def token_of(self, secret: str) -> Token | None:
        """Return the token of a session; None if it has ended, or its token was revoked.

        Raises:
            StorageError: a file cannot be read.
        """
        digest = _digest(secret)  # compared as a hash, so the time it takes tells nothing of the secret
        for session in self._current(self._file.all()):
            if session.sha256 == digest:
                return next((token for token in self._tokens.all() if token.id == session.token_id), None)
        return None

    def end(self, secret: str) -> None:
        """End a session, if there is such a one.

        Raises:
            StorageError: the file cannot be written.
        """
        digest = _digest(secret)
        self._file.change(lambda all_: [each for each in self._current(all_) if each.sha256 != digest])

    def _current(self, sessions: tuple[Session, ...]) -> list[Session]:
        """Return the sessions that have not ended, whose token is there."""
        ids, now = {token.id for token in self._tokens.all()}, time.time()
        return [session for session in sessions if session.token_id in ids and session.expires > now]


def _parsed(entry: Any) -> Session:
    return Session(str(entry["sha256"]), str(entry["token_id"]), float(entry["expires"]))


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode(errors="replace")).hexdigest()
