"""Environments, names, settings and values of other libraries."""

from __future__ import annotations

import json
import threading
from argparse import Namespace
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from click.testing import CliRunner
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, VectorEnv

import runner
from runner.cli import cli
from runner.errors import ConfigError, EnvironmentNotUsable
from runner.recording.integrity import check_integrity
from runner.recording.reader import open_recording
from tests.runner.loops.making import make


class Pool(gymnasium.Env[Any, Any]):
    """Two environments like EnvPool's: an Env and a VectorEnv, with its own specification."""

    num_envs = 2
    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012 - as EnvPool has it
    observation_space = single_observation_space = spaces.Box(-1, 1, (3,), np.float32)
    action_space = single_action_space = spaces.Discrete(2)
    spec = SimpleNamespace(config={"num_envs": 2, "seed": 1})  # type: ignore[assignment]

    def reset(self, env_id: Any = None, *, seed: Any = None, options: Any = None) -> Any:
        return np.zeros((2, 3), np.float32), {"env_id": np.arange(2)}

    def step(self, action: Any, env_id: Any = None) -> Any:
        never = np.zeros(2, bool)
        return np.ones((2, 3), np.float32), np.ones(2, np.float32), never, never, {"env_id": np.arange(2)}


class Listed(VectorEnv[Any, Any, Any]):
    """Two environments like SuperSuit's: resets not stated, spaces of one environment, infos in a list."""

    def __init__(self) -> None:
        self.num_envs, self.t = 2, 0
        self.envs: list[object] = []  # they are in other processes
        self.metadata = {}
        self.observation_space = spaces.Box(0, 99, (1,), np.float32)
        self.action_space = spaces.Discrete(2)

    def _observations(self) -> Any:
        return np.full((2, 1), self.t, np.float32)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return self._observations(), [{}, {}]

    def step(self, actions: Any) -> Any:
        self.t += 1
        over = self.t == 3
        infos: list[dict[str, Any]] = [{"terminal_observation": self._observations()[0]} if over else {}] * 2
        self.t = 0 if over else self.t
        return self._observations(), np.ones(2), np.full(2, over), np.zeros(2, bool), infos


def test_an_environment_in_the_shape_of_envpool_is_recorded(tmp_path):
    class Both(Pool, VectorEnv):  # type: ignore[misc,type-arg]
        pass

    with pytest.raises(ConfigError, match="record_vector is for vector environments"):
        runner.record(Both(), tmp_path)
    with runner.record_vector(Both(), tmp_path, info=["*"]) as rec:
        rec.reset()
        rec.step(np.zeros(2, int))
    check_integrity(rec.run.recording)
    assert rec.run.facts["config"]["env"]["kwargs"] == {"seed": 1}


def test_an_environment_in_the_shape_of_supersuit_is_recorded(tmp_path):
    with pytest.raises(EnvironmentNotUsable, match="autoreset_mode="):
        runner.record_vector(Listed(), tmp_path)
    with pytest.raises(ConfigError, match="autoreset_mode: found 'soon', expected one of 'NextStep'"):
        runner.record_vector(Listed(), tmp_path, autoreset_mode="soon")
    with runner.record_vector(Listed(), tmp_path, autoreset_mode="SameStep", info=["*"]) as rec:
        rec.reset()
        for _ in range(6):
            rec.step(np.zeros(2, int))
    check_integrity(rec.run.recording)
    with open_recording(rec.run.recording) as recording:
        steps = recording.train.steps.array()
        assert recording.train.episodes.array()["length"].tolist() == [3] * 4
    assert steps["next_observation"][::2].ravel().tolist() == [1, 2, 3, 1, 2, 3]


def test_an_async_vector_environment_is_recorded_by_its_own_id(tmp_path):
    envs = AsyncVectorEnv([lambda: make("FrozenLake-v1")] * 2)
    before = np.random.get_state()[1].tolist()  # type: ignore[union-attr]
    with runner.record_vector(envs, tmp_path) as rec:
        rec.reset(seed=1)
        rec.step(np.zeros(2, int))
    assert np.random.get_state()[1].tolist() == before  # type: ignore[union-attr]
    assert rec.run.facts["config"]["env"]["id"] == "FrozenLake-v1"


def test_arguments_of_make_vec_are_not_settings_of_the_environment(tmp_path):
    envs = gymnasium.make_vec("CartPole-v1", 2, vectorization_mode="vector_entry_point")
    with runner.record_vector(envs, tmp_path) as rec:
        rec.reset(seed=1)
    assert not rec.run.facts["config"]["env"]["kwargs"].keys() & {"num_envs", "vectorization_mode"}


class Mission(spaces.Space[str]):
    """A space of texts like MiniGrid's."""

    def __init__(self) -> None:
        super().__init__(dtype=str)


@pytest.mark.parametrize(
    ("space", "value", "expected"),
    [
        (Mission(), "open the door", "open the door"),
        (spaces.Sequence(spaces.Discrete(3)), (1, 2), "[1, 2]"),
        (spaces.OneOf([spaces.Discrete(3), spaces.Box(0, 1, (1,))]), (0, 2), "[0, 2]"),
        (spaces.Discrete(2**40), 2**39 + 1, 2**39 + 1),
    ],
    ids=["custom", "sequence", "one of", "large"],
)
def test_values_of_any_space_are_recorded(tmp_path, space, value, expected):
    class World(gymnasium.Env[Any, Any]):
        observation_space = space
        action_space = spaces.Discrete(2)

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            return value, {}

        def step(self, action: Any) -> Any:
            return value, 0.0, False, False, {}

    with runner.record(World(), tmp_path) as rec:
        rec.reset()
        rec.step(1)
    check_integrity(rec.run.recording)
    with open_recording(rec.run.recording) as recording:
        (step,) = recording.train.transitions()
    assert step["next_observation"] == expected


