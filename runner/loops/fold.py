"""The shards of a run, folded into its recording when no process records into it any more.

Each episode is kept whole, with the resets before it, and the episodes of all processes are put in one order:
by how many steps their processes had taken when they began, then by the names of the processes. So the run is
as if one loop had done all of it, and does not depend on which process was faster.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import shutil
import tempfile
import time
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from blake3 import blake3

from runner.client.outbox import forget_upload
from runner.config.loading import recorded_packing
from runner.errors import ConfigError, RecordingError, RunnerError, StorageError, truncated_message
from runner.loops.description import Copied
from runner.loops.extras import ExtrasWriter
from runner.loops.messages import Outcomes
from runner.loops.shard_sources import PHASES, UNIT, Source, open_sources
from runner.loops.step_buffer import StepBuffer
from runner.recording import schema
from runner.recording.extras import (
    MAX_EXTRA_BYTES,
    MAX_NAME_LENGTH,
    MAX_NAMES,
    NOTHING,
    ExtraLayout,
    encoded,
    united,
)
from runner.recording.layout import Layout
from runner.recording.maker import SHARD_MAKER, EnvironmentMaker, Shard
from runner.recording.messages import (
    Message,
    ResetOptions,
    ResetState,
    decode,
    encode,
    encode_image,
    encode_log,
    frame_id,
    frame_place,
    log_level,
)
from runner.recording.metadata import json_object, layout_of_run, write_result
from runner.recording.observer import Observer
from runner.recording.reader import open_recording
from runner.recording.recorder import Recorder
from runner.recording.rewriting import content_of
from runner.recording.run_file import parse_result
from runner.recording.schema import STEP_NANOSECONDS, Topic
from runner.recording.spaces import Description, leaf_dtype, parts_of
from runner.recording.writer import create_recording
from runner.runs.run import RECORDING_FILE, SHARDS_FOLDER, UNFOLDED_FOLDER, Run, run_at
from runner.runs.shards import ENDS_AS, are_over, handed_over, shard_folders, shards_locked, shards_of
from runner.runs.trust_marks import merge_marks
from runner.util.arrays import Array, Ints, Records
from runner.util.files import storage_errors
from runner.util.values import Json

_OWN_METADATA: Final = frozenset({"run", "result", "repair"})
"""The metadata that is not copied from the process that began the run."""
_NEW_FIELDS: Final = frozenset(
    {"step", "episode", "t", "environment", "taken", "reset", "log_time", "publish_time"}
)
"""The fields with new numbers in the run, and those that only the steps of a vector have."""

OWNER_WAITS: Final = 5.0
"""Seconds for which the process that began a run waits, at its end, for the others to end."""
_POLL_SECONDS: Final = 0.05
_OWN_UNFOLDED: Final = "recording.unfolded.mcap"
"""What the process that began a run recorded, if not all of it is in the run's recording."""

Report = Callable[[int, int], None]
"""Takes the steps copied so far, and how many there are."""


def fold_if_over(run: Run, seconds: float = 0.0, report: Report = lambda *_: None) -> Run:
    """Fold the shards of a run into its recording if no process records into it; return the run as it is.

    Args:
        seconds: how long to wait for the processes of its shards to end.

    Raises:
        RecordingError: a recording is damaged; all stay as they are.
        StorageError: the run's folder cannot be written; all stay as they are.
    """
    if not (run.folder / SHARDS_FOLDER).is_dir():
        return run
    deadline = time.monotonic() + seconds
    while not are_over(run_at(run.folder)) and time.monotonic() < deadline:
        time.sleep(_POLL_SECONDS)
    with shards_locked(run):
        run = run_at(run.folder)
        if not are_over(run):
            return handed_over(run)
        try:
            with storage_errors(run.folder, "free some disk; `dualtaxi repair` folds its shards in then"):
                return _fold(run, report)
        except RunnerError:
            if run.file.status != "interrupted":  # it is not complete without its shards
                with contextlib.suppress(StorageError):
                    run.update(status="interrupted", **{ENDS_AS: _ending_of_run(run)})
            raise


