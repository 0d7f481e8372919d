"""The lazy reader of a recording: opens by the index, reads in blocks, keeps little in memory.

    with runner.open_recording("recordings/k3v9m2xq/recording.mcap") as recording:
        for block in recording.train.steps.blocks():      # NumPy records, some thousands at a time
            print(block["rewards"].mean())

All other parts of the project read recordings through this module.
"""

from __future__ import annotations

import contextlib
import math
import os
from bisect import bisect_right
from collections.abc import Iterator, Mapping
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from runner.environments.naming import action_names, actions_in_words
from runner.errors import NotInRecording, RecordingError
from runner.recording import schema
from runner.recording.description import RunDescription, environment_count
from runner.recording.extras import ExtraLayout, ExtraNames, Extras
from runner.recording.labels import read_labels
from runner.recording.maker import MAKER_RECORD, SHARD_MAKER, EnvironmentMaker
from runner.recording.messages import (
    Message,
    QTable,
    ResetOptions,
    ResetState,
    Scalars,
    Snapshot,
    decode_array,
    decode_q_table,
    decode_reset_options,
    decode_reset_state,
    decode_scalars,
    unknown_measures,
)
from runner.recording.metadata import check_file
from runner.recording.metrics import RECENT_EPISODES, finite_mean
from runner.recording.record_store import RecordStore
from runner.recording.run_file import RecentTraining, is_owned, run_title
from runner.recording.schema import Topic, topics_of
from runner.recording.spaces import decode as decode_value
from runner.recording.steps import EpisodeSteps, Steps, taken
from runner.recording.topic_chunks import FOREVER, TopicChunks
from runner.util.arrays import Records

MAX_METRICS: Final = 1 << 17
"""The most that `Phase.all_metrics` returns as one list."""
_METRICS_BYTES: Final = 1 << 20
_MAX_SCALARS: Final = 8_192
MAX_EPISODE_BYTES: Final = 128 << 20
"""The most that `Phase.episode_steps` returns as one array: some 1.5 million steps."""


def open_recording(path: str | os.PathLike[str]) -> Recording:
    """Open a recording, finished or not.

    Raises:
        RecordingError: it is missing, not a dualtaxi recording, of an unknown version, or damaged.
    """
    return Recording(Path(path))


