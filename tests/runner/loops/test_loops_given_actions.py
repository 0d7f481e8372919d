"""Actions are recorded as the policy gave them, also where the environment changes its arrays in place."""

from __future__ import annotations

import copy
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.lib.recfunctions import structured_to_unstructured

import runner
from runner.errors import ConfigError
from runner.execution.verify import verify
from runner.loops.actions import parsed_action
from tests.runner.loops.making import dualtaxi

GIVEN = (0.8, -0.4)
BOX = spaces.Box(-1, 1, (2,), np.float32)


def halved(action: Any) -> Any:
    """Halve every array of an action in place; return the sum of what they are then."""
    if isinstance(action, np.ndarray):
        action *= 0.5
        return float(action.sum())
    if isinstance(action, int | np.integer):
        return 0.0
    return sum(halved(part) for part in (action.values() if isinstance(action, dict) else action))


class Halving(gymnasium.Env[Any, Any]):
    """Changes its action in place, and pays the sum of what it is then."""

    observation_space = spaces.Box(-9, 9, (1,), np.float32)

    def __init__(self, action_space: spaces.Space[Any] = BOX) -> None:
        self.action_space = action_space

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> Any:
        return np.zeros(1, np.float32), halved(action), False, False, {}


class HalvingVector(VectorEnv[Any, Any, Any]):
    """A vector of its own class that changes its actions in place."""

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012 - as in Gymnasium
    num_envs = 2
    single_observation_space, single_action_space = Halving.observation_space, BOX
    observation_space = batch_space(Halving.observation_space, 2)
    action_space = batch_space(BOX, 2)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return np.zeros((2, 1), np.float32), {}

    def step(self, actions: Any) -> Any:
        actions *= 0.5
        never = np.zeros(2, np.bool_)
        return np.zeros((2, 1), np.float32), actions.sum(axis=1).astype(np.float64), never, never, {}


class HalvingGame:
    """A PettingZoo parallel game that changes its agents' actions in place."""

    metadata = {"name": "halving"}  # noqa: RUF012 - as PettingZoo has it
    possible_agents = ["a", "b"]  # noqa: RUF012
    agents = possible_agents
    unwrapped = property(lambda self: self)

    def observation_space(self, agent: str) -> Any:
        return Halving.observation_space

    def action_space(self, agent: str) -> Any:
        return BOX

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        return {agent: np.zeros(1, np.float32) for agent in self.agents}, {agent: {} for agent in self.agents}

    def step(self, actions: Any) -> Any:
        seen, infos = self.reset()
        rewards = {agent: halved(actions[agent]) for agent in self.agents}
        never = dict.fromkeys(self.agents, False)
        return seen, rewards, never, never, infos

    def close(self) -> None:
        pass


def make_sync() -> Any:
    return SyncVectorEnv([Halving, Halving])


def array() -> Any:
    return np.array(GIVEN, np.float32)


NESTED = spaces.Dict({"arm": BOX, "legs": spaces.Tuple((BOX, spaces.Discrete(3)))})


def make_nested() -> Any:
    return Halving(NESTED)


def make_varying() -> Any:
    return Halving(spaces.Sequence(BOX))


WAYS: dict[str, tuple[Any, Any, Any, tuple[float, ...]]] = {
    "one": (runner.record, Halving, array, GIVEN),
    "parts": (
        runner.record,
        make_nested,
        lambda: {"arm": array(), "legs": (array(), 2)},
        (*GIVEN, *GIVEN, 2),
    ),
    "vector": (runner.record_vector, make_sync, lambda: np.tile(array(), (2, 1)), GIVEN),
    "own vector": (runner.record_vector, HalvingVector, lambda: np.tile(array(), (2, 1)), GIVEN),
    "game": (runner.record_parallel, HalvingGame, lambda: {"a": array(), "b": array()}, GIVEN * 2),
}


