"""The run of a loop, with its file and its recorder: how it is opened, described, completed and folded."""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

from blake3 import blake3

from runner.client.outbox import Follower, connect, is_server, outbox_folder
from runner.config.model import NOT_CONTENT
from runner.errors import ConfigError, RunnerError, StorageError, truncated_message
from runner.loops.description import Described
from runner.loops.fold import OWNER_WAITS, fold_if_over
from runner.loops.messages import Outcomes
from runner.loops.options import Options
from runner.recording import schema
from runner.recording.gym_spaces import recorded_space
from runner.recording.maker import EnvironmentMaker
from runner.recording.metadata import run_metadata, write_description, write_maker, write_result
from runner.recording.observer import Observer
from runner.recording.recorder import ActionRecorder, Recorder
from runner.recording.rewriting import compacted
from runner.recording.steps import ACTION_TOPICS
from runner.recording.writer import SYNCER, create_recording
from runner.runs.code import CodeCollector
from runner.runs.provenance import provenance_entries
from runner.runs.redaction import LineRedactor
from runner.runs.run import RECORDING_FILE, Run, made_by, new_run, recordings_folder, run_at, unless_empty
from runner.runs.shards import RUN_VARIABLE, new_shard
from runner.runs.trust_marks import mark
from runner.util.values import Json, JsonView