class Recording(RunDescription):
    """A recording, opened; a context manager.

    A block is the file's own bytes, seen through the dtype of `layout.record_dtype`: no message is parsed
    by itself.
    """

    def __init__(self, path: Path) -> None:
        self.file = RecordStore(path)
        super().__init__(path, self.file)
        try:
            check_file(self.layout, self.file.index, str(path))
        except BaseException:
            self.close()
            raise
        self._tables: dict[Topic, TopicChunks] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self.file.close()
        for phase in schema.PHASES:  # which know this recording: it would stay in memory for a while
            vars(self).pop(phase, None)

    def table(self, topic: Topic | str) -> TopicChunks:
        """Return the messages of a topic, given by itself or by its name.

        Raises:
            RecordingError: the recording has no topic of that name.
        """
        if isinstance(topic, str):
            known = {known.name: known for known in self.topics}
            if topic not in known:
                raise RecordingError(
                    f"{self.path}: has no topic {topic!r}: it is of the kind {self.layout.kind!r}."
                )
            topic = known[topic]
        if topic not in self._tables:
            message = self.layout.message(topic)
            lost = self.lost.get(topic.name, [])
            chunks = self.file, topic, self._places[topic], message, lost
            if topic.message is schema.STEP:
                actions = self.table(topics_of(topic.phase).actions)
                self._tables[topic] = Steps(*chunks, actions=actions, environments=self.environments)
            elif topic.message in (schema.TRAIN_METRICS, schema.EVAL_METRICS, schema.OPTIMALITY):
                channel = self.file.index.channels.get(topic.channel)
                recorded = self.file.index.schemas.get(channel.schema_id) if channel else None
                unknown = dict.fromkeys(
                    unknown_measures(topic.message, recorded.data if recorded else b""), math.nan
                )
                self._tables[topic] = TopicChunks(*chunks, _METRICS_BYTES, unknown)
            else:
                self._tables[topic] = TopicChunks(*chunks)
        return self._tables[topic]

    @cached_property
    def _places(self) -> Mapping[Topic, NDArray[np.intp]]:
        """The numbers of the chunks that hold each topic; for extras, the chunks of all layouts."""
        channels = self.file.channels % schema.LAYOUT_STRIDE
        return {topic: np.flatnonzero(channels == topic.channel) for topic in schema.ALL_TOPICS}

    @cached_property
    def train(self) -> Phase:
        """What was recorded of training."""
        return Phase(self, "train")

    @cached_property
    def eval(self) -> Phase:
        """What was recorded of evaluations; their episodes are trials."""
        return Phase(self, "eval")

    def phase(self, name: str) -> Phase:
        """Return a phase, `train` or `eval`.

        Raises:
            ValueError: there is no such phase.
        """
        if name not in schema.PHASES:
            raise ValueError(f"found phase {name!r}, expected one of: {', '.join(schema.PHASES)}.")
        return self.train if name == "train" else self.eval

    @property
    def phases(self) -> tuple[Phase, Phase]:
        """Training and evaluation."""
        return self.train, self.eval

    @property
    def has_actions(self) -> bool:
        """Whether any action was recorded, with its step or alone."""
        return any(phase.steps.are_known for phase in self.phases)

    @property
    def status(self) -> str:
        """The status of the run: `finished`, `failed`, `running`, or else `interrupted`."""
        if self.result.status is None and self._is_in_run_folder and is_owned(self.path.parent):
            return "running"
        return self.result.status or "interrupted"

    @property
    def name(self) -> str:
        """The current name of the run: that in its labels if it was renamed, else the first one."""
        renamed = read_labels(self.path.parent).name if self._is_in_run_folder else ""
        return renamed or self.run["name"]

    @property
    def title(self) -> str:
        """The current name of the run, and its seed if it has one: `patient, seed 3`."""
        return run_title(self.name, self.seed)

    @property
    def _is_in_run_folder(self) -> bool:
        return self.path.name == "recording.mcap"

    def done(self) -> dict[str, int]:
        """Return the number of training episodes and steps of each phase: as written, else counted."""
        counts = {
            "episodes": self.train.episodes.count,
            "train_steps": self.train.steps.total,
            "eval_steps": self.eval.steps.total,
        }
        recorded = {key: getattr(self.result, key) for key in counts}
        return {key: count() if recorded[key] is None else recorded[key] for key, count in counts.items()}

    def arrays(self) -> Iterator[Snapshot]:
        """Yield the arrays that a loop recorded by `snapshot`, in order."""
        return (array for _, array in self.table(schema.ARRAY_TOPIC).parsed(decode_array))

    def scalars(self) -> Iterator[Scalars]:
        """Yield the values that a loop logged, thousands at a time, as columns.

        Raises:
            RecordingError: a message cannot be read.
        """
        scalars = self.table(schema.SCALAR_TOPIC)
        messages = scalars.parsed(bytes)
        while batch := list(islice(messages, _MAX_SCALARS)):
            try:
                yield decode_scalars(batch)
            except RecordingError:
                for _ in scalars.decoded():  # names the message
                    pass
                raise

    def snapshots(self, step: int = 0, tables: int = 0) -> Iterator[QTable]:
        """Yield the snapshots in order, from the oldest that is needed for `step`.

        All tables of the last moment at or before `step` are included, and of the moment before it.

        Args:
            step: a training step.
            tables: how many tables each moment has; by default only the learners' Q-tables are yielded, not
                what else their algorithm keeps.
        """
        learners, table = len(self.agents), self.table(schema.Q_TABLE_TOPIC)
        chunks = range(len(table))

        def read(part: range) -> Iterator[QTable]:
            return (snapshot for _, snapshot in table.parsed(decode_q_table, chunks=part))

        if step:
            after = bisect_right(chunks, step, key=lambda k: next(read(chunks[k:])).step)
            chunks = chunks[max(0, after - 2 * (tables or learners)) :]
        for snapshot in read(chunks):
            if tables or snapshot.table < learners:
                yield snapshot


