"""Files that others may have put there, opened only if they are regular; and texts that files can hold."""

from __future__ import annotations

import errno
import os
import stat
from typing import BinaryIO

_WITHOUT_WAITING = getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


def open_regular(path: str | os.PathLike[str]) -> BinaryIO:
    """Return a regular file, opened for reading; a link is followed.

    Anything else is refused: opening a pipe would wait for whoever writes to it, and a device never ends.

    Raises:
        OSError: it cannot be read, or is no regular file.
    """
    descriptor = os.open(path, os.O_RDONLY | _WITHOUT_WAITING)
    stream = os.fdopen(descriptor, "rb") if stat.S_ISREG(os.fstat(descriptor).st_mode) else None
    if stream is None:
        os.close(descriptor)
        raise OSError(errno.EINVAL, "it is not a regular file", os.fspath(path))
    return stream


def is_utf8(text: str) -> bool:
    """Return whether UTF-8 can hold a text.

    It cannot if the text was made from bytes that are none, such as an argument or a file name in Latin-1.
    """
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def as_utf8(text: str) -> str:
    r"""Return a text such that UTF-8 can hold it: of bytes that are none, `\\xe9` is left."""
    return text.encode(errors="surrogateescape").decode(errors="backslashreplace")
