"""Runs of several processes, killed and damaged: `python -m tests.reliability.shards [--rounds N]`.

Each round takes a run of three processes that were not put together yet, of one of several kinds of
environment. Perhaps a fourth process joins, and is killed (SIGKILL) at a random moment. Files are then
damaged, cut, emptied, or left without their `run.json`; that of another run is added; and the run is shown,
repaired, and shown again, in a random order.

Every step of a whole chunk that any file had before must be readable afterwards, in the run or in a file that
is kept in its folder. A run that lacks one, or one that a process had stated before the damage, must not be
called finished, nor pass `verify`.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import gymnasium
import numpy as np
from click.testing import CliRunner
from gymnasium.vector import SyncVectorEnv

import runner
from runner.cli import cli
from runner.errors import RunnerError
from runner.execution.verify import verify
from runner.loops import loop_run
from runner.recording import schema
from runner.recording.layout import HEADER_BYTES, Layout, rows_of
from runner.recording.messages import decode
from runner.recording.metadata import layout_of_run
from runner.recording.records import MetadataRecord, ReadChunk
from runner.recording.repair import DamagedFile
from runner.recording.run_file import owner
from runner.recording.steps import taken
from runner.runs.run import run_at
from runner.runs.shards import shards_of
from runner.util.files import open_regular
from tests.runner.loops.making import Rooms

SHARDS: Final = ("w0", "w1")
LONGEST: Final = 0.9
"""Seconds after which a process is killed at the latest."""
_VALUES: Final = ("state", "action", "next_state", "next_observation", "rewards", "terminated", "truncated")


def _vector() -> SyncVectorEnv:
    return SyncVectorEnv([lambda: gymnasium.make("CartPole-v1")] * 2)


KINDS: Final[dict[str, tuple[Callable[[], Any], Callable[..., Any]]]] = {
    "arrays": (lambda: gymnasium.make("CartPole-v1"), runner.record),
    "states": (lambda: gymnasium.make("Taxi-v4"), runner.record),
    "texts": (lambda: Rooms(with_text=True), runner.record),
    "vectors": (_vector, runner.record_vector),
}


def main() -> int:
    """Do the rounds; return 1 if one failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=200, help="how many")
    parser.add_argument("--seed", type=int, default=1, help="fixes all but the moments of kills")
    options = parser.parse_args()
    begun, failed, seen = time.monotonic(), [], Counter[str]()
    with tempfile.TemporaryDirectory() as folder:
        runs = {kind: unfolded_run(Path(folder) / kind, kind) for kind in KINDS}
        for number in range(options.rounds):
            place = Path(folder) / "round"
            story = [f"seed {options.seed}, round {number}"]
            try:
                seen.update(do_round(runs, place, random.Random(f"{options.seed}/{number}"), story))
            except Exception:
                failed.append("; ".join(story) + "\n" + traceback.format_exc())
            shutil.rmtree(place, ignore_errors=True)
    outcomes = ", ".join(f"{n} {outcome}" for outcome, n in sorted(seen.items()))
    print(
        f"seed {options.seed}: {options.rounds} rounds, {len(failed) or 'none'} failed ({outcomes})", end=""
    )
    print(f"; {time.monotonic() - begun:.0f} s", *failed, sep="\n")
    return 1 if failed else 0


def unfolded_run(folder: Path, kind: str) -> Path:
    """Record a run of three processes and leave it as it is when all of them are killed at their end."""
    make, record = KINDS[kind]
    real, loop_run.fold_if_over = loop_run.fold_if_over, lambda run, _: run
    try:
        with record(make(), folder, name=kind, chunk_steps=256) as rec:
            for k, shard in enumerate(SHARDS):
                with record(make(), join=rec.run, shard=shard, chunk_steps=256) as joined:
                    play(joined, 1_000 + 300 * k, k)
            play(rec, 700, 9)
    finally:
        loop_run.fold_if_over = real
    return rec.run.folder


def play(rec: Any, steps: int, seed: int) -> None:
    """Take random steps, with resets and logged numbers."""
    rec.action_space.seed(seed)
    rec.reset(seed=seed)
    for step in range(steps):
        terminated, truncated = rec.step(rec.action_space.sample())[2:4]
        if np.ndim(terminated) == 0 and (terminated or truncated):
            rec.reset()
        if step % 50 == 0:
            rec.log("loss", 1 / (step + 1))