def test_a_graph_is_recorded_as_json(tmp_path):
    space = spaces.Graph(spaces.Box(0, 1, (1,)), None)

    class World(gymnasium.Env[Any, Any]):
        observation_space = space
        action_space = spaces.Discrete(2)

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            return space.sample(), {}

    with runner.record(World(), tmp_path) as rec:
        rec.reset()
    with open_recording(rec.run.recording) as recording:
        (reset,) = recording.train.reset_values()
    assert json.loads(reset["observation"]).keys() == {"nodes", "edges", "edge_links"}


@dataclass
class Args:
    """The settings of a script."""

    lr: float = 0.5
    folder: Path = Path("there")
    inner: dict[str, Any] = field(default_factory=lambda: {"sizes": (8, 8)})


class Conf(Mapping[str, Any]):
    """A mapping that is not a dictionary, like OmegaConf's."""

    def __getitem__(self, key: str) -> Any:
        return {"lr": 0.5, "folder": "there", "inner": {"sizes": [8, 8]}}[key]

    def __iter__(self) -> Iterator[str]:
        return iter(("lr", "folder", "inner"))

    def __len__(self) -> int:
        return 3


@pytest.mark.parametrize(
    "settings", [Args(), Namespace(**vars(Args())), SimpleNamespace(**vars(Args())), Conf()], ids=type
)
def test_settings_may_be_of_any_type_with_fields(tmp_path, settings):
    runner.record(make("CartPole-v1"), tmp_path, config=settings, name="any").close()
    found = runner.find_run("any", tmp_path).facts["config"]["config"]
    assert found == {"lr": 0.5, "folder": "there", "inner": {"sizes": [8, 8]}}


def test_settings_without_fields_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="config: found int, expected a mapping, a dataclass"):
        runner.record(make("CartPole-v1"), tmp_path, config=3)


@pytest.mark.parametrize("name", ["ALE/Pong-v5__ppo__1", "a+b"])
def test_names_of_other_libraries_are_accepted(tmp_path, name):
    runner.record(make("CartPole-v1"), tmp_path, name=name).close()
    assert runner.find_run(name, tmp_path).name == name
    shown = CliRunner().invoke(cli, ["show", name, "--recordings", str(tmp_path)])
    assert shown.exit_code == 0
    assert name in shown.output


def test_a_loop_without_a_seed_is_listed_without_one(tmp_path):
    for seed in (None, 0):
        runner.record(make("CartPole-v1"), tmp_path, name=f"seed-{seed}", seed=seed).close()
    listed = CliRunner().invoke(cli, ["ls", "--recordings", str(tmp_path), "--json"])
    assert {row["name"]: row["seed"] for row in json.loads(listed.output)["runs"]} == {
        "seed-None": None,
        "seed-0": 0,
    }
    run = runner.find_run("seed-None", tmp_path)
    assert run.title == "seed-None"
    (run.folder / "run.json").unlink()  # the recording says it too
    assert runner.find_run("seed-None", tmp_path).title == "seed-None"


class Tensor:
    """A tensor with a gradient, like PyTorch's."""

    def __init__(self, values: Any, dtype: str = "torch.float32", needs_gradient: bool = True) -> None:
        self._values, self.dtype, self._needs = np.asarray(values, np.float32), dtype, needs_gradient

    def detach(self) -> Tensor:
        return Tensor(self._values, self.dtype, needs_gradient=False)

    def cpu(self) -> Tensor:
        return self

    def float(self) -> Tensor:
        return Tensor(self._values, "torch.float32", self._needs)

    def __array__(self, dtype: Any = None, copy: Any = None) -> Any:
        if self._needs or self.dtype == "torch.bfloat16":
            raise RuntimeError("Can't call numpy() on a tensor like this")
        return self._values

    def __float__(self) -> Any:
        return float(self.__array__())


def test_tensors_and_dictionaries_of_them_are_recorded(tmp_path):
    with runner.record(make("CartPole-v1"), tmp_path) as rec:
        rec.reset(seed=0)
        rec.step(0)
        rec.snapshot("net", {"w": Tensor([1, 2]), "inner": {"b": Tensor([0.5], "torch.bfloat16")}})
        rec.log({"loss": Tensor(2.0), "lone": Tensor([3.0]), "eval": {"return": 3}})
        with pytest.raises(ConfigError, match="found list of object for 'opt/groups'"):
            rec.snapshot("opt", {"w": [1.0], "groups": [{"lr": 1}]})
    with open_recording(rec.run.recording) as recording:
        arrays = {array.name: array.values.tolist() for array in recording.arrays()}
        logged = {one["name"]: one["value"] for one in recording.table("/scalar").decoded()}
    assert arrays == {"net/w": [1, 2], "net/inner/b": [0.5]}
    assert logged == {"loss": 2, "lone": 3, "eval/return": 3}


def test_short_recordings_start_no_threads(tmp_path):
    before = {thread.name for thread in threading.enumerate()} | {"recording-flush"}
    with runner.record(make("CartPole-v1"), tmp_path) as rec:
        rec.log("x", 1.0)
        assert {thread.name for thread in threading.enumerate()} <= before
    check_integrity(rec.run.recording)
