"""What the index knows of a run: one row, the columns of a table in SQLite."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterator, Mapping
from itertools import islice
from typing import Any, Final

from peewee import BigIntegerField, BooleanField, CompositeKey, Field, FloatField, Model, TextField

from runner.errors import RecordingError
from runner.recording.metrics import METRICS
from runner.recording.run_file import EvaluationMetrics, Summary
from runner.runs.run import Run

SEEDS: Final = 2**64
_LARGEST: Final = 2**63 - 1
_MODES: Final = {("joint", "team"): "cooperative", ("per_agent", "individual"): "competitive"}
_DEPTH: Final = 20
_LOGGED: Final = 64
_NAME: Final = 200
"""Logged names that are kept, and the letters of one."""
_TEXT: Final = 4000
"""The most characters kept of a text, and the most settings of a configuration."""


_SUMMED: Final = (
    *("root", "used_recording", "used_other", "used_left_over", "used_freed"),
    *("status", "tags", "digest", "created", "id"),
)
"""What sums over the use of the disk need: an index of these spares a look at all rows."""


class SeedField(Field):
    """A seed, from 0 to 2^64 - 1, kept in order as SQLite's signed integers."""

    field_type = "BIGINT"

    def db_value(self, value: int | None) -> int | None:
        """Return what is stored of a seed."""
        return None if value is None else value - 2**63

    def python_value(self, value: int | None) -> int | None:
        """Return the seed that is stored."""
        return None if value is None else value + 2**63


class Row(Model):
    """A run's folder as it was last read; a damaged run has a `problem`; what is no run has no `id`."""

    root = TextField()
    """The recordings folder, absolute."""
    entry = TextField()
    """The run's folder in it."""
    fingerprint = TextField()
    """What tells whether its files changed."""
    mark = TextField()
    """What tells whether files in it were made, replaced or removed."""
    settled = BooleanField()
    """Whether they had not changed just before; if they had, they may do so again without a trace."""
    problem = TextField(null=True)

    id = TextField(null=True)
    name = TextField(null=True)
    config = TextField(null=True)
    seed = SeedField(null=True)
    status = TextField(null=True)
    tags = TextField(null=True)
    """A tag a line."""
    note = TextField(null=True)
    words = TextField(null=True)
    """Id, name, configuration's name, tags and note, each on lines of its own."""
    created = BigIntegerField(null=True)
    """Milliseconds since 1970, UTC."""
    episodes = BigIntegerField(null=True)
    episodes_to_do = BigIntegerField(null=True)
    steps = BigIntegerField(null=True)
    train_steps = BigIntegerField(null=True)
    eval_steps = BigIntegerField(null=True)
    logged = TextField(null=True)
    """The last value logged under each name, as a JSON object; null for a value that is not finite."""
    seconds = FloatField(null=True)
    bytes = BigIntegerField(null=True)
    digest = TextField(null=True)
    mode = TextField(null=True)
    environment = TextField(null=True)
    host = TextField(null=True)
    git = TextField(null=True)
    archive = TextField(null=True)
    settings = TextField(null=True)
    """The configuration as a JSON object of paths and plain values."""

    used_recording = BigIntegerField(null=True)
    """Bytes that its folder uses of the disk, by what they are; null until somebody asks."""
    used_other = BigIntegerField(null=True)
    used_left_over = BigIntegerField(null=True)
    used_freed = BigIntegerField(null=True)

    class Meta:
        """How the table is made."""

        table_name = "runs"
        primary_key = CompositeKey("root", "entry")
        without_rowid = True
        indexes = (
            (("root", "entry", "fingerprint", "mark", "settled", "status"), False),
            (("digest",), False),
            (("root", "created", "id", "name", "seed"), False),
            (_SUMMED, False),
        )


for _metric in METRICS:
    Row._meta.add_field(_metric.name, FloatField(null=True))


def row_of(run: Run, size: int | None) -> dict[str, Any]:
    """Return what is kept of a run, by column; the place and the fingerprint are not in it.

    Args:
        run: as its folder says now.
        size: bytes of its recording; None if there is none.
    """
    config, summary = run.file.config, run.summary
    last, recent = summary.last_evaluation or EvaluationMetrics(), summary.recent_training
    done = summary if summary.episodes is not None else {**_recorded(run), **summary}
    episodes, train, evaluation = (done.get(key) for key in ("episodes", "train_steps", "eval_steps"))
    called = text(config.get("name"))
    return {
        "id": run.run_id,
        "name": text(run.name),
        "config": called,
        "problem": text(run.problem) or None,
        "seed": run.file.seed if run.has_seed else None,
        "status": text(run.status),
        "tags": "\n".join(run.tags),
        "note": text(run.note),
        "words": text("\n".join([run.run_id, run.name, called or "", *run.tags, run.note]), 3 * _TEXT),
        "created": math.floor(run.created.timestamp() * 1000),
        "episodes": episodes,
        "episodes_to_do": run.episodes_to_do,
        "steps": None if train is None or evaluation is None else train + evaluation,
        "train_steps": train,
        "eval_steps": evaluation,
        **{metric.name: last.values.get(metric.name) for metric in METRICS},
        **({} if summary.last_evaluation or not recent else {"mean_return": recent.mean_return}),
        "logged": json.dumps(_logged(summary)),
        "seconds": summary.seconds,
        "bytes": size,
        "digest": summary.content_digest,
        "mode": _mode(config),
        "environment": text(_mapping(config.get("env")).get("id")),
        "host": text(run.file.provenance.get("host") or run.file.owner.get("host")),
        "git": text(run.file.provenance.get("git")),
        "archive": text(run.archive.target or None),
        "settings": json.dumps(dict(_flat(config))),
    }


def _recorded(run: Run) -> Mapping[str, Any]:
    """Return how far a run came that was ended before it could say so; nothing if nobody can tell, or yet."""
    from runner.recording.reader import open_recording

    if run.status == "archived":
        return run.archive.done
    if run.status in ("interrupted", "failed") and run.recording.exists():
        with contextlib.suppress(RecordingError), open_recording(run.recording) as recording:
            return recording.done()
    return {}


def _logged(summary: Summary) -> dict[str, float | None]:
    """Return the last logged values of a loop by name."""
    return {
        name: value for name, value in islice(summary.logged.items(), _LOGGED) if text(name, _NAME) == name
    }


def text(value: Any, most: int = _TEXT) -> str | None:
    """Return a text that SQLite can hold, cut off where it is too long; None if it is none."""
    if not isinstance(value, str):
        return None
    return value[:most].encode(errors="replace").decode()


def number(value: Any) -> float | None:
    """Return a finite number; None if it is none."""
    if type(value) not in (int, float):
        return None
    try:
        return float(value) if math.isfinite(value) else None
    except OverflowError:
        return None


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _mode(config: Mapping[str, Any]) -> str | None:
    tables, rewards = config.get("tables"), config.get("rewards")
    return _MODES.get((tables, rewards)) if isinstance(tables, str) and isinstance(rewards, str) else None


def _flat(value: Any, path: str = "", depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Yield the plain values in a configuration by path: `evaluation.every`; lists by position."""
    if isinstance(value, Mapping | list):
        parts = enumerate(value) if isinstance(value, list) else value.items()
        for (key, part), _ in zip(parts, range(_TEXT), strict=False):
            if depth < _DEPTH:
                yield from _flat(part, f"{path}.{key}" if path else str(key), depth + 1)
    elif isinstance(value, str):
        yield path, text(value)
    elif value is None or isinstance(value, bool) or number(value) is not None:
        yield path, value