@pytest.mark.parametrize("way", WAYS)
def test_the_action_of_the_policy_is_recorded_and_reproduces_the_run(way, tmp_path):
    record, make, action, flat = WAYS[way]
    with record(make(), tmp_path, name="halving", make=make) as rec:
        rec.reset(seed=0)
        for _ in range(3):
            given = action()
            rec.step(given)
            changed = copy.deepcopy(action())
            halved(changed)
            assert repr(given) == repr(changed)  # what the environment was given is the caller's own array
    with runner.open_recording(rec.run.recording) as recording:
        rows = recording.train.steps.array()
    recorded = rows["action"]
    if recorded.dtype.names:
        recorded = structured_to_unstructured(recorded)
    floats = np.float32(recorded.reshape(-1, recorded.shape[-1]))
    assert np.array_equal(floats, np.tile(np.float32(flat), (len(floats), 1)))
    verified = dualtaxi(tmp_path, "verify", "halving", "--trust")
    assert (verified.exit_code, "reproduced" in verified.output) == (0, True), verified.output


def test_actions_of_varying_size_reproduce_the_run(tmp_path):
    with runner.record(make_varying(), tmp_path, name="halving", make=make_varying) as rec:
        rec.reset(seed=0)
        for n in range(3):
            rec.step(tuple(array() for _ in range(n)))
    verified = dualtaxi(tmp_path, "verify", "halving", "--trust")
    assert (verified.exit_code, "reproduced" in verified.output) == (0, True), verified.output


class EndingVector(HalvingVector):
    """Ends an episode in its steps 2 and 3, as if it were reset in the step that ends one."""

    taken = 0

    def step(self, actions: Any) -> Any:
        seen, rewards, never, _, infos = super().step(actions)
        self.taken += 1
        return seen, rewards, never | [self.taken in (2, 3), False], never, infos


def test_an_end_in_a_step_that_only_resets_is_recorded_and_not_counted(tmp_path):
    rec = runner.record_vector(EndingVector(), tmp_path)
    rec.reset()
    for _ in range(6):
        rec.step(np.ones((2, 2), np.float32))
    with pytest.warns(RuntimeWarning, match="An episode ended in the step after another end, which only"):
        rec.close()
    with runner.open_recording(rec.run.recording) as recording:
        rows = np.concatenate(list(recording.train.steps.rows()))
        own = rows[rows["environment"] == 0]
        assert own["terminated"].tolist() == [False, True, True, False, False, False]
        assert own["taken"].tolist() == [True, True, False, False, True, True]
        assert recording.train.episodes.array()["length"].tolist() == [2]
        assert len(recording.train.episode_steps(0)) == 2
    assert verify(rec.run.recording).finding == ""


@pytest.mark.parametrize(
    ("space", "fraction", "whole"),
    [
        (spaces.MultiDiscrete([3, 3]), [1.5, 0], [1.0, 0]),
        (spaces.MultiDiscrete([3, 3]), ["1.5", "0"], ["1", "0"]),
        (spaces.MultiBinary(2), np.array([0.9, 1]), (True, False)),
        (spaces.Tuple([spaces.MultiDiscrete([3, 3])]), "[[1.5, 0]]", "[[1, 0]]"),
    ],
)
def test_a_fraction_is_no_whole_number_of_an_action(space, fraction, whole):
    recorded = space.sample()
    assert parsed_action(space, whole, recorded, ()) in space
    with pytest.raises(ConfigError, match="expected numbers separated by commas, of Multi"):
        parsed_action(space, fraction, recorded, ())


@pytest.mark.parametrize("seed", [np.int64(3), np.arange(3, 5)])
def test_a_vector_gets_the_seeds_of_numpy_that_it_takes(seed, tmp_path):
    with runner.record_vector(HalvingVector(), tmp_path) as envs:
        envs.reset(seed=seed)
    with runner.open_recording(envs.run.recording) as recording:
        assert recording.train.resets.array()["seed"].tolist() == [3, 4]


def test_a_text_is_no_list_of_actions():
    space = spaces.Tuple([spaces.Discrete(3), spaces.Discrete(3)])
    with pytest.raises(ConfigError, match="found '12', expected a list of 2 parts"):
        parsed_action(space, '"12"', (0, 0), ())
