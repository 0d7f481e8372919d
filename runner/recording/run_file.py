"""The contents of `run.json` and of a recording's result, as typed records; the process that owns a run.

Anyone may have written either of them. An invalid value is left out of the record and named in a problem, so
that no other code has to check types.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeGuard

from runner.errors import shortened
from runner.recording.metrics import METRICS
from runner.util.files import read_object
from runner.util.values import MAX_JSON_DEPTH, Json, JsonView, is_number, is_too_deep

STATED_STATUSES: Final = ("running", "finished", "interrupted", "failed")
"""The statuses that a run's owner writes."""
RUN_ID: Final = re.compile(r"[\w.-]{1,100}")
NO_ENVIRONMENT: Final = "none"
"""The environment's id in the configuration of a run of logged values alone."""

_LARGEST: Final = 2**62
_QUOTED: Final = 60
"""Characters of a wrong value that a problem quotes."""


def has_environment(config: JsonView) -> bool:
    """Return whether a run of this configuration has an environment, and not logged values alone."""
    return config.get("env") != {"id": NO_ENVIRONMENT, "kwargs": {}}


class Check(NamedTuple):
    """What a value must be."""

    fits: Callable[[object], bool]
    expected: str


@dataclass(frozen=True)
class EvaluationMetrics:
    """The figures of an evaluation that people quote; None if one is unknown."""

    episode: int | None = None
    """Training episodes before it."""
    trials: int | None = None
    values: Mapping[str, float | None] = field(default_factory=dict)
    """Value by name of a metric; a metric of each agent is summed over the agents."""

    @classmethod
    def of(cls, record: JsonView) -> EvaluationMetrics:
        """Return the figures of a summary's `last_evaluation`."""
        values = {metric.name: record.get(metric.name) for metric in METRICS}
        return cls(record.get("episode"), record.get("trials"), values)

    def as_json(self) -> dict[str, float | None]:
        """Return the figures by name."""
        return {"episode": self.episode, "trials": self.trials, **self.values}


@dataclass(frozen=True)
class RecentTraining:
    """The figures of a loop's last training episodes; None if they are unknown."""

    episodes: int | None = None
    mean_length: float | None = None
    mean_return: float | None = None


@dataclass(frozen=True, eq=False)
class Summary(JsonView):
    """How a run ended, as its owner wrote it; also a mapping of the valid JSON values."""

    status: str | None = None
    """In a recording's result only."""
    content_digest: str | None = None
    topic_digests: Mapping[str, str] = field(default_factory=dict)
    """Topic to digest."""
    train_steps: int | None = None
    eval_steps: int | None = None
    episodes: int | None = None
    """Training episodes."""
    messages: Mapping[str, int] = field(default_factory=dict)
    """Topic to number of messages."""
    steps_recorded: bool = True
    last_evaluation: EvaluationMetrics | None = None
    recent_training: RecentTraining | None = None
    logged: Mapping[str, float | None] = field(default_factory=dict)
    """Name to the value that a loop logged last under it."""
    rewards_off_table: int | None = None
    """Steps of a loop whose reward its environment's table excludes."""
    seconds: float | None = None
    bytes: int | None = None
    """Size of the recording."""
    error: str | None = None
    unfolded: Mapping[str, str] = field(default_factory=dict)
    """Name of a process whose recording was kept, as not all of it could be put into the run, to what is."""
    values_by_key: JsonView = field(default_factory=dict, repr=False)

    def __getitem__(self, key: str) -> Any:
        return self.values_by_key[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self.values_by_key)

    def __len__(self) -> int:
        return len(self.values_by_key)


@dataclass(frozen=True)
class ArchiveReference:
    """Where an archived run's recording is."""

    target: str = ""
    """Path or URL of the archive; empty if the run was never archived."""
    digest: str = ""
    done: Summary = field(default_factory=Summary)
    """How far the run got, if it was not finished."""

    def __bool__(self) -> bool:
        return bool(self.target)


@dataclass(frozen=True)
class RunFile:
    """The contents of `run.json`."""

    run_id: str
    name: str
    seed: int | None
    status: str
    """One of `STATED_STATUSES`; `interrupted` if the file states none of them."""
    created: datetime | None
    """In UTC."""
    owner: JsonView
    config: JsonView
    """As it was written: only its depth is checked."""
    summary: Summary
    archive: ArchiveReference
    provenance: Mapping[str, str]
    proof: str | None
    """The content digest that the run must have again."""
    recording: str | None
    """The name of the recording, if it is not in a folder of its own."""
    problems: tuple[str, ...] = ()
    """The invalid values, a sentence each without its full stop."""


