"""A `SummaryWriter` with TensorBoard's interface, which writes into a recording.

    from runner.integrations.tensorboard import SummaryWriter

The import is the whole change of a script. The environment that it resets first after it made the writer is
recorded, every step of it, and what is written goes into that recording, with the step that the script gives
as `global_step`. `runner.integrations.script` has the rules.
"""

from __future__ import annotations

import ast
import os
import re
import socket
import sys
import weakref
from collections.abc import Callable, Mapping
from datetime import datetime
from functools import wraps
from pathlib import Path
from typing import Any, Final

from runner.integrations.script import ScriptRun, open_runs
from runner.integrations.shapes import Tracker, as_number, as_run_name, forgiving, logs
from runner.loops.media import Media, array_of, film_of, histogram_of, picture_of
from runner.runs.redaction import redacted_settings
from runner.runs.run import Run
from runner.util.jsonable import as_json

_HYPERPARAMETERS: Final = re.compile(r"\|param\|value\|\n\|-\|-\|\n", re.ASCII)
"""How the tables begin in which CleanRL's scripts write their settings."""
_WRITERS: Final = ("torch.utils.tensorboard.writer", "tensorboardX.writer")
"""The modules of the writers from which `forward` takes values."""


def _settings(table: str) -> dict[str, object]:
    """Return the rows `|name|value|` of a Markdown table; values as Python writes them, else as text."""
    settings: dict[str, object] = {}
    for line in table.splitlines():
        if match := re.fullmatch(r"\|([^|]+)\|(.*)\|", line.strip()):
            name, text = match.groups()
            try:
                settings[name] = ast.literal_eval(text)
            except (ValueError, SyntaxError, MemoryError, RecursionError):
                settings[name] = text
    return settings


class SummaryWriter(Tracker):
    """Records what is written as TensorBoard's own writer would log it; a context manager.

        writer = SummaryWriter("runs/CartPole-v1__ppo__1")
        writer.add_scalar("losses/value_loss", loss, global_step)

    Args:
        log_dir: names the run, without a leading `runs/`; the folder is made, for files of the script's own.
        comment: is added to the name if there is no log_dir.
        purge_step: ignored, like max_queue, flush_secs and filename_suffix.
        max_queue: ignored.
        flush_secs: ignored.
        filename_suffix: ignored.
        recordings: the recordings folder or a server, as for `runner.record`.
        monitor_gym: whether to record an environment.
        **options: further arguments of `runner.record`, such as `steps`, `frames_every` and `on_error`;
            others are ignored, with a warning.

    What cannot be recorded gives a warning for each method, and no error unless `on_error="raise"`. Methods
    that TensorBoard's writer may have and this one has not do nothing, with a warning.
    """

    _shape = "SummaryWriter"

    def __init__(
        self,
        log_dir: str | os.PathLike[str] | None = None,
        comment: str = "",
        purge_step: int | None = None,  # noqa: ARG002
        max_queue: int = 10,  # noqa: ARG002
        flush_secs: int = 120,  # noqa: ARG002
        filename_suffix: str = "",  # noqa: ARG002
        *,
        recordings: str | os.PathLike[str] | None = None,
        monitor_gym: bool = True,
        **options: Any,
    ) -> None:
        log_dir = options.pop("logdir", log_dir)
        options.pop("write_to_disk", None)
        if log_dir is None:
            self.log_dir = f"runs/{datetime.now():%b%d_%H-%M-%S}_{socket.gethostname()}{comment}"
        else:
            self.log_dir = os.fspath(log_dir)
            Path(self.log_dir).mkdir(parents=True, exist_ok=True)
        self.logdir = self.log_dir
        tracked = [run for run in open_runs if run.takes_writers]
        self._is_own = not tracked
        if tracked:
            self.script = tracked[-1]
            self.script.has_writer = True
        else:
            name = None if log_dir is None else run_name(self.log_dir)
            self.script = ScriptRun(recordings, name, has_environment=monitor_gym, **options)

    @property
    def run(self) -> Run | None:
        """The run, as soon as it is recorded: from the first reset of its environment on."""
        return self.script.run

    def get_logdir(self) -> str:
        """Return the folder that the script named."""
        return self.log_dir

    # --- what is written ----------------------------------------------------------------------------------

    def add_scalar(
        self,
        tag: str,
        scalar_value: object,
        global_step: object = None,
        *_: object,
        **__: object,
    ) -> None:
        """Log a number."""
        try:
            self.script.log(tag, as_number(tag, scalar_value), global_step)
        except Exception as error:  # as `logs` does, which would double the time
            self.script.leave_out(error, "add_scalar")

    @forgiving
    def add_text(
        self, tag: str, text_string: object, global_step: object = None, *_: object, **__: object
    ) -> None:
        """Log a text; a table of hyperparameters, as CleanRL writes it, also becomes the settings."""
        text = str(text_string)
        if self.script.is_waiting and (match := _HYPERPARAMETERS.search(text)):
            self.script.settings = _settings(text[match.end() :]) | self.script.settings
        self.script.log(tag, text, global_step)

    add_histogram = logs("add_histogram", histogram_of, "tag values global_step")
    add_tensor = logs("add_tensor", array_of, "tag tensor global_step")
    add_image = logs(
        "add_image", picture_of, "tag img_tensor global_step walltime dataformats", dataformats="CHW"
    )
    add_images = logs(
        "add_images", picture_of, "tag img_tensor global_step walltime dataformats", dataformats="NCHW"
    )
    add_video = logs("add_video", film_of, "tag vid_tensor global_step fps", dataformats="NTCHW", fps=4)

    @forgiving
    def add_figure(
        self,
        tag: str,
        figure: object,
        global_step: object = None,
        close: bool = True,
        **_: object,
    ) -> None:
        """Record a figure of Matplotlib, or a list of them, as pictures."""
        for part in figure if isinstance(figure, list) else [figure]:
            self.script.log(tag, Media(picture_of, part), global_step)
            if close and (pyplot := sys.modules.get("matplotlib.pyplot")):
                pyplot.close(part)

    @forgiving
    def add_scalars(
        self,
        main_tag: str,
        tag_scalar_dict: Mapping[str, object],
        global_step: object = None,
        *_: object,
        **__: object,
    ) -> None:
        """Log several numbers, as `main_tag/name`."""
        for name, value in tag_scalar_dict.items():
            self.add_scalar(f"{main_tag}/{name}", value, global_step)

    @forgiving
    def add_hparams(
        self,
        hparam_dict: Mapping[str, object],
        metric_dict: Mapping[str, object],
        hparam_domain_discrete: object = None,  # noqa: ARG002
        run_name: str | None = None,  # noqa: ARG002
        global_step: object = None,
    ) -> None:
        """Take settings, and log metrics; settings that come after the recording began are logged too."""
        if self.script.is_waiting:
            self.script.settings |= dict(hparam_dict)
        else:
            self.script.log("hparams", str(redacted_settings(as_json(hparam_dict))), global_step)
        for name, value in metric_dict.items():
            self.add_scalar(name, value, global_step)

    # --- the end ------------------------------------------------------------------------------------------

    def flush(self) -> None:
        """Do nothing: what is written is in the file within a second."""

    def close(self) -> None:
        """End the run as finished, unless something else does."""
        self._end()

    finish = close  # TorchRL's loggers end by it what has it

    def _end(self, status: str = "finished", error: str = "") -> None:
        if self._is_own:
            self.script.close(status, error)


