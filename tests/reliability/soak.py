"""Runs killed at random moments: `python -m tests.reliability.soak [--kills N] [--seed S]`.

A run is done to its end once, for comparison. Then, again and again: the same run in a process of its own,
which is killed (SIGKILL) at a random moment, and

1. what is left is opened and read: every topic is a beginning of the whole run's, byte for byte;
2. a copy is repaired, without loss; the official reader, checksums compared, gives the same messages;
3. the run is resumed, perhaps killed again and again, and then finished;
4. its recording is verified, has the digest of the run that nobody killed, and satisfies the official
   reader and, now and then, Rerun's own check.

The processes are forked from this one, so that only the run itself takes time. Seed and number of a kill
fix everything about it but the scheduling of the threads that are killed.
"""

from __future__ import annotations

import argparse
import mmap
import os
import random
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from mcap.reader import make_reader

from runner.config import ExperimentConfig
from runner.config.model import Job
from runner.errors import RecordingError, RunnerError
from runner.execution.resume import resume
from runner.execution.session import run_job
from runner.execution.verify import verify
from runner.recording import schema
from runner.recording.reader import open_recording
from runner.recording.recorder import Recorder
from runner.recording.repair import repair
from runner.runs.resolve import find_run
from runner.runs.run import Run, create_run, list_runs
from tests.runner.recording.making import SMALL_MAP, experiment

COMMON: dict[str, Any] = {
    "env": {"kwargs": {"map": SMALL_MAP, "max_episode_steps": 100}},
    "episodes": 400,
    "epsilon": {"schedule": "linear", "start": 1.0, "end": 0.3, "over": 400},
    "step_size": {"schedule": "exponential", "start": 0.5, "factor": 0.999, "floor": 0.1},
    "evaluation": {"every": 100, "trials": 20},
    "log": {"every_steps": 2000, "window": 1000},
    "snapshots": {"every": 150},
}
CONFIGS: dict[str, dict[str, Any]] = {
    "cooperative": {"mode": "cooperative"},
    "competitive": {"mode": "competitive", "recording": {"chunk_steps": 256, "compression": "lz4"}},
    "without message indexes": {"mode": "cooperative", "recording": {"index": "chunk"}},
    "mostly evaluation": {"mode": "competitive", "evaluation": {"every": 50, "trials": 200}},
    "steps left out": {"mode": "cooperative", "recording": {"steps": "none"}},
    "slippery lake": {
        "env": {"id": "FrozenLake-v1", "kwargs": {"max_episode_steps": 100}},
        "episodes": 1500,
        "recording": {"chunk_steps": 1024, "compression": "none"},
    },
}
SEEDS = (0, 1, 2)
PAUSES = (0.0, 0.01, 0.02)
"""Seconds that a process sleeps after each block: none, and enough that blocks are flushed by the clock."""
MAX_KILLS_A_RUN = 4
_COMMITTED = struct.Struct("<dq")


@dataclass
class Whole:
    """A run that nobody killed."""

    config: ExperimentConfig
    seed: int
    digest: str
    seconds: float
    commits: int
    """How often blocks were committed: what a pause after each of them is multiplied by."""
    messages: dict[str, bytes]

    def takes(self, pause: float) -> float:
        """Return about how many seconds a run takes with this pause."""
        return self.seconds + self.commits * pause


@dataclass
class Tally:
    """What came of the kills."""

    kills: int = 0
    runs: int = 0
    found: Counter[str] = field(default_factory=Counter)
    """How the killed runs were found: before the first message, in the middle, ..."""
    lost_seconds: list[float] = field(default_factory=list)
    """Of work that was done and is not in the file, a kill."""

    def __str__(self) -> str:
        lost = sorted(self.lost_seconds) or [0.0]
        found = ", ".join(f"{count} {how}" for how, count in sorted(self.found.items()))
        return (
            f"{self.kills} kills of {self.runs} runs, none failed; found {found}; work lost by a kill: "
            f"median {lost[len(lost) // 2]:.3f} s, at most {lost[-1]:.3f} s"
        )


