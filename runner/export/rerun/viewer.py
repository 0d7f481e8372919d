"""The Rerun viewer on loopback, in a window, a browser or without a screen, and the exports it shows."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import os
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from runner.errors import RunnerError
from runner.export.rerun.selection import Request, Selection, select
from runner.recording.reader import open_recording
from runner.runs.run import Run
from runner.util import __version__, files
from runner.util.extras import missing
from runner.util.files import CACHE_VARIABLE, CACHED_EXPORTS, RUN_SEPARATOR, new_file, storage_errors

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient

LOOPBACK: Final = "127.0.0.1"
START_SECONDS: Final = 20.0
DRAW_SECONDS: Final = 4.0
"""A viewer without a screen has drawn everything this long after the step was set."""
NOTICE_SECONDS: Final = 2.5
"""After this time, the viewer's notice in a corner has disappeared."""
MESA_PACKAGES: Final = (
    "mesa-vulkan-drivers libgl1-mesa-dri libegl1 libxkbcommon-x11-0 libxcursor1 libxi6 libxrandr2 libx11-xcb1"
)

MAX_CACHED: Final = 20
"""Exports in the cache; those that were not used for longest are removed."""


class ViewerError(RunnerError):
    """The viewer cannot be started, or does not answer."""

    exit_code = 1


def require_rerun(purpose: str) -> None:
    """Check that Rerun is installed."""
    if importlib.util.find_spec("rerun") is None:
        raise missing("rerun", "all", purpose)


def viewer_program() -> Path:
    """Return the viewer's executable, which comes with the package.

    Raises:
        ViewerError: it is missing.
    """
    import rerun_cli  # type: ignore[import-untyped,unused-ignore]

    folder = Path(rerun_cli.__file__).parent
    for name in ("rerun", "rerun.exe"):
        if (folder / name).is_file():
            return folder / name
    raise ViewerError(f"found no Rerun viewer in {folder}; install rerun-sdk again.")


