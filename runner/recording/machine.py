"""How a recording went on its machine: the time that passed, and what the process used.

`/clock` has a sample of the time about once a second. A session is the time in which one process records; the
pause before a run is resumed does not count. `/host` has what a training uses: processor, memory, GPUs, disk
and network, measured about once a second by the thread of `observer`, for all runs of a process at once.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.messages import encode
from runner.recording.reader import Recording
from runner.recording.schema import STEP_NANOSECONDS
from runner.util.arrays import Floats, Ints

if TYPE_CHECKING:
    import psutil

SAMPLE_SECONDS: Final = 1.0
_SAMPLES_A_DURATION: Final = 3600
"""After an hour samples become rarer, so that their interval stays this fraction of the duration."""
MAX_SAMPLES: Final = 1 << 20
_MAX_SECONDS: Final = 1e10


def interval(seconds: float) -> float:
    """Return after how many seconds the next sample is due in a session that has lasted `seconds`."""
    return max(SAMPLE_SECONDS, seconds / _SAMPLES_A_DURATION)


class Stopwatch:
    """Measures a session, which begins at the first call of `begin`."""

    def __init__(self) -> None:
        self.started = 0.0
        """When the session began, in seconds since 1970, UTC."""
        self._origin: float | None = None
        self._next = 0.0

    def begin(self) -> bool:
        """Begin the session, unless it has begun; return whether it begins now."""
        if self._origin is not None:
            return False
        self.started = time.time()
        self._origin = time.monotonic()
        self._next = SAMPLE_SECONDS
        return True

    def is_due(self) -> bool:
        """Return whether it is time for another sample, and plan the next one."""
        if self.seconds < self._next:
            return False
        self._next = self.seconds + interval(self.seconds)
        return True

    @property
    def seconds(self) -> float:
        """Seconds since the beginning of the session; 0 before."""
        return 0.0 if self._origin is None else time.monotonic() - self._origin

    def seconds_at(self, monotonic: float) -> float:
        """Return the seconds since the beginning of the session at a time of `time.monotonic`."""
        return -math.inf if self._origin is None else monotonic - self._origin

    def sample(self) -> bytes:
        """Return a `dualtaxi.Clock`: the time now."""
        return encode(schema.CLOCK, {"started": self.started, "seconds": self.seconds})


@dataclass(frozen=True, eq=False)
class Clock:
    """How much time had passed after how many steps, without pauses before a run was resumed."""

    positions: Ints
    """[samples], never decreasing: steps executed so far, of training and evaluation together."""
    seconds: Floats
    """[samples], never decreasing."""
    started: Floats
    """[samples]: when the session of the sample began, in seconds since 1970, UTC."""
    earlier: Mapping[float, float] = field(default_factory=dict)
    """When each session began -> the seconds that had been recorded before."""

    @property
    def duration(self) -> float:
        """The seconds that were recorded."""
        return float(self.seconds[-1])

    @property
    def steps_a_second(self) -> float | None:
        """The mean rate, of training and evaluation together; None if no step or no time was recorded."""
        steps = int(self.positions[-1] - self.positions[0])
        return steps / self.duration if steps and self.duration > 0 else None

    def seconds_at(self, positions: Ints) -> Floats:
        """Return the seconds that had passed at each number of steps, interpolated between samples.

        Args:
            positions: [n], numbers of steps of training and evaluation together: of any message
                `log_time // STEP_NANOSECONDS`. After the last sample time stands still.
        """
        after = np.searchsorted(self.positions, positions, side="left")
        i = np.minimum(after, len(self.positions) - 1)
        before = np.maximum(after - 1, 0)
        gap = self.positions[i] - self.positions[before]
        done = (np.asarray(positions) - self.positions[before]) / np.maximum(gap, 1)
        passed = self.seconds[i] - self.seconds[before]
        return np.asarray(self.seconds[before] + np.clip(done, 0.0, 1.0) * passed)

    def run_seconds(self, started: Floats, seconds: Floats) -> Floats:
        """Return the seconds of the run for seconds of its sessions, [n]; `started` are their beginnings."""
        return seconds + [self.earlier.get(start, 0.0) for start in started.tolist()]


def read_clock(recording: Recording) -> Clock | None:
    """Return the clock of a recording; None if it has no samples.

    Raises:
        RecordingError: samples are damaged, or more than 1,048,576.
    """
    rows: list[tuple[int, float, float]] = []
    for fields in recording.table(schema.CLOCK_TOPIC).decoded(max_bytes=1024):
        row = (fields["log_time"] // STEP_NANOSECONDS, fields["seconds"], fields["started"])
        if len(rows) == MAX_SAMPLES or not all(map(math.isfinite, row)) or not 0 <= row[1] < _MAX_SECONDS:
            raise RecordingError(
                f"{recording.path}: {schema.CLOCK_TOPIC.name}: found {fields['seconds']} seconds in sample "
                f"{len(rows)}, expected at most {MAX_SAMPLES:,} samples of less than {_MAX_SECONDS:g} s."
            )
        rows.append(row)
    if not rows:
        return None
    positions = np.array([row[0] for row in rows], np.int64)
    seconds, started = np.array([row[1:] for row in rows]).T
    ends = np.flatnonzero(started[1:] != started[:-1])
    earlier = np.zeros(len(rows))
    earlier[ends + 1] = seconds[ends]
    earlier = np.cumsum(earlier)
    seconds = seconds + earlier
    if (np.diff(positions) < 0).any() or (np.diff(seconds) < 0).any():
        raise RecordingError(f"{recording.path}: {schema.CLOCK_TOPIC.name}: found a clock that goes back.")
    return Clock(positions, seconds, started, dict(zip(started.tolist(), earlier.tolist(), strict=True)))


MAX_GPUS: Final = 64
_CHILDREN_SECONDS: Final = 10.0
"""Interval at which child processes are looked for, which takes milliseconds where many processes run."""
_BYTES: Final = 8192
"""The largest message that is read."""
_STAMPS: Final = ("started", "seconds")
GPU_FIELDS: Final = tuple(field.name for field in schema.HOST.fields if field.repeated)
FIELDS: Final = tuple(
    field.name for field in schema.HOST.fields if not field.repeated and field.name not in _STAMPS
)


class HostSampler:
    """Measures this process, its children and the host. Not thread-safe."""

    def __init__(self) -> None:
        import psutil

        self._psutil = psutil
        self._process = psutil.Process()
        self._children: list[psutil.Process] = []
        self._looked = -math.inf
        self._before: tuple[float, float] | None = None
        """When the last sample was taken, and the processor time until then."""
        self._hidden = psutil.Error, OSError, RuntimeError, NotImplementedError
        """The errors for what a system does not tell."""
        with contextlib.suppress(*self._hidden):
            psutil.cpu_percent()  # the next call measures from here
        self._gpus: list[object] = []
        """Handles of the GPUs of NVIDIA; none without its driver or without the library (the extra `gpu`)."""
        with contextlib.suppress(Exception):  # the library may be of another version, or of another package
            import pynvml

            self._nvml = pynvml
            pynvml.nvmlInit()
            count = min(pynvml.nvmlDeviceGetCount(), MAX_GPUS)
            self._gpus = [pynvml.nvmlDeviceGetHandleByIndex(k) for k in range(count)]
        self.sample()

    def sample(self) -> dict[str, float | list[float]]:
        """Return the values of `FIELDS` and `GPU_FIELDS`, but `disk_free_bytes`; NaN where one is unknown.

        Percentages of the processor are means since the last call.
        """
        psutil = self._psutil
        now = time.monotonic()
        if now - self._looked > _CHILDREN_SECONDS:
            self._looked = now
            with contextlib.suppress(psutil.Error, OSError):
                self._children = self._process.children(recursive=True)
        processor, memory = self._used()
        cpu = math.nan
        if self._before is not None and now > self._before[0]:
            cpu = max(0.0, 100 * (processor - self._before[1]) / (now - self._before[0]))
        self._before = (now, processor)
        values: dict[str, float | list[float]] = dict.fromkeys(FIELDS, math.nan)
        values |= {"cpu_percent": cpu, "memory_bytes": memory}
        # The system may hide each of these, as in a container.
        with contextlib.suppress(*self._hidden):
            host = psutil.virtual_memory()
            values["host_memory_bytes"] = float(host.total - host.available)
            values["host_memory_total"] = float(host.total)
            values["host_cpu_percent"] = float(psutil.cpu_percent())
        with contextlib.suppress(*self._hidden):
            if (disk := psutil.disk_io_counters()) is not None:
                values["disk_read_bytes"] = float(disk.read_bytes)
                values["disk_written_bytes"] = float(disk.write_bytes)
        with contextlib.suppress(*self._hidden):
            if (network := psutil.net_io_counters()) is not None:
                values["network_received_bytes"] = float(network.bytes_recv)
                values["network_sent_bytes"] = float(network.bytes_sent)
        return values | self._sample_gpus()

    def _used(self) -> tuple[float, float]:
        """Return processor time in seconds and resident memory in bytes, of the process and its children."""
        processor = 0.0
        memory = 0.0
        for process in (self._process, *self._children):
            with contextlib.suppress(self._psutil.Error, OSError), process.oneshot():
                times = process.cpu_times()
                processor += times.user + times.system
                if process is self._process:  # of children that have ended
                    processor += times.children_user + times.children_system
                memory += process.memory_info().rss
        return processor, memory

    def _sample_gpus(self) -> dict[str, list[float]]:
        """Return the values of `GPU_FIELDS`, one a GPU."""
        values: dict[str, list[float]] = {name: [] for name in GPU_FIELDS}
        for handle in self._gpus:
            use = used = total = math.nan
            with contextlib.suppress(Exception):  # each of its errors is a class of its own
                memory = self._nvml.nvmlDeviceGetMemoryInfo(handle)
                used, total = float(memory.used), float(memory.total)
                use = float(self._nvml.nvmlDeviceGetUtilizationRates(handle).gpu)
            for name, value in zip(GPU_FIELDS, (use, used, total), strict=True):
                values[name].append(value)
        return values


@dataclass(frozen=True, eq=False)
class HostMetrics:
    """What a run used of its machine; NaN where a value is unknown."""

    positions: Ints
    """[samples]: steps executed so far, of training and evaluation together."""
    seconds: Floats
    """[samples]: as in the clock."""
    values: Mapping[str, Floats]
    """Each of `FIELDS`, [samples]; each of `GPU_FIELDS`, [samples, GPUs]."""
    started: Floats = field(repr=False)
    """[samples]: when the session of the sample began."""

    @cached_property
    def gpus(self) -> int:
        """The number of GPUs."""
        return int(self.values[GPU_FIELDS[0]].shape[1])

    @property
    def largest(self) -> dict[str, float]:
        """The largest use of memory, in bytes, and `disk_free_bytes` at the end; only what is known."""
        names = ("memory_bytes", "host_memory_total", "gpu_memory_bytes")
        values = {name: self.values[name] for name in names}
        values["disk_free_bytes"] = self.values["disk_free_bytes"][-1:]
        finite = {name: column[np.isfinite(column)] for name, column in values.items()}
        return {name: float(column.max()) for name, column in finite.items() if column.size}

    def rate(self, name: str) -> Floats:
        """Return the bytes a second of a counter, [samples]; NaN for the first sample of a session."""
        counts = self.values[name]
        rate = np.full(len(counts), np.nan)
        passed = np.diff(self.seconds)
        same = (np.diff(self.started) == 0) & (passed > 0)
        rate[1:][same] = np.diff(counts)[same] / passed[same]
        return np.where(rate < 0, np.nan, rate)


def read_host(recording: Recording, clock: Clock | None) -> HostMetrics | None:
    """Return what a run used of its machine; None if that was not recorded.

    Raises:
        RecordingError: samples are damaged, or too many.
    """
    rows: list[tuple[float, ...]] = []
    gpus: list[list[list[float]]] = []
    name = schema.HOST_TOPIC.name
    for fields in recording.table(schema.HOST_TOPIC).decoded(max_bytes=_BYTES):
        measures = [fields[name] for name in GPU_FIELDS]
        counts = [*map(len, measures)]
        if len(rows) == MAX_SAMPLES or len(set(counts)) > 1 or counts[0] > MAX_GPUS:
            raise RecordingError(
                f"{recording.path}: {name}: found {counts} values of GPUs in sample "
                f"{len(rows)}, expected at most {MAX_SAMPLES:,} samples, with at most {MAX_GPUS} GPUs each."
            )
        rows.append((fields["log_time"] // STEP_NANOSECONDS, *(fields[name] for name in (*_STAMPS, *FIELDS))))
        gpus.append(measures)
    if not rows:
        return None
    positions = np.array([row[0] for row in rows], np.int64)
    started, seconds, *columns = np.array([row[1:] for row in rows]).T
    if not np.isfinite([started, seconds]).all():
        raise RecordingError(f"{recording.path}: {name}: found a time that is not finite.")
    widest = max(len(measures[0]) for measures in gpus)
    per_gpu = np.full((len(GPU_FIELDS), len(rows), widest), np.nan)
    for k, measures in enumerate(gpus):
        per_gpu[:, k, : len(measures[0])] = measures
    values = dict(zip(FIELDS, columns, strict=True)) | dict(zip(GPU_FIELDS, per_gpu, strict=True))
    seconds = seconds if clock is None else clock.run_seconds(started, seconds)
    return HostMetrics(positions, seconds, values, started)