def _fold(run: Run, report: Report) -> Run:
    fresh = run.folder / f".{RECORDING_FILE}.folding"
    fresh.unlink(missing_ok=True)
    with ExitStack() as stack:
        sources, unusable = open_sources(run, stack)
        if not sources:
            if unusable:
                raise RecordingError(" ".join(unusable.values()))
            return run
        if sources[0].recording.shards:  # it was folded by a process that was killed before it said so
            text = sources[0].recording.file.metadata("result").get("json")
            summary = json_object(text, f"{run.recording}: the result")
        else:
            fold = _Fold(run, sources, unusable, report)
            summary = fold.write(fresh)
            fold.content.check(fresh)
    summary = {**run.file.summary, **summary}
    unfolded = parse_result(summary, []).unfolded
    if fresh.exists():
        if "" in unfolded and run.recording.exists():
            shutil.copy2(run.recording, run.folder / _OWN_UNFOLDED)
        fresh.replace(run.folder / RECORDING_FILE)
    forget_upload(run)
    facts = {key: value for key, value in run.facts.items() if key != ENDS_AS}
    ending = _ending_of_run(run, unfolded)
    folded = Run(run.folder, facts).update(status=ending, summary=summary)
    merge_marks(run.folder, shard_folders(run))
    for folder in shard_folders(run):
        if folder.name in unfolded:  # it is not whole in the run, and is kept
            (run.folder / UNFOLDED_FOLDER).mkdir(exist_ok=True)
            folder.rename(run.folder / UNFOLDED_FOLDER / folder.name)
    shutil.rmtree(run.folder / SHARDS_FOLDER)
    return folded


def _widest(a: Description, b: Description) -> Description:
    """Return the description of a space, with the wider numbers of each part of two."""
    if (parts := parts_of(a)) is None:
        return max(a, b, key=lambda leaf: np.dtype(leaf.get("dtype", "V0")).itemsize)
    pairs = zip(parts, parts_of(b) or (), strict=True)
    wider = {key: _widest(part, other) for (key, part), (_, other) in pairs}
    return {**a, "spaces": wider if a["type"] == "Dict" else [*wider.values()]}


