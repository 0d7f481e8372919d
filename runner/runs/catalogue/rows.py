"""A run in the index: the columns of one row in SQLite, and how they are read from the run."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import Any, Final, NamedTuple

from runner.errors import RecordingError
from runner.recording.metrics import METRICS
from runner.recording.run_file import EvaluationMetrics
from runner.runs.branches import origin_in
from runner.runs.catalogue.columns import COLUMNS
from runner.runs.listing import listed_run
from runner.runs.run import Run
from runner.util.values import JsonView, is_number

_MODES: Final = {"joint team": "cooperative", "per_agent individual": "competitive"}
_DEPTH: Final = 20
_LOGGED: Final = 64
_NAME: Final = 200
"""The most characters of a logged name."""
_TEXT: Final = 4000
"""The most characters of a text, and the most values of a configuration."""

SEED_SHIFT: Final = 2**63
"""Subtracted from a seed, from 0 to 2^64 - 1, so that SQLite's signed integers hold it in order."""
_TYPES: Final = {str: "TEXT", int: "INTEGER", float: "REAL"}
STORED: Final = {
    "root": "TEXT NOT NULL",  # the recordings folder, absolute
    "entry": "TEXT NOT NULL",  # the run's folder in it
    "fingerprint": "TEXT NOT NULL",  # changes with every change of its files
    "mark": "TEXT NOT NULL",  # changes when a file in it is created, replaced or removed
    # whether they had not just changed; if they had, they may change again with the same time
    "stable": "INTEGER NOT NULL",
    "problem": "TEXT",
    "tags": "TEXT",  # a tag a line
    **{column.name: _TYPES[column.type] for column in COLUMNS.values() if column.type},
    "origin": "TEXT",  # what it was branched from: a JSON object
    # The long texts come last, so that SQLite reads the other columns without them.
    "words": "TEXT",  # id, name, configuration's name, tags, note: a line each
    "settings": "TEXT",  # the configuration: a JSON object of dotted paths
}
"""The columns of the table `runs` with their types: a run's folder as it was last read.

A damaged run has a `problem`, other folders have no `id`.
"""


class Sql(NamedTuple):
    """A condition or an order in SQL, with the values of its parameters."""

    text: str
    values: tuple[object, ...] = ()


def row_of(run: Run, size: int | None) -> dict[str, object]:
    """Return the row of a run, by column, without place and fingerprint.

    Args:
        size: bytes of its recording; None if there is none.
    """
    config = run.file.config
    summary = run.summary
    recorded = {} if summary.episodes is not None else _recorded(run)
    last = summary.last_evaluation or EvaluationMetrics()
    done = {**recorded, **summary}
    recent = summary.recent_training or recorded.get("recent_training")
    episodes, train, evaluation = (done.get(key) for key in ("episodes", "train_steps", "eval_steps"))
    logged = islice(summary.logged.items(), _LOGGED)
    config_name = text(config.get("name"))
    environment = config.get("env")
    origin = origin_in(config)
    return {
        "id": run.run_id,
        "name": text(run.name),
        "config": config_name,
        "problem": text(run.problem) or None,
        "seed": run.file.seed if run.has_seed else None,
        "status": text(run.status),
        "tags": "\n".join(run.tags),
        "note": text(run.note),
        "words": text("\n".join([run.run_id, run.name, config_name or "", *run.tags, run.note]), 3 * _TEXT),
        "created": math.floor(run.created.timestamp() * 1000),
        "episodes": episodes,
        "episodes_to_do": run.episodes_to_do,
        "steps": None if train is None or evaluation is None else train + evaluation,
        "train_steps": train,
        "eval_steps": evaluation,
        **{metric.name: last.values.get(metric.name) for metric in METRICS},
        **({} if summary.last_evaluation or not recent else {"mean_return": recent.mean_return}),
        "logged": json.dumps({name: value for name, value in logged if text(name, _NAME) == name}),
        "seconds": summary.seconds,
        "bytes": size,
        "digest": summary.content_digest,
        "parent": None if origin is None else text(origin.run),
        "origin": None if origin is None else json.dumps(asdict(origin)),
        "mode": _MODES.get(f"{config.get('tables')} {config.get('rewards')}"),
        "environment": text(environment.get("id") if isinstance(environment, Mapping) else None),
        "host": text(run.file.provenance.get("host") or run.file.owner.get("host")),
        "git": text(run.file.provenance.get("git")),
        "archive": text(run.archive.target or None),
        "settings": json.dumps(_flat(config)),
    }


def _recorded(run: Run) -> Mapping[str, Any]:
    """Return the progress of a run that is running or was killed, from its recording; empty if unknown.

    A loop that has not been evaluated also has its `recent_training`.
    """
    from runner.recording.reader import open_recording

    if run.status == "archived":
        return run.archive.done
    if run.status in ("running", "interrupted", "failed") and run.recording.exists():
        with contextlib.suppress(RecordingError), open_recording(run.recording) as recording:
            done = recording.done()
            if not done["eval_steps"] and not recording.train.has_metrics:
                return {**done, "recent_training": recording.train.recent_means()}
            return done
    return {}


def text(value: object, max_length: int = _TEXT) -> str | None:
    """Return a text for SQLite, truncated; None if the value is not a text."""
    if not isinstance(value, str):
        return None
    return value[:max_length].encode(errors="replace").decode()


def _flat(config: JsonView) -> dict[str, object]:
    """Return the plain values in a configuration by dotted path; items of lists by their position."""
    flat: dict[str, object] = {}

    def put(parts: Iterable[tuple[object, object]], path: str, depth: int) -> None:
        for key, value in islice(parts, _TEXT):
            here = f"{path}{key}"
            kind = value.__class__
            if kind is dict or kind is list:
                if depth < _DEPTH:
                    inside: Any = value
                    put(enumerate(inside) if kind is list else inside.items(), f"{here}.", depth + 1)
            elif kind is str:
                flat[here] = text(value)
            elif value is None or kind is bool or is_number(value):
                flat[here] = value

    put(config.items(), "", 1)
    return flat


class Candidate(NamedTuple):
    """A run as the index has it."""

    root: str
    entry: str
    run_id: str
    name: str
    seed: int | None
    milliseconds: int

    @property
    def created(self) -> datetime:
        """When the run began, in UTC."""
        return datetime.fromtimestamp(self.milliseconds / 1000, UTC)

    def run(self, root: Path | None = None) -> Run:
        """Return the run; its path begins with `root`, which names the recordings folder as the user did.

        Raises:
            RunNotFound: it was removed in the meantime.
        """
        return listed_run(Path(root or self.root, self.entry), self.run_id)