def parse_run_file(record: JsonView) -> RunFile:
    """Return the contents of a `run.json`; invalid values are named in `problems`.

    Args:
        record: the JSON object; its `run_id` must be valid.
    """
    problems: list[str] = []
    values = _valid(_without_deep_values(record, problems), _RUN, "", problems)
    problems += [f"{key} is missing" for key in _REQUIRED if key not in record]
    return RunFile(
        run_id=record["run_id"],
        name=values["name"] if "name" in values else record["run_id"],
        seed=values.get("seed"),
        status=values.get("status", "interrupted"),
        created=_in_utc(values["created"]) if "created" in values else None,
        owner=values.get("owner", {}),
        config=values.get("config", {}),
        summary=_parse_summary(values.get("summary", {}), "summary.", problems),
        archive=_archive(values.get("archive") or {}, problems),
        provenance=values.get("provenance", {}),
        proof=values.get("proof"),
        recording=values.get("recording"),
        problems=tuple(problems),
    )


def parse_result(record: Mapping[str, object], problems: list[str]) -> Summary:
    """Return a recording's result; a line is appended to `problems` for each invalid value."""
    return _parse_summary(_without_deep_values(record, problems), "", problems)


def _parse_summary(record: JsonView, prefix: str, problems: list[str]) -> Summary:
    values = _valid(record, _SUMMARY, prefix, problems)
    fields = {key: values[key] for key in _SUMMARY if values.get(key) is not None}
    for key, make, checks in _NESTED:
        if key in fields:
            figures = _valid(fields[key], checks, f"{prefix}{key}.", problems)
            values[key] = figures
            fields[key] = make({name: figures.get(name) for name in checks})
    return Summary(**fields, values_by_key=values)


def _without_deep_values(record: Mapping[str, object], problems: list[str]) -> Mapping[str, object]:
    if not is_too_deep(record):
        return record
    problems.append(f"found values nested more than {MAX_JSON_DEPTH} deep")
    return {key: value for key, value in record.items() if not is_too_deep(value, 1)}


def run_title(name: str, seed: int | None) -> str:
    """Return a run's name, and its seed if it has one: `patient, seed 3`."""
    return name if seed is None else f"{name}, seed {seed}"


def _valid(record: JsonView, checks: Mapping[str, Check], prefix: str, problems: list[str]) -> Json:
    """Return the valid values, and those without a check; name the others in `problems`."""
    values = {}
    for key, value in record.items():
        check = checks.get(key)
        if check is None or check.fits(value):
            values[key] = value
        else:
            problems.append(f"{prefix}{key}: found {_quoted(value)}, expected {check.expected}")
    return values


def _archive(record: JsonView, problems: list[str]) -> ArchiveReference:
    values = _valid(record, _ARCHIVE, "archive.", problems)
    done = _parse_summary(values.get("done") or {}, "archive.done.", problems)
    return ArchiveReference(values.get("target", ""), values.get("digest") or "", done)


def _quoted(value: object) -> str:
    if isinstance(value, Mapping):
        return "an object"
    if isinstance(value, list):
        return "a list"
    with contextlib.suppress(ValueError):  # of a number with too many digits to be shown
        return shortened(repr(value), _QUOTED)
    return "a number of many digits"


def _in_utc(text: str) -> datetime:
    return datetime.fromisoformat(text).astimezone(UTC)


def _is_moment(value: object) -> bool:
    if isinstance(value, str):
        with contextlib.suppress(ValueError, OverflowError):  # the latter of a date at the end of time
            return bool(_in_utc(value))
    return False


def _is_count(value: object) -> bool:
    return type(value) is int and 0 <= value < _LARGEST


def _is_text(value: object) -> TypeGuard[str]:
    return isinstance(value, str)


def _maps_to(fits: Callable[[object], bool]) -> Callable[[object], bool]:
    return lambda value: isinstance(value, Mapping) and all(map(fits, value.values()))


def _optional(check: Check) -> Check:
    return Check(lambda value: value is None or check.fits(value), f"{check.expected} or null")


def _within(lowest: float = -math.inf, highest: float = math.inf) -> Check:
    if math.isfinite(highest):
        expected = f"a number from {lowest:g} to {highest:g}"
    else:
        expected = f"a finite number from {lowest:g} up" if math.isfinite(lowest) else "a finite number"
    return Check(lambda value: is_number(value) and lowest <= value <= highest, expected)


_DIGEST: Final = Check(
    lambda value: _is_text(value) and re.fullmatch(r"[0-9A-Za-z]{1,128}", value) is not None, "a digest"
)
_COUNT: Final = Check(_is_count, "a whole number from 0 up")
_TEXT: Final = Check(_is_text, "a text")
_OBJECT: Final = Check(lambda value: isinstance(value, Mapping), "an object")
_NUMBER: Final = _within()
_LENGTH: Final = _within(0)
_STATUS: Final = Check(lambda value: value in STATED_STATUSES, f"one of {', '.join(STATED_STATUSES)}")

