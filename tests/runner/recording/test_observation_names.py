"""The names of observations: as many as Gymnasium documents, and none where they may mean something else."""

from __future__ import annotations

import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium import wrappers

import runner
from runner.recording.environment import NAMES, observation_names
from runner.recording.reader import open_recording

POLE = NAMES["CartPoleEnv"]
IDS = {
    "AcrobotEnv": "Acrobot-v1",
    "BipedalWalker": "BipedalWalker-v3",
    "CartPoleEnv": "CartPole-v1",
    "Continuous_MountainCarEnv": "MountainCarContinuous-v0",
    "HalfCheetahEnv": "HalfCheetah-v5",
    "HopperEnv": "Hopper-v5",
    "LunarLander": "LunarLander-v3",
    "MountainCarEnv": "MountainCar-v0",
    "PendulumEnv": "Pendulum-v1",
    "Walker2dEnv": "Walker2d-v5",
}
ROW = re.compile(r"^ *\| *\d+ *\|", re.MULTILINE)


class Doubled(gymnasium.ObservationWrapper):
    """A wrapper of the user."""

    def observation(self, observation):
        return 2 * observation


def names_of(env, folder):
    with runner.record(env, folder) as recorded:
        recorded.reset(seed=1)
        recorded.step(recorded.action_space.sample())
    with open_recording(recorded.run.recording) as recording:
        return observation_names(recording)


@pytest.mark.parametrize("kind", sorted(NAMES))
@pytest.mark.filterwarnings("ignore:builtin type:DeprecationWarning")  # of Box2D when it is imported
def test_each_number_that_gymnasium_documents_has_a_name_of_its_own(kind):
    module, _, name = gymnasium.spec(IDS[kind]).entry_point.partition(":")
    assert name == kind
    assert len(set(NAMES[kind])) == len(NAMES[kind])
    source = Path(gymnasium.__file__).parent.parent / f"{module.replace('.', '/')}.py"
    text = (
        source.read_text(encoding="utf-8") if source.is_file() else ""
    )  # not imported: MuJoCo may be absent
    text = text.partition("Observation Space")[2]
    if "| Num |" in text:
        rows = ROW.findall(text[text.index("| Num |") :].split("\n\n")[0])
        assert len(rows) == len(NAMES[kind])
    else:
        assert gymnasium.make(IDS[kind]).observation_space.shape == (len(NAMES[kind]),)


@pytest.mark.parametrize(
    ("wrap", "names"),
    [
        (wrappers.NormalizeObservation, POLE),
        (wrappers.RecordEpisodeStatistics, POLE),
        (lambda env: wrappers.TransformObservation(env, np.sort, env.observation_space), ()),
        (wrappers.TimeAwareObservation, ()),
        (lambda env: wrappers.FrameStackObservation(env, 4), ()),
        (Doubled, ()),
    ],
)
def test_names_are_given_only_where_wrappers_keep_their_meaning(wrap, names, tmp_path):
    assert names_of(wrap(gymnasium.make("CartPole-v1")), tmp_path) == names


def test_other_environments_have_no_names(tmp_path):
    assert names_of(gymnasium.make("Blackjack-v1"), tmp_path) == ()
    assert names_of(gymnasium.make("FrozenLake-v1"), tmp_path) == ()


@pytest.mark.parametrize("mode", ["sync", "vector_entry_point"])
def test_a_vector_has_the_names_of_its_environments(mode, tmp_path):
    with runner.record_vector(
        gymnasium.make_vec("CartPole-v1", 2, vectorization_mode=mode), tmp_path
    ) as recorded:
        recorded.reset(seed=1)
        recorded.step(recorded.action_space.sample())
    with open_recording(recorded.run.recording) as recording:
        assert observation_names(recording) == POLE
