"""`dualtaxi` whose event loop is watched: `python -m benchmarks.watched serve ...`.

At its end it writes the ticks of a 10 ms ticker and the longer callbacks of the loop to the file in $WATCHED.
Times are in seconds, by `time.monotonic`; those for which the thread waited for a processor are given apart.
"""

from __future__ import annotations

import asyncio
import json
import os
import threading
import time
from pathlib import Path
from typing import Final

import uvicorn

from runner.__main__ import main

VARIABLE: Final = "WATCHED"
TICK_SECONDS: Final = 0.01
LONG_SECONDS: Final = 0.005
ticks: list[tuple[float, float, float]] = []
"""When each tick was due, how late it was, and what of this was waiting for a processor."""
callbacks: list[tuple[float, float, float]] = []
"""The start and the duration of each callback of more than `LONG_SECONDS`, and the same."""


class Thread:
    """The thread of the event loop, as Linux accounts for it."""

    def __init__(self) -> None:
        path = f"/proc/self/task/{threading.get_native_id()}/schedstat"
        self._file = os.open(path, os.O_RDONLY) if Path(path).exists() else None

    def waited(self) -> float:
        """Return how long it has waited for a processor in all, in seconds; 0 if that is not known."""
        return int(os.pread(self._file, 100, 0).split()[1]) / 1e9 if self._file is not None else 0.0


def watch() -> None:
    """Measure every callback of event loops, and start a ticker with the server."""
    run, startup, thread = asyncio.Handle._run, uvicorn.Server.startup, Thread()  # type: ignore[attr-defined]

    def measured(handle: asyncio.Handle) -> None:
        began, waited = time.monotonic(), thread.waited()
        run(handle)
        if (taken := time.monotonic() - began) > LONG_SECONDS:
            callbacks.append((began, taken, thread.waited() - waited))

    async def started(server: uvicorn.Server, sockets: object) -> None:
        await startup(server, sockets)  # type: ignore[arg-type]
        server.ticker = asyncio.create_task(tick(thread))  # type: ignore[attr-defined]

    asyncio.Handle._run = measured  # type: ignore[attr-defined]
    uvicorn.Server.startup = started  # type: ignore[method-assign, assignment]


async def tick(thread: Thread) -> None:
    """Note how late each tick is."""
    while True:
        due, waited = time.monotonic() + TICK_SECONDS, thread.waited()
        await asyncio.sleep(TICK_SECONDS)
        ticks.append((due, time.monotonic() - due, thread.waited() - waited))


if __name__ == "__main__":
    watch()
    try:
        main()
    finally:
        Path(os.environ[VARIABLE]).write_text(json.dumps({"ticks": ticks, "callbacks": callbacks}))