class LoopRun:
    """The run of a loop that is being recorded. Not thread-safe: the loop holds its lock."""

    def __init__(self, described: Described, options: Options, maker: EnvironmentMaker) -> None:
        is_shard = options.join is not None
        client = connect(str(options.recordings)) if is_server(options.recordings) and not is_shard else None
        self.started = time.monotonic()
        self.described = described
        self._options = options
        self._maker = maker
        self.own_makers: dict[str, EnvironmentMaker] = {}
        """Makers of environments that were recorded into the run for one phase, until they are written."""
        self._config = options.config(described)
        self._is_described = False
        self.is_settled = not recorded_space(described.action).can_widen()
        """Whether the dtypes of all values are known."""
        self._provenance = provenance_entries(with_command=options.packing.code)
        facts = {"provenance": made_by(self._provenance), "spaces": described.common}
        self.run = self._new_run(outbox_folder() if client else None, facts)
        self._code = CodeCollector(self.run.folder.parent, options.packing.code and not is_shard)
        path = self.run.folder / RECORDING_FILE
        with unless_empty(self.run):
            self.file = create_recording(path)
        mark(self.run.folder, maker)
        self._beat_code = self._code.beat(self.run, self.file)
        self._facts = self._run_facts()
        self.outcomes = Outcomes(described.mdp)
        self.recorder = Recorder(
            self.file,
            described.layout,
            packing=options.packing.packing,
            record_steps=options.steps == "all",
            beat=self._beat,
            before=self.describe,
            observer=Observer(
                self.run.folder,
                options.packing.system and not is_shard,
                LineRedactor() if options.packing.console and not is_shard else None,
            ),
        )
        self.recorder.watch(schema.EPISODE, self.outcomes.take_episodes)
        self._actions = (
            ActionRecorder(self.recorder, described.environments, options.packing.chunk_steps)
            if options.steps == "actions"
            else None
        )
        if self.is_settled:
            try:
                self.describe()
            except BaseException as error:
                self.file.close()
                self._mark_failed(truncated_message(error))
                raise
        self._follower = Follower(client, self.run, lambda: self.file.size) if client else None
        self._absolute = os.path.abspath(self.run.folder)  # noqa: PTH100 - links stay what they are
        self._joined_before = os.environ.get(RUN_VARIABLE)
        """The folder of the run that child processes joined before this one began."""
        if not is_shard:
            os.environ[RUN_VARIABLE] = self._absolute

    def _new_run(self, folder: Path | None, facts: JsonView) -> Run:
        """Create the folder of the run, or of the shard of the run that is joined.

        Raises:
            ConfigError: the run that is joined has other spaces.
        """
        options, config = self._options, self._config
        if options.join is None:
            folder = folder or recordings_folder(options.recordings)
            return new_run(folder, config, options.seed, config["name"], options.run_id, **facts)
        expected = options.join.facts.get("spaces")
        if facts["spaces"] != expected:
            raise ConfigError(
                f"join: found an environment with {facts['spaces'][:500]}, expected the spaces and agents of "
                f"run {options.join.run_id}: {str(expected)[:500]}"
            )
        return new_shard(options.join, options.shard, config, options.seed, **facts)

    def _beat(self) -> None:
        """Write what came since the last call; called now and then while nothing else writes to the file."""
        self._beat_code()
        with contextlib.suppress(StorageError):  # tried again at the end
            self._write_makers()

    def _write_makers(self) -> None:
        for phase, maker in list(self.own_makers.items()):
            write_maker(self.file, phase, maker)
            mark(self.run.folder, maker)
            del self.own_makers[phase]

    def _run_facts(self) -> dict[str, str]:
        described = self.described
        mdp = described.mdp
        run = self.run
        content = {key: value for key, value in self._config.items() if key not in NOT_CONTENT}
        job = json.dumps(content | {"seed": self._options.seed}, sort_keys=True)
        facts = {"kind": described.kind, "spaces": json.dumps(described.recorded_spaces)}
        if described.has_turns:
            facts["environments"] = str(described.environments)
        metadata = run_metadata(
            run.run_id,
            run.facts["name"],
            self._options.seed,
            job=blake3(job.encode()).hexdigest()[:32],
            created=run.facts["created"],
            agents=described.agents,
            events=len(mdp.event_names) if mdp else 0,
        )
        return metadata | facts

    def describe(self) -> None:
        """Write what makes the recording self-contained, once; from then on dtypes are fixed."""
        if not self._is_described:
            self._is_described = True
            self.is_settled = True
            environment = self.described.attachments(), self._maker
            write_description(self.file, self._facts, self._config, self._provenance, *environment)

    def settle(self, action: object) -> bool:
        """Fix the dtype of all actions by the first one; return whether it is not the space's own."""
        if self.is_settled:
            return False
        self.is_settled = True
        wide = recorded_space(self.described.action).widened(action)
        if wide is self.described.action:
            return False
        self.described = replace(self.described, wide_action=wide)
        self._facts = self._run_facts()
        self.recorder.set_layout(self.described.layout)
        return True

    def commit(self) -> None:
        """Hand the actions to the recorder, where they are recorded alone."""
        if self._actions is not None:
            self._actions.commit()

    def finish(self, status: str, error: str, rewards_off_table: int) -> Json:
        """Write everything and the result; return the summary."""
        topic_digests = self.recorder.drain()
        self._code.write(self.file, wait=True)
        self._write_makers()
        if self._actions is not None and self._follower is None:  # which has sent the file as it is
            counts = self.recorder.counts
            if any(counts.get(topic.name, 0) > 1 for topic in ACTION_TOPICS):
                with contextlib.suppress(OSError):  # without the space for both, it keeps its many chunks
                    self.file, messages = compacted(self.file, self._options.packing.packing)
                    counts |= messages
        result = self.recorder.totals(topic_digests) | self.outcomes.summary()
        result |= {
            "episodes": self.recorder.counts["/train/episode"],
            "steps_recorded": self._options.steps == "all",
        }
        if self.described.mdp is not None:
            result["rewards_off_table"] = rewards_off_table
        if error:
            result["error"] = truncated_message(error)
        write_result(self.file, status, result, synced=False)
        seconds = round(time.monotonic() - self.started, 3)
        return result | {"seconds": seconds, "bytes": self.file.size}

    def write_status(self, status: str, summary: Mapping[str, object]) -> None:
        """Write how the run ended next to its recording, which is synced to disk within seconds."""
        self.run = self.run.update(status=status, summary=summary, provenance=self._code.made_by(self.run))
        SYNCER.add(self.file.path, partial(_mark_unsynced, self.run.folder))

    def end_joining(self) -> None:
        """Let child processes join the run that was open before this one, if any."""
        if os.environ.get(RUN_VARIABLE) == self._absolute:
            del os.environ[RUN_VARIABLE]
            if self._joined_before is not None:
                os.environ[RUN_VARIABLE] = self._joined_before

    def fold(self) -> Run:
        """Put together what several processes recorded, if this was the last one; return the whole run."""
        joined = self._options.join
        whole = fold_if_over(joined or self.run, 0 if joined else OWNER_WAITS)
        self.run = self.run if joined else whole
        return whole

    def finish_following(self) -> None:
        """Send the rest to the server, if the run is sent to one."""
        if self._follower:
            self._follower.finish(self.run)

    def abandon(self, reason: str) -> None:
        """Close what could not be finished, with as much as can be written."""
        with contextlib.suppress(Exception):  # the first error is the one that matters
            self.recorder.abandon()
        with contextlib.suppress(StorageError):
            write_result(self.file, "failed", {"error": reason})
        self._mark_failed(reason)
        if self._follower:
            self._follower.stop()

    def _mark_failed(self, reason: str) -> None:
        with contextlib.suppress(StorageError):
            self.run = self.run.update(status="failed", summary={"error": reason})


def _mark_unsynced(folder: Path, error: OSError) -> None:
    """Mark a run as failed, and say so, as its complete recording could not be written to disk."""
    reason = (
        f"{folder}: the recording could not be written to disk ({error.strerror}); `dualtaxi verify` shows "
        "whether it is complete."
    )
    with contextlib.suppress(RunnerError):
        run = run_at(folder)
        run.update(status="failed", summary=dict(run.facts.get("summary") or {}) | {"error": reason})
    print(reason, file=sys.stderr)  # a warning might be an exception, which nobody would see here