_EVALUATION: Final = {
    "episode": _optional(_COUNT),
    **{metric.name: _optional(_within(metric.lowest, metric.highest)) for metric in METRICS},
    "trials": _optional(_COUNT),
}
_RECENT: Final = {
    "episodes": _optional(_COUNT),
    "mean_length": _optional(_LENGTH),
    "mean_return": _optional(_NUMBER),
}
_NESTED: Final = (
    ("last_evaluation", EvaluationMetrics.of, _EVALUATION),
    ("recent_training", lambda figures: RecentTraining(**figures), _RECENT),
)
_SUMMARY: Final = {
    "status": Check(lambda value: value in STATED_STATUSES[1:], f"one of {', '.join(STATED_STATUSES[1:])}"),
    "content_digest": _optional(_DIGEST),
    "topic_digests": Check(_maps_to(_is_text), "an object of texts"),
    "train_steps": _COUNT,
    "eval_steps": _COUNT,
    "episodes": _COUNT,
    "messages": Check(_maps_to(_is_count), "an object of whole numbers from 0 up"),
    "steps_recorded": Check(lambda value: isinstance(value, bool), "true or false"),
    "last_evaluation": _optional(_OBJECT),
    "recent_training": _optional(_OBJECT),
    "logged": Check(
        _maps_to(lambda value: value is None or is_number(value)), "an object of finite numbers or nulls"
    ),
    "rewards_off_table": _COUNT,
    "seconds": _optional(_LENGTH),
    "bytes": _COUNT,
    "error": _optional(_TEXT),
    "unfolded": Check(_maps_to(_is_text), "an object of texts"),
}
_ARCHIVE: Final = {"target": _TEXT, "digest": _optional(_TEXT), "done": _optional(_OBJECT)}
_REQUIRED: Final = ("name", "seed", "status", "created")
_RUN: Final = {
    "name": Check(
        lambda value: _is_text(value) and 0 < len(value) <= 1000, "a text of 1 to 1,000 characters"
    ),
    "seed": Check(lambda value: type(value) is int and 0 <= value < 2**64, "a whole number of 64 bits"),
    "status": _STATUS,
    "created": Check(_is_moment, "a date and time such as 2026-01-31T10:00:00+00:00"),
    "owner": _OBJECT,
    "config": _OBJECT,
    "summary": _OBJECT,
    "archive": _optional(_OBJECT),
    "provenance": Check(_maps_to(_is_text), "an object of texts"),
    "proof": _optional(_DIGEST),
    "recording": _TEXT,
}

MAX_RUN_FILE_BYTES: Final = 8 << 20
HEARTBEAT_SECONDS: Final = 15.0
"""On another host, a run without a heartbeat for this long counts as interrupted."""


def owner() -> Json:
    """Return the identity of this process: host, boot, process id and start."""
    return {"host": socket.gethostname(), **_of_process(os.getpid())}


@lru_cache(1)
def _of_process(pid: int) -> dict[str, object]:
    """Return what does not change while this process lives."""
    return {"boot_id": boot_id(), "pid": pid, "process_started": process_start(pid)}


def is_alive(owner: JsonView, heartbeat: Path) -> bool:
    """Return whether an owner is alive: its process, if it is on this machine; else by its last heartbeat.

    Args:
        heartbeat: the file whose modification time is set at each heartbeat.
    """
    if owner.get("host") == socket.gethostname() and owner.get("boot_id") == boot_id():
        started = process_start(owner.get("pid", 0))
        return started is not None and started == owner.get("process_started")
    with contextlib.suppress(OSError):
        return time.time() - heartbeat.stat().st_mtime < HEARTBEAT_SECONDS
    return False


def is_owned(folder: Path) -> bool:
    """Return whether a living process owns the run in a folder, according to its `run.json`."""
    try:
        facts = read_object(folder / "run.json", MAX_RUN_FILE_BYTES)
    except (OSError, ValueError):
        return False
    process = facts.get("owner")
    return (
        facts.get("status") == "running"
        and isinstance(process, dict)
        and is_alive(process, folder / "run.json")
    )


def boot_id() -> str:
    """Return an identifier of this boot of the machine."""
    with contextlib.suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    import psutil

    return f"{psutil.boot_time():.0f}"


def process_start(pid: int) -> float | None:
    """Return when a process started, comparable within one boot of the machine; None if there is none.

    On Linux it is counted in ticks since the boot, so that setting the clock changes nothing.
    """
    if not isinstance(pid, int) or isinstance(pid, bool):
        return None  # a file may contain anything
    with contextlib.suppress(OSError, ValueError, IndexError):
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return None if fields[0] == "Z" else float(fields[19])
    if Path("/proc/self/stat").exists():
        return None
    import psutil

    try:
        process = psutil.Process(pid)
        return None if process.status() == psutil.STATUS_ZOMBIE else process.create_time()
    except (psutil.Error, ValueError, TypeError, OverflowError):
        return None