class _Fold:
    """Writes the recordings of several processes into one.

    Args:
        sources: of its processes; the process that began it comes first, unless it recorded nothing.
        left_out: why the recordings of other processes cannot be folded, by name.
    """

    def __init__(
        self, run: Run, sources: Sequence[Source], left_out: Mapping[str, str], report: Report
    ) -> None:
        self._run = run
        self._sources = sources
        self._report = report
        self._left_out = left_out
        self._read: dict[int, Counter[str]] = {source.number: Counter() for source in sources}
        """The messages read of each process, by topic."""
        first = sources[0].recording
        self._first = first
        self._mdp = first.mdp if first.tabular else None
        self._outcomes = Outcomes(self._mdp)
        self._units = self._ordered()
        leads = sources[0].is_placed or any(sources[0].taken.values())
        self._main = sources[0] if leads else max(sources, key=lambda source: sum(source.taken.values()))
        """The process with the clock that the run takes over."""
        self._begun: dict[str, Records] = {}
        """The units of each phase in their order, once they are placed, after one of zeros."""
        self._totals = {phase: sum(source.taken[phase] for source in sources) for phase in PHASES}

    def write(self, fresh: Path) -> Json:
        """Write the new recording; return the summary of the run."""
        first = self._first
        started = time.monotonic()
        facts = self._facts()
        layout = layout_of_run(facts, str(fresh))
        packing = recorded_packing(first.config)
        self._layout = layout
        self.content = Content(layout)
        with create_recording(fresh, layout) as file:
            file.add_metadata("run", facts)
            for name in first.file.metadata_names:
                if name not in _OWN_METADATA:
                    file.add_metadata(name, first.file.metadata(name))
            for name, maker in self._own_makers().items():
                file.add_metadata(f"{SHARD_MAKER}/{name}", maker.to_metadata())
            for name, media_type, data in first.file.attachments():
                file.add_attachment(name, media_type, data)
            recorder = Recorder(file, layout, packing, observer=Observer(fresh.parent))
            recorder.watch(schema.EPISODE, self._outcomes.take_episodes)
            self._recorder = recorder
            try:
                off_table = self._copy_units()
                with tempfile.TemporaryFile(dir=fresh.parent) as spool:
                    for topic in first.topics:
                        self._copy_messages(topic, spool)
                result = recorder.totals(recorder.drain()) | self._outcomes.summary()
            except BaseException:
                recorder.abandon()
                raise
            result |= {"episodes": recorder.counts["/train/episode"], "steps_recorded": True}
            if self._mdp is not None:
                result["rewards_off_table"] = off_table
            unfolded = dict(self._left_out)
            for source in self._sources:
                if parts := source.left_out(self._read[source.number]):
                    unfolded[source.name] = f"{parts} are in the run."
            if unfolded:
                result["unfolded"] = unfolded
            failed = (shard for shard in shards_of(self._run) if shard.status == "failed")
            errors = [
                self._run.file.summary.error,
                *(f"{shard.run_id} failed: {shard.summary.error or 'of unknown cause'}" for shard in failed),
                *(_kept(name, reason) for name, reason in unfolded.items()),
            ]
            if any(errors):
                result["error"] = truncated_message("; ".join(filter(None, errors)))
            write_result(file, _ending_of_run(self._run, unfolded), result)
            result |= {"bytes": file.size}
            if (before := self._run.file.summary.seconds) is not None:  # else killed: nobody knows how long
                result["seconds"] = before + round(time.monotonic() - started, 3)
            return result

    def _facts(self) -> dict[str, str]:
        shards = [
            Shard(source.name, source.n, source.recording.status, source.taken["train"], source.taken["eval"])
            for source in self._sources
        ]
        spaces = dict(self._first.spaces)
        for source in self._sources[1:]:  # with the widest numbers of all recorded actions
            spaces["action"] = _widest(spaces["action"], source.recording.spaces["action"])
        facts = {key: value for key, value in self._first.run.items() if key != "seeded"} | {
            "run_id": self._run.run_id,
            "name": str(self._run.facts["name"]),
            "seed": str(self._run.seed),
            "created": self._run.created_text,
            "environments": "1",
            "spaces": json.dumps(spaces),
            "shards": json.dumps([vars(shard) for shard in shards]),
        }
        return facts if self._run.has_seed else facts | {"seeded": "false"}

    def _own_makers(self) -> dict[str, EnvironmentMaker]:
        """Return how the environments of shards were made, where they differ from the run's."""
        makers = {}
        for source in self._sources[1:]:
            maker = source.recording.maker
            phases = [phase for phase in PHASES if source.stops[phase]]
            others = [self._first.phase(phase).maker_of() for phase in phases]
            if maker is not None and any(other is None or not maker.is_like(other) for other in others):
                makers[source.name] = maker
        return makers

    # --- the order ------------------------------------------------------------------------------------

    def _ordered(self) -> Records:
        """Return the units of all processes in the order of the run."""
        for source in self._sources:
            for phase, units in source.units.items():
                before = units["first"] - units["environment"]
                position = units["position"]
                trained = before if phase == "train" else position - before
                units["key"] = self._keys(source, position, trained, before)
        units = np.concatenate([units for source in self._sources for units in source.units.values()])
        names = ("reset", "phase", "steps", "position", "source", "key")
        columns = [units[name] if name != "steps" else units["steps"] > 0 for name in names]
        return units[np.lexsort(columns)]

    def _keys(self, source: Source, position: Ints, trained: Ints, evaluated: Ints) -> Array:
        """Return the training steps of the run before positions of a process.

        Args:
            position: as the process counted them, with the steps of either phase before them.
        """
        if source.is_placed and not source.stops["train"]:
            return position - evaluated
        # What the run had when every process had stepped its environments as often.
        times = (trained if source.stops["train"] else evaluated) / source.n
        total = np.zeros(len(times))
        for other in self._sources:
            if stop := other.stops["train"]:
                total += np.minimum(times * other.n, stop) * (other.taken["train"] / stop)
        return total

    # --- steps ----------------------------------------------------------------------------------------

    def _copy_units(self) -> int:
        """Copy all resets, steps and extras; return how many rewards the environment's table excludes."""
        recorder = self._recorder
        copied = Copied(self._layout, self._first.spaces, self._mdp)
        buffers = {phase: StepBuffer(recorder, copied, phase) for phase in PHASES}
        begun = dict.fromkeys(PHASES, 0)
        extras = CopiedExtras(recorder, self._sources)
        active = buffers["train"]
        copied_steps = 0
        total = sum(self._totals.values())
        for unit in self._units:
            phase, source = PHASES[unit["phase"]], self._sources[unit["source"]]
            buffer = buffers[phase]
            topics = schema.topics_of(phase)
            if buffer is not active:
                active.commit()
                active = buffer
            unit["new_reset"] = buffer.resets
            unit["new_step"] = buffer.progress[0]
            unit["new_position"] = recorder.position + buffer.pending
            reset = source.reset(phase, unit)
            read = self._read[source.number]
            environment = source.environment + int(unit["environment"])
            buffer.copy_reset(reset, environment)
            self.content.take(topics.resets, reset)
            read[topics.resets.name] += 1
            unit["new_episode"] = begun[phase]
            for steps, numbers in source.steps(phase, unit):
                self.content.take(topics.steps, steps)
                read[topics.extras.name] += extras.copy(source, phase, numbers, buffer.progress[0])
                buffer.copy(steps, environment)
                begun[phase] += int(np.count_nonzero(steps["t"] == 0))
                copied_steps += len(numbers)
                self._report(copied_steps, total)
        active.commit()
        for number, phase in enumerate(PHASES):
            units = self._units[self._units["phase"] == number]
            self._begun[phase] = np.concatenate([np.zeros(1, UNIT), units])
            for source in self._sources:
                placed = units[units["source"] == source.number]
                source.units[phase] = placed[np.lexsort((placed["reset"], placed["environment"]))]
        return sum(buffer.off_table for buffer in buffers.values())

    # --- messages -------------------------------------------------------------------------------------

    def _copy_messages(self, topic: Topic, spool: BinaryIO) -> None:
        """Copy the messages of a topic in the order of the run, unless they are steps."""
        if topic in schema.ROW_TOPICS or topic.message in (schema.EXTRA, schema.EXTRA_COLUMNS):
            return
        spool.seek(0)
        positions, sizes = array("q"), array("q")  # a run may have many millions of logged values
        for source in self._sources:
            if topic not in source.recording.topics:
                continue
            for position, payload in self._messages(source, topic):
                positions.append(position)
                sizes.append(len(payload))
                spool.write(payload)
        starts = np.cumsum(sizes) - sizes
        for k in np.argsort(positions, kind="stable"):
            spool.seek(starts[k])
            payload = spool.read(sizes[k])
            self._recorder.append(topic, payload, positions[k])
            if topic == schema.SCALAR_TOPIC:
                fields = decode(schema.SCALAR, payload)
                self._outcomes.take_logged(fields["name"], fields["value"])

    def _messages(self, source: Source, topic: Topic) -> Iterator[tuple[int, bytes]]:
        """Yield position and payload in the run of a process's messages of a topic."""
        phase = topic.phase
        read = self._read[source.number]
        if topic.message in (schema.RESET_OPTIONS, schema.RESET_STATE):
            tables = source.recording.phase(phase)
            is_state = topic.message == schema.RESET_STATE
            for attached in tables.reset_states() if is_state else tables.reset_options():
                read[topic.name] += 1
                alone: ResetState | ResetOptions
                if isinstance(attached, ResetState):
                    alone = attached._replace(environment=source.environment + attached.environment)
                else:  # other processes may come between the resets of a call, so each gets its options
                    alone = attached._replace(resets=1)
                after = source.units[phase]["reset"] - attached.reset
                for unit in source.units[phase][(after >= 0) & (after < attached.resets)]:
                    moved = alone._replace(reset=int(unit["new_reset"]))
                    yield int(unit["new_position"]), moved.to_payload()
            return
        for fields in source.recording.table(topic).decoded():
            read[topic.name] += 1
            position = int(fields.pop("log_time")) // STEP_NANOSECONDS
            if topic.message == schema.INFO:
                yield from self._info(source, phase, fields)
            elif topic.message == schema.IMAGE:
                yield self._frame(source, phase, position, fields)
            else:
                yield from self._moment(source, topic, position, fields)

    def _info(self, source: Source, phase: str, fields: Message) -> Iterator[tuple[int, bytes]]:
        if not fields["reset"]:
            if fields["step"] < source.stops[phase]:
                step, position = source.step_place(phase, fields["step"])
                yield position, encode(schema.INFO, fields | {"step": step})
            return
        units = source.units[phase]
        for unit in units[units["first"] - units["environment"] == fields["step"]]:
            moved = fields | {"step": int(unit["new_step"])}
            yield int(unit["new_position"]), encode(schema.INFO, moved)

    def _frame(self, source: Source, phase: str, position: int, fields: Message) -> tuple[int, bytes]:
        environment, is_reset = frame_place(fields)
        step = source.phase_steps(phase, position)
        if is_reset:
            position = int(source.unit(phase, environment, step + environment)["new_position"])
        else:
            _, position = source.step_place(phase, max(step - source.n, 0) + environment)
        frame = frame_id(phase, None, is_reset)
        return position, encode_image(fields["data"], fields["format"], position, frame)

    def _moment(
        self, source: Source, topic: Topic, position: int, fields: Message
    ) -> Iterator[tuple[int, bytes]]:
        """Yield a message that belongs to a moment: a logged number, a text, an array, a checkpoint."""
        before = [[position], *([source.phase_steps(phase, position)] for phase in PHASES)]
        key = float(self._keys(source, *np.array(before))[0])
        last = {
            phase: units[np.searchsorted(units["key"][1:], key, side="right")]
            for phase, units in self._begun.items()
        }
        evaluated = int(last["eval"]["new_step"] + last["eval"]["steps"])
        trained = min(int(key), self._totals["train"])
        position = trained + evaluated
        if topic.message == schema.LOG:
            seconds = position * STEP_NANOSECONDS / 1e9
            level = log_level(fields["level"])
            yield position, encode_log(fields["message"], seconds, level, fields["name"])
        elif {"phase", "step", "episode"} <= fields.keys():
            fields["step"] = evaluated if fields["phase"] == "eval" else trained
            fields["episode"] = int(last[fields["phase"]]["new_episode"])
            yield position, encode(topic.message, fields)
        elif source is (self._main if topic == schema.CLOCK_TOPIC else self._sources[0]):
            # Of a machine or a process, such as what it printed.
            yield position, encode(topic.message, fields)


