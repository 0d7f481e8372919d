"""A module with the shape of `wandb`, which writes into a recording.

    from runner.integrations import wandb

    wandb.init(project="cartpole", config={"learning_rate": 2.5e-4, "seed": 1})
    wandb.log({"loss": loss})
    wandb.finish()

The import is the whole change of a script. The environment that it resets first after `init` is recorded,
every step of it, and what is logged goes into that recording. `runner.integrations.script` has the rules.
What wandb has and this module has not does nothing, with one warning: no script ends because of it. Nothing
is sent to Weights & Biases, and its package is not needed.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from runner.errors import ConfigError, RunnerError
from runner.integrations.script import ScriptRun, local_folder
from runner.integrations.shapes import (
    Tracker,
    WithoutEffect,
    as_number,
    as_run_name,
    forgiving,
    warn_once,
    without_effect,
)
from runner.integrations.tensorboard import end_forwarding, forward
from runner.loops.media import Histogram as Histogram
from runner.loops.media import Image, Media, array_of
from runner.loops.options import settings_in
from runner.runs.redaction import redacted_settings
from runner.runs.run import list_runs
from runner.util.jsonable import as_json
from runner.util.values import Json, flatten

_IGNORED: Final = frozenset(
    [
        "allow_val_change",
        "anonymous",
        "config_exclude_keys",
        "config_include_keys",
        "dir",
        "entity",
        "force",
        "magic",
        "save_code",
        "settings",
    ]
)
"""Arguments of `init` that change nothing in a recording."""


# --- a run --------------------------------------------------------------------------------------------------


class Config(MutableMapping[str, Any]):
    """The settings of a run: `config["lr"]`, `config.lr`, `config.update({...})`."""

    _script: ScriptRun
    _configure: Callable[..., None]

    def __init__(self, script: ScriptRun, configure: Callable[..., None]) -> None:
        vars(self).update(_script=script, _configure=configure)

    def update(self, *settings: Any, **more: object) -> None:
        """Take the settings of a mapping, dataclass or namespace."""
        more.pop("allow_val_change", None)
        for part in settings:
            self._configure(part)
        self._configure(more)

    def setdefaults(self, settings: Any) -> None:
        """Take the settings that are not there yet."""
        self._configure(settings, is_default=True)

    def as_dict(self) -> Json:
        """Return the settings."""
        return dict(self._script.settings)

    def __getitem__(self, key: str) -> Any:
        return self._script.settings[key]

    def __setitem__(self, key: str, value: object) -> None:
        self._configure({key: value})

    def __delitem__(self, key: str) -> None:
        raise RunnerError(f"config: {key!r} cannot be removed")

    def __iter__(self) -> Iterator[str]:
        return iter(self._script.settings)

    def __len__(self) -> int:
        return len(self._script.settings)

    def __getattr__(self, key: str) -> Any:
        try:
            return self._script.settings[key]
        except KeyError:
            raise AttributeError(f"config has no {key!r}, but {', '.join(self) or 'nothing'}") from None

    __setattr__ = __setitem__


class Summary(Json):
    """The last value logged under each name, and what the script puts there, which is logged at the end."""

    def __init__(self) -> None:
        super().__init__()
        self.own: Json = {}

    def __setitem__(self, key: str, value: object) -> None:
        super().__setitem__(key, value)
        self.own[key] = value

    def update(self, values: Any = (), **more: object) -> None:  # type: ignore[override]
        """Put several values there."""
        for key, value in {**dict(values), **more}.items():
            self[key] = value

    def seen(self, key: str, value: object) -> None:
        """Note a value that was logged."""
        super().__setitem__(key, value)


class Tracked(Tracker):
    """A run, as `wandb.init` returns it; a context manager."""

    resumed = False
    _shape = "wandb"

    def __init__(self, script: ScriptRun, own_id: str | None, is_disabled: bool) -> None:
        self.script = script
        self._id = own_id
        self._is_disabled = is_disabled
        self.config = Config(script, self.configure)
        self.summary = Summary()
        script.log_last = self._log_summary
        self.step = 0
        """The number of calls of `log` that were committed."""

    @property
    def id(self) -> str:
        """The id that the script gave the run, or the id of the recording."""
        return self._id or self.script.run_id

    @property
    def name(self) -> str:
        """The name of the run; may be set until the recording begins."""
        return self.script.name or self.id

    @name.setter
    def name(self, name: str) -> None:
        self.script.name = as_run_name(str(name))
        if not self.script.is_waiting:
            self.script.warn_once(f"name: run {self.id} is being recorded; rename it by `dualtaxi label`.")

    @property
    def dir(self) -> str:
        """A folder for files of the script; they do not become part of the recording."""
        folder = Path("wandb") / f"run-{self.script.run_id}" / "files"
        folder.mkdir(parents=True, exist_ok=True)
        return str(folder.absolute())

    @forgiving
    def log(
        self, data: Mapping[str, object], step: object = None, commit: bool | None = None, **_: object
    ) -> None:
        """Log numbers, texts, pictures, histograms and arrays by name; nested names are joined by `/`.

        Args:
            data: the values by name.
            step: the script's own step; without it calls are counted, where no environment is recorded.
            commit: False if the next call logs values of the same step.
        """
        if not isinstance(data, Mapping):
            raise ConfigError(f"log: found {type(data).__name__}, expected a mapping of names to values")
        if self._is_disabled:
            return
        at = self.script.step_of(step)
        self.step = self.step if at is None else max(self.step, at)
        self.script.calls = self.step
        for name, value in data.items():
            self._log(str(name), value, at)
        if commit or (commit is None and at is None):
            self.step += 1

    @forgiving
    def _log(self, name: str, value: Any, step: int | None) -> None:
        if isinstance(value, list | tuple) and any(isinstance(part, Image) for part in value):
            value = dict(enumerate(value))
        if isinstance(value, Mapping):
            for key, inner in value.items():
                self._log(f"{name}/{key}", inner, step)
        elif isinstance(value, Media):
            self.script.log(name, value, step)
            if caption := getattr(value, "caption", None):
                self.script.log(f"{name}/caption", str(caption), step)
        elif value is None or isinstance(value, WithoutEffect):
            self.script.warn_once(
                f"log: {value} is not recorded, first found for {name!r}.", about=str(value)
            )
        elif np.ndim(value) and np.size(value) != 1:
            self.script.log(name, Media(array_of, value), step)
        else:
            try:
                value = value if isinstance(value, str) else as_number(name, value)
            except ConfigError:
                self.script.warn_once(
                    f"log: found {type(value).__name__} for {name!r}, which is recorded as text. This "
                    "warning is given once."
                )
                self.script.log(name, str(as_json(value)), step)
                return
            self.script.log(name, value, step)
            self.summary.seen(name, value)

    def define_metric(self, *_: object, **__: object) -> None:
        """Do nothing: every name that does not decrease is an axis of the plots."""

    @forgiving
    def configure(self, config: object, is_default: bool = False) -> None:
        """Take settings; those that come after the recording began are logged as text.

        Args:
            config: a mapping, dataclass or namespace, or nothing.
            is_default: whether they count only where there is no such setting yet.
        """
        taken = {str(key): value for key, value in settings_in(config).items()}
        settings = {key: value for key, value in taken.items() if not is_default or key not in self.config}
        self.script.settings |= settings
        as_text = [
            key
            for key, value in flatten(settings).items()
            if not isinstance(value, str | float | os.PathLike) and isinstance(as_json(value), str)
        ]
        if as_text:
            self.script.warn_once(f"config: {', '.join(as_text)} are recorded as text.")
        if not self.script.is_waiting and settings and not self._is_disabled:
            self.script.warn_once(
                "config: found settings after the recording began, which are logged as a text, `config`: set "
                "them before the environment is reset."
            )
            self.script.log("config", json.dumps(redacted_settings(as_json(settings))))

    def finish(self, exit_code: int | None = None, quiet: bool | None = None) -> None:  # noqa: ARG002
        """End the run: as failed if the exit code is not 0."""
        if exit_code:
            self._end("failed", f"exit code {exit_code}")
        else:
            self._end()

    def _end(self, status: str = "finished", error: str = "") -> None:
        global run  # noqa: PLW0603 - wandb.run is part of the shape
        if self.script.has_writer is False:
            self.script.warn_once(
                "sync_tensorboard: found no SummaryWriter of PyTorch or tensorboardX when init was called, "
                "expected it to be imported before."
            )
        self.script.close(status, error)
        if self.script.has_writer:
            end_forwarding()
        if run is self:
            run = None

    def _log_summary(self) -> None:
        for name, value in self.summary.own.items():
            self._log(f"summary/{name}", value, None)


run: Tracked | None = None
"""The run that is open."""


def init(
    project: str | None = None,
    config: Any = None,
    name: str | None = None,
    group: str | None = None,
    tags: Sequence[str] | None = None,
    notes: str | None = None,
    job_type: str | None = None,
    mode: str | None = None,
    reinit: bool | str | None = None,
    sync_tensorboard: bool | None = None,
    tensorboard: bool | None = None,
    monitor_gym: bool | None = None,
    recordings: str | os.PathLike[str] | None = None,
    id: str | None = None,  # noqa: A002
    resume: bool | str | None = None,
    **more: Any,
) -> Tracked:
    """Begin a run.

    Args:
        project: the name of the run unless `name` is given, and its tag `project=...`.
        config: the settings: a mapping, dataclass or namespace; its `seed` is the seed of the run.
        name: the name of the run.
        group: its tag `group=...`.
        tags: its tags.
        notes: its note.
        job_type: its tag `job_type=...`.
        mode: `disabled` records nothing; also if $WANDB_MODE is that.
        reinit: whether to finish a run that is still open; without it that one is returned.
        sync_tensorboard: also record what is written with the `SummaryWriter` of PyTorch or tensorboardX.
        tensorboard: the same.
        monitor_gym: False records values only, and not the environment.
        recordings: the recordings folder, or the address of a server, as for `runner.record`.
        id: the script's own id, the tag `id=...` of the run.
        resume: whether the script continues the run of this id. That run stays as it is: this one is new, and
            its note names the other.
        **more: further arguments of `runner.record`, such as `steps`, `frames_every` and `on_error`; others
            have no effect.
    """
    global run  # noqa: PLW0603 - wandb.run is part of the shape
    if run is not None and not run.script.closed:
        if not reinit or reinit == "return_previous":
            warn_once(
                f"init: run {run.id} is still open, and is returned: call finish(), or use reinit=True."
            )
            run.config.update(config or {})
            return run
        run.finish()
    labels = {"project": project, "group": group, "job_type": job_type, "id": id}
    own_tags = tuple(re.sub(r"[^\w.=+/@-]", "-", f"{key}={value}") for key, value in labels.items() if value)
    tags = [tags] if isinstance(tags, str) else list(map(str, tags or ()))
    note = str(notes or "")
    if id and resume and resume != "never":
        note = f"{_predecessor(own_tags[-1], recordings)}{note}"
    is_disabled = (mode or os.environ.get("WANDB_MODE")) == "disabled"
    script = ScriptRun(
        recordings,
        as_run_name(str(name or project or "")),
        tags=(*tags, *own_tags),
        note=note,
        has_environment=monitor_gym is not False,
        takes_writers=True,
        **{key: value for key, value in more.items() if key not in _IGNORED},
    )
    if is_disabled:
        script.discard()
    run = Tracked(script, id, is_disabled)
    run.configure(config)
    if (sync_tensorboard or tensorboard) and not is_disabled:
        script.has_writer = forward()
    return run


def log(data: Mapping[str, object], step: object = None, commit: bool | None = None, **more: Any) -> None:
    """Log values into the open run."""
    _open_run("log").log(data, step, commit, **more)


def define_metric(*_: object, **__: object) -> None:
    """Do nothing: every name that does not decrease is an axis of the plots."""


def finish(exit_code: int | None = None, quiet: bool | None = None) -> None:
    """End the open run, if there is one."""
    if run is not None:
        run.finish(exit_code, quiet)


def _open_run(what: str) -> Tracked:
    if run is None:
        raise RunnerError(f"wandb.{what}: no run is open: call wandb.init() first")
    return run


def _predecessor(tag: str, recordings: str | os.PathLike[str] | None) -> str:
    """Warn that the last run with a tag is not continued, and return a line of the note that names it."""
    earlier = [run for run in list_runs(local_folder(recordings)) if tag in run.tags]
    if not earlier:
        return ""
    last = max(earlier, key=lambda run: run.created)
    warn_once(
        f"init: run {last.run_id} with this id is not continued, as recordings stay as they are: a new run "
        "follows it, and names it in its note."
    )
    return f"Follows run {last.run_id}.\n"


def __getattr__(name: str) -> Any:
    return getattr(_open_run(name), name) if name in ("config", "summary") else without_effect("wandb", name)