def run_name(log_dir: str) -> str | None:
    """Return the name of a run that is logged into a folder, such as `CartPole-v1__ppo__1__1700000000`."""
    parts = Path(log_dir).parts
    inside = parts[parts.index("runs") + 1 :] if "runs" in parts[:-1] else parts[-1:]
    return as_run_name("/".join(inside))


# --- other writers ------------------------------------------------------------------------------------------


not_forwarded: weakref.WeakSet[object] = weakref.WeakSet()
"""Writers of other libraries whose values are left out, as they are recorded otherwise."""


def _other_writers() -> list[Any]:
    """Return the writers of other libraries that are loaded."""
    loaded = (getattr(sys.modules.get(module), "SummaryWriter", None) for module in _WRITERS)
    return list(filter(None, loaded))


def forward() -> bool:
    """Also log what the script writes with the writers of PyTorch and tensorboardX into the run that is open.

    Returns whether such a writer is loaded.
    """
    ours = SummaryWriter()
    for writer in _other_writers():
        for name in vars(SummaryWriter):
            method = getattr(writer, name, None) if name.startswith("add_") else None
            if method is not None and not hasattr(method, "forwards"):
                setattr(writer, name, _forwarding(name, method, ours))
    return bool(_other_writers())


def end_forwarding() -> None:
    """Give the writers of other libraries their own methods back."""
    for writer in _other_writers():
        for name, method in list(vars(writer).items()):
            if hasattr(method, "forwards"):
                setattr(writer, name, method.__wrapped__)


def _forwarding(name: str, method: Callable[..., object], ours: SummaryWriter) -> Callable[..., object]:
    @wraps(method)
    def both(self: object, *arguments: object, **named: object) -> object:
        if ours.script.closed or self in not_forwarded:
            return method(self, *arguments, **named)
        getattr(ours, name)(*arguments, **named)
        not_forwarded.add(self)  # it may call its other methods, as `add_figure` calls `add_image`
        try:
            return method(self, *arguments, **named)
        finally:
            not_forwarded.discard(self)

    both.forwards = True  # type: ignore[attr-defined]
    return both