def main() -> int:
    """Kill runs until there were enough kills; return 1 at the first that does not come out right."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=200, help="how many")
    parser.add_argument("--seed", type=int, default=1, help="fixes configurations and moments")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin no run after so long")
    parser.add_argument("--folder", type=Path, help="where the runs are kept; a temporary one if not given")
    options = parser.parse_args()
    print(f"seed {options.seed}", flush=True)
    tally, begun = Tally(), time.monotonic()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        while tally.kills < options.kills and time.monotonic() - begun < options.seconds:
            own = folder / f"{tally.runs:05d}"
            rng = random.Random(f"{options.seed} {tally.runs}")
            try:
                kill_one(own, rng, tally)
            except BaseException:
                kept = Path(tempfile.mkdtemp(prefix="soak-"))
                if own.exists():
                    shutil.copytree(own, kept, dirs_exist_ok=True)
                print(f"run {tally.runs} of seed {options.seed} failed; it is kept in {kept}", flush=True)
                raise
            shutil.rmtree(own, ignore_errors=True)
            if tally.runs % 20 == 0:
                print(tally, flush=True)
    print(f"{tally}; {time.monotonic() - begun:.0f} s")
    return 0


def kill_one(folder: Path, rng: random.Random, tally: Tally) -> None:
    """Kill a run, look at what is left, resume it, and compare it with the one nobody killed."""
    whole = whole_run(rng.choice(sorted(CONFIGS)), rng.choice(SEEDS))
    pause = rng.choice(PAUSES)
    tally.runs += 1
    killed = kill(folder, lambda: begin(folder, whole), pause, whole.takes(pause), rng)
    for _ in range(rng.choice((0, 0, 0, 1, MAX_KILLS_A_RUN - 1))):
        look(folder, whole, tally, killed)
        runs = list_runs(folder)
        if not runs or runs[0].status == "finished":
            return _finish(folder, whole, tally, rng)
        killed = kill(folder, lambda: resume_soon(list_runs(folder)[0]), pause, whole.takes(pause), rng)
    look(folder, whole, tally, killed)
    return _finish(folder, whole, tally, rng)


def _finish(folder: Path, whole: Whole, tally: Tally, rng: random.Random) -> None:
    """Resume the run to its end and compare it."""
    runs = list_runs(folder)
    if not runs:  # killed before it had said what it is
        return
    run = runs[0] if runs[0].status == "finished" else resume_soon(runs[0])
    assert find_run(run.run_id, folder).status == "finished"
    verification = verify(run.recording)
    assert verification.sound, verification.finding
    with open_recording(run.recording) as recording:
        assert recording.result["content_digest"] == whole.digest
    if tally.runs % 4 == 0 or not rng.randrange(4):
        assert official_messages(run.recording) == our_messages(run.recording)
    if tally.runs % 20 == 1:
        check_by_rerun(run.recording)


def resume_soon(run: Run) -> Run:
    """Resume a run, when nothing that the killed process had started holds its folder any more.

    The code may have been committed meanwhile: every recorded step is compared all the same.
    """
    until = time.monotonic() + 10
    while True:
        try:
            return resume(run, accept_changes=True)
        except RunnerError as error:
            if "another process" not in str(error) or time.monotonic() > until:
                raise
        time.sleep(0.01)


@cache
def whole_run(name: str, seed: int) -> Whole:
    """Return a run of a configuration and seed that nobody kills."""
    config = experiment(COMMON, {"name": "soak"}, CONFIGS[name])
    seconds, commits = [], 0
    original = Recorder.commit

    def commit(*arguments: Any) -> None:
        nonlocal commits
        commits += 1
        original(*arguments)

    with tempfile.TemporaryDirectory() as folder:
        Recorder.commit = commit  # type: ignore[method-assign]
        try:
            for _ in range(2):  # the first may have to compile
                commits, begun = 0, time.monotonic()
                run = run_job(Job(config, seed), create_run(Path(folder), config, seed))
                seconds.append(time.monotonic() - begun)
        finally:
            Recorder.commit = original  # type: ignore[method-assign]
        digest = run.summary["content_digest"]
        return Whole(config, seed, digest, min(seconds), commits, our_messages(run.recording))


def begin(folder: Path, whole: Whole) -> Run:
    """Do a run from its beginning."""
    return run_job(Job(whole.config, whole.seed), create_run(folder, whole.config, whole.seed))


@dataclass
class Killed:
    """A process that was killed: when, and when it had taken how many steps."""

    moment: float
    committed: list[tuple[float, int]]


def kill(
    folder: Path, work: Callable[[], object], pause: float, seconds: float, rng: random.Random
) -> Killed:
    """Do the work in a process of its own, and kill it at a random moment up to a little after its end."""
    folder.mkdir(parents=True, exist_ok=True)
    shared = mmap.mmap(-1, 1 << 22)
    after = rng.uniform(0, 1.1 * seconds + 0.02)
    child = os.fork()
    if child == 0:
        _work_and_exit(work, pause, shared)
    time.sleep(after)
    os.kill(child, signal.SIGKILL)
    moment = time.monotonic()
    _, status = os.waitpid(child, 0)
    assert status == signal.SIGKILL or os.waitstatus_to_exitcode(status) == 0, f"it ended by {status}"
    committed = []
    for at in range(0, len(shared) - _COMMITTED.size, _COMMITTED.size):
        when, steps = _COMMITTED.unpack_from(shared, at)
        if not when:
            break
        committed.append((when, steps))
    return Killed(moment, committed)


def _work_and_exit(work: Callable[[], object], pause: float, shared: mmap.mmap) -> None:
    """Do the work, saying what is committed when; never returns."""
    original, at = Recorder.commit, 0

    def commit(recorder: Recorder, phase: str, steps: int, episodes: int) -> None:
        nonlocal at
        original(recorder, phase, steps, episodes)
        if at + 2 * _COMMITTED.size < len(shared):
            _COMMITTED.pack_into(shared, at, time.monotonic(), sum(recorder.steps.values()))
            at += _COMMITTED.size
        if pause:
            time.sleep(pause)

    code = 1
    try:
        Recorder.commit = commit  # type: ignore[method-assign]
        work()
        code = 0
    finally:
        os._exit(code)


def look(folder: Path, whole: Whole, tally: Tally, killed: Killed) -> None:
    """Read what a kill left, and repair a copy of it."""
    tally.kills += 1
    runs = list_runs(folder)
    if not runs:
        tally.found["without a run"] += 1
        return
    run = runs[0]
    assert run.status in {"interrupted", "finished"}, run.status
    if not run.recording.exists():
        tally.found["without a recording"] += 1
        return
    try:
        with open_recording(run.recording) as recording:
            finished, steps = recording.file.finished, sum(recording.table(t).count() for t in _STEPS)
    except RecordingError:
        if has_chunk(run.recording):
            raise
        tally.found["before the first message"] += 1
        return
    found = our_messages(run.recording)
    for topic, messages in found.items():
        assert whole.messages[topic].startswith(messages), f"{topic} is no beginning of the whole"
    tally.found["finished" if finished else "in the middle"] += 1
    if not finished and whole.config.recording.steps == "all":
        late = [when for when, committed in killed.committed if committed > steps]
        tally.lost_seconds.append(killed.moment - min(late, default=killed.moment))
    _repair_copy(run.recording, found, tally)


_STEPS = (schema.TRAIN_STEP, schema.EVAL_STEP)


def _repair_copy(path: Path, found: dict[str, bytes], tally: Tally) -> None:
    copy = path.with_name("copy.mcap")
    shutil.copyfile(path, copy)
    try:
        done = repair(copy)
        assert not done.lost, f"lost {done.lost}"
        assert our_messages(copy) == found
        if tally.kills % 4 == 0:
            assert official_messages(copy) == found
        if tally.kills % 20 == 1:
            check_by_rerun(copy)
    except RecordingError:
        if has_chunk(path):
            raise
    finally:
        copy.unlink()


def has_chunk(path: Path) -> bool:
    """Return whether a file has a whole chunk, by its records alone."""
    data, at = path.read_bytes(), 8
    while at + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        if length > len(data) - at - 9:
            return False
        if opcode == 6:
            return True
        at += 9 + length
    return False


def our_messages(path: Path) -> dict[str, bytes]:
    """Return times and payloads of each topic, in order, as our reader gives them."""
    with open_recording(path) as recording:
        return {
            topic.name: b"".join(
                struct.pack("<QI", time, len(payload)) + payload
                for time, payload in recording.table(topic).messages()
            )
            for topic in schema.JOB_TOPICS
        }


def official_messages(path: Path) -> dict[str, bytes]:
    """Return the same, as the official reader does, every checksum compared."""
    found = {topic.name: bytearray() for topic in schema.JOB_TOPICS}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        for _, channel, message in reader.iter_messages(log_time_order=False):
            if channel.topic not in found:  # of the machine, which differs each time
                continue
            found[channel.topic] += struct.pack("<QI", message.log_time, len(message.data)) + message.data
        assert all(attachment.data for attachment in reader.iter_attachments())
        assert {record.name for record in reader.iter_metadata()} >= {"run", "config", "provenance"}
    return {topic: bytes(messages) for topic, messages in found.items()}


def check_by_rerun(path: Path) -> None:
    """Have Rerun check the file.

    Raises:
        AssertionError: it finds something.
    """
    command = shutil.which("rerun", path=os.pathsep.join([str(Path(sys.executable).parent), os.defpath]))
    if command is None:
        return
    checked = subprocess.run(
        [command, "mcap", "check", str(path)],
        env=os.environ | {"RERUN_ANALYTICS": "0"},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert checked.returncode == 0, checked.stdout + checked.stderr


if __name__ == "__main__":
    sys.exit(main())