class Phase:
    """A phase of an open recording; each of its tables has the messages of a topic."""

    def __init__(self, recording: Recording, name: str) -> None:
        topics = schema.topics_of(name)
        self.name = name
        self.title = schema.PHASE_NAMES[name]
        steps = recording.table(topics.steps)
        assert isinstance(steps, Steps)
        self.steps = steps
        self.episodes = recording.table(topics.episodes)
        self.resets = recording.table(topics.resets)
        self.infos = recording.table(topics.infos)
        self.frames = recording.table(topics.frames)
        self.metrics = recording.table(topics.metrics)
        self._recording = recording
        self.topics = topics

    def steps_of_episodes(self, start: int, stop: int | None) -> Iterator[Records]:
        """Yield the steps of the episodes number `start` up to `stop`; None for all that follow."""
        end = None if stop is None else self.steps.first_from("episode", stop)
        return self.steps.blocks(self.steps.first_from("episode", start), end)

    def known_episodes(self) -> int:
        """Return how many episodes are known by their ends, or, of one environment, by their steps alone."""
        count, total = self.episodes.count(), self.steps.total()
        if environment_count(self._recording) == 1:
            with contextlib.suppress(RecordingError):  # the last steps are damaged
                for rows in self.steps.numbered(range(max(0, total - 1), total)):
                    count = max(count, int(rows["episode"][-1]) + 1)
        return count

    def episode(self, number: int) -> EpisodeSteps:
        """Return the steps of an episode, which are read later; also of one whose end is not recorded.

        Where several environments take turns, episodes are numbered as they ended, and only ended ones are
        found.

        Raises:
            RecordingError: the recording has no such episode, or no steps.
        """
        total, ended = self.steps.total(), self.episodes.count()
        if not total:
            recording = self._recording
            advice = ""
            if recording.leaves_out_steps:
                advice = f"; `dualtaxi rerecord {recording.run_id}` records them"
            raise RecordingError(f"{recording.path}: has no {self.title} steps{advice}.")
        first, last, length, environment = 0, -1, 0, 0
        if 0 <= number < ended and len(records := self.episodes.array(number, number + 1)):
            first, last = int(records[0]["first_step"]), int(records[0]["last_step"])
            length = last + 1 - first
            if self.steps.have_turns:
                length, environment = int(records[0]["length"]), int(records[0]["environment"])
        elif number >= 0 and environment_count(self._recording) == 1:
            starts = (self.steps.rows_between("episode", begin) for begin in (number, number + 1))
            first, stop = (next((int(rows["step"][0]) for rows in start), total) for start in starts)
            for rows in self.steps.numbered(range(first, first + 1)):
                first += len(rows) - len(taken(rows))  # a vector of one may have only reset it at first
            last, length = stop - 1, stop - first
        if not (0 <= first <= last < total and 0 < length <= last + 1 - first):
            raise NotInRecording(
                f"{self._recording.path}: has no {self.title} episode {number:,}; "
                f"there are {self.known_episodes():,}, from 0."
            )
        return EpisodeSteps(self.steps, first, last, length, environment)

    def episode_steps(self, episode: int) -> Records:
        """Return the steps of one episode as an array.

        Raises:
            RecordingError: the recording has no such episode or steps, or they are too large for an array.
        """
        steps = self.episode(episode)
        path = self._recording.path
        if len(steps) * self.steps.row_dtype.itemsize > MAX_EPISODE_BYTES:
            raise RecordingError(
                f"{path}: {self.title} episode {episode} has {len(steps):,} steps, too many for an array; "
                f"read them in blocks, from {steps.first}."
            )
        if not (blocks := list(steps.rows())):
            raise RecordingError(f"{path}: the steps of {self.title} episode {episode} were lost.")
        return np.concatenate(blocks)

    def transitions(self, episode: int | None = None) -> Iterator[Any]:
        """Yield the steps of a loop, or of one episode, with `action` and `next_observation` as values.

        Those of the kind `step` have `state`, `action` and `next_state`, counted from 0. They are NumPy
        records where values have one size (`steps.blocks` yields many at once), else dictionaries.
        """
        blocks = self.steps.taken() if episode is None else self.episode(episode).rows()
        return self._values(self.steps, blocks, action="action", next_observation="observation")

    def reset_values(self) -> Iterator[Any]:
        """Yield the resets one by one, as `transitions` yields steps."""
        return self._values(self.resets, self.resets.rows(), observation="observation")

    def reset_options(self, times: range | None = None) -> Iterator[ResetOptions]:
        """Yield what resets of a loop were called with, besides their seeds, in the order of the resets.

        Only resets with options, or with a seed of more than 64 bits, have some; jobs have none. `times` as
        for `TopicChunks.rows`.

        Raises:
            RecordingError: they are damaged.
        """
        options = self._recording.table(self.topics.reset_options)
        return (given for _, given in options.parsed(decode_reset_options, times=times))

    def reset_states(self, times: range | None = None) -> Iterator[ResetState]:
        """Yield what resets of a loop without a seed depend on, in the order of the resets.

        Not every reset has one; jobs have none. `times` as for `TopicChunks.rows`.

        Raises:
            RecordingError: one is damaged.
        """
        states = self._recording.table(self.topics.reset_states)
        return (state for _, state in states.parsed(decode_reset_state, times=times))

    def _values(self, table: TopicChunks, blocks: Iterator[Records], **spaces: str) -> Iterator[Any]:
        """Yield messages in blocks one by one; `spaces` names the space of each field that is a value."""
        if table.dtype is not None:
            for block in blocks:
                yield from block
            return
        names = ["log_time", *(field.name for field in table.message.fields)]
        for block in blocks:
            for row in block:
                where = f"{self._recording.path}: {table.topic.name} at {row['log_time']} ns"
                fields = {name: row[name] for name in names}
                for name, space in spaces.items():
                    fields[name] = decode_value(self._recording.spaces[space], fields[name], where)
                yield fields

    def whole_steps(self) -> int:
        """Return how many steps of a loop are known to have their resets.

        In a recording that was cut off these are the steps up to the first end of an episode after its last
        reset: what comes later may lack its reset, since topics are written one after the other.
        """
        total = self.steps.total()
        if "content_digest" in self._recording.result:
            return total
        if (last := self.resets.last()) is None:
            return 0
        for block in self.steps.rows(range(int(last["log_time"]), FOREVER)):
            over = (block["terminated"] | block["truncated"]) & (block["step"] >= last["step"])
            if over.any():
                total = min(self.steps.round_of(int(block["step"][np.argmax(over)])).stop, total)
                break
        return self.steps.round_of(total).start

    @cached_property
    def extras(self) -> Extras:
        """The values that a loop recorded with the steps: names with dtypes, and values; empty for a job.

        Raises:
            RecordingError: they are damaged.
        """
        table = self._recording.table(self.topics.extras)
        where = str(self._recording.path)
        layouts = extra_layouts(self._recording) if table else {}
        index = self._recording.file.index
        parts = []
        channels = self._recording.file.channels[table.places]
        for channel in sorted(set(channels.tolist())):
            layout = layouts.get(channel // schema.LAYOUT_STRIDE)
            if layout is None or not layout.is_declared_in(index):
                raise RecordingError(
                    f"{where}: the names of extras do not give the schema of channel {channel}."
                )
            places = table.places[channels == channel]
            chunks = TopicChunks(table.file, schema.TOPIC_OF[channel], places, layout.message)
            parts.append((layout, chunks))
        return Extras(parts, self.episode, where)

    @property
    def has_metrics(self) -> bool:
        """Whether metrics are recorded, as by training; else they follow from the episodes."""
        return self.topics.metrics in self._recording.topics

    def recent_episodes(self) -> Records:
        """Return the records of the last `RECENT_EPISODES` episodes."""
        return self.episodes.array(max(0, self.episodes.count() - RECENT_EPISODES))

    def recent_means(self) -> RecentTraining:
        """Return the means of the last episodes; None where no value is finite."""
        recent = self.recent_episodes()
        length = finite_mean(recent["length"])
        total = finite_mean(recent["returns"].sum(axis=1))
        return RecentTraining(len(recent), length, total)

    def all_metrics(self) -> list[Message]:
        """Return the metrics, in order.

        Raises:
            RecordingError: they are damaged, or more than 131,072; `metrics.decoded` yields them one by one.
        """
        metrics = list(islice(self.metrics.decoded(), MAX_METRICS + 1))
        if len(metrics) > MAX_METRICS:
            raise RecordingError(
                f"{self._recording.path}: has more than {MAX_METRICS:,} {self.name} metrics."
            )
        return metrics

    def maker_of(self, environment: int = 0) -> EnvironmentMaker | None:
        """Return how an environment of the phase was made: the recording's `maker` unless it has its own.

        Args:
            environment: its number among those of all shards.

        Raises:
            RecordingError: it is damaged.
        """
        stop, shard_maker = 0, None
        for shard in self._recording.shards:
            start, stop = stop, stop + shard.environments
            if start <= environment < stop:
                shard_maker = self._recording._maker(f"{SHARD_MAKER}/{shard.name}")
        return shard_maker or self.own_maker or self._recording.maker

    @property
    def own_maker(self) -> EnvironmentMaker | None:
        """How the environment of this phase was made if it was recorded into the run of another."""
        return self._recording._maker(f"{MAKER_RECORD}/{self.name}")

    def action_names(self, agent: str = "") -> tuple[str, ...]:
        """Return the names of the discrete actions, the least action's first; empty if unknown.

        Args:
            agent: of a game of several agents, which may have different actions.

        Raises:
            RecordingError: they are damaged.
        """
        recording = self._recording
        if recording.tabular:
            mdp = recording.mdp
            return () if action_names(mdp) is None else tuple(map(str, actions_in_words(mdp)))
        maker = self.maker_of()
        if maker is None:
            return ()
        names = maker.agent_action_names.get(agent, ()) if agent else maker.action_names
        space = recording.spaces["action"] if names else {}
        if names and agent:
            space = space["spaces"][agent] if agent in space.get("spaces", ()) else {"type": "?"}
        if names and (space["type"], space.get("n")) != ("Discrete", len(names)):
            raise RecordingError(
                f"{recording.path}: its {MAKER_RECORD} is damaged: found {len(names)} action_names, expected "
                f"one for each action of a {space['type']} space of {space.get('n', 'no')} actions."
            )
        return names


def extra_layouts(recording: Recording) -> Mapping[int, ExtraLayout]:
    """Return the names of extras, from when on, by number; each layout has the names of the one before it."""
    columns = recording.table(schema.EXTRA_COLUMNS_TOPIC).decoded()
    named = ((fields["log_time"], fields) for fields in columns)
    return ExtraNames(str(recording.path), named).layouts
