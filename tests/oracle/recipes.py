"""Makes recordings of every kind, the same each time."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from PIL import Image

import runner
from dualtaxi.parallel import DualTaxiParallelEnv
from runner.archive.runs import archive_run, restore_run
from runner.config.model import Job
from runner.execution.resume import resume
from runner.execution.session import run_job
from runner.recording import schema
from runner.recording.integrity import survey
from runner.runs.run import Run, create_run, run_at
from tests.oracle import reading
from tests.oracle.reading import Content
from tests.runner.altering import without_chunk
from tests.runner.loops.making import (
    Counting,
    Leaving,
    drive,
    make,
    parallel,
    play,
    record_counting,
)
from tests.runner.loops.sharing import work
from tests.runner.recording.making import LAKE, TAXIS, experiment, make_run, stopping_after

tictactoe = pytest.importorskip("pettingzoo.classic.tictactoe_v3")

DATA = Path(__file__).parents[1] / "data"
ALGORITHMS: dict[str, dict[str, Any]] = {
    "double_q_learning": {"initial_q": "random"},
    "wolf_phc": {"mode": "competitive"},
}
"""Algorithms that keep more than a Q-table for each learner."""
MORE_ALGORITHMS: dict[str, dict[str, Any]] = {
    "sarsa": {"epsilon": {"schedule": "linear", "start": 1.0, "end": 0.1, "over": 10}},
    "expected_sarsa": {"tables": "per_agent", "rewards": "individual"},
    "hysteretic_q_learning": {"mode": "competitive", "exploration": "shared"},
    "random": {},
}
"""The others, whose recordings have the same columns: each takes some seconds to compile."""
SHORT: dict[str, Any] = {"episodes": 12, "evaluation": {"every": 6, "trials": 2}, "snapshots": {"every": 6}}


class Varied(gymnasium.Env[Any, Any]):
    """Values whose size varies, and numbers of unusual types, in spaces in spaces."""

    observation_space = spaces.Tuple(
        (
            spaces.Sequence(spaces.Box(-1, 1, (2,), np.float32)),
            spaces.Dict({"half": spaces.Box(-1, 1, (2,), np.float16), "word": spaces.Text(12)}),
        )
    )
    action_space = spaces.Tuple((spaces.MultiDiscrete([3, 4]), spaces.Discrete(3, start=-1)))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self._t = 0
        return self._observation(), {}

    def step(self, action: Any) -> Any:
        self._t += 1
        return self._observation(), float(self._t) / 3, False, self._t == 9, {"t": self._t}

    def _observation(self) -> Any:
        self.observation_space.seed(int(self.np_random.integers(2**31)))
        return self.observation_space.sample()


class Small(gymnasium.Env[Any, Any]):
    """Numbers of one and two bytes, rewards that are not finite, and negative zeros."""

    observation_space = spaces.Dict(
        {"camera": spaces.Box(0, 255, (4, 6, 3), np.uint8), "height": spaces.Box(-9, 9, (), np.int16)}
    )
    action_space = spaces.MultiBinary([2, 3])

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self._t = 0
        return self._observation(), {}

    def step(self, action: Any) -> Any:
        self._t += 1
        rewards = (-0.0, np.inf, np.nan, 0.1, -0.0)
        return self._observation(), rewards[self._t % 5], self._t == 7, False, {}

    def _observation(self) -> Any:
        camera = self.np_random.integers(0, 256, (4, 6, 3), np.uint8)
        return {"camera": camera, "height": np.int16(-self._t)}


def contents(folder: Path, algorithms: dict[str, dict[str, Any]] = ALGORITHMS) -> dict[str, Content]:
    """Make a recording of each kind in a folder; return what they hold, by name."""
    found = {path.stem: reading.read(path) for path in sorted(DATA.glob("*.mcap"))}
    with pytest.MonkeyPatch.context() as patch:
        # So that chunks do not depend on the machine.
        patch.setattr("runner.recording.recorder.FLUSH_SECONDS", 1e9)
        patch.setattr("runner.loops.loop.Loop.flush", lambda _: True)
        for name, path in recordings(folder, algorithms):
            assert name not in found, name
            found[name] = reading.read(path)
    return found


def recordings(folder: Path, algorithms: dict[str, dict[str, Any]]) -> Iterator[tuple[str, Path]]:
    """Make a recording of each kind; yield its name and path as soon as it is made."""
    yield from _jobs(folder, algorithms)
    yield from _damaged_jobs(folder)
    yield from _singles(folder)
    yield from _partial(folder)
    yield from _vectors(folder)
    yield from _games(folder)
    yield from _shards(folder)


def _jobs(folder: Path, algorithms: dict[str, dict[str, Any]]) -> Iterator[tuple[str, Path]]:
    base = {key: value for key, value in TAXIS.items() if key != "mode"}
    for algorithm, changes in algorithms.items():
        yield f"job-{algorithm}", make_run(folder, base, SHORT, changes, algorithm=algorithm).recording
    lake = make_run(folder, LAKE)
    yield "job-lake", lake.recording
    archive_run(lake, str(folder / "archive"), remove=True)
    yield "job-lake-restored", restore_run(run_at(lake.folder)).recording
    sparse = make_run(folder, LAKE, recording={"steps": "none"})
    yield "job-no-steps", sparse.recording
    yield "job-no-steps-rerecorded", runner.rerecord(sparse).recording
    branch = runner.branch(lake, at="3:1", action="0", name="branch", recordings=folder)
    yield "job-branch", branch.run.recording


def _damaged_jobs(folder: Path) -> Iterator[tuple[str, Path]]:
    config = experiment(TAXIS, SHORT, recording={"chunk_steps": 256})
    interrupted = run_job(Job(config, 1), create_run(folder, config, 1), stop=stopping_after(2))
    yield "job-interrupted", interrupted.recording
    cut = _cut(interrupted.recording, schema.TRAIN_STEP, 1)
    yield "job-killed", cut
    yield "job-resumed", resume(interrupted).recording
    whole = make_run(folder, TAXIS, SHORT, recording={"chunk_steps": 256})
    without_chunk(whole.recording, schema.TRAIN_STEP, 1)
    yield "job-repaired", whole.recording


def _singles(folder: Path) -> Iterator[tuple[str, Path]]:
    for env_id in ("Taxi-v4", "Blackjack-v1", "CartPole-v1", "Pendulum-v1", "Rooms", "RoomsText"):
        yield f"loop-{env_id}", _everything(make(env_id), folder).recording
    for env in (Varied(), Small()):
        yield f"loop-{type(env).__name__}", _everything(env, folder).recording
    with contextlib.suppress(KeyError), runner.record(make("FrozenLake-v1"), folder) as rec:
        list(play(rec, 30))
        raise KeyError
    yield "loop-failed", rec.run.recording
    pole = _everything(make("CartPole-v1"), folder)
    archive_run(pole, str(folder / "archive"), remove=True)
    yield "loop-restored", restore_run(run_at(pole.folder)).recording
    branch = runner.branch(pole, at="0:2", action=0, policy="random", recordings=folder, trust=True)
    yield "loop-branch", branch.run.recording


def _everything(env: gymnasium.Env[Any, Any], folder: Path) -> Run:
    """Record all that a loop can add to its steps: the same in both phases."""
    with runner.record(env, folder, seed=3, info=["*"], config={"lr": 3e-4, "layers": [64, 64]}) as rec:
        for phase, seed in (("train", 1), ("eval", 2)):
            with rec.phase(phase):
                rec.action_space.seed(seed)
                for k, reset in enumerate(
                    ({"seed": seed}, {}, {"options": {"key": [1, 2.5]}}, {"seed": 2**70 + seed}, {})
                ):
                    rec.reset(**reset)
                    for t in range(4 * k + 3):
                        extras = {"t": t} | ({"late": np.array([k, t], np.float32)} if k > 1 else {})
                        *_, terminated, truncated, _ = rec.step(rec.action_space.sample(), extras)
                        if terminated or truncated:
                            break
                    rec.log("loss", 1 / (k + 1))
                    rec.log({"a": {"b": k}, "nan": float("nan")})
                    rec.log("note", f"episode {k}: “{phase}”")
                rec.snapshot("weights", {"w": np.arange(6.0).reshape(3, 2), "b": np.zeros(2, np.int8)})
                rec.checkpoint("policy", f"parameters of {phase}".encode())
                rec.log("picture", Image.fromarray(np.full((4, 6, 3), 90, np.uint8)))
    return rec.run


def _partial(folder: Path) -> Iterator[tuple[str, Path]]:
    for env_id in ("CartPole-v1", "FrozenLake-v1", "Rooms"):
        with runner.record(make(env_id), folder, steps="actions") as rec:
            list(play(rec, 60))
            with rec.phase("eval"):
                list(play(rec, 20, seed=6))
        yield f"loop-actions-{env_id}", rec.run.recording
        if env_id != "Rooms":
            yield f"loop-actions-{env_id}-rerecorded", runner.rerecord(rec.run).recording
    with runner.record(make("CartPole-v1"), folder, steps="none") as rec:
        list(play(rec, 60))
    yield "loop-no-steps", rec.run.recording
    with runner.record(make("CartPole-v1"), folder, chunk_steps=256) as rec:
        for phase, seed in (("train", 5), ("eval", 6), ("train", 7)):
            with rec.phase(phase):
                list(play(rec, 300, seed))
    yield "loop-killed", _cut(rec.run.recording, schema.TRAIN_STEP, 2)
    without_chunk(rec.run.recording, schema.TRAIN_STEP, 1)
    yield "loop-repaired", rec.run.recording
    with runner.record(Counting(4), folder, frames_every=3) as rec:
        list(play(rec, 30))
    yield "loop-frames", rec.run.recording
    with runner.record(make("Blackjack-v1"), folder) as rec:
        rec.reset(seed=1)
        rec.log("only", 1.0)
    yield "loop-reset-only", rec.run.recording


def _vectors(folder: Path) -> Iterator[tuple[str, Path]]:
    for mode in AutoresetMode:
        yield f"vector-{mode.value}", record_counting(folder, mode)
        for env_id in ("FrozenLake-v1", "Rooms"):
            envs = SyncVectorEnv([lambda env_id=env_id: make(env_id)] * 2, autoreset_mode=mode)
            with runner.record_vector(envs, folder, info=["prob", "luck"]) as rec:
                drive(rec, 40)
            yield f"vector-{mode.value}-{env_id}", rec.run.recording
    yield "vector-actions", _sparse_vector(folder)
    for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP):
        yield f"batches-{mode.value}", _batches(folder, mode)


def _sparse_vector(folder: Path) -> Path:
    envs = SyncVectorEnv([lambda: make("CartPole-v1")] * 3)
    with runner.record_vector(envs, folder, steps="actions") as rec:
        rec.action_space.seed(0)
        rec.reset(seed=0)
        for _ in range(50):
            rec.step(rec.action_space.sample())
    return rec.run.recording


def _batches(folder: Path, mode: AutoresetMode) -> Path:
    """Record two batches of steps, with extras."""
    envs = SyncVectorEnv([lambda: make("CartPole-v1")] * 3, autoreset_mode=mode)
    envs.action_space.seed(0)
    with runner.record_batches(envs, folder) as rec:
        first, _ = envs.reset(seed=0)
        rec.reset(first)
        for _ in range(2):
            rows = []
            for _ in range(30):
                actions = envs.action_space.sample()
                observations, rewards, terminated, truncated, infos = envs.step(actions)
                final = np.zeros_like(observations)
                for i in np.flatnonzero(terminated | truncated) if "final_obs" in infos else ():
                    final[i] = infos["final_obs"][i]
                rows.append((observations.copy(), actions, rewards, terminated, truncated, final))
            *columns, final = (np.array(column) for column in zip(*rows, strict=True))
            finals = {"final_observations": final} if mode == AutoresetMode.SAME_STEP else {}
            rec.batch(*columns, **finals, extras={"value": columns[2] / 2})
    return rec.run.recording


def _games(folder: Path) -> Iterator[tuple[str, Path]]:
    for name, game in (("leaving", Leaving()), ("taxis", DualTaxiParallelEnv(max_steps=15))):
        with runner.record_parallel(game, folder, name=name, info=["*"]) as rec:
            parallel(rec, 4)
        yield f"game-{name}", rec.run.recording
    with runner.record_aec(tictactoe.env(), folder) as rec:
        generator = np.random.default_rng(0)
        for seed in range(3):
            rec.reset(seed=seed)
            for _ in rec.agent_iter():
                observation, _, terminated, truncated, _ = rec.last()
                free = np.flatnonzero(observation["action_mask"])
                rec.step(None if terminated or truncated else int(generator.choice(free)))
    yield "game-turns", rec.run.recording


def _shards(folder: Path) -> Iterator[tuple[str, Path]]:
    with runner.record(make("CartPole-v1"), folder, name="joined") as rec:
        for shard, phase in (("b", "train"), ("a", "train"), ("judge", "eval")):
            work(rec.run, shard, 60, 3, phase=phase, at=20 if phase == "eval" else None)
        list(play(rec, 60))
    yield "shards", rec.run.recording
    with runner.record_vector(SyncVectorEnv([lambda: Counting(7)] * 2), folder, name="vectors") as rec:
        with runner.record_vector(
            SyncVectorEnv([lambda: Counting(9)] * 3), join=rec.run, shard="other"
        ) as other:
            drive(other, 25)
        drive(rec, 25)
    yield "shards-vectors", rec.run.recording


def _cut(path: Path, topic: schema.Topic, chunks: int) -> Path:
    """Return a copy of a recording that ends after some chunks of a topic, as if its process was killed."""
    copy = path.parent.with_name(f"{path.parent.name}-cut") / path.name
    copy.parent.mkdir()
    shutil.copy(path, copy)
    own = [chunk for chunk in survey(path).chunks if chunk.channel == topic.channel]
    last = own[chunks - 1]
    with copy.open("r+b") as file:
        file.truncate(last.offset + last.length)
    return copy
