"""Recordings of loops forged with every checksum, digest and count right: what is implied must still fit."""

from __future__ import annotations

import json
import re
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import Autoreset, TransformReward

import runner
from runner.errors import RecordingError
from runner.execution.verify import verify
from runner.recording import schema
from runner.recording.consistency import check_phase
from runner.recording.digest import ContentHash, combined_digest
from runner.recording.layout import message_record
from runner.recording.reader import open_recording
from runner.recording.rewriting import content_of
from runner.recording.topic_chunks import TopicChunks
from tests.runner.altering import altered
from tests.runner.loops.making import Described, Leaving, Rooms, drive, make, parallel, play


def forged(source, target, topics=None, result=None):
    """Return a recording with topics changed, by name, whose result says what its messages come to."""
    for k, (name, change) in enumerate((topics or {}).items()):
        with open_recording(source) as recording:
            topic = recording.table(name).topic
        source = altered(source, target.with_name(f"{k}-{target.name}"), topic, change)
    with open_recording(source) as recording:
        digest, counts = ContentHash(), {}
        for topic in set(recording.topics) - set(schema.MACHINE_TOPICS):
            messages = list(recording.table(topic).messages())
            counts[topic.name] = len(messages)
            for time, payload in messages:
                digest.update(topic, message_record(topic, time, payload))
    stored = {
        "content_digest": combined_digest(digest.topics()),
        "topic_digests": digest.topics(),
        "messages": {name: count for name, count in counts.items() if count},
        "train_steps": counts["/train/step"],
        "eval_steps": counts["/eval/step"],
        "episodes": counts["/train/episode"],
    } | (result or {})

    def change(entries):
        return {"json": json.dumps(json.loads(entries["json"]) | stored)}

    return altered(source, target, None, None, result=change)


def setting(field, index, value):
    """Return what changes a field of one record; `value` takes what is there."""

    def change(records):
        records[field][index] = value(records[field][index])
        return records

    return change


def but_last(records):
    return records[:-1]


def without(index):
    """Return what leaves one reset out, and numbers the others again."""

    def change(records):
        kept = np.delete(records, index)
        kept["reset"] = np.arange(len(kept))
        return kept

    return change


@pytest.fixture(scope="module")
def loops(tmp_path_factory):
    """Return the recordings of many kinds of loops, by name."""
    folder = tmp_path_factory.mktemp("loops")
    found = {}
    for name, steps in (("Taxi-v4", 900), ("FrozenLake-v1", 400), ("CartPole-v1", 700), ("RoomsText", 150)):
        with runner.record(make(name), folder, name=name, chunk_steps=256) as env:
            for _ in play(env, steps):
                pass
            with env.phase("eval"):
                for k, _ in enumerate(play(env, 120, seed=6)):
                    if k in (30, 31):
                        env.reset()
        found[name] = env.run.recording
    for mode in AutoresetMode:
        for name in ("CartPole-v1", "FrozenLake-v1"):
            envs = SyncVectorEnv([lambda name=name: make(name)] * 3, autoreset_mode=mode)
            with runner.record_vector(envs, folder, name=mode.name, chunk_steps=256) as rec:
                drive(rec, 200)
                rec.reset(seed=3)
                drive(rec, 50)
                rec.reset()
            found[f"{name} {mode.name}"] = rec.run.recording
    with runner.record_parallel(Leaving(), folder, name="game") as rec:
        parallel(rec, 30)
        rec.reset()
    found["game"] = rec.run.recording
    return found


KINDS = ["Taxi-v4", "FrozenLake-v1", "CartPole-v1", "RoomsText", "game"]
KINDS += [f"{name} {mode.name}" for name in ("CartPole-v1", "FrozenLake-v1") for mode in AutoresetMode]
FIXED = [name for name in KINDS if name != "RoomsText"]


@pytest.mark.parametrize("name", KINDS)
def test_what_a_loop_recorded_is_sound(loops, name, tmp_path):
    found = verify(loops[name])
    assert found.sound, found.finding
    assert len(found.notes) == ("DISABLED" in name and "without a reset" in str(found.notes))
    assert verify(forged(loops[name], tmp_path / "same.mcap")).sound


