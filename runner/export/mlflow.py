"""A run into MLflow: parameters, metrics over training steps, tags, and what it is as an artifact."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import re
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count, islice
from pathlib import Path
from typing import Any, Final

from runner.errors import RunnerError
from runner.export.contents import flat_text
from runner.export.scalars import Measures, created, episodes, measures, seconds_of
from runner.recording.reader import Recording
from runner.util.extras import require

RUN_TAG: Final = "dualtaxi.run_id"
DIGEST_TAG: Final = "dualtaxi.content_digest"
_SQLITE: Final = "sqlite:///"
_STATUS: Final = {"finished": "FINISHED", "interrupted": "KILLED", "failed": "FAILED", "running": "RUNNING"}
_AT_ONCE: Final = 1000
_PARAMS_AT_ONCE: Final = 100
_LONGEST: Final = 6000
_LONGEST_NAME: Final = 240
_TOLD: Final = 60
_REFUSED: Final = re.compile(r"[^/\w.\- :]")
"""What MLflow has in no name."""


@dataclass(frozen=True)
class Exported:
    """What came of an export."""

    mlflow_run: str
    metrics: int
    already: bool
    """Whether the run was there before; then nothing was written."""
    notes: tuple[str, ...] = ()


def require_packages() -> None:
    """Raise an error that says what is missing, if MLflow's client is not installed.

    Raises:
        MissingExtra: it is not.
    """
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    with _quiet():
        require("mlflow", "sqlalchemy", extra="mlflow", purpose="export mlflow")


def export(
    recording: Recording, tracking: str, experiment: str, with_recording: bool = False, force: bool = False
) -> Exported:
    """Write a run into an MLflow store; one that is there with the same content is left as it is.

    Args:
        recording: the run's.
        tracking: the store: `sqlite:///exports/mlflow.db`, or the address of a server.
        experiment: the name of the experiment, made if it is missing.
        with_recording: also store the recording as an artifact.
        force: write it anew, and delete what is there of it.

    Raises:
        RunnerError: the store cannot be used.
        RecordingError: the recording is damaged.
    """
    from mlflow.exceptions import MlflowException

    with _quiet():
        try:
            if tracking.startswith(_SQLITE):  # SQLite makes the file, but not its folder
                Path(tracking.removeprefix(_SQLITE)).parent.mkdir(parents=True, exist_ok=True)
            return _export(recording, tracking, experiment, with_recording, force)
        except (MlflowException, ImportError, OSError) as error:
            raise RunnerError(f"{tracking}: MLflow cannot use it ({error}).") from error
        except Exception as error:
            if type(error).__module__.partition(".")[0] == "sqlalchemy":
                raise RunnerError(f"{tracking}: the database cannot be used ({error}).") from error
            raise


def _export(
    recording: Recording, tracking: str, experiment: str, with_recording: bool, force: bool
) -> Exported:
    from mlflow.tracking import MlflowClient

    client = MlflowClient(tracking_uri=tracking, registry_uri=tracking)
    found = client.get_experiment_by_name(experiment)
    into = client.create_experiment(experiment) if found is None else found.experiment_id
    known = client.search_runs([into], f"tags.`{RUN_TAG}` = '{recording.run_id}'")
    same = [one for one in known if one.data.tags.get(DIGEST_TAG) == _digest(recording)]
    if same and not force:
        return Exported(same[0].info.run_id, 0, already=True)
    if known and not force:
        raise RunnerError(
            f"{tracking}: experiment {experiment!r} has the run {recording.run_id} "
            "with other content; --force replaces it."
        )
    made = client.create_run(into, start_time=round(created(recording) * 1000), tags=_tags(recording))
    try:
        exported = _fill(client, made.info.run_id, recording, with_recording)
    except BaseException:
        client.delete_run(made.info.run_id)
        raise
    for one in known:
        client.delete_run(one.info.run_id)
    return exported


def _fill(client: Any, run_id: str, recording: Recording, with_recording: bool) -> Exported:
    from mlflow.entities import Metric, Param

    params, names = flat_text(recording.config), dict[str, str]()
    fitting = [Param(_name(key, names), text) for key, text in params.items() if len(text) <= _LONGEST]
    notes = [
        f"{key} is longer than MLflow's {_LONGEST:,} characters; it is in run.json alone."
        for key, text in params.items()
        if len(text) > _LONGEST
    ]
    for start in range(0, len(fitting), _PARAMS_AT_ONCE):
        client.log_batch(run_id, params=fitting[start : start + _PARAMS_AT_ONCE])
    began, written, last = created(recording), 0, 0.0
    rows = (
        (f"{found.phase}/{name}", value, began + seconds_of(found.position), found.step)
        for found in _measured(recording)
        for name, value in found.values.items()
    )
    while some := list(islice(rows, _AT_ONCE)):
        client.log_batch(
            run_id,
            [Metric(_name(key, names), value, round(at * 1000), step) for key, value, at, step in some],
        )
        written, last = written + len(some), max(last, *(at for _, _, at, _ in some))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "run.json")
        path.write_text(json.dumps(recording.run_facts(), indent=1), encoding="utf-8")
        client.log_artifact(run_id, str(path))
    if with_recording:
        client.log_artifact(run_id, str(recording.path))
    status = _STATUS.get(recording.status, "KILLED")
    client.set_terminated(run_id, status, round(max(last, began) * 1000))
    notes += [
        f"{_short(name)} is called {_short(key)}: MLflow takes no such name."
        for name, key in names.items()
        if name != key
    ]
    return Exported(run_id, written, False, tuple(notes))


def _measured(recording: Recording) -> Iterator[Measures]:
    """Yield the measures of a run; of a loop, which has few, also length and return of its episodes."""
    yield from measures(recording)
    if not recording.is_job:
        for phase in ("train", "eval"):
            yield from episodes(recording, phase)


def _name(name: str, known: dict[str, str]) -> str:
    """Return what MLflow takes for a name, another one for each; `known` is what was taken so far."""
    if name not in known:
        parts = _REFUSED.sub("_", name)[:_LONGEST_NAME].split("/")
        plain = "/".join(part if part.strip(". ") else "_" for part in parts)
        several = (plain if number == 1 else f"{plain}_{number}" for number in count(1))
        known[name] = next(one for one in several if one not in known.values())
    return known[name]


def _short(name: str) -> str:
    return repr(name if len(name) <= _TOLD else f"{name[: _TOLD - 1]}…")


def _digest(recording: Recording) -> str:
    return recording.result.content_digest or ""


def _tags(recording: Recording) -> dict[str, str]:
    run = recording.run
    return {
        "mlflow.runName": recording.title,
        "mlflow.source.name": "dualtaxi",
        "mlflow.user": "",
        RUN_TAG: run["run_id"],
        DIGEST_TAG: _digest(recording),
        "dualtaxi.job": run["job"],
        **({} if recording.seed is None else {"dualtaxi.seed": run["seed"]}),
        "dualtaxi.status": recording.status,
    }


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep MLflow's own notices from the user's terminal."""
    loggers = [logging.getLogger(name) for name in ("mlflow", "alembic")]
    levels = [logger.level for logger in loggers]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            for logger in loggers:
                logger.setLevel(logging.ERROR)
            yield
        finally:
            for logger, level in zip(loggers, levels, strict=True):
                logger.setLevel(level)
