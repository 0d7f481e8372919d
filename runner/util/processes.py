"""A child process that calls functions within limits on time and memory.

    with ChildProcess(memory_bytes=10**9) as child:
        result = child.call(function, argument, seconds=60)

For work that is long, needs much memory, or runs code that cannot be trusted to end. The thread that calls
waits for it; any other may end the process meanwhile by `kill`. The function may report its progress.
"""

from __future__ import annotations

import contextlib
import errno
import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
import types
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from multiprocessing import process, resource_tracker
from multiprocessing.process import BaseProcess
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any, Final, ParamSpec, Self, TypeVar

from runner.errors import RunnerError
from runner.util.files import is_installed
from runner.util.humanize import size

_RESERVE_BYTES: Final = 64 << 20
"""Memory counts as used up if no block of this size is left."""
_RESTARTS: Final = 3
"""How often a fork server that was killed is replaced as a process starts."""
_RESTART_SECONDS: Final = 0.1
"""Time in which the system learns that a fork server was killed."""
OWN_ONLY: Final = "DUALTAXI_OWN_ONLY"
"""Environment variable: if not empty, a process and its children make only what their user recorded."""
_SAFE_PATH: Final = "PYTHONSAFEPATH"
_HASH_SEED: Final = "PYTHONHASHSEED"
Report = Callable[[int], None]
"""Takes the amount done so far, such as a number of steps."""
Tell = Callable[[str], None]
"""Takes a line of text for the user, or the name of the next stage."""
Stop = Callable[[], bool]
"""Returns whether to stop."""
Args = ParamSpec("Args")
Result = TypeVar("Result")


class CallFailed(RunnerError):
    """A call in a child process did not end by itself."""


class TimedOut(CallFailed):
    """A call exceeded its time limit."""


class OutOfMemory(CallFailed):
    """A call exceeded its memory limit."""


class ProcessDied(CallFailed):
    """The process died during a call."""


class NeverBegun(ProcessDied):
    """The process ended before it began a call, which another process can do."""


_pipe_to_parent: Any = None
_must_end = False
_starting: Final = threading.Lock()


def report_progress(value: object) -> None:
    """Pass a value to the caller's `on_progress`; for functions that are called in a child process."""
    _pipe_to_parent.send(("progress", value))


def end_after_call() -> None:
    """End this child process after its call, which leaves traces that the next call must not meet."""
    global _must_end  # noqa: PLW0603 - of the whole process
    _must_end = True


@contextlib.contextmanager
def importing_from(folders: Sequence[str], is_for_good: bool = False) -> Iterator[None]:
    """Find modules in further folders too, after all others, while the block runs or from then on."""
    added = [folder for folder in folders if folder not in sys.path]
    sys.path.extend(added)
    try:
        yield
    finally:
        if not is_for_good:
            sys.path[:] = [folder for folder in sys.path if folder not in added]


@contextlib.contextmanager
def starting_processes(with_main: bool = True, hash_seed: int | None = None) -> Iterator[None]:
    """Start interpreters in the block that import nothing from the current folder.

    Python lets `python -c` and `python -m` look there first, and `multiprocessing` starts its processes by
    the one and hands them this process's `sys.path`, with the folder that the other put there.

    Args:
        with_main: whether the script of this process is imported in them, as `multiprocessing` does, for what
            it registers; never if it does not guard its statements, which would run once more there.
        hash_seed: their hash seed, if it is not to be that of this process.

    Raises:
        OSError: the system cannot start another process.
    """
    with _starting:
        variables = {_SAFE_PATH: "1"} | ({} if hash_seed is None else {_HASH_SEED: str(hash_seed)})
        main = sys.modules["__main__"]
        path = sys.path
        before = {name: os.environ.get(name) for name in variables}
        os.environ.update(variables)
        sys.path = _without_current_folder(path)
        if not with_main or not _is_guarded(main):
            sys.modules["__main__"] = types.ModuleType("__main__")
        try:
            with _interrupts_blocked():
                yield
        except EOFError as error:  # the fork server could not open what it needs
            raise OSError(errno.EMFILE, os.strerror(errno.EMFILE)) from error
        finally:
            sys.modules["__main__"], sys.path = main, path
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value


