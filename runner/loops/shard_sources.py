"""The processes of a run as it is folded: what each recorded, in units that begin with a reset.

A unit is a reset of one environment, and the steps that it took up to its next reset.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.messages import Message
from runner.recording.reader import Recording, open_recording
from runner.recording.repair import DamagedFile
from runner.recording.schema import STEP_NANOSECONDS
from runner.runs.run import RECORDING_FILE, Run
from runner.runs.shards import shards_of
from runner.util.arrays import Ints, Records
from runner.util.files import open_regular

PHASES: Final = tuple(schema.PHASES)
UNIT: Final = np.dtype(
    [
        ("key", "f8"),
        ("source", "i8"),
        ("position", "i8"),
        ("phase", "i8"),
        ("environment", "i8"),
        ("reset", "i8"),
        ("first", "i8"),
        ("stop", "i8"),
        ("steps", "i8"),
        ("new_step", "i8"),
        ("new_position", "i8"),
        ("new_episode", "i8"),
        ("new_reset", "i8"),
    ]
)
"""A unit: `key` is how many training steps of the whole run it comes after; `position`, `reset`, `first` and
`stop` (steps of the phase) are as its process counted them, `steps` those that it took; the `new_` ones are
its numbers in the run."""
_RESET: Final = ("reset", "step", "environment", "log_time")


class Source:
    """What one process recorded.

    Args:
        name: of the shard; empty for the process that began the run.
        number: its place among the processes of the run.
        environment: the number of its first environment among those of the run.
        is_placed: whether its process stated after how many training steps of the run it recorded.
    """

    def __init__(
        self, name: str, recording: Recording, number: int, environment: int, is_placed: bool
    ) -> None:
        self.name, self.recording, self.number, self.environment = name, recording, number, environment
        self.is_placed = is_placed
        self.n = recording.environments
        self.stops = {phase: self._stop(phase) for phase in PHASES}
        """Steps of each phase."""
        self.only_resets = {phase: self._only_resets(phase) for phase in PHASES}
        """The numbers of those at which an environment was only reset."""
        self.taken = {phase: self.stops[phase] - len(self.only_resets[phase]) for phase in PHASES}
        self.units = {phase: self._units(phase) for phase in PHASES}
        self._messages: dict[str, Iterator[Message]] = {}
        self.times = {phase: self._times(phase) for phase in PHASES}
        """`log_time` of each step where values vary in size; else empty."""

    def _topic(self, phase: str, name: str) -> schema.Topic:
        return self.recording.topic(f"/{phase}/{name}")

    @property
    def _is_fixed(self) -> bool:
        return self.recording.kind != "variable"

    def _stop(self, phase: str) -> int:
        """Return the steps of a phase, up to the first that a repair could not save."""
        lost = self.recording.lost.get(f"/{phase}/step")
        stop = self.recording.whole_steps(phase)
        return min(stop, lost[0][0] // self.n * self.n) if lost else stop

    def _only_resets(self, phase: str) -> NDArray[np.int64]:
        maker = self.recording.maker
        if self.n == 1 and (maker is None or maker.kind != "vector"):
            return np.empty(0, np.int64)
        blocks = self.recording.blocks(self._topic(phase, "step"), 0, self.stops[phase])
        parts = [block["step"][block["t"] == schema.RESET_ONLY] for block in blocks]
        return np.concatenate([np.empty(0, np.int64), *parts])

    def _times(self, phase: str) -> NDArray[np.int64]:
        if self._is_fixed:
            return np.empty(0, np.int64)
        steps = self.recording.decoded(self._topic(phase, "step"))
        return np.array([step["log_time"] for step in steps], np.int64)[: self.stops[phase]]

    def _units(self, phase: str) -> NDArray[np.void]:
        """Return the units of a phase, ordered by environment, without key and new numbers."""
        topic, stop = self._topic(phase, "reset"), self.stops[phase]
        if self._is_fixed:
            dtype = np.dtype([(name, "i8") for name in _RESET])
            parts = [np.empty(0, dtype)]
            for block in self.recording.blocks(topic):
                part = np.empty(len(block), dtype)
                for name in _RESET:
                    part[name] = block[name]
                parts.append(part)
            resets = np.concatenate(parts)
        else:
            rows = [tuple(each[name] for name in _RESET) for each in self.recording.decoded(topic)]
            resets = np.array(rows, [(name, "i8") for name in _RESET])
        resets = resets[(resets["step"] <= stop) & (resets["environment"] < self.n)]
        resets = resets[np.lexsort((resets["reset"], resets["environment"]))]
        units = np.zeros(len(resets), UNIT)
        units["source"], units["phase"] = self.number, PHASES.index(phase)
        units["position"] = resets["log_time"] // STEP_NANOSECONDS
        units["reset"], units["environment"] = resets["reset"], resets["environment"]
        units["first"] = resets["step"] + resets["environment"]
        units["stop"] = stop + resets["environment"]
        same = units["environment"][1:] == units["environment"][:-1]
        units["stop"][:-1][same] = units["first"][1:][same]
        units["steps"] = (units["stop"] - units["first"]) // self.n
        units["steps"] -= np.isin(units["first"], self.only_resets[phase]) & (units["steps"] > 0)
        return units

    def phase_steps(self, phase: str, position: int) -> int:
        """Return the steps of a phase that were taken by a position, as its process counted it."""
        other = next(each for each in PHASES if each != phase)
        if not self.stops[phase]:
            return 0
        if not self.stops[other] and not self.is_placed:
            return min(position, self.stops[phase])
        time = position * STEP_NANOSECONDS + 1
        if not self._is_fixed:
            return int(np.searchsorted(self.times[phase], time))
        first = self.recording.first_from(self._topic(phase, "step"), "log_time", time)
        return min(first, self.stops[phase])

    # --- what a unit holds, read in the order of the run ----------------------------------------------

    def reset(self, phase: str, unit: np.void) -> np.void | Message:
        """Return the reset of a unit."""
        topic, number = self._topic(phase, "reset"), int(unit["reset"])
        if self._is_fixed:
            record: np.void = next(self.recording.blocks(topic, number, number + 1))[0]
            return record
        return next(self._stream(f"/{phase}/reset"))

    def steps(self, phase: str, unit: np.void) -> Iterator[tuple[Records | list[Message], Ints]]:
        """Yield the steps of a unit in pieces, with their numbers in the phase of its process."""
        first, stop = int(unit["first"]), int(unit["stop"])
        if first >= stop:
            return
        if not self._is_fixed:
            stream = self._stream(f"/{phase}/step")
            for begin in range(first, stop, 1024):
                numbers = np.arange(begin, min(begin + 1024, stop))
                yield [next(stream) for _ in numbers], numbers
            return
        for block in self.recording.blocks(self._topic(phase, "step"), first, stop):
            rows = block[(first - int(block["step"][0])) % self.n :: self.n]
            rows = rows[rows["t"] != schema.RESET_ONLY]
            if len(rows):
                yield rows, rows["step"].astype(np.int64)

    def _stream(self, name: str) -> Iterator[Message]:
        """Return the messages of a topic of varying size; units of one environment come in their order."""
        if name not in self._messages:
            self._messages[name] = self.recording.decoded(self.recording.topic(name))
        return self._messages[name]

    # --- where messages go ----------------------------------------------------------------------------

    def step_place(self, phase: str, step: int) -> tuple[int, int]:
        """Return number and position in the run of a step, by its number in the phase of its process."""
        unit = self.unit(phase, step % self.n, step)
        is_only_reset = bool(np.isin(unit["first"], self.only_resets[phase]))
        offset = (step - int(unit["first"])) // self.n - is_only_reset
        offset = min(max(offset, 0), max(int(unit["steps"]) - 1, 0))
        return int(unit["new_step"]) + offset, int(unit["new_position"]) + offset + 1

    def unit(self, phase: str, environment: int, step: int) -> np.void:
        """Return the unit that a step of an environment belongs to: the last one that had begun by it."""
        units = self.units[phase]
        low, high = np.searchsorted(units["environment"], [environment, environment + 1])
        at = int(np.searchsorted(units["first"][low:high], step, side="right"))
        unit: np.void = units[low + max(at - 1, 0)]
        return unit


def open_sources(run: Run, stack: ExitStack) -> list[Source]:
    """Open what each process of a run recorded; leave out those that joined and recorded nothing.

    Raises:
        RecordingError: a recording is damaged, and holds messages.
    """
    sources: list[Source] = []
    first = 0
    for name, part in [("", run), *((shard.run_id, shard) for shard in shards_of(run))]:
        try:
            recording = stack.enter_context(open_recording(part.folder / RECORDING_FILE))
        except RecordingError:
            if _has_messages(part.folder / RECORDING_FILE):
                raise
            continue
        has_content = any(recording.has_messages(topic.name) for topic in recording.topics if topic.digested)
        if name and not has_content:
            continue
        sources.append(Source(name, recording, len(sources), first, part.facts.get("placed") is True))
        first += recording.environments
    return sources


def _has_messages(path: Path) -> bool:
    """Return whether a damaged recording holds any message."""
    if not path.is_file() or not path.stat().st_size:
        return False
    with open_regular(path) as stream:
        return any(opcode == Opcode.CHUNK for opcode, _, _ in DamagedFile(stream, path).good_records())
