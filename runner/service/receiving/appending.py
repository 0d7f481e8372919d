"""Writing what comes to an upload, and what its client is told of the disk."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator

from runner.errors import StorageError
from runner.service.receiving.model import TooLarge


@contextlib.contextmanager
def on_disk() -> Iterator[None]:
    """Tell a client of an error of the disk without saying where on it.

    Raises:
        StorageError: there was one.
    """
    try:
        yield
    except OSError as error:
        raise StorageError(f"the server's disk cannot be written ({error.strerror}).") from error


class Appending:
    """Takes the bytes of one request.

    Args:
        descriptor: of the file that they are appended to.
        most: how many there may be.
        check: raises if the disk has no room for so many.
    """

    def __init__(self, descriptor: int, most: int, check: Callable[[int], None]) -> None:
        self._descriptor = descriptor
        self._left = most
        self._check = check
        self.written = 0
        """Bytes that were taken."""

    def write(self, data: bytes | bytearray) -> None:
        """Append bytes.

        Raises:
            TooLarge: they are more than were said to come; nothing of these is kept.
            StorageError: the disk is full, but for what is left free, or failing; what was written is kept.
        """
        if len(data) > self._left:
            raise TooLarge("found more bytes than the upload is said to have.")
        self._check(len(data))
        self._left -= len(data)
        self.written += len(data)
        view = memoryview(data)
        with on_disk():
            while view:
                view = view[os.write(self._descriptor, view) :]
