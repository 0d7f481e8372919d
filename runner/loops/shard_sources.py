"""The processes of a run as it is folded: what each recorded, in units that begin with a reset.

A unit is a reset of one environment, and the steps that it took up to its next reset.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import numpy as np

from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.integrity import check_up_to_cut
from runner.recording.layout import MAGIC
from runner.recording.metadata import kind_of
from runner.recording.reader import Recording, open_recording
from runner.recording.repair import can_be_repaired
from runner.recording.schema import STEP_NANOSECONDS
from runner.recording.steps import is_of_environment, is_taken
from runner.recording.topic_chunks import FOREVER, TopicChunks
from runner.runs.run import RECORDING_FILE, RUN_FILE, Run, run_in
from runner.runs.shards import shard_folders
from runner.util.arrays import Ints, Records
from runner.util.files import open_regular

PHASES: Final = tuple(schema.PHASES)
_NUMBERS: Final = ("source", "position", "phase", "environment", "reset", "first", "stop", "steps")
_NEW_NUMBERS: Final = ("new_step", "new_position", "new_episode", "new_reset")
UNIT: Final = np.dtype([("key", "f8"), *((name, "i8") for name in (*_NUMBERS, *_NEW_NUMBERS))])
"""A unit: `key` is how many training steps of the whole run it comes after; `position`, `reset`, `first` and
`stop` (steps of the phase) are as its process counted them, `steps` is how many it took; the `new_`
fields are its numbers in the run."""
_OWN_TOPICS: Final = (*schema.MACHINE_TOPICS, schema.EXTRA_COLUMNS_TOPIC)
"""Topics of one process alone, or recorded again, as are episodes, which follow from the steps."""
_RESET: Final = ("reset", "step", "environment", "log_time")


class Source:
    """What one process recorded.

    Args:
        name: of the shard; empty for the process that began the run.
        number: its place among the processes of the run.
        environment: the number that its first environment has in the run.
        is_placed: whether its process stated after how many training steps of the run it recorded.
        stated: the number of messages of each topic, as its process stated it at its end; empty if it was
            killed.
    """

    def __init__(
        self,
        name: str,
        recording: Recording,
        number: int,
        environment: int,
        is_placed: bool,
        stated: Mapping[str, int],
    ) -> None:
        self.name = name
        self.recording = recording
        self.number = number
        self.environment = environment
        self.stated = stated
        self.is_placed = is_placed
        self.n = recording.environments
        self.stops = {phase: self._stop(phase) for phase in PHASES}
        """Steps of each phase."""
        self.only_resets = {phase: self._only_resets(phase) for phase in PHASES}
        """The numbers of the steps at which an environment was only reset."""
        self.taken = {phase: self.stops[phase] - len(self.only_resets[phase]) for phase in PHASES}
        self.units = {phase: self._units(phase) for phase in PHASES}

    def _stop(self, phase: str) -> int:
        """Return the steps of a phase, up to the first that is lost or may lack its reset."""
        tables = self.recording.phase(phase)
        (step, _), (_, last_reset) = map(self._first_gap, (tables.steps, tables.resets))
        return min(tables.whole_steps(), step, last_reset) // self.n * self.n

    def _first_gap(self, table: TopicChunks) -> tuple[int, int]:
        """Return the number of the first message that a repair lost, and the `step` of the last one before.

        Both are `FOREVER` if none was lost.
        """
        if not self.recording.lost.get(table.topic.name):
            return FOREVER, FOREVER
        number = last = 0
        for rows in table.rows():
            numbers = rows[schema.NUMBERED_BY[table.topic.message]]
            count = int(np.append(numbers == number + np.arange(len(rows)), False).argmin())
            number += count
            last = int(rows["step"][count - 1]) if count else last
            if count < len(rows):
                break
        return number, last

    def _only_resets(self, phase: str) -> Ints:
        steps = self.recording.phase(phase).steps
        blocks = steps.numbered(range(self.stops[phase] if steps.have_turns else 0))
        return np.concatenate([np.empty(0, np.int64), *(block["step"][~is_taken(block)] for block in blocks)])

    def _units(self, phase: str) -> Records:
        """Return the units of a phase, ordered by environment, without key and new numbers."""
        table = self.recording.phase(phase).resets
        stop = self.stops[phase]
        dtype = np.dtype([(name, "i8") for name in _RESET])
        parts = (block[list(_RESET)].astype(dtype) for block in table.rows())
        resets = np.concatenate([np.empty(0, dtype), *parts])
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
        other = next(name for name in PHASES if name != phase)
        if not self.stops[phase]:
            return 0
        if not self.stops[other] and not self.is_placed:
            return min(position, self.stops[phase])
        time = position * STEP_NANOSECONDS + 1
        first = self.recording.phase(phase).steps.first_from("log_time", time)
        return min(first, self.stops[phase])

    # --- what a unit holds, read in the order of the run ----------------------------------------------

    def reset(self, phase: str, unit: np.void) -> np.void:
        """Return the reset of a unit."""
        return self.recording.phase(phase).resets.one(int(unit["reset"]))

    def steps(self, phase: str, unit: np.void) -> Iterator[tuple[Records, Ints]]:
        """Yield the steps of a unit in pieces, with their numbers in the phase of its process."""
        numbers = range(int(unit["first"]), int(unit["stop"]))
        for block in self.recording.phase(phase).steps.numbered(numbers):
            rows = block[is_of_environment(block, int(unit["environment"]))]
            if len(rows):
                yield rows, rows["step"].astype(np.int64)

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

    def left_out(self, read: Mapping[str, int]) -> str:
        """Return how much of what the process recorded is in the run, if not all of it is.

        Args:
            read: the number of messages by topic that the fold read.
        """
        steps, others = [], []
        for topic in self.recording.topics:
            if topic.name.endswith("/episode") or topic in _OWN_TOPICS:
                continue
            copied = read.get(topic.name, 0)
            recorded = self.stated.get(topic.name, 0)
            recorded = max([recorded, *(stop for _, stop in self.recording.lost.get(topic.name, []))])
            if topic.message is schema.STEP:
                copied = self.stops[topic.phase]
                recorded = max(recorded, self.recording.phase(topic.phase).steps.total())
                if copied < recorded:
                    steps.append(f"{copied:,} of {recorded:,} {schema.PHASE_NAMES[topic.phase]} steps")
            elif copied < recorded:
                others.append(f"{copied:,} of {recorded:,} messages of {topic.name}")
        return ", ".join(steps or others)


def open_sources(run: Run, stack: ExitStack) -> tuple[list[Source], dict[str, str]]:
    """Open what each process of a run recorded; leave out processes that joined and recorded nothing.

    Returns also why recordings are to be kept, by name: they cannot be folded, or it is not known how much
    they lack.

    Raises:
        RecordingError: a recording is damaged, and can be repaired.
    """
    sources: list[Source] = []
    left_out: dict[str, str] = {}
    first = 0
    for folder in [run.folder, *shard_folders(run)]:
        name = folder.name if folder != run.folder else ""
        part = run_in(folder)
        path = folder / RECORDING_FILE
        stated = part.summary.messages if part is not None else {}
        try:
            check_up_to_cut(path)  # every byte is good, up to the end or to where it was cut off
            recording = stack.enter_context(open_recording(path))
            if not sources and recording.tabular:  # the run is described as in its first recording
                recording.mdp  # noqa: B018 - an attachment may be lost
        except RecordingError as error:
            if can_be_repaired(path):
                raise
            if any(stated.values()) or _is_foreign(path):
                expected = f"expected {sum(stated.values()):,} messages" if stated else "expected a recording"
                left_out[name] = f"{str(error).removeprefix(f'{path}: ').rstrip('.')}; {expected}."
            continue
        if sources and (other := _difference(recording, sources[0].recording)):
            left_out[name] = other
            continue
        if name and not any(recording.table(topic) for topic in recording.topics if topic.digested):
            if any(stated.values()):
                left_out[name] = f"found no messages, expected {sum(stated.values()):,}."
            continue
        if name and not recording.file.finished and not (folder / RUN_FILE).is_file():
            left_out[name] = "was cut off, and its run.json is missing, which states how much there was."
        is_placed = part is not None and part.facts.get("placed") is True
        sources.append(Source(name, recording, len(sources), first, is_placed, stated))
        first += recording.environments
    return sources, left_out


def _difference(recording: Recording, first: Recording) -> str:
    """Return why a recording cannot be put together with the first one; empty if it can."""
    facts, expected = (
        {"kind": kind_of(source.run), "agents": list(source.agents), **_comparable(source.spaces)}
        for source in (recording, first)
    )
    if facts == expected:
        return ""
    key = next(key for key in expected if facts.get(key) != expected[key])
    return f"found {key} {facts.get(key)}, expected {expected[key]} as in the other processes."


def _comparable(description: Any) -> Any:
    """Return the description of spaces without dtypes and bounds, which actions may widen."""
    if isinstance(description, dict):
        widened = ("dtype", "low", "high")
        return {key: _comparable(value) for key, value in description.items() if key not in widened}
    return [*map(_comparable, description)] if isinstance(description, list) else description


def _is_foreign(path: Path) -> bool:
    """Return whether a file begins with anything but a recording, or nothing."""
    with contextlib.suppress(OSError), open_regular(path) as stream:
        start = stream.read(len(MAGIC))
        return any(start) and not MAGIC.startswith(start)
    return False