@contextlib.contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Start processes in the block that Ctrl-C, which reaches every process of a terminal, does not stop.

    A fork server imports modules for a second before it ignores the signal itself.
    """
    if sys.platform == "win32":
        yield
        return
    resource_tracker.ensure_running()  # or its start, which the first process causes, unblocks the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _is_guarded(main: types.ModuleType) -> bool:
    """Return whether a script says `if __name__ == "__main__":`, or there is none, as in a notebook."""
    file = getattr(main, "__file__", None)
    with contextlib.suppress(OSError):
        return file is None or b"__main__" in Path(file).read_bytes()
    return True


def _without_current_folder(path: list[str]) -> list[str]:
    """Return the entries of `sys.path` but that of `python -m`, `-c` or a prompt: the current folder."""
    is_module = getattr(sys.modules["__main__"], "__spec__", None) is not None and not sys.flags.safe_path
    current: str = process.ORIGINAL_DIR  # type: ignore[attr-defined]
    is_added = is_module and path[:1] == [current] and current != str(Path(__file__).parents[2])
    return [entry for entry in path[is_added:] if Path(entry).is_absolute()]


def process_context(preload: Sequence[str] = ()) -> Any:
    """Return the multiprocessing context that starts processes, from a fork server where there is one.

    Args:
        preload: modules that the fork server imports once, for all processes.
    """
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    if preload:  # or it would forget those of others, if it does not run yet
        # The entry point of the command line lets Python search for garbage less often.
        context.set_forkserver_preload(["runner.__main__", *preload])
    return context


def start_process(context: Any, target: Callable[..., None], *args: object, **keywords: Any) -> BaseProcess:
    """Start and return a process with the variables of this one, also where a fork server starts it.

    Args:
        keywords: of `multiprocessing.Process`.
    """
    with _starting:  # not while another thread has changed them to start a process
        variables = dict(os.environ)
    started: BaseProcess = context.Process(
        target=_with_variables, args=(variables, target, *args), **keywords
    )
    with starting_processes():
        for _ in range(_RESTARTS):
            try:
                started.start()
                return started
            except (EOFError, ConnectionError):  # the fork server was killed; the next start makes another
                time.sleep(_RESTART_SECONDS)
        started.start()
        return started


def _with_variables(variables: Mapping[str, str], target: Callable[..., None], *args: object) -> None:
    os.environ.clear()
    os.environ.update(variables)
    target(*args)


class ChildProcess:
    """A process that calls functions, one after the other.

    Args:
        memory_bytes: how much its calls may allocate; not limited on Windows.
        on_progress: called with what functions pass to `report_progress`.
        hash_seed: makes it a fresh interpreter with this hash seed.
        keep_seconds: how long it waits for its next call before it ends. It ends at once after a call that
            imported modules of the user, whose files may change, or called `end_after_call`. By default it
            serves all calls, and waits without end.

    Raises:
        OSError: the system cannot start another process.
    """

    def __init__(
        self,
        memory_bytes: int,
        context: Any = None,
        on_progress: Callable[[Any], None] = lambda _: None,
        hash_seed: int | None = None,
        keep_seconds: float | None = None,
    ) -> None:
        self._memory_bytes = memory_bytes
        self._on_progress = on_progress
        if hash_seed is not None:
            context = multiprocessing.get_context("spawn")
        context = context or process_context()
        self._pipe, theirs = context.Pipe()
        arguments = (theirs, memory_bytes, _own_variables(), keep_seconds)
        self._process = context.Process(target=_serve, args=arguments, daemon=True)
        try:
            with starting_processes(with_main=False, hash_seed=hash_seed):
                self._process.start()
        except BaseException:
            self._pipe.close()
            raise
        finally:
            theirs.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def call(
        self, function: Callable[Args, Result], seconds: float, *args: Args.args, **keywords: Args.kwargs
    ) -> Result:
        """Return what a function returns in the process.

        Args:
            function: of a module, not nested.
            seconds: the time limit; the process is of no use after it.
            args: of the function; they and the result are pickled.

        Raises:
            TimedOut, OutOfMemory, ProcessDied: the call did not end by itself.
            RuntimeError: the function raised anything else, whose traceback is in the message.
        """
        events = self._events(function, seconds, args, keywords)
        while True:
            try:
                self._on_progress(next(events))
            except StopIteration as end:
                return end.value  # type: ignore[no-any-return]

    def stream(
        self, function: Callable[Args, object], seconds: float, *args: Args.args, **keywords: Args.kwargs
    ) -> Iterator[object]:
        """Yield what a function in the process passes to `report_progress`, as it comes.

        The function waits where its caller is slower. Arguments and errors are those of `call`, but `seconds`
        is the limit for each value.
        """
        yield from self._events(function, seconds, args, keywords, for_each=True)

    def _events(
        self,
        function: Callable[..., object],
        seconds: float,
        args: object,
        keywords: object,
        for_each: bool = False,
    ) -> Generator[object, None, object]:
        """Yield what the function reports, and return its result; the limit is for all, or for each."""
        failure: type[ProcessDied] = NeverBegun
        try:
            self._pipe.send((function, args, keywords))
            deadline = time.monotonic() + seconds
            while True:
                if not self._pipe.poll(max(deadline - time.monotonic(), 0)):
                    raise TimedOut(f"this took longer than {seconds:g} s and was given up; ask for less.")
                kind, result = self._pipe.recv()
                if kind == "begun":
                    failure = ProcessDied
                    continue
                if kind != "progress":
                    break
                yield result
                if for_each:
                    deadline = time.monotonic() + seconds
        except (EOFError, OSError):
            raise failure("the process that worked on this died; it may have run out of memory.") from None
        if kind == "memory":
            limit = size(self._memory_bytes)
            raise OutOfMemory(f"this needs more than {limit} of memory, and was given up; ask for less.")
        if kind == "error":
            cls, arguments, attributes = result
            error = cls.__new__(cls, *arguments)  # its constructor may take other arguments
            vars(error).update(attributes)
            raise error
        if kind == "unexpected":
            raise RuntimeError(result)
        return result

    def is_alive(self) -> bool:
        """Return whether the process is running."""
        return bool(self._process.is_alive())

    def stop(self) -> None:
        """Have the process end as by `sys.exit`, while another thread may be waiting for it."""
        with contextlib.suppress(ValueError):  # closed meanwhile
            if self._process.is_alive():  # else another one may have its number
                self._process.terminate()

    def kill(self) -> None:
        """Kill the process, while another thread may be waiting for it."""
        with contextlib.suppress(ValueError):
            if self._process.is_alive():
                self._process.kill()

    def end(self) -> None:
        """Kill the process and release its resources."""
        self.kill()
        with contextlib.suppress(ValueError):
            self._process.join()
            self._process.close()
        self._pipe.close()


def _own_variables() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name.startswith("DUALTAXI_")}


def _serve(pipe: Any, memory_bytes: int, variables: Mapping[str, str], keep_seconds: float | None) -> None:
    """Call functions that come through a pipe, and send what they return, until it is closed."""
    for name in _own_variables():  # as they were when the fork server began
        del os.environ[name]
    os.environ.update(variables)
    global _pipe_to_parent  # noqa: PLW0603 - one pipe for the whole process
    _pipe_to_parent = pipe
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent to act on
    # Temporary files are removed. A call in compiled code ends first: who stops it kills it after a while.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    _limit_memory(memory_bytes)
    path = list(sys.path)
    before = set(sys.modules)
    with contextlib.suppress(EOFError, BrokenPipeError):
        while pipe.poll(keep_seconds):
            pipe.send(("begun", None))
            function, args, keywords = pipe.recv()
            pipe.send_bytes(_outcome(function, args, keywords))
            if keep_seconds is not None and (
                _must_end or sys.path != path or _any_of_user(sys.modules.keys() - before)
            ):
                break
    pipe.close()  # the process may live on, if a module of the user has started a thread


def _any_of_user(modules: Iterable[str]) -> bool:
    """Return whether any of these modules belongs to the user: neither to this project nor installed."""
    files = [
        getattr(sys.modules[name], "__file__", None)
        for name in modules
        if name.partition(".")[0] not in ("runner", "dualtaxi")
    ]
    return not all(is_installed(file) for file in files if file)


def _outcome(
    function: Callable[..., Any], args: Sequence[object], keywords: Mapping[str, object]
) -> memoryview:
    """Return what a function returns or raises, pickled."""
    try:
        return ForkingPickler.dumps(("done", function(*args, **keywords)))
    except Exception as error:
        cause: BaseException | None = error
        while cause is not None:  # others may have wrapped a `MemoryError`
            if isinstance(cause, MemoryError):
                return ForkingPickler.dumps(("memory", None))
            cause = cause.__cause__ or cause.__context__
        if isinstance(error, RunnerError | OSError):
            with contextlib.suppress(Exception):  # an error of a library may hold what cannot be pickled
                return ForkingPickler.dumps(("error", (type(error), error.args, vars(error))))
        return ForkingPickler.dumps(("unexpected", traceback.format_exc()))


def raise_if_out_of_memory() -> None:
    """Raise MemoryError if the memory of this process is used up; libraries report that in their own ways.

    Called after an error of foreign code, to learn its cause: SDL raises `pygame.error`, for example.
    """
    bytes(_RESERVE_BYTES)


def _limit_memory(more_bytes: int) -> None:
    """Limit what this process may allocate from now on."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        limit = more_bytes
        with contextlib.suppress(OSError):  # stacks and buffers of libraries count already, by the core
            lines = Path("/proc/self/status").read_text().splitlines()
            limit += sum(int(line.split()[1]) << 10 for line in lines if line.startswith("VmData:"))
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