def do_round(runs: dict[str, Path], place: Path, rng: random.Random, story: list[str]) -> list[str]:
    """Do one round in a new folder; return what came of it. `story` gets what was done."""
    kind = rng.choice(sorted(runs))
    folder = place / runs[kind].name
    shutil.copytree(runs[kind], folder)
    story.append(kind)
    stated = steps_below(folder)
    if rng.random() < 0.4:
        killed_process(folder, kind, rng.random() * LONGEST, story)
    for _ in range(rng.choice((0, 1, 1, 2))):
        damage(folder, runs, rng, story)
    before = steps_below(folder)
    for command in rng.choice((["show"], ["repair"], ["show", "repair"], ["repair", "show", "repair"])):
        story.append(command)
        done = CliRunner().invoke(cli, [command, folder.name, "--recordings", str(place)])
        if done.exception is not None and not isinstance(done.exception, SystemExit):
            raise done.exception
    missing = before - steps_below(folder)
    assert not missing, f"{missing.total()} of {before.total()} steps are gone"
    return [outcome(folder, before | stated, story)]


def outcome(folder: Path, recorded: Counter[bytes], story: list[str]) -> str:
    """Check what the run says of itself, and return it."""
    run = run_at(folder)
    lacks = (recorded - steps_in(run.recording)).total()
    try:
        sound = not shards_of(run) and verify(run.recording, rerun=False).sound
    except RunnerError:
        sound = False
    story.append(f"{lacks} of {recorded.total()} steps are not in the run, {run.status}, sound: {sound}")
    assert not lacks or (run.status != "finished" and not sound), "a loss is hidden"
    return "whole" if not lacks else "waiting for a repair" if shards_of(run) else "kept in part"


def killed_process(folder: Path, kind: str, seconds: float, story: list[str]) -> None:
    """Have a process join the run, record into it as fast as it can, and kill it after some time."""
    story.append(f"a process was killed after {seconds:.3f} s")
    make, record = KINDS[kind]
    facts = run_at(folder).facts
    run_at(folder).update(status="running", owner=owner())
    pid = os.fork()
    if not pid:
        try:
            rec = record(make(), join=folder, shard="victim", chunk_steps=256)
            play(rec, 10**9, 3)
        finally:
            os._exit(1)
    time.sleep(seconds)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    run_at(folder).update(status=facts["status"], owner=facts["owner"])


def damage(folder: Path, runs: dict[str, Path], rng: random.Random, story: list[str]) -> None:
    """Change a file of the run."""
    parts = [folder, *(shard.folder for shard in shards_of(run_at(folder)))]
    part = rng.choice(parts)
    path = part / "recording.mcap"
    if not path.exists():
        return
    how = rng.choice(["byte", "byte", "cut", "empty", "no run.json", "other kind"])
    story.append(f"{part.name}: {how}")
    data = bytearray(path.read_bytes())
    if how == "byte" and data:
        at = rng.randrange(len(data))
        data[at] ^= rng.randrange(1, 256)
        path.write_bytes(data)
        story.append(f"at {at}")
    elif how == "cut":
        path.write_bytes(data[: rng.randrange(len(data) + 1)])
    elif how == "empty":
        path.write_bytes(b"")
    elif how == "no run.json" and part != folder:
        (part / "run.json").unlink(missing_ok=True)
    elif how == "other kind" and not (folder / "shards" / "other").exists():
        other = rng.choice([kind for kind in sorted(runs) if runs[kind].name != folder.name])
        shutil.copytree(runs[other] / "shards" / "w0", folder / "shards" / "other")


def steps_below(folder: Path) -> Counter[bytes]:
    """Return the values of all steps in whole chunks of all recordings in a folder: the most in one file.

    A file that was repaired lies next to its original: a step in both is one step.
    """
    parts: dict[Path, Counter[bytes]] = {}
    for path in folder.rglob("*.mcap"):
        part = path if "unfolded" in path.name else path.parent
        parts[part] = parts.get(part, Counter()) | steps_in(path)
    return sum(parts.values(), Counter())


def steps_in(path: Path) -> Counter[bytes]:
    """Return the values of the steps in the whole chunks of a file, however damaged."""
    steps: Counter[bytes] = Counter()
    layout: Layout | None = None
    if not path.stat().st_size:
        return steps
    try:
        with open_regular(path) as stream:
            for record in DamagedFile(stream, path).good_records():
                if isinstance(record, ReadChunk):
                    if record.topic.message is schema.STEP and layout is not None:
                        steps.update(values_of(record, layout))
                elif isinstance(record, MetadataRecord) and record.name == "run":
                    layout = layout_of_run(record.entries, str(path))
    except RunnerError:
        pass
    return steps


def values_of(chunk: ReadChunk, layout: Layout) -> list[bytes]:
    """Return what the steps of a chunk hold that no fold may change; none of a reset in place of a step."""
    dtype, message = layout.dtype(chunk.topic), layout.message(chunk.topic)
    if dtype is not None:
        rows = taken(rows_of(message, np.frombuffer(chunk.records, dtype)))
        names = [name for name in _VALUES if name in rows.dtype.names]
        return [b"".join(row[name].tobytes() for name in names) for row in rows]
    decoded = (decode(message, record[HEADER_BYTES:]) for record in chunk.messages)
    return [repr([fields[name] for name in _VALUES if name in fields]).encode() for fields in decoded]


if __name__ == "__main__":
    sys.exit(main())
