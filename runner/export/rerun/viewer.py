"""The Rerun viewer, started on loopback, at a step: in a window, a browser, or without a screen."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from runner.errors import RunnerError
from runner.util.extras import missing

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient

LOOPBACK: Final = "127.0.0.1"
START_SECONDS: Final = 20.0
SCREEN_SECONDS: Final = 0.5
"""A viewer that finds no screen has ended this long after it began to listen."""
ANSWER_SECONDS: Final = 5.0
SETTLE_SECONDS: Final = 4.0
"""A viewer without a screen has drawn everything this long after it was told where to look."""
NOTICE_SECONDS: Final = 2.5
"""After that, what the viewer says of itself in a corner is gone."""
MESA_PACKAGES: Final = (
    "mesa-vulkan-drivers libgl1-mesa-dri libegl1 libxkbcommon-x11-0 libxcursor1 libxi6 libxrandr2 libx11-xcb1"
)


class ViewerError(RunnerError):
    """The viewer cannot be started, or does not answer."""

    exit_code = 1


def require_rerun(purpose: str) -> None:
    """Raise an error that says what is missing, if Rerun is not installed.

    Raises:
        MissingExtra: it is not.
    """
    if importlib.util.find_spec("rerun") is None:
        raise missing("rerun", "all", purpose)


def viewer_program() -> Path:
    """Return the viewer's executable, which comes with the package.

    Raises:
        ViewerError: it is not there.
    """
    import rerun_cli  # type: ignore[import-untyped,unused-ignore]

    folder = Path(rerun_cli.__file__).parent
    for name in ("rerun", "rerun.exe"):
        if (folder / name).is_file():
            return folder / name
    raise ViewerError(f"found no Rerun viewer in {folder}; install rerun-sdk again.")


def free_port() -> int:
    """Return a port that nothing listens on now."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def check_port(port: int) -> int:
    """Return the port if it is free; 0 means any.

    Raises:
        ViewerError: something listens there.
    """
    if not port:
        return free_port()
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOOPBACK, port))
        except OSError as error:
            raise ViewerError(
                f"port {port} cannot be used ({error.strerror}); choose another by --port, or leave it out."
            ) from error
    return port


def environment() -> dict[str, str]:
    """Return the environment that viewers are started in: nothing is reported to anyone."""
    return os.environ | {"RERUN_ANALYTICS": "0"}


