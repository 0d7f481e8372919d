"""Work in child processes: limits on time and memory, on every platform's event loop."""

from __future__ import annotations

import asyncio
import os
import pkgutil
import sys
import tempfile
import threading
import time
from pathlib import Path

import psutil
import pytest
from starlette.requests import ClientDisconnect

from runner.errors import RecordingError
from runner.service.dependencies import Computation
from runner.service.errors import Busy
from runner.service.processes import ProcessPool
from runner.service.response_cache import ResponseCache
from runner.util.processes import OutOfMemory, ProcessDied, TimedOut
from tests.waiting import until

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


def is_loaded(module):
    return module in sys.modules


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux")
def test_a_process_has_what_kernels_need_from_its_start(pool):
    assert pool.submit(30, is_loaded, "numba.np.arraymath").result()
    assert not pool.submit(30, is_loaded, "scipy.linalg").result()


def test_a_process_can_be_reused_until_it_was_idle_for_long():
    with ProcessPool(1, 30, MEMORY) as pool:
        assert pool.submit(60, os.getpid).result() == pool.submit(60, os.getpid).result()
    with ProcessPool(1, 30, MEMORY, keep_seconds=0.01) as pool:
        first = pool.submit(60, os.getpid).result()
        until(bool, lambda: not psutil.pid_exists(first))
        assert pool.submit(60, os.getpid).result() != first


def test_a_process_that_imported_a_module_of_the_user_reads_it_anew(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    with ProcessPool(1, 30, MEMORY) as pool:
        for size in (10, 9):  # a file of another length, so Python does not take the old one from its cache
            (tmp_path / "theirs.py").write_text("ones = " + "1" * size)
            assert pool.submit(60, pkgutil.resolve_name, "theirs:ones").result() == int("1" * size)


def test_a_process_that_must_end_does_so_although_a_thread_of_the_user_runs_on(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    source = "import threading, time; threading.Thread(target=time.sleep, args=(600,)).start(); ok = True"
    (tmp_path / "threaded.py").write_text(source)
    with ProcessPool(1, 30, MEMORY) as pool:
        assert pool.submit(60, pkgutil.resolve_name, "threaded:ok").result()
        assert pool.submit(5, os.getpid).result()


@pytest.mark.parametrize("name", ["runner.replay.makers:silence", "runner.util.processes:end_after_call"])
def test_a_call_that_leaves_traces_is_the_last_of_its_process(name):
    with ProcessPool(1, 30, MEMORY) as pool:
        before = pool.submit(60, os.getpid).result()
        pool.submit(60, pkgutil.resolve_name(name)).result()
        assert pool.submit(60, os.getpid).result() != before


def test_a_late_cancel_stops_nobody_elses_call(tmp_path):
    async def calls(pool):
        for _ in range(20):
            hasty = asyncio.create_task(pool(os.getpid))
            await asyncio.sleep(0.001)
            patient = asyncio.create_task(pool(append_and_wait, str(tmp_path / "begun")))
            await asyncio.sleep(0)
            hasty.cancel()
            await patient

    with ProcessPool(1, 30, MEMORY) as pool:
        asyncio.run(calls(pool))
    assert (tmp_path / "begun").read_text() == "x" * 20


def test_a_call_for_which_a_reused_process_has_no_memory_left_gets_a_new_one():
    with ProcessPool(1, 30, MEMORY) as pool:
        pool.submit(60, exec, f"import sys; sys.kept = bytearray({MEMORY // 4 * 3})").result()
        pool.submit(60, exec, f"bytearray({MEMORY // 2})").result()


def note_and_die(path):
    with open(path, "a", encoding="utf-8") as file:  # noqa: PTH123
        file.write("x")
    os._exit(3)


def test_a_call_that_kills_a_reused_process_is_not_tried_once_more(tmp_path):
    with ProcessPool(1, 30, MEMORY) as pool:
        pool.submit(60, os.getpid).result()
        with pytest.raises(ProcessDied):
            pool.submit(60, note_and_die, tmp_path / "begun").result()
        assert (tmp_path / "begun").read_text() == "x"
        assert pool.submit(60, sum, [1, 2]).result() == 3


def test_calls_of_a_reused_process_leak_no_threads():
    with ProcessPool(1, 30, MEMORY) as pool:
        pool.submit(60, os.getpid).result()
        before = threading.active_count()
        for _ in range(20):
            pool.submit(60, os.getpid).result()
        assert threading.active_count() <= before


def append_and_wait(path):
    with open(path, "a", encoding="utf-8") as file:  # noqa: PTH123
        file.write("x")
    time.sleep(0.02)


def fill_a_folder(noted):
    with tempfile.TemporaryDirectory() as folder:
        Path(noted).write_text(folder)
        time.sleep(600)


def test_a_film_of_clients_that_have_gone_ends_and_leaves_no_files(pool, tmp_path):
    noted = tmp_path / "noted"

    class Client:
        async def is_disconnected(self):
            return noted.exists()

    async def abandon():
        cache = ResponseCache(1000)
        clients = [Computation(cache, pool, pool, Client()) for _ in range(2)]
        calls = [compute(fill_a_folder, str(noted), alone=True) for compute in clients]
        left = await asyncio.gather(*calls, return_exceptions=True)
        assert all(isinstance(error, ClientDisconnect) for error in left)
        folder = Path(noted.read_text())
        while folder.exists():
            await asyncio.sleep(0.05)
        assert await clients[0](bytes, 3, alone=True) == b"\0\0\0"  # nothing waits for it

    asyncio.run(asyncio.wait_for(abandon(), 60))


def test_a_response_is_made_until_nobody_waits_for_it():
    cache, ended = ResponseCache(1000), []

    async def make():
        try:
            await asyncio.sleep(600)
        finally:
            ended.append(True)

    async def abandon():
        first, second = (asyncio.ensure_future(cache.get_or_await("key", make)) for _ in range(2))
        await asyncio.sleep(0)
        first.cancel()
        await asyncio.sleep(0.05)
        assert not ended
        second.cancel()
        await asyncio.sleep(0.05)
        assert ended

        async def quickly():
            return b"made"

        assert await cache.get_or_await("key", quickly) == b"made"

    asyncio.run(abandon())


def test_a_response_that_is_larger_than_the_cache_drops_no_others():
    cache = ResponseCache(10)
    cache.keep("small", b"1234")
    cache.keep("large", b"12345678901")
    assert (cache.get("small"), cache.get("large")) == (b"1234", None)
    cache.keep("other", b"1234567")
    assert (cache.get("small"), cache.get("other")) == (None, b"1234567")
