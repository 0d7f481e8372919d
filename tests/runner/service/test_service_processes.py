"""Work in child processes: limits on time and memory, on every platform's event loop."""

from __future__ import annotations

import asyncio
import os
import threading
import time

import pytest

from runner.errors import RecordingError
from runner.service.errors import Busy
from runner.service.processes import ProcessPool
from runner.util.processes import OutOfMemory, ProcessDied, TimedOut

MEMORY = 256 << 20


class WithoutReaders(asyncio.SelectorEventLoop):
    """An event loop that cannot wait for a pipe, as that of Windows."""

    def add_reader(self, *_):
        raise NotImplementedError


def refuse(path):
    raise RecordingError(f"{path} is damaged.")


@pytest.fixture
def pool():
    with ProcessPool(2, 30, MEMORY) as made:
        yield made


def test_results_and_errors_are_those_of_the_function_on_any_event_loop(pool):
    async def calls():
        assert await pool(os.path.join, "a", "b") == os.path.join("a", "b")  # noqa: PTH118
        with pytest.raises(RecordingError, match="x is damaged"):
            await pool(refuse, "x")

    with asyncio.Runner(loop_factory=WithoutReaders) as loop:
        loop.run(calls())


def test_a_call_that_exceeds_a_limit_or_dies_fails(pool):
    with pytest.raises(OutOfMemory, match=r"more than 268 MB"):
        pool.submit(60, bytearray, 2 * MEMORY).result()
    with pytest.raises(ProcessDied):
        pool.submit(60, os._exit, 3).result()
    with ProcessPool(1, 60, MEMORY) as hasty, pytest.raises(TimedOut, match=r"longer than 0\.5 s"):
        hasty.submit(0.5, time.sleep, 600).result()


def test_closing_ends_running_calls():
    pool = ProcessPool(1, 600, MEMORY)
    calls = [pool.submit(60, time.sleep, 600) for _ in range(3)]
    pool.close()
    assert all(isinstance(call.exception(), Busy) for call in calls)


def test_a_process_can_be_reused():
    with ProcessPool(1, 30, MEMORY, keep_seconds=60) as pool:
        assert pool.submit(60, os.getpid).result() == pool.submit(60, os.getpid).result()


def test_calls_of_a_reused_process_leak_no_threads():
    with ProcessPool(1, 30, MEMORY, keep_seconds=60) as pool:
        pool.submit(60, os.getpid).result()
        before = threading.active_count()
        for _ in range(20):
            pool.submit(60, os.getpid).result()
        assert threading.active_count() <= before + 2  # a cancelled timer may still be ending