@pytest.mark.parametrize("name", FIXED)
@pytest.mark.parametrize(
    ("topic", "change"),
    [
        ("/train/episode", setting("returns", 3, lambda value: value + 1)),
        ("/train/episode", setting("length", 3, lambda value: value + 1)),
        ("/train/episode", setting("last_step", 3, lambda value: value - 1)),
        ("/train/episode", setting("terminated", 2, np.logical_not)),
        ("/train/episode", but_last),
        ("/train/step", setting("terminated", 20, np.logical_not)),
        ("/train/step", setting("truncated", 20, np.logical_not)),
        ("/train/step", setting("t", 20, lambda value: value + 1)),
        ("/train/step", setting("episode", 20, lambda value: value + 1)),
        ("/train/step", setting("rewards", 20, lambda value: value + 1)),
        ("/train/step", but_last),
        ("/train/reset", but_last),
        ("/train/reset", without(0)),
        ("/train/reset", without(2)),
        ("/train/reset", lambda records: records[:0]),
        ("/train/reset", setting("episode", 2, lambda value: value + 1)),
        ("/train/reset", setting("step", 2, lambda value: value + 1)),
    ],
)
def test_what_does_not_follow_from_the_rest_is_wrong(loops, tmp_path, name, topic, change):
    if topic == "/train/reset" and change is but_last and name in ("game", "FrozenLake-v1 NEXT_STEP"):
        pytest.skip("nothing follows from a reset that ends no episode, and after which there is no step")
    finding = verify(forged(loops[name], tmp_path / "x.mcap", {topic: change})).finding
    assert "/train/" in finding or "steps, expected" in finding


@pytest.mark.parametrize("name", ["Taxi-v4", "FrozenLake-v1", *KINDS[-3:]])
@pytest.mark.parametrize("field", ["state", "next_state"])
def test_a_state_that_does_not_follow_from_the_one_before_is_wrong(loops, tmp_path, name, field):
    def change(records):
        within = np.flatnonzero(~(records["terminated"] | records["truncated"]) & (records["t"] == 1))
        records[field][within[3]] = (records[field][within[3]] + 1) % 16
        return records

    finding = verify(forged(loops[name], tmp_path / "x.mcap", {"/train/step": change})).finding
    assert f"{field.removeprefix('next_')}: found" in finding


def test_a_reward_that_the_table_excludes_is_wrong_though_the_episode_fits_it(loops, tmp_path):
    def pay(records):
        records["rewards"][5] += 7
        return records

    def collect(records):
        records["returns"][0] += 7
        return records

    made = forged(loops["Taxi-v4"], tmp_path / "x.mcap", {"/train/step": pay, "/train/episode": collect})
    assert "step 5: rewards: found one that the environment's table excludes" in verify(made).finding


def test_a_loop_whose_rewards_are_changed_by_a_wrapper_is_sound_and_says_so(tmp_path):
    env = TransformReward(gymnasium.make("FrozenLake-v1"), lambda reward: reward - 0.01)
    with runner.record(env, tmp_path) as env:
        for _ in play(env, 300):
            pass
    found = verify(env.run.recording)
    assert found.sound, found.finding
    assert any(
        "300 steps have rewards that are not in the environment's table" in note for note in found.notes
    )


def test_a_loop_whose_environment_resets_itself_is_sound(tmp_path):
    with runner.record(Autoreset(gymnasium.make("CartPole-v1")), tmp_path) as env:
        env.reset(seed=1)
        for _ in range(300):
            env.step(env.action_space.sample())
    found = verify(env.run.recording)
    assert found.sound, found.finding
    assert any("began without a reset" in note for note in found.notes)


@pytest.mark.parametrize("key", ["train_steps", "eval_steps", "episodes", "messages", "topic_digests"])
def test_a_result_that_counts_something_else_is_wrong(loops, tmp_path, key):
    with open_recording(loops["Taxi-v4"]) as recording:
        value = recording.result[key]
    other = value + 1 if isinstance(value, int) else {}
    finding = verify(forged(loops["Taxi-v4"], tmp_path / "x.mcap", result={key: other})).finding
    assert f"metadata result: {key}" in finding


