"""The description of a run, as its recording and its archive hold it: metadata records and attachments."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Protocol

from runner.environments.mdp import Mdp
from runner.errors import RecordingError, RunnerError
from runner.recording.code import CODE_ATTACHMENT, CODE_RECORD, Code, parse_code
from runner.recording.layout import Layout
from runner.recording.maker import (
    MAKER_RECORD,
    EnvironmentMaker,
    Shard,
    parse_maker,
    parse_shards,
)
from runner.recording.metadata import (
    LostRanges,
    RecordedEnvironment,
    environment_description,
    environment_of,
    json_object,
    kind_of,
    layout_of_run,
    lost_ranges,
    spaces_of,
    unpacked_provenance,
)
from runner.recording.run_file import Summary, parse_result
from runner.recording.schema import Q_TABLE_TOPIC, Topic
from runner.util.values import Json


class NamedRecords(Protocol):
    """What describes a run in a file: metadata records and attachments, each by name."""

    @property
    def metadata_names(self) -> list[str]:
        """The names of the metadata records, in order."""

    @property
    def attachment_names(self) -> list[str]:
        """The names of the attachments, in order."""

    def metadata(self, name: str) -> dict[str, str]:
        """Return a metadata record's entries.

        Raises:
            RecordingError: there is none of that name, or it cannot be read.
        """

    def attachment(self, name: str) -> bytes:
        """Return an attachment's data, after comparing its checksum.

        Raises:
            RecordingError: there is none of that name, or it is damaged.
        """


class RunDescription:
    """What is recorded about a run besides its messages; raises a `RecordingError` where it is damaged."""

    def __init__(self, path: Path, records: NamedRecords) -> None:
        self.path = path
        self._records = records

    @cached_property
    def run(self) -> dict[str, str]:
        """The metadata record `run`: id, name, seed, job, creation, agents and more, as texts."""
        return self._records.metadata("run")

    @property
    def run_id(self) -> str:
        """The id of the run."""
        return self.run["run_id"]

    @property
    def created(self) -> datetime:
        """When the run began, in UTC.

        Raises:
            RecordingError: the recording does not state a time.
        """
        try:
            return datetime.fromisoformat(self.run["created"]).astimezone(UTC)
        except (ValueError, OverflowError) as error:
            raise RecordingError(
                f"{self.path}: found {self.run['created']!r}, expected the time at which it was created."
            ) from error

    @property
    def seed(self) -> int | None:
        """The seed of the run's job; None for a loop without one."""
        return None if self.run.get("seeded") == "false" else int(self.run["seed"])

    @cached_property
    def agents(self) -> tuple[str, ...]:
        """The names of the learners: one table and one reward each."""
        return tuple(map(str, json.loads(self.run["agents"])))

    @cached_property
    def config(self) -> Json:
        """The resolved configuration, as `runner.config.from_mapping` takes it."""
        return self._json("config")

    @cached_property
    def provenance(self) -> dict[str, str]:
        """Where and by what it was made, with the commit of the user's code where it is recorded."""
        first = unpacked_provenance(self._records.metadata("provenance"), str(self.path))
        code = self._records.metadata(CODE_RECORD) if CODE_RECORD in self._records.metadata_names else {}
        return first | code | first  # no entry of the first is replaced

    @cached_property
    def code(self) -> Code:
        """The user's code; empty where it is not recorded.

        Raises:
            RecordingError: it is damaged.
        """
        records = self._records
        if CODE_RECORD not in records.metadata_names or CODE_ATTACHMENT not in records.attachment_names:
            return Code()
        return parse_code(records.attachment(CODE_ATTACHMENT), str(self.path))

    @cached_property
    def _stated_result(self) -> dict[str, object]:
        """The result as it was written, unchecked; empty if the run ended without one."""
        return self._json("result") if "result" in self._records.metadata_names else {}

    @cached_property
    def result(self) -> Summary:
        """What the recorder wrote at the end: status, digest, counts; empty if the run ended without it.

        Raises:
            RecordingError: it has a value that is not possible.
        """
        problems: list[str] = []
        result = parse_result(self._stated_result, problems)
        if problems:
            raise RecordingError(f"{self.path}: its result is damaged: {'; '.join(problems)}.")
        return result

    @cached_property
    def lost(self) -> LostRanges:
        """Messages that a repair could not save, by topic: ranges (first, stop) of their numbers."""
        if "repair" not in self._records.metadata_names:
            return {}
        return lost_ranges(self._json("repair"), str(self.path))

    @property
    def has_tables(self) -> bool:
        """Whether the Q-tables at any step are known: each update of them follows from the recorded steps."""
        return Q_TABLE_TOPIC in self.topics

    @property
    def can_train_again(self) -> bool:
        """Whether training the configuration again gives the same content."""
        return kind_of(self.run) == "job"

    def require_job(self, purpose: str, instead: str) -> None:
        """Refuse the recording of a loop.

        Raises:
            RunnerError: it is one; `purpose` says what it cannot be used for, `instead` what can be done.
        """
        if not self.can_train_again:
            raise RunnerError(
                f"{self.path}: was recorded from a training loop, by {self.config.get('made_by')}; "
                f"{purpose} is for runs that were trained here. {instead}"
            )

    @property
    def topics(self) -> tuple[Topic, ...]:
        """The topics that the recording has, some of them perhaps empty."""
        return self.layout.topics

    @cached_property
    def layout(self) -> Layout:
        """The messages of the recording.

        Raises:
            RecordingError: it is of another version, or its metadata record `run` is damaged.
        """
        return layout_of_run(self.run, str(self.path))

    @cached_property
    def environment(self) -> RecordedEnvironment:
        """The environment's description without its arrays: agents, events, scene; not to be changed."""
        return environment_description(self._records.attachment("environment.json"), str(self.path))

    @cached_property
    def maker(self) -> EnvironmentMaker | None:
        """How a loop's environment was made; None for jobs, and for recordings that do not state it.

        Raises:
            RecordingError: it is damaged.
        """
        return self._maker(MAKER_RECORD)

    def _maker(self, name: str) -> EnvironmentMaker | None:
        if name not in self._records.metadata_names:
            return None
        return parse_maker(self._json(name), str(self.path))

    @property
    def tabular(self) -> bool:
        """Whether the environment's arrays are there, so that it has an `mdp`."""
        return self.has_states and bool(self.environment["arrays"])

    @cached_property
    def mdp(self) -> Mdp:
        """The environment: arrays, agents, events, scene."""
        return environment_of(self.environment, self._records.attachment, str(self.path))

    @property
    def has_states(self) -> bool:
        """Whether its steps have states and actions by number, from 0; else values of the spaces."""
        return self.layout.has_states

    @cached_property
    def spaces(self) -> Json:
        """The descriptions of the `observation` and `action` spaces; a job has the spaces of its tables."""
        if self.layout.spaces:
            return spaces_of(self.run, str(self.path))
        number = {"type": "Discrete", "start": 0, "dtype": "<i8", "shape": []}
        sizes = {"observation": self.mdp.states, "action": self.mdp.joint_actions}
        return {name: number | {"n": n} for name, n in sizes.items()}

    @property
    def environments(self) -> int:
        """How many environments step at once; 1 for shards too, whose steps follow one another."""
        return int(self.run.get("environments", "1"))

    @cached_property
    def shards(self) -> tuple[Shard, ...]:
        """The processes that recorded it together; empty if it was one.

        Their environments are numbered through, in this order; `environment` of a reset is that number, and
        the steps up to the next reset are of that environment.

        Raises:
            RecordingError: they are damaged.
        """
        return parse_shards(self.run.get("shards"), str(self.path))

    @property
    def leaves_out_steps(self) -> bool:
        """Whether the configuration leaves whole steps out of the recording (`recording.steps`)."""
        plan = self.config.get("recording")
        return isinstance(plan, Mapping) and plan.get("steps", "all") != "all"

    def _json(self, name: str) -> Json:
        return json_object(self._records.metadata(name).get("json"), f"{self.path}: the metadata {name!r}")


def recorded_facts(run: RunDescription) -> Json:
    """Return the contents of `run.json`, from the recording alone; the result in it is unchecked.

    Raises:
        RecordingError: the result is no JSON object.
    """
    result = run._stated_result
    return {
        "run_id": run.run_id,
        "name": run.run["name"],
        "seed": run.seed or 0,
        **({"seeded": False} if run.seed is None else {}),
        "created": run.run["created"],
        "status": result.get("status", "interrupted"),
        "config": run.config,
        "summary": {key: value for key, value in result.items() if key != "status"},
    }


def environment_count(run: RunDescription) -> int:
    """Return how many environments resets name, summed over the shards if there are any."""
    return sum(shard.environments for shard in run.shards) or run.environments
