"""A child process gives a function's result or error, or says which limit it exceeded."""

from __future__ import annotations

import errno
import multiprocessing
import os
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from runner.errors import RecordingError
from runner.util.processes import ChildProcess, OutOfMemory, ProcessDied, TimedOut, report_progress

MEMORY = 256 << 20


def refuse(path):
    raise RecordingError(f"{path} is damaged.")


def count(number):
    for k in range(number):
        report_progress(k)
    return number


@pytest.fixture
def child():
    with ChildProcess(MEMORY) as made:
        yield made


def test_a_process_returns_what_functions_return_and_raises_what_they_raise(child):
    assert child.call(sorted, 60, [2, 1], reverse=True) == [2, 1]
    with pytest.raises(RecordingError, match="x is damaged"):
        child.call(refuse, 60, "x")
    with pytest.raises(RuntimeError, match="TypeError"):
        child.call(len, 60, 1)


@pytest.mark.parametrize(
    ("function", "argument", "error"),
    [(bytearray, 2 * MEMORY, OutOfMemory), (os._exit, 3, ProcessDied), (time.sleep, 600, TimedOut)],
)
def test_a_call_that_exceeds_a_limit_or_ends_the_process_is_an_error_of_its_own(
    child, function, argument, error
):
    with pytest.raises(error):
        child.call(function, 5, argument)


def hold_open(path):
    error = OSError(f"{path} cannot be read")
    error.file = open(path)  # noqa: PTH123, SIM115
    raise error


def fill_when_pickled():
    return Unwieldy()


class Unwieldy:
    """Needs more memory than there is when it is pickled."""

    def __reduce__(self):
        return bytearray, (bytearray(2 * MEMORY),)


@pytest.mark.parametrize(
    ("function", "args", "error", "message"),
    [
        (open, [os.devnull], RuntimeError, "cannot pickle"),
        (hold_open, [os.devnull], RuntimeError, "cannot be read"),
        (fill_when_pickled, [], OutOfMemory, "more than 268 MB"),
    ],
)
def test_a_result_that_cannot_be_sent_is_an_error_of_its_call_alone(
    child, capfd, function, args, error, message
):
    with pytest.raises(error, match=message):
        child.call(function, 60, *args)
    assert child.call(sum, 60, [1, 2]) == 3
    assert capfd.readouterr().err == ""


def test_progress_reaches_the_caller():
    seen = []
    with ChildProcess(MEMORY, on_progress=seen.append) as child:
        assert child.call(count, 60, 3) == 3
    assert seen == [0, 1, 2]


def test_a_script_need_not_guard_its_statements(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "from runner.util.processes import ChildProcess\n"
        "with ChildProcess(1 << 28) as child:\n"
        "    print(child.call(sum, 60, [1, 2]))\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=120, check=False)
    assert (done.stdout, done.stderr) == ("3\n", "")


@pytest.mark.skipif(sys.platform == "win32", reason="there is no fork server on Windows")
def test_a_fork_server_that_is_killed_while_a_process_starts_is_replaced():
    program = (
        "import os, signal, threading\n"
        "from multiprocessing import forkserver\n"
        "from runner.util.processes import process_context, start_process\n"
        "if __name__ == '__main__':\n"
        "    start_process(process_context(), print, 'first').join()\n"
        "    server = forkserver._forkserver._forkserver_pid\n"
        "    os.kill(server, signal.SIGSTOP)  # so that the next process waits for it\n"
        "    threading.Timer(0.5, os.kill, (server, signal.SIGKILL)).start()\n"
        "    start_process(process_context(), print, 'second').join()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.stdout, done.stderr) == ("first\nsecond\n", "")


@pytest.mark.skipif(sys.platform == "win32", reason="there is no fork server on Windows")
def test_ctrl_c_does_not_stop_a_fork_server_that_is_importing(tmp_path):
    (tmp_path / "slow.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n")
    script = tmp_path / "script.py"
    script.write_text(
        "from runner.util.processes import process_context, start_process\n"
        "if __name__ == '__main__':\n"
        "    start_process(process_context(['slow']), print, 'started').join()\n"
    )
    done = subprocess.run(
        [sys.executable, script],
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (done.stdout, done.stderr) == ("started\n", "")


def test_a_process_that_cannot_be_started_is_an_error_of_the_system():
    def start():
        raise EOFError

    context = SimpleNamespace(Pipe=multiprocessing.Pipe, Process=lambda **_: SimpleNamespace(start=start))
    with pytest.raises(OSError, match=os.strerror(errno.EMFILE)):
        ChildProcess(MEMORY, context)