@pytest.mark.parametrize("name", KINDS)
def test_a_loop_that_was_killed_is_sound_as_far_as_it_goes(loops, tmp_path, name):
    data = loops[name].read_bytes()
    for part in range(1, 20):
        (tmp_path / "cut.mcap").write_bytes(data[: len(data) * part // 20])
        try:
            with open_recording(tmp_path / "cut.mcap"):
                pass
        except runner.errors.RecordingError:
            continue
        finding = verify(tmp_path / "cut.mcap").finding
        assert "/train/" not in finding, finding
        assert "/eval/" not in finding, finding


REWARD = b'^"\x08.{8}'
"""The reward of a step, and below its number, as they stand in a message."""
STEP_3 = b"\\)\x03\x00{7}"


@pytest.mark.parametrize(
    ("part", "other", "finding"),
    [
        (
            REWARD,
            b'"\x10' + bytes(16),
            "at 400000000 ns: found a payload that is no dualtaxi.Step",
        ),
        (REWARD, b"", "at 400000000 ns: found a payload that is no dualtaxi.Step"),
        (STEP_3, b")\x04" + bytes(7), "found step 4, expected 3"),
    ],
)
def test_messages_of_varying_size_have_their_number_and_their_rewards(tmp_path, part, other, finding):
    with runner.record(Rooms(with_text=True), tmp_path) as rec:
        rec.reset(seed=1)
        for _ in range(5):
            rec.step(rec.action_space.sample())

    def change(messages):
        time, payload = messages[3]
        changed = re.sub(part, lambda _: other, payload, count=1, flags=re.DOTALL)
        assert changed != payload
        messages[3] = time, changed
        return messages

    odd = altered(rec.run.recording, tmp_path / "odd.mcap", schema.TRAIN_STEP, change)
    assert finding in verify(odd).finding


def test_descriptions_of_a_loop_that_cannot_be_true_are_refused(tmp_path):
    with runner.record(gymnasium.make("CartPole-v1"), tmp_path, steps="actions", index="message") as rec:
        rec.reset(seed=1)
        for _ in range(5):
            rec.step(0)

    def stating(name, **values):
        def change(entries):
            return {"json": json.dumps(json.loads(entries["json"]) | values)}

        return altered(
            rec.run.recording, tmp_path / f"{len(values)}-{name}.mcap", None, None, **{name: change}
        )

    assert "env_id" in verify(stating("config", env=5)).finding
    found = verify(stating("result", topic_digests={"/train/step": "no"}, x=0))
    assert "the hash of /train/step: found 'no', expected hexadecimal digits" in found.finding
    claimed = {"compression": "zstd", "level": 1, "index": "message", "steps": "all"}
    found = verify(stating("config", recording=claimed, y=0))
    assert "/train/step: found actions alone, expected whole steps" in found.finding


@pytest.mark.parametrize("wrong", [0, 1, 2])
def test_of_several_resets_before_a_step_the_wrong_one_is_named(tmp_path, wrong):
    envs = SyncVectorEnv([lambda: make("FrozenLake-v1")] * 2)
    with runner.record_vector(envs, tmp_path) as rec:
        drive(rec, 20)
        for _ in range(3):
            rec.reset(seed=3)
        drive(rec, 20)
        rec.reset()
        rec.reset()
    with open_recording(rec.run.recording) as recording:
        resets = recording.train.resets.array()
    (several,) = (step for step in np.unique(resets["step"]) if np.sum(resets["step"] == step) >= 6)
    number = int(resets["reset"][resets["step"] == several][2 * wrong])
    change = setting("episode", number, lambda value: value + 1)
    assert verify(forged(rec.run.recording, tmp_path / "same.mcap")).sound
    made = forged(rec.run.recording, tmp_path / "x.mcap", {"/train/reset": change})
    assert f"/train/reset, reset {number}: episode: found" in verify(made).finding


@pytest.mark.parametrize("topic", ["/train/episode", "/train/reset"])
def test_each_message_is_compared_in_a_time_that_does_not_grow(tmp_path, monkeypatch, topic):
    read = []

    def counted(original):
        def chunks(self, *arguments):
            for k, rows in original(self, *arguments):
                if self.topic.name == topic:
                    read.append(len(rows))
                yield k, rows

        return chunks

    with runner.record_parallel(Leaving(), tmp_path, chunk_steps=256) as rec:
        parallel(rec, 700)
        for _ in range(300):
            rec.reset()
    with open_recording(rec.run.recording) as recording:
        total = recording.table(topic).count()
        monkeypatch.setattr(TopicChunks, "_read", counted(TopicChunks._read))
        check_phase(recording, "train", complete=True)
        assert total <= sum(read) <= 4 * total


def test_the_digests_of_other_topics_than_steps_are_compared_though_steps_are_left_out(tmp_path):
    with runner.record(make("CartPole-v1"), tmp_path, steps="none") as env:
        for _ in play(env, 100):
            pass

    def add(entries):
        result = json.loads(entries["json"])
        digests = result["topic_digests"] | {"/other/step": "00" * 32}
        return {"json": json.dumps(result | {"topic_digests": digests})}

    assert content_of(env.run.recording)
    with pytest.raises(RecordingError, match="other content than the digest"):
        content_of(altered(env.run.recording, tmp_path / "x.mcap", None, None, result=add))


def test_a_step_after_the_end_of_an_episode_is_no_damage_if_a_rerun_gives_it(tmp_path):
    with runner.record(gymnasium.make("CartPole-v1", disable_env_checker=True), tmp_path) as env:
        for episode in range(4):
            env.reset(seed=episode)
            over = False
            while not over:
                _, _, terminated, truncated, _ = env.step(0)
                over = terminated or truncated
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Gymnasium's, of the step after the end
            env.step(0)
    found = verify(env.run.recording)
    assert (found.verdict, found.finding) == ("reproduced", "")
    assert any("1 episode began without a reset" in note for note in found.notes)
    unproved = verify(env.run.recording, rerun=False)
    assert (unproved.verdict, "without a reset before it" in unproved.finding) == ("damaged", True)


def test_an_environment_with_a_method_of_games_comes_out_again(tmp_path):
    with runner.record(Described(), tmp_path) as env:
        for _ in play(env, 20):
            pass
    assert verify(env.run.recording).verdict == "reproduced"
