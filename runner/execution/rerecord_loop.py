"""Record the whole steps of a loop whose actions alone were recorded: its environment takes them again."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from runner.errors import CannotRedo, Diverged, RunnerError
from runner.recording import schema
from runner.recording.actions import ACTION_TOPICS
from runner.recording.metadata import json_object, sizes_of
from runner.recording.reader import Recording, open_recording
from runner.recording.recorder import Recorder
from runner.recording.rewriting import rewrite
from runner.recording.writer import RecordingFile
from runner.replay.engine import Replay
from runner.replay.environment import stream_from_child
from runner.replay.makers import why_not_redone
from runner.replay.recorded import Piece, pieces
from runner.runs.run import Run
from runner.util.files import storage_errors
from runner.util.packing import Packing
from runner.util.processes import report_progress


def rerecord_loop(run: Run, trust: bool, report: Callable[[int], None]) -> Run:
    """Record the whole steps of a loop; the caller has locked the run.

    The new recording replaces the old one when it is complete and has the same content digest.

    Raises:
        CannotRedo: the environment cannot be had.
        Diverged: it gives other observations or rewards; the recording stays as it is.
        RunnerError: no actions were recorded, or the loop was cut off.
    """
    with open_recording(run.recording) as recording:
        if not recording.has_actions:
            raise RunnerError(
                f"run {run.run_id} was recorded without its actions, so its steps cannot be done again."
            )
        if recording.result.content_digest is None:
            raise RunnerError(
                f"run {run.run_id} was cut off, so it has no content digest to compare with; "
                f"`dualtaxi verify {run.run_id}` compares the episodes that it has."
            )
        if reason := why_not_redone(recording, trust):
            raise CannotRedo(reason)
    fresh, started = run.recording.with_suffix(".rerecording"), time.monotonic()
    try:
        with storage_errors(fresh):
            fresh.unlink(missing_ok=True)
            for done in stream_from_child(_write, run.recording, fresh, trust):
                report(done)
            fresh.replace(run.recording)
    finally:
        fresh.unlink(missing_ok=True)
    with open_recording(run.recording) as recording:
        config, result = recording.config, recording.metadata("result")["json"]
    size, seconds = run.recording.stat().st_size, round(time.monotonic() - started, 3)
    summary = json_object(result, "the result") | {"seconds": seconds, "bytes": size}
    return run.update(config=config, summary=summary)


def _write(path: Path, fresh: Path, trust: bool) -> None:
    """Write the recording with whole steps into a new file; runs in a child process."""
    with open_recording(path) as recording:
        rewrite(
            path,
            fresh,
            _with_all_steps,
            left_out=[topic.name for topic in ACTION_TOPICS.values()],
            add=lambda file: _add_steps(recording, file, trust),
        )


def _with_all_steps(name: str, entries: dict[str, str]) -> dict[str, str]:
    """Return a metadata record as a recording with whole steps has it."""
    if name not in ("config", "result"):
        return entries
    values = json.loads(entries["json"])
    if name == "config":
        values["recording"]["steps"] = "all"
    else:
        values["steps_recorded"] = True
        for topic in ACTION_TOPICS.values():
            values["messages"].pop(topic.name, None)
    return entries | {"json": json.dumps(values, sort_keys=True)}


def _add_steps(recording: Recording, file: RecordingFile, trust: bool) -> None:
    """Do the recorded actions again, and write the steps.

    Raises:
        Diverged: they differ from the recorded ones.
    """
    names = {recording.topic(f"/{phase}/step").name for phase in schema.PHASES}
    every = sizes_of(recording.run, str(recording.path))
    sizes = {topic: size for topic, size in every.items() if topic.name in names}
    plan = recording.config["recording"]
    packing = Packing(plan["compression"], plan["level"] or 0, plan["index"], plan["chunk_steps"])
    recorder = Recorder(file, len(recording.agents), 0, packing, sizes=sizes)
    try:
        with closing(Replay(recording, trust, 0.0, lambda _: None, render=False)) as replay:
            states = {phase: np.full(recording.environments, -1, np.int64) for phase in schema.PHASES}
            for piece in pieces(recording, schema.PHASES):
                records = _whole_records(recording, replay, piece, recorder, states[piece.phase])
                _record(recorder, recording.topic(f"/{piece.phase}/step"), records)
                report_progress(replay.taken)
        if replay.skipped:
            raise CannotRedo(f"The states of the generators before {replay.skipped:,} steps are not known.")
        found = recorder.drain()
    except BaseException:
        recorder.abandon()
        raise
    for name in sorted(names):
        expected = recording.result.topic_digests.get(name)
        if found.get(name) != expected:
            raise Diverged(name, "digest", found.get(name), expected)


def _whole_records(
    recording: Recording, replay: Replay, piece: Piece, recorder: Recorder, states: NDArray[np.int64]
) -> NDArray[np.void]:
    """Return the whole records of the steps of a piece; `states` are those after the last of each."""
    topic, rows = recording.topic(f"/{piece.phase}/step"), piece.rows
    records = recorder.blank(topic, len(rows))
    for name in rows.dtype.names or ():
        if name != "digest":
            records[name] = rows[name]
    after = "next_state" if recording.kind == "step" else "next_observation"
    for environment in replay.environments:
        for steps in replay.steps(piece, environment, draws=False):
            if steps.difference is not None:
                raise CannotRedo(f"The environment is not the recorded one: {steps.difference}.")
            at = steps.step - piece.first
            records[after][at], records["rewards"][at] = steps.got.observations, steps.got.rewards
    start = int(recording.spaces["observation"]["start"]) if recording.kind == "step" else 0
    for reset in piece.resets:
        row = reset.step - piece.first + reset.environment
        if row < len(rows) and rows["t"][row] == schema.RESET_ONLY:
            records[after][row] = reset.observation - start if start else reset.observation
    if recording.kind == "step":
        _fill_states(records, piece, states, start)
    return records


def _fill_states(records: NDArray[np.void], piece: Piece, states: NDArray[np.int64], start: int) -> None:
    """Fill in the state before each step: that after the one before it, or that of a reset between them."""
    n = len(states)
    if len(records):
        before = np.vstack([states, records["next_state"].astype(np.int64).reshape(-1, n)])
        states[:] = before[-1]
        records["state"] = before[:-1].reshape(-1)
    for reset in piece.resets:
        at = reset.step - piece.first + reset.environment
        if at >= len(records):
            states[reset.environment] = reset.observation - start
        elif records["t"][at] != schema.RESET_ONLY:
            records["state"][at] = reset.observation - start


def _record(recorder: Recorder, topic: schema.Topic, records: NDArray[np.void]) -> None:
    """Hand whole records to the recorder."""
    for block, part in recorder.fill(topic, records["log_time"] // schema.STEP_NANOSECONDS):
        block[:] = records[part]
