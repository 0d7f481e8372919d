"""A run in MLflow: parameters, metrics over training steps, tags, and its facts as an artifact."""

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
from itertools import chain, count, islice
from pathlib import Path
from typing import TYPE_CHECKING, Final

from runner.errors import RunnerError, shortened
from runner.export.contents import flat_text
from runner.export.scalars import episodes, measures, times
from runner.recording.reader import Recording
from runner.util.extras import require

if TYPE_CHECKING:
    from mlflow.tracking import MlflowClient

RUN_TAG: Final = "dualtaxi.run_id"
DIGEST_TAG: Final = "dualtaxi.content_digest"
_SQLITE: Final = "sqlite:///"
_STATUS: Final = {"finished": "FINISHED", "interrupted": "KILLED", "failed": "FAILED", "running": "RUNNING"}
# Limits of MLflow: metrics and parameters of a request, and characters of a parameter and of a name.
_MAX_METRICS: Final = 1000
_MAX_PARAMS: Final = 100
_MAX_TEXT: Final = 6000
_MAX_NAME: Final = 240
_REFUSED: Final = re.compile(r"[^/\w.\- :]")
"""The characters that MLflow does not allow in names."""
_MAX_SHOWN: Final = 60


@dataclass(frozen=True)
class MlflowExport:
    """The result of an export."""

    mlflow_run: str
    metrics: int
    exists: bool = False
    """Whether the run was in the store already; then nothing was written."""
    notes: tuple[str, ...] = ()


def require_packages() -> None:
    """Check that MLflow's client is installed."""
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    with _quiet():
        require("mlflow", "sqlalchemy", extra="mlflow", purpose="export mlflow")


def export(
    recording: Recording, tracking: str, experiment: str, with_recording: bool = False, force: bool = False
) -> MlflowExport:
    """Write a run into an MLflow store, unless it is there already with the same content.

    The store, `tracking`, is `sqlite:///exports/mlflow.db` or the address of a server. `force` writes the run
    again, and deletes what the store has of it.

    Raises:
        RunnerError: the store cannot be used, or has the run with other content.
    """
    from mlflow.exceptions import MlflowException

    with _quiet():
        try:
            if tracking.startswith(_SQLITE):  # SQLite creates the file, but not its folder
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
) -> MlflowExport:
    from mlflow.tracking import MlflowClient

    client = MlflowClient(tracking_uri=tracking, registry_uri=tracking)
    existing = client.get_experiment_by_name(experiment)
    experiment_id = client.create_experiment(experiment) if existing is None else existing.experiment_id
    stored = client.search_runs([experiment_id], f"tags.`{RUN_TAG}` = '{recording.run_id}'")
    tags = tags_of(recording)
    if stored and not force:
        for one in stored:
            if one.data.tags.get(DIGEST_TAG) == tags[DIGEST_TAG]:
                return MlflowExport(one.info.run_id, 0, exists=True)
        raise RunnerError(
            f"{tracking}: experiment {experiment!r} has the run {recording.run_id} "
            "with other content; --force replaces it."
        )
    run = client.create_run(experiment_id, start_time=round(recording.began.timestamp() * 1000), tags=tags)
    run_id = run.info.run_id
    try:
        names: dict[str, str] = {}
        notes = _log_params(client, run_id, recording, names)
        metrics, end = _log_metrics(client, run_id, recording, names)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "run.json")
            path.write_text(json.dumps(recording.run_facts(), indent=1), encoding="utf-8")
            client.log_artifact(run_id, str(path))
        if with_recording:
            client.log_artifact(run_id, str(recording.path))
        client.set_terminated(run_id, _STATUS.get(recording.status, "KILLED"), round(end * 1000))
    except BaseException:
        client.delete_run(run_id)
        raise
    for one in stored:
        client.delete_run(one.info.run_id)
    notes += [
        f"{shortened(name, _MAX_SHOWN)!r} is called {shortened(key, _MAX_SHOWN)!r}: "
        "MLflow takes no such name."
        for name, key in names.items()
        if name != key
    ]
    return MlflowExport(run_id, metrics, notes=tuple(notes))


def _log_params(client: MlflowClient, run_id: str, recording: Recording, names: dict[str, str]) -> list[str]:
    """Log the configuration; return a note about each value that is too long."""
    from mlflow.entities import Param

    values = flat_text(recording.config)
    params = iter([Param(_name(key, names), text) for key, text in values.items() if len(text) <= _MAX_TEXT])
    while batch := list(islice(params, _MAX_PARAMS)):
        client.log_batch(run_id, params=batch)
    return [
        f"{key} is longer than MLflow's {_MAX_TEXT:,} characters; it is in run.json alone."
        for key, text in values.items()
        if len(text) > _MAX_TEXT
    ]


def _log_metrics(
    client: MlflowClient, run_id: str, recording: Recording, names: dict[str, str]
) -> tuple[int, float]:
    """Log all metrics, of a loop also length and return of its episodes; return their number, and the end."""
    from mlflow.entities import Metric

    end, at = recording.began.timestamp(), times(recording)
    phases = () if recording.has_reports else ("train", "eval")
    moments = chain(measures(recording), *(episodes(recording, phase) for phase in phases))
    metrics = (
        Metric(_name(name, names), value, round(at(moment.position) * 1000), moment.step)
        for moment in moments
        for name, value in moment.by_phase.items()
    )
    written = 0
    while batch := list(islice(metrics, _MAX_METRICS)):
        client.log_batch(run_id, batch)
        written += len(batch)
        end = max(end, *(metric.timestamp / 1000 for metric in batch))
    return written, end


def tags_of(recording: Recording) -> dict[str, str]:
    """Return the tags of a run."""
    return {
        "mlflow.runName": recording.title,
        "mlflow.source.name": "dualtaxi",
        "mlflow.user": "",
        RUN_TAG: recording.run_id,
        DIGEST_TAG: recording.result.content_digest or "",
        "dualtaxi.job": recording.run["job"],
        **({} if recording.seed is None else {"dualtaxi.seed": str(recording.seed)}),
        "dualtaxi.status": recording.status,
    }


def _name(name: str, names: dict[str, str]) -> str:
    """Return a name that MLflow allows, distinct from the others in `names`, to which it is added."""
    if name not in names:
        parts = _REFUSED.sub("_", name)[:_MAX_NAME].split("/")
        allowed = "/".join(part if part.strip(". ") else "_" for part in parts)
        candidates = chain([allowed], (f"{allowed}_{number}" for number in count(2)))
        taken = set(names.values())
        names[name] = next(candidate for candidate in candidates if candidate not in taken)
    return names[name]


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Suppress MLflow's own notices."""
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
