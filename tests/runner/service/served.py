"""A service in a process of its own, which tests stop, kill and start again."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import random
import signal
import socket
import sys
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Self

import httpx2
import psutil
from selenium.common.exceptions import (
    NoSuchElementException,
    StaleElementReferenceException,
    WebDriverException,
)
from selenium.webdriver.remote.webdriver import WebDriver
from selenium.webdriver.support.ui import WebDriverWait

from runner.__main__ import main
from runner.util.processes import process_context, start_process
from tests.waiting import until


def free_port() -> int:
    """Return a port at which nothing listens; none of those that Linux gives to clients, as it may now."""
    while True:
        port = random.randrange(10_000, 32_768)
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", port)):
            return port


def wait(browser: WebDriver, is_so: Callable[[], Any], seconds: float = 60) -> Any:
    """Wait until a page is so, and return what was found; parts of it may be replaced meanwhile."""

    def ask(_: WebDriver) -> Any:
        try:
            return is_so()
        except WebDriverException as error:
            if "does not belong to the document" in str(error):  # another way in which drivers say stale
                return None
            raise

    ignored = [NoSuchElementException, StaleElementReferenceException]
    return WebDriverWait(browser, seconds, 0.05, ignored).until(ask)


def serve(words: list[str], log: Path, output: Connection, max_files: int | None) -> None:
    """Be the command of these words in this process."""
    with log.open("ab") as errors:
        os.dup2(errors.fileno(), 2)
    os.dup2(output.fileno(), 1)
    output.close()
    sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w", buffering=1)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # blocked while processes are started
    if max_files is not None:
        import resource

        resource.setrlimit(resource.RLIMIT_NOFILE, (max_files, max_files))
    sys.argv = ["dualtaxi", *words]
    main()


class Served:
    """`dualtaxi serve` over a folder, always at the same port and with one log; a `with` starts and stops it.

    Before it is started, nothing listens at its address.

    Args:
        options: words after the command.
        context: of `multiprocessing`. By default the process is forked with all that the tests import, which
            takes half the time; that of "spawn" makes it a fresh interpreter.
    """

    def __init__(self, recordings: Path, *options: str, context: Any = None) -> None:
        self.recordings, self.options = recordings, options
        self.log = recordings.with_name(f"{recordings.name}.log")
        self.port = free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self.origin = {"Origin": self.url}
        self.max_files: int | None = None
        """How many files it may have open at once; None for as many as the tests."""
        self.process: BaseProcess | None = None
        self._context = context or process_context()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        """Start it, and wait until it responds."""
        words = ["serve", "--port", str(self.port), "--recordings", str(self.recordings), *self.options]
        output, theirs = multiprocessing.Pipe(duplex=False)
        with output:
            with theirs:
                self.process = start_process(self._context, serve, words, self.log, theirs, self.max_files)
            self.client = httpx2.Client(base_url=f"{self.url}/api/v1", headers=self.origin, timeout=60)
            with open(output.fileno(), closefd=False) as lines:
                first = lines.readline()
        if first != f"{self.url}/\n":
            self.stop()
            raise AssertionError(self.log.read_text())
        httpx2.get(f"{self.url}/healthz", timeout=60)  # answered when it has the folder

    def stop(self) -> int | None:
        """Stop it, if it runs; return its exit code."""
        if self.process is None:
            return None
        self.process.terminate()
        return self._ended()

    def kill(self, with_workers: bool = False) -> list[psutil.Process]:
        """Kill it, and its workers if `with_workers`; return its workers."""
        workers = self.workers()
        self.process.kill()
        for worker in workers if with_workers else ():
            with contextlib.suppress(psutil.NoSuchProcess):
                worker.kill()
        self._ended()
        return workers

    def _ended(self) -> int | None:
        process, self.process = self.process, None
        self.client.close()
        process.join(60)
        process.kill()  # which does nothing to one that has ended
        return process.exitcode

    def workers(self) -> list[psutil.Process]:
        """Return its child processes, and theirs."""
        return psutil.Process(self.process.pid).children(recursive=True)

    def get(self, path: str) -> Any:
        """Return the JSON at a path of the API."""
        return self.client.get(path).raise_for_status().json()

    def post(self, path: str, text: str = "") -> Any:
        """Post a text to a path of the API; return the JSON of the response."""
        return self.client.post(path, content=text.encode()).raise_for_status().json()

    def until(self, condition: Any, seconds: float = 90) -> dict[int, dict[str, Any]]:
        """Wait until the jobs, by number, satisfy a condition; return them."""
        return until(condition, lambda: {job["number"]: job for job in self.get("/jobs")["jobs"]}, seconds)