@contextlib.contextmanager
def viewer(port: int, *options: str, log: Path | None = None) -> Iterator[subprocess.Popen[bytes]]:
    """Start a viewer that listens on loopback; it is ended when the block is left.

    Raises:
        ViewerError: it ended at once.
    """
    arguments = [str(viewer_program()), "--bind", LOOPBACK, "--port", str(port), *options]
    with contextlib.ExitStack() as stack:
        output: Any = stack.enter_context(log.open("wb")) if log else subprocess.DEVNULL
        process = subprocess.Popen(arguments, env=environment(), stdout=output, stderr=subprocess.STDOUT)
        try:
            wait_for(process, port, log)
            yield process
        finally:
            process.terminate()
            try:
                process.wait(5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def wait_for(process: subprocess.Popen[bytes], port: int, log: Path | None = None) -> None:
    """Wait until the viewer listens.

    Raises:
        ViewerError: it ended, or took too long.
    """
    deadline = time.monotonic() + START_SECONDS
    while time.monotonic() < deadline:
        if process.poll() is not None:
            break
        with contextlib.suppress(OSError), socket.create_connection((LOOPBACK, port), timeout=1):
            return
        time.sleep(0.05)
    raise ViewerError(f"the Rerun viewer does not start{_reason(log)}")


def _reason(log: Path | None) -> str:
    """Return why a viewer did not start, as far as its output tells."""
    text = log.read_text(errors="replace") if log and log.exists() else ""
    if "graphics adapter" in text or "libEGL" in text or "Vulkan" in text or "libxkbcommon" in text:
        return f": it finds no graphics. On Debian: apt-get install {MESA_PACKAGES}"
    if "DISPLAY is set" in text:
        return ": there is no screen here. Start one where there is, by `rerun`, and name its address."
    last = [line for line in text.splitlines() if line.strip()][-1:]
    return f": {last[0]}" if last else "."


@contextlib.contextmanager
def headless(path: Path, step: int, size: str = "1600x900") -> Iterator[ViewerClient]:
    """Give a viewer without a screen that shows a file at a step, when it has drawn.

    Raises:
        ViewerError: it cannot be started.
    """
    import tempfile

    from rerun.experimental import ViewerClient

    with tempfile.TemporaryDirectory() as folder:
        port, log = free_port(), Path(folder) / "viewer.log"
        with viewer(port, "--headless", "--hide-welcome-screen", "--window-size", size, log=log) as process:
            client = ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy")
            try:
                client.open(path.resolve().as_uri())
                client.set_time("step", sequence=step, play_state="paused")
                time.sleep(SETTLE_SECONDS)
            except Exception as error:  # the client raises whatever its transport does
                ended = process.poll() is not None
                raise ViewerError(
                    f"the Rerun viewer {'ended' if ended else 'does not answer'}{_reason(log)}"
                ) from error
            yield client


def screenshot(path: Path, step: int, picture: Path, size: str = "1600x900") -> None:
    """Draw a file at a step into a PNG.

    Raises:
        ViewerError: the viewer cannot be started, or draws nothing.
        StorageError: the picture cannot be written.
    """
    import shutil
    import tempfile

    from runner.export.places import write_new

    def keep(fresh: Path) -> None:
        shutil.copyfile(drawn, fresh)

    with tempfile.TemporaryDirectory() as folder:
        drawn = Path(folder) / "screenshot.png"
        with headless(path, step, size) as client:
            time.sleep(NOTICE_SECONDS)
            client.save_screenshot(str(drawn))
        if not drawn.exists():
            raise ViewerError(f"{picture}: the Rerun viewer has not drawn it.")
        write_new(picture, True, keep)


def live_window(port: int) -> str:
    """Open a window that stays when this program ends; return the address that runs can be sent to.

    Raises:
        ViewerError: it cannot be started.
    """
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "viewer.log"
        arguments = [str(viewer_program()), "--bind", LOOPBACK, "--port", str(port), "--hide-welcome-screen"]
        with log.open("wb") as output:
            process = subprocess.Popen(
                arguments, env=environment(), stdout=output, stderr=output, start_new_session=True
            )
        wait_for(process, port, log)
        with contextlib.suppress(subprocess.TimeoutExpired):  # it listens before it looks for a screen
            process.wait(SCREEN_SECONDS)
            raise ViewerError(f"the Rerun viewer does not start{_reason(log)}")
    return f"rerun+http://{LOOPBACK}:{port}/proxy"


def check_address(url: str) -> str:
    """Return the address of a viewer if something listens there.

    Raises:
        ViewerError: it is none, or nothing does.
    """
    from urllib.parse import urlsplit

    parts = urlsplit(url)
    try:
        if not parts.scheme.startswith("rerun") or parts.hostname is None:
            raise ValueError
        place = (parts.hostname, parts.port or (443 if parts.scheme.endswith("https") else 80))
    except ValueError:
        raise RunnerError(
            f"--live-url: found {url!r}, expected a viewer's address such as "
            "rerun+http://127.0.0.1:9876/proxy"
        ) from None
    try:
        socket.create_connection(place, timeout=ANSWER_SECONDS).close()
    except OSError as error:
        raise ViewerError(
            f"{url}: nothing answers there ({error.strerror or error}); start a viewer by `rerun`."
        ) from error
    return url


def open_window(path: Path, step: int, port: int) -> None:
    """Show a file at a step in a window, until it is closed.

    Raises:
        ViewerError: the viewer cannot be started.
    """
    import tempfile

    from rerun.experimental import ViewerClient

    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "viewer.log"
        with viewer(port, "--hide-welcome-screen", log=log) as process:
            try:
                client = ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy")
                client.open(path.resolve().as_uri())
                client.set_time("step", sequence=step, play_state="paused")
            except Exception as error:  # the client raises whatever its transport does
                raise ViewerError(f"the Rerun viewer cannot show the file{_reason(log)}") from error
            process.wait()
        if process.returncode:
            raise ViewerError(f"the Rerun viewer ended with code {process.returncode}{_reason(log)}")


@contextlib.contextmanager
def web_viewer(path: Path, port: int) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """Serve a file and the web viewer on loopback; give the process and the address to open.

    Raises:
        ViewerError: it cannot be started.
    """
    import tempfile

    data = free_port()
    with tempfile.TemporaryDirectory() as folder:
        options = ("--serve-web", "--web-viewer-port", str(port), str(path.resolve()))
        with viewer(data, *options, log=Path(folder) / "viewer.log") as process:
            wait_for(process, port, Path(folder) / "viewer.log")
            yield process, f"http://{LOOPBACK}:{port}/?url=rerun%2Bhttp://{LOOPBACK}:{data}/proxy"
