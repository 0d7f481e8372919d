"""A folder with every kind of run, made the same way each time."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from gymnasium.vector import SyncVectorEnv
from mcap.reader import make_reader

import runner
from dualtaxi.parallel import DualTaxiParallelEnv
from runner.cli import cli
from runner.config import from_mapping
from runner.config.model import Job
from runner.execution.session import run_job
from runner.export.mcap import export_mcap
from runner.integrations.tensorboard import SummaryWriter
from runner.recording.machine import HostSampler
from runner.recording.metadata import packed_provenance
from runner.recording.observer import Observer
from runner.recording.rewriting import rewrite
from runner.runs import provenance
from runner.runs.importing import import_recording
from runner.runs.run import Run, create_run, made_by
from tests.runner.loops.making import Rooms

ROOT = Path(__file__).parents[2]
STEPS = 60


def quick(**changes: Any) -> dict[str, Any]:
    """Return the shipped experiment `quick`, shorter, with changes."""
    config = yaml.safe_load((ROOT / "configs" / "quick.yaml").read_text(encoding="utf-8"))
    evaluation = {"every": 10, "trials": 5}
    return config | {"episodes": 30, "evaluation": evaluation} | changes


def constant(content: bytes, *spaces: Any) -> Callable[[Any], float]:
    """Return a policy that is the same for every observation; for `values`."""
    return lambda observation: 0.5


@contextlib.contextmanager
def same_everywhere() -> Iterator[None]:
    """Record no fact of this machine or installation, and of each run what it used of the machine, once."""
    take = Observer.take

    def take_measured(observer: Observer, is_last: bool = False) -> Any:
        if is_last and observer.host:
            observer.see_host(HostSampler().sample())
        return take(observer, is_last)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Observer, "take", take_measured)
        patch.setattr(Observer, "wants_host", lambda _: False)
        machine = {"dualtaxi": "1.0", "python": "3.11", "platform": "Linux"}
        patch.setattr(provenance, "_machine", lambda: machine)
        patch.setattr(provenance, "_packages", lambda: {"package.gymnasium": "1.2"})
        patch.setattr(provenance, "_packed_constants", provenance._packed_constants.__wrapped__)
        patch.setattr(provenance, "_settings", lambda _: {"host": "machine", "user": "user"})
        yield


def make_runs(folder: Path) -> dict[str, Run]:
    """Record a run of each kind into a folder; return them by name."""
    runs = dict(_jobs(folder)) | dict(_loops(folder))
    branch = runner.branch(
        runs["cooperative"], at="5:2", action="north + east", name="job-branch", recordings=folder
    )
    runs["job-branch"] = branch.run
    loop_branch = runner.branch(
        runs["pole"], at="0:3", action=0, policy="random", name="loop-branch", recordings=folder
    )
    runs["loop-branch"] = _made_here(loop_branch.run)
    _sweep(folder)
    plain, eager = quick(name="plain"), quick(name="eager", epsilon=0.5)
    for config in (plain, eager):
        folder.with_name(f"{config['name']}.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
    runner.explain(plain, eager, seeds=2, workers=1, recordings=folder)
    return runs


def _made_here(run: Run) -> Run:
    """Give a run that another process recorded the same provenance as the others."""
    fresh = run.folder / "fresh.mcap"
    here = packed_provenance(provenance.provenance())
    rewrite(run.recording, fresh, lambda name, entries: here if name == "provenance" else entries)
    fresh.replace(run.recording)
    return run.update(provenance=made_by(provenance.provenance()))


def _jobs(folder: Path) -> Iterator[tuple[str, Run]]:
    cooperative = runner.run(quick(name="cooperative"), recordings=folder)
    yield "cooperative", cooperative
    yield "other", runner.run(quick(name="other"), seed=1, recordings=folder)
    yield "competitive", runner.run(quick(name="competitive", mode="competitive"), recordings=folder)
    exact = {"every": 10, "trials": 5, "exact": True}
    yield (
        "lake",
        runner.run(
            {"name": "lake", "env": {"id": "FrozenLake-v1"}, "episodes": 20, "evaluation": exact},
            recordings=folder,
        ),
    )
    sparse = {"steps": "none", "system": False}
    yield "sparse", runner.run(quick(name="sparse", recording=sparse), seed=2, recordings=folder)
    config = from_mapping(quick(name="interrupted"))
    yield "interrupted", run_job(Job(config, 0), create_run(folder, config, 0), stop=_after(2))
    damaged = runner.run(quick(name="damaged"), seed=3, recordings=folder)
    with damaged.recording.open("r+b") as file:
        summary = make_reader(file).get_summary()
        (steps,) = (number for number, each in summary.channels.items() if each.topic == "/train/step")
        chunk = next(each for each in summary.chunk_indexes if steps in each.message_index_offsets)
        file.seek(chunk.chunk_start_offset + chunk.chunk_length // 2)
        byte = file.read(1)
        file.seek(-1, os.SEEK_CUR)
        file.write(bytes([byte[0] ^ 255]))
    yield "damaged", damaged
    elsewhere = runner.run(quick(name="pushed"), seed=4, recordings=folder.with_name("elsewhere"))
    export_mcap(elsewhere, folder.with_name("pushed.mcap"), anonymous=True)
    yield "pushed", import_recording(folder.with_name("pushed.mcap"), folder).run


def _after(calls: int) -> Any:
    """Return what says to stop after so often."""
    left = iter(range(calls))
    return lambda: next(left, None) is None


def _loops(folder: Path) -> Iterator[tuple[str, Run]]:
    frames = {"frames_every": 5, "info": ["*"]}
    pole = gymnasium.make("CartPole-v1")
    yield "pole", _played(runner.record(pole, folder, name="pole", seed=0, config={"lr": 3e-4}))
    framed = gymnasium.make("CartPole-v1", render_mode="rgb_array")
    yield "framed", _played(runner.record(framed, folder, name="framed", **frames))
    yield "taxi", _played(runner.record(gymnasium.make("Taxi-v4"), folder, name="taxi"))
    yield "rooms", _played(runner.record(Rooms(with_text=True), folder, name="rooms"))
    actions = gymnasium.make("CartPole-v1")
    yield "actions", _played(runner.record(actions, folder, name="actions", steps="actions"))
    poles = SyncVectorEnv([lambda: gymnasium.make("CartPole-v1")] * 3)
    with runner.record_vector(poles, folder, name="poles") as vector:
        vector.action_space.seed(0)
        vector.reset(seed=0)
        for _ in range(STEPS):
            vector.step(vector.action_space.sample())
    yield "poles", vector.run
    with runner.record_parallel(DualTaxiParallelEnv(max_steps=20), folder, name="game") as game:
        for episode in range(3):
            game.reset(seed=episode)
            while game.agents:
                game.step({agent: episode + i for i, agent in enumerate(game.agents)})
    yield "game", game.run
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DUALTAXI_RECORDINGS", str(folder))
        writer = SummaryWriter("logged")
        for step in range(STEPS):
            writer.add_scalar("loss", 1 / (step + 1), step)
        writer.close()
    yield "logged", runner.find_run("@latest", folder)


def _played(rec: Any) -> Run:
    """Take steps with everything that a loop can add to them."""
    with rec:
        rec.action_space.seed(0)
        for episode in range(4):
            with rec.phase("eval" if episode == 3 else "train"):
                rec.reset(seed=episode)
                over = False
                for step in range(15):
                    if not over:
                        *_, terminated, truncated, _ = rec.step(
                            rec.action_space.sample(), extras={"value": float(step)}
                        )
                        over = terminated or truncated
            rec.log("loss", 1 / (episode + 1))
            rec.log("note", f"episode {episode}")
        rec.snapshot("q", np.arange(6.0).reshape(3, 2))
        rec.checkpoint("policy", rec.run.name.encode())
    return rec.run


def _sweep(folder: Path) -> None:
    file = folder.with_name("small.yaml")
    base = {"env": {"id": "FrozenLake-v1"}, "episodes": 20, "evaluation": {"every": 10, "trials": 5}}
    values = {
        "name": "small",
        "base": base,
        "strategy": "grid",
        "parameters": {"step_size": [0.1, 0.5], "discount": [0.5, 0.9]},
        "seeds": [0, 1],
        "objective": {"metric": "mean_length", "direction": "minimize"},
    }
    file.write_text(yaml.safe_dump(values), encoding="utf-8")
    done = CliRunner().invoke(cli, ["sweep", "run", str(file), "--workers", "1", "--recordings", str(folder)])
    assert done.exit_code == 0, done.output