def _kept(name: str, reason: str) -> str:
    """Return a sentence on a recording that was kept, as not all of it is in the run."""
    who, where = (
        (name, f"{UNFOLDED_FOLDER}/{name}") if name else ("the process that began the run", _OWN_UNFOLDED)
    )
    return f"{who}: {reason} Its recording is kept in {where}"


def _ending_of_run(run: Run, unfolded: Mapping[str, str] | None = None) -> str:
    """Return how a run ended when its processes are gone; with `unfolded` shards it is not finished."""
    status = str(run.facts.get(ENDS_AS) or run.file.status)
    return status if status == "failed" or (status == "finished" and not unfolded) else "interrupted"


class Content:
    """Digests of the values in steps and resets, by topic and field: a fold must not change them.

    Args:
        layout: the messages of the folded recording; values are compared in their dtypes.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self.digests: dict[tuple[str, str], Any] = defaultdict(blake3)

    def take(self, topic: Topic, rows: Any) -> None:
        """Take the next steps or resets: records, or a record."""
        for name in {field.name for field in self._layout.message(topic).fields} - _NEW_FIELDS:
            values = np.atleast_1d(rows)[name]
            if values.dtype.hasobject:
                parts = [len(value).to_bytes(4, "little") + value for value in values.tolist()]
                data = b"".join(parts)
            else:
                dtype = self._layout.row_dtype(topic)[name]
                data = np.ascontiguousarray(values, dtype.base).tobytes()
            self.digests[topic.name, name].update(data)

    def check(self, path: Path) -> None:
        """Compare a folded recording with what was copied into it, after checking every byte of it.

        Raises:
            RecordingError: it is damaged, or holds other values.
        """
        content_of(path)
        folded = Content(self._layout)
        with open_recording(path) as recording:
            for topic in recording.topics:
                if topic.name.endswith(("/step", "/reset")):
                    for rows in recording.table(topic).rows():
                        folded.take(topic, rows)
        for (topic_name, name), digest in self.digests.items():
            if folded.digests[topic_name, name].digest() != digest.digest():
                raise RecordingError(
                    f"{path}: {topic_name}: {name}: found other values than its processes recorded; "
                    "their recordings are kept as they are."
                )


class CopiedExtras:
    """The extras of all processes, with the names of all of them."""

    def __init__(self, recorder: Recorder, sources: Sequence[Source]) -> None:
        columns: dict[str, Description] = {}
        self._names: dict[tuple[int, str], str] = {}
        """The names in the run, by number of the process and the name there."""
        for source, phase in itertools.product(sources, PHASES):
            for name, column in source.recording.phase(phase).extras.columns.items():
                new = name
                before = columns.get(name, column)
                both = united(before, column)
                if both is None or before["type"] == column["type"] != both["type"]:
                    new = f"{name} ({source.name})"[:MAX_NAME_LENGTH]
                    both = united(columns.get(new, column), column) or column
                columns[new], self._names[source.number, name] = both, new
        size = ExtraLayout(0, 0, columns).values.itemsize
        if len(columns) > MAX_NAMES or size > MAX_EXTRA_BYTES:
            raise ConfigError(
                f"extras: found {len(columns)} names and {size:,} bytes a step in all shards, expected at "
                f"most {MAX_NAMES} and {MAX_EXTRA_BYTES:,}"
            )
        self._writer = ExtrasWriter(recorder)
        self._writer.described = columns

    def copy(self, source: Source, phase: str, numbers: Ints, new_step: int) -> int:
        """Copy the extras of some steps, which follow each other in the run; return how many had some.

        Args:
            numbers: of the steps, as their process counted them.
            new_step: the number of the first step in the run.
        """
        extras = source.recording.phase(phase).extras
        if not extras:
            return 0
        n = len(numbers)
        named = {self._names[source.number, name]: values for name, values in extras.at(numbers).items()}
        flags = {name: ~np.ma.getmaskarray(values).reshape(n, -1)[:, 0] for name, values in named.items()}
        rows = np.flatnonzero(np.logical_or.reduce(list(flags.values())))
        if not len(rows):
            return 0
        given = {name: are_given[rows] for name, are_given in flags.items()}
        columns = {name: values.data[rows] for name, values in named.items()}
        for name, values in columns.items():
            column = self._writer.described[name]
            if leaf_dtype(column) is None:
                pairs = zip(values, given[name], strict=True)
                data = [encoded(column, value) if is_given else NOTHING for value, is_given in pairs]
                columns[name] = np.fromiter(data, object)
        self._writer.put(phase, new_step + rows, columns, given)
        return len(rows)