def free_port(port: int = 0) -> int:
    """Return the port if it is free, or any free port for 0.

    Raises:
        ViewerError: something listens on it.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError as error:
            raise ViewerError(
                f"port {port} cannot be used ({error.strerror}); choose another by --port, or leave it out."
            ) from error
        return int(probe.getsockname()[1])


@dataclass
class RerunViewer:
    """A viewer that listens on a port of loopback, and writes to a log."""

    process: subprocess.Popen[bytes]
    log: Path
    url: str

    def wait_for(self, port: int) -> None:
        """Wait until it listens on a port."""
        deadline = time.monotonic() + START_SECONDS
        while time.monotonic() < deadline and self.process.poll() is None:
            with contextlib.suppress(OSError), socket.create_connection((LOOPBACK, port), timeout=1):
                return
            time.sleep(0.05)
        raise self.error("does not start")

    def show(self, path: Path, step: int) -> ViewerClient:
        """Open a file at a step, and return a client of the viewer."""
        from rerun.experimental import ViewerClient

        try:
            client = ViewerClient.connect(self.url)
            client.open(path.resolve().as_uri())
            client.set_time("step", sequence=step, play_state="paused")
        except Exception as error:  # the transport raises various exceptions
            has_ended = self.process.poll() is not None
            raise self.error("ended" if has_ended else "does not answer") from error
        return client

    def error(self, what: str) -> ViewerError:
        """Return an error of the viewer, with the reason as far as its output shows it."""
        text = self.log.read_text(errors="replace")
        if any(word in text for word in ("graphics adapter", "libEGL", "Vulkan", "libxkbcommon")):
            reason = f": it finds no graphics. On Debian: apt-get install {MESA_PACKAGES}"
        elif "DISPLAY is set" in text:
            reason = ": there is no screen; --web and --screenshot need none."
        else:
            reason = next((f": {line}" for line in reversed(text.splitlines()) if line.strip()), ".")
        return ViewerError(f"the Rerun viewer {what}{reason}")


@contextlib.contextmanager
def viewer(port: int, *options: str) -> Iterator[RerunViewer]:
    """Start a viewer that ends with the block; the options are more arguments of its command line."""
    arguments = [str(viewer_program()), "--bind", LOOPBACK, "--port", str(port), *options]
    environment = os.environ | {"RERUN_ANALYTICS": "0"}
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "viewer.log"
        with (
            log.open("wb") as output,
            subprocess.Popen(arguments, env=environment, stdout=output, stderr=output) as process,
        ):
            try:
                started = RerunViewer(process, log, f"rerun+http://{LOOPBACK}:{port}/proxy")
                started.wait_for(port)
                yield started
            finally:
                process.terminate()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(5)
                process.kill()


@contextlib.contextmanager
def headless(path: Path, step: int, size: str = "1600x900") -> Iterator[ViewerClient]:
    """Start a viewer without a screen, and yield its client when it has drawn a file at a step."""
    with viewer(free_port(), "--headless", "--hide-welcome-screen", "--window-size", size) as started:
        client = started.show(path, step)
        time.sleep(DRAW_SECONDS)
        if started.process.poll() is not None:
            raise started.error("ended")
        yield client


def screenshot(path: Path, step: int, picture: Path, size: str = "1600x900") -> None:
    """Draw a file at a step into a PNG.

    Raises:
        ViewerError: the viewer cannot be started, or draws nothing.
    """
    with new_file(picture, True) as temporary:
        with headless(path, step, size) as client:
            time.sleep(NOTICE_SECONDS)
            client.save_screenshot(str(temporary))
        if not temporary.exists():
            raise ViewerError(f"{picture}: the Rerun viewer has not drawn it.")


def open_window(path: Path, step: int, port: int) -> None:
    """Show a file at a step in a window, until it is closed."""
    with viewer(port, "--hide-welcome-screen") as started:
        started.show(path, step)
        if code := started.process.wait():
            raise started.error(f"ended with code {code}")


@contextlib.contextmanager
def web_viewer(port: int, path: Path | None = None) -> Iterator[tuple[RerunViewer, str]]:
    """Serve the web viewer on loopback, and a file; yield the viewer and the address to open."""
    data = free_port()
    files = [str(path.resolve())] if path else []
    with viewer(data, "--serve-web", "--web-viewer-port", str(port), *files) as started:
        started.wait_for(port)
        yield started, f"http://{LOOPBACK}:{port}/?url=rerun%2Bhttp://{LOOPBACK}:{data}/proxy"


def cached_export(
    runs: Sequence[Run], request: Request, stage: Callable[[str], None] = lambda _: None
) -> tuple[Path, list[Selection]]:
    """Return the export of these runs in the user's cache, made now if missing, and the selection of each.

    Rerun, which takes a second to load, is loaded only to make an export. `stage` is as for `export`.
    """
    folder = files.cache_folder() / CACHED_EXPORTS
    path = folder / f"{RUN_SEPARATOR.join(run.run_id for run in runs)}-{_cache_key(runs, request)}.rrd"
    with contextlib.suppress(FileNotFoundError):
        os.utime(path)  # creates no file, where another process removes this one meanwhile
        selections = []
        for run in runs:
            with open_recording(run.recording) as recording:
                selections.append(select(recording, request))
        return path, selections
    from runner.export.rerun.writing import export

    with storage_errors(folder, f"set {CACHE_VARIABLE} to another folder"):
        folder.mkdir(parents=True, exist_ok=True)
        files.remove_oldest(folder, "*.rrd", keep=MAX_CACHED - 1)
    return path, export(runs, request, path, stage)


def _cache_key(runs: Sequence[Run], request: Request) -> str:
    """Return a hash of the recordings as they are now, the request, and the code."""
    parts = [__version__, repr(request)]
    for run in runs:
        stat = run.recording.stat()
        parts += [str(run.recording.absolute()), str(stat.st_size), str(stat.st_mtime_ns), repr(run.marks)]
    parts += [str(file.stat().st_mtime_ns) for file in sorted(Path(__file__).parent.glob("*.py"))]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
