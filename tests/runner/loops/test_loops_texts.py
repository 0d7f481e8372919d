"""Texts and other values of varying size, of several environments at once and of games."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from click.testing import CliRunner
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import concatenate, create_empty_array

import runner
from runner.cli import cli
from runner.errors import ConfigError, RecordingError
from runner.execution.verify import check_integrity, verify
from runner.recording.description import environment_count
from runner.recording.reader import open_recording
from runner.recording.spaces import decode
from runner.replay.environment import rerun
from runner.replay.recorded import reset_of
from tests.runner.loops import talking
from tests.runner.loops.talking import ENVIRONMENTS, MAKERS, said
from tests.runner.replay.varied import SPACES, Varied

STEPS = 300
TEXTS = ("observation", "action")


def talk(envs, steps=STEPS):
    """Step environments; return first observations, and actions, observations, rewards and ends by step."""
    first, _ = envs.reset(seed=3)
    taken, over = [], np.zeros(ENVIRONMENTS, bool)
    for t in range(steps):
        if over.any() and envs.unwrapped.metadata["autoreset_mode"] == AutoresetMode.DISABLED:
            envs.reset(options={"reset_mask": over})
        actions = tuple(said(t, i) for i in range(ENVIRONMENTS))
        seen, rewards, terminated, truncated, infos = envs.step(actions)
        over = terminated | truncated
        taken.append((actions, seen, rewards, terminated, truncated, infos.get("final_obs")))
    return first, taken


def played(run, folder, episode):
    """Return the observations after the steps of an episode, as `play` prints them with their rewards."""
    shown = CliRunner().invoke(
        cli, ["play", run.run_id, "--episode", str(episode), "--recordings", str(folder)]
    )
    assert shown.exit_code == 0, shown.output
    lines = shown.output.splitlines()
    return [lines[k + 1] for k, line in enumerate(lines) if line.startswith("reward")]


def texts(recording, name, field):
    return [
        decode(recording.spaces[name], data, "")
        for rows in recording.train.steps.rows()
        for data in rows[field]
    ]


@pytest.mark.parametrize("mode", AutoresetMode)
def test_texts_of_a_vector_are_read_back_and_reproduced(mode, tmp_path):
    make = MAKERS[mode]
    with runner.record_vector(make(), tmp_path, make=make) as envs:
        _, taken = talk(envs)
    with open_recording(envs.run.recording) as recording:
        assert texts(recording, "action", "action") == [text for step in taken for text in step[0]]
        after = [
            final[i] if final is not None and final[i] is not None else step[1][i]
            for step in taken
            for i, final in ((i, step[5]) for i in range(ENVIRONMENTS))
        ]
        assert texts(recording, "observation", "next_observation") == after
        assert recording.train.steps.count() == STEPS * ENVIRONMENTS
    check_integrity(envs.run.recording)
    outcome = verify(envs.run.recording)
    assert (outcome.verdict, outcome.sound) == ("reproduced", True), outcome.reason


@pytest.mark.parametrize("is_whole", [True, False])
def test_a_change_of_the_environment_is_found_at_its_first_step(is_whole, tmp_path):
    options = {"make": talking.make} if is_whole else {}
    with runner.record_vector(talking.make(), tmp_path, **options) as envs:
        _, taken = talk(envs)
    step = next(t for t, own in enumerate(taken) if "so far" in own[1][0])
    make = talking.make_mistaken if is_whole else talking.Mistaken
    with open_recording(envs.run.recording) as recording:
        found = [steps.difference for steps in rerun(recording, make=make)][-1]
    assert (found.environment, found.t, found.field) == (0, step, "observation")
    was = taken[step][1][0]
    assert (found.recorded, found.got) == (was, was.replace("so far", "now"))


def test_an_episode_of_a_vector_is_played_alone(tmp_path):
    with runner.record_vector(talking.make(), tmp_path, make=talking.make) as envs:
        first, taken = talk(envs, 40)
    with open_recording(envs.run.recording) as recording:
        ended = recording.train.episodes.array()
        for number in (1, 5):
            length, environment = int(ended[number]["length"]), int(ended[number]["last_step"]) % ENVIRONMENTS
            seen = [repr(step[1][environment]) for step in taken[:length]]
            assert played(envs.run, tmp_path, number) == [*seen[:-1], f"{seen[-1]}, ended"]
            reset = reset_of(recording, "train", number)
            assert reset.value(recording) == first[environment]


def test_vectors_of_texts_share_a_run(tmp_path):
    with runner.record_vector(talking.make(), tmp_path, make=talking.make) as envs:
        with runner.record_vector(talking.make(), join=envs.run, shard="two", make=talking.make) as two:
            talk(two, 90)
        talk(envs, 60)
    check_integrity(envs.run.recording)
    outcome = verify(envs.run.recording)
    assert outcome.sound, outcome.reason
    with open_recording(envs.run.recording) as recording:
        assert environment_count(recording) == 2 * ENVIRONMENTS


@pytest.mark.parametrize("name", SPACES)
def test_any_space_is_recorded_of_a_vector(name, tmp_path):
    make = partial(SyncVectorEnv, [partial(Varied, name)] * 3)
    with runner.record_vector(make(), tmp_path) as envs:
        envs.single_action_space.seed(5)
        envs.reset(seed=1)
        for _ in range(20):
            sample = [envs.single_action_space.sample() for _ in range(3)]
            envs.step(batch(envs.single_action_space, sample))
    check_integrity(envs.run.recording)
    with open_recording(envs.run.recording) as recording:
        for steps in rerun(recording, make=partial(Varied, name)):
            steps.require_equal()


def batch(space, values):
    return concatenate(space, values, create_empty_array(space, len(values)))


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("as_lists", [True, False])
def test_texts_in_batches_are_those_of_a_vector(mode, as_lists, tmp_path):
    make = MAKERS[mode]
    with runner.record_vector(make(), tmp_path, name="steps", make=make) as envs:
        first, taken = talk(envs)
    with runner.record_batches(make(), tmp_path, name="batches", make=make) as rec:
        before = first
        for part in (taken[:100], taken[100:101], taken[101:]):
            actions, seen, rewards, terminated, truncated, finals = zip(*part, strict=True)
            last = None
            if mode == AutoresetMode.SAME_STEP:
                last = [["" if own is None else own[i] or "" for i in range(ENVIRONMENTS)] for own in finals]
            values = [[before, *seen], actions, last]
            if not as_lists:
                values = [None if own is None else np.array(own, object) for own in values]
            observations, done, last = (own if own is None else to_lists(own) for own in values)
            rec.batch(observations, done, rewards, terminated, truncated, final_observations=last)
            before = seen[-1]
        with pytest.raises(ConfigError, match="not the last observations"):
            rec.batch(
                [["x"] * ENVIRONMENTS, *to_lists(seen)],
                to_lists(actions),
                *part_of(part),
                final_observations=last,
            )
    with open_recording(envs.run.recording) as a, open_recording(rec.run.recording) as b:
        for name, field in (("action", "action"), ("observation", "next_observation")):
            assert texts(a, name, field) == texts(b, name, field)
    outcome = verify(rec.run.recording)  # batches have no seeds
    assert (outcome.verdict, outcome.sound) == ("consistent", True), outcome.reason


def to_lists(values):
    return values if isinstance(values, np.ndarray) else [list(own) for own in values]


def part_of(part):
    return [list(values) for values in list(zip(*part, strict=True))[2:5]]


def test_a_batch_of_texts_of_an_unknown_space_is_refused(tmp_path):
    rec = runner.record_batches("Talk", tmp_path, autoreset_mode="NextStep")
    with pytest.raises(ConfigError, match="pass observation_space"):
        rec.batch([["a"], ["b"]], [["c"]], [[0.0]], [[False]])


def test_observations_of_another_number_of_environments_are_refused(tmp_path):
    with runner.record_vector(talking.make(), tmp_path) as envs:
        envs.reset(seed=1)
        for wrong in (("a",) * 7, ("a",) * 9, "a" * ENVIRONMENTS, (3,) * ENVIRONMENTS):
            none = np.zeros(ENVIRONMENTS, bool)
            with pytest.raises(RecordingError, match="not of the environment's observation space"):
                envs.record_step(("",) * ENVIRONMENTS, (wrong, np.zeros(ENVIRONMENTS), none, none, {}))


def test_long_texts_are_written_before_the_block_is_full(tmp_path):
    long = "ab" * 500_000
    none = np.zeros(ENVIRONMENTS, bool)
    with runner.record_vector(talking.make(), tmp_path) as envs:
        envs.reset(seed=1)
        for t in range(6):
            seen = tuple(f"{t}{i}{long}" for i in range(ENVIRONMENTS))
            envs.record_step(("",) * ENVIRONMENTS, (seen, np.zeros(ENVIRONMENTS), none, none, {}))
            assert envs._rows.pending <= 2 * ENVIRONMENTS
    with open_recording(envs.run.recording) as recording:
        found = texts(recording, "observation", "next_observation")
    assert found == [f"{t}{i}{long}" for t in range(6) for i in range(ENVIRONMENTS)]


@pytest.mark.parametrize("field", ["observation", "action"])
def test_long_texts_in_batches_are_written_before_the_block_is_full(field, tmp_path):
    long, none = [["ab" * 250_000] * ENVIRONMENTS], np.zeros((1, ENVIRONMENTS))
    with runner.record_batches(talking.make(), tmp_path) as rec:
        rec.reset(["begin"] * ENVIRONMENTS)
        for _ in range(8):
            seen, done = (long if field == name else [["b"] * ENVIRONMENTS] for name in TEXTS)
            rec.batch(seen, done, none, none)
            assert rec._rows.pending <= 3 * ENVIRONMENTS
    with open_recording(rec.run.recording) as recording:
        (found,) = set(texts(recording, field, field.replace("obs", "next_obs")))
    assert found == long[0][0]


def test_texts_of_a_game_are_read_back_and_reproduced(tmp_path):
    taken = []
    with runner.record_parallel(talking.Negotiation(), tmp_path, make=talking.Negotiation) as env:
        for episode in range(4):
            env.reset(seed=episode)
            for t in range(6):
                actions = talking.offers(env.agents, t)
                taken.append((actions, env.step(actions)[0]))
    with open_recording(env.run.recording) as recording:
        actions = texts(recording, "action", "action")
        seen = texts(recording, "observation", "next_observation")
        for (acted, observed), action, after in zip(taken, actions, seen, strict=True):
            assert action["buyer"] == acted.get("buyer", "")
            assert action["seller"]["text"] == acted["seller"]["text"]
            assert after["seller"]["heard"] == observed["seller"]["heard"]
            assert after["buyer"]["heard"] == observed.get("buyer", {}).get("heard", "")
    check_integrity(env.run.recording)
    assert verify(env.run.recording).verdict == "reproduced"
    with open_recording(env.run.recording) as recording:
        found = [steps.difference for steps in rerun(recording, make=talking.Changed)][-1]
    assert (found.episode, found.t, found.field) == (0, 0, "observation['buyer']['heard']")


def test_texts_of_a_game_in_turns_are_reproduced(tmp_path):
    taken = []
    with runner.record_aec(talking.in_turns(), tmp_path, make=talking.in_turns) as env:
        for episode in range(3):
            env.reset(seed=episode)
            for agent in env.agent_iter():
                _, _, terminated, truncated, _ = env.last()
                action = None if terminated or truncated else talking.offers([agent], len(taken) % 5)[agent]
                env.step(action)
                if action is not None:
                    taken.append((agent, action))
    with open_recording(env.run.recording) as recording:
        for (agent, action), found in zip(taken, texts(recording, "action", "action"), strict=True):
            text = action if agent == "buyer" else action["text"]
            assert (found[agent] if agent == "buyer" else found[agent]["text"]) == text
    assert verify(env.run.recording).verdict == "reproduced"
