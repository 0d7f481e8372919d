"""Values of spaces in a recording: every dtype, shape, space and way in, bit for bit, by every reader."""

from __future__ import annotations

import copy
import json
import tempfile

import gymnasium
import hypothesis.strategies as st
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from hypothesis import given, settings
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

import runner
from runner.errors import RecordingError
from runner.recording import schema
from runner.recording.fields import space_field
from runner.recording.integrity import check_integrity
from runner.recording.layout import layout_of
from runner.recording.messages import decode_rows, encode_rows, file_descriptor_set
from runner.recording.reader import open_recording
from runner.recording.spaces import leaves_of
from tests.runner.altering import altered
from tests.runner.loops.making import Leaving

STEPS = 7
DTYPES = ("b1", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f2", "f4", "f8")


def numbers(code: str, shape: tuple[int, ...]) -> spaces.Space:
    dtype = np.dtype(code)
    low, high = (0, 1) if dtype.kind == "b" else (-1, 1)
    if dtype.kind in "iu":
        low, high = np.iinfo(dtype).min, np.iinfo(dtype).max
    return spaces.Box(low, high, shape, dtype.type)


LEAVES = st.one_of(
    st.builds(numbers, st.sampled_from(DTYPES), st.sampled_from([(), (1,), (3,), (2, 2), (0,)])),
    st.builds(spaces.Discrete, st.integers(1, 1000), start=st.integers(-5, 5)),
    st.builds(spaces.MultiBinary, st.integers(1, 5)),
    st.builds(spaces.MultiDiscrete, st.lists(st.integers(1, 9), min_size=1, max_size=4)),
)
KEYS = st.text("aB1_ .é", min_size=1, max_size=4).filter(lambda key: key.strip() == key)
TEXTS = st.builds(spaces.Text, st.integers(1, 12))


def nested(leaves):
    return st.recursive(
        leaves,
        lambda inner: st.one_of(
            st.builds(spaces.Dict, st.dictionaries(KEYS, inner, min_size=1, max_size=4)),
            st.builds(spaces.Tuple, st.lists(inner, min_size=1, max_size=3)),
        ),
        max_leaves=5,
    )


class Any(gymnasium.Env):
    """Returns samples of its space."""

    def __init__(self, observation, action):
        self.observation_space, self.action_space = observation, action

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self._t = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        self._t += 1
        return self.observation_space.sample(), self._t / 3, self._t == 4, False, {}


class Pair:
    """A game of two agents that see and take samples of a space each."""

    def __init__(self, first, second):
        self.metadata = {"name": "pair"}
        self.possible_agents = self.agents = ["a", "b"]
        self.of_agents = {"a": first, "b": second}
        self.to_take = copy.deepcopy(self.of_agents)

    def observation_space(self, agent):
        return self.of_agents[agent]

    def action_space(self, agent):
        return self.to_take[agent]

    def reset(self, seed=None, options=None):
        return self._samples(), {agent: {} for agent in self.agents}

    def step(self, actions):
        ends = dict.fromkeys(self.agents, False)
        return (
            self._samples(),
            dict.fromkeys(self.agents, 1.0),
            ends,
            ends,
            {agent: {} for agent in self.agents},
        )

    def close(self):
        pass

    def _samples(self):
        return {agent: self.of_agents[agent].sample() for agent in self.agents}


def same(left, right):
    if isinstance(left, dict):
        return list(left) == list(right) and all(same(left[key], right[key]) for key in left)
    if isinstance(left, tuple):
        return len(left) == len(right) and all(map(same, left, right))
    if isinstance(left, str):
        return left == right
    left, right = np.asarray(left), np.asarray(right)
    return (left.dtype, left.shape, left.tobytes()) == (right.dtype, right.shape, right.tobytes())


def plain(space, value):
    """Return a value of a space as a reader has it that gives records with fields by name."""
    if isinstance(space, spaces.Dict):
        return {key: plain(part, value[key]) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(
            plain(part, value[str(i)] if isinstance(value, np.void) else value[i])
            for i, part in enumerate(space)
        )
    return value


def by_name(field, message):
    """Return a value that a standard Protobuf parser gives, as arrays by the names of the description."""
    value = getattr(message, field.stored_name)
    if field.parts is not None:
        return {part.name: by_name(part, value) for part in field.parts}
    if field.dtype is None:
        raw = getattr(message, f"{field.stored_name}_raw")
        return value or raw.decode("utf-8", "surrogatepass")
    if isinstance(value, bytes):
        return np.frombuffer(value, field.dtype.base).reshape(field.dtype.shape)
    return np.array(value, field.dtype.base).reshape(field.dtype.shape)


def expected_by_name(value):
    if isinstance(value, dict):
        return {str(key): expected_by_name(part) for key, part in value.items()}
    if isinstance(value, tuple):
        return {str(i): expected_by_name(part) for i, part in enumerate(value)}
    return value


def official(path, topic):
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        return [message.decoded_message for message in reader.iter_decoded_messages(topics=[topic])]


def check_steps(path, observation, action, seen):
    """Compare the recorded steps with those of a loop, by our reader and by the official one."""
    with open_recording(path) as recording:
        rows, fields = list(recording.train.transitions()), recording.layout.message(schema.TRAIN_STEP).fields
    messages = official(path, "/train/step")
    assert len(rows) == len(messages) == len(seen)
    of_values = {field.name: field for field in fields if field.is_value}
    for row, message, (taken, after) in zip(rows, messages, seen, strict=True):
        if not of_values:
            start = action.start, observation.start
            assert (row["action"], row["next_state"]) == (taken - start[0], after - start[1])
            continue
        assert same(plain(observation, row["next_observation"]), after)
        assert same(plain(action, row["action"]), taken)
        assert same(by_name(of_values["next_observation"], message), expected_by_name(after))
        assert same(by_name(of_values["action"], message), expected_by_name(taken))


def loop_over(observation, action, folder):
    seen = []
    with runner.record(Any(observation, action), folder) as rec:
        rec.action_space.seed(3)
        rec.reset(seed=5)
        for _ in range(STEPS):
            taken = rec.action_space.sample()
            after, _, over, _, _ = rec.step(taken)
            seen.append((taken, after))
            if over:
                rec.reset()
    return rec.run.recording, seen


@settings(max_examples=60)
@given(nested(LEAVES), nested(LEAVES))
def test_values_of_one_size_come_back_and_have_names(observation, action):
    with tempfile.TemporaryDirectory() as folder:
        path, seen = loop_over(observation, action, folder)
        check_steps(path, observation, action, seen)


@settings(max_examples=40)
@given(nested(st.one_of(LEAVES, TEXTS)), nested(st.one_of(LEAVES, TEXTS)))
def test_values_of_varying_size_come_back_and_have_names(observation, action):
    with tempfile.TemporaryDirectory() as folder:
        path, seen = loop_over(observation, action, folder)
        check_steps(path, observation, action, seen)


@settings(max_examples=15)
@given(nested(st.one_of(LEAVES, TEXTS)))
def test_values_of_a_vector_come_back(observation):
    def make():
        return Any(copy.deepcopy(observation), spaces.Box(-1, 1, (2,), np.float32))

    with tempfile.TemporaryDirectory() as folder:
        envs = SyncVectorEnv([make] * 2, autoreset_mode=AutoresetMode.NEXT_STEP)
        with runner.record_vector(envs, folder) as rec:
            rec.reset(seed=[1, 2])
            for _ in range(3):
                rec.step(np.zeros((2, 2), np.float32))
        with open_recording(rec.run.recording) as recording:
            rows = list(recording.train.transitions())
    expected = []
    for seed in (1, 2):
        env = make()
        env.reset(seed=seed)
        expected.append([env.step(None)[0] for _ in range(3)])
    assert len(rows) == 6
    for number, row in enumerate(rows):
        assert same(plain(observation, row["next_observation"]), expected[number % 2][number // 2])


@settings(max_examples=15)
@given(nested(st.one_of(LEAVES, TEXTS)), nested(st.one_of(LEAVES, TEXTS)))
def test_values_of_a_game_come_back(first, second):
    with tempfile.TemporaryDirectory() as folder:
        with runner.record_parallel(Pair(first, second), folder) as rec:
            rec.reset(seed=5)
            seen = []
            for _ in range(3):
                actions = {agent: rec.action_space(agent).sample() for agent in rec.agents}
                seen.append((actions, rec.step(actions)[0]))
        with open_recording(rec.run.recording) as recording:
            rows = list(recording.train.transitions())
    assert len(rows) == len(seen)
    for row, (actions, after) in zip(rows, seen, strict=True):
        for agent, space in (("a", first), ("b", second)):
            assert same(plain(space, row["action"][agent]), actions[agent])
            assert same(plain(space, row["next_observation"][agent]), after[agent])


def stacked(space, values):
    """Return values [T][N] of a space as arrays [T, N, ...], nested as the space."""
    if isinstance(space, spaces.Dict):
        return {
            key: stacked(part, [[value[key] for value in row] for row in values])
            for key, part in space.spaces.items()
        }
    if isinstance(space, spaces.Tuple):
        return tuple(
            stacked(part, [[value[i] for value in row] for row in values]) for i, part in enumerate(space)
        )
    return np.array(values, space.dtype)


@settings(max_examples=60)
@given(nested(LEAVES), nested(LEAVES))
def test_values_of_batches_come_back(observation, action):
    observation.seed(1)
    action.seed(2)
    seen = [[observation.sample() for _ in range(2)] for _ in range(4)]
    taken = [[action.sample() for _ in range(2)] for _ in range(3)]
    zeros = np.zeros((3, 2))
    with tempfile.TemporaryDirectory() as folder:
        with runner.record_batches(
            "any", folder, observation_space=observation, action_space=action, autoreset_mode="NextStep"
        ) as rec:
            rec.batch(stacked(observation, seen), stacked(action, taken), zeros, zeros.astype(np.bool_))
        with open_recording(rec.run.recording) as recording:
            rows = list(recording.train.transitions())
            in_states = recording.has_states
    assert len(rows) == 6
    for number, row in enumerate(rows):
        after, done = seen[1 + number // 2][number % 2], taken[number // 2][number % 2]
        if in_states:
            assert (row["action"], row["next_state"]) == (done - action.start, after - observation.start)
            continue
        assert same(plain(observation, row["next_observation"]), after)
        assert same(plain(action, row["action"]), done)


def test_the_action_of_an_agent_stands_by_its_name(tmp_path):
    env = Leaving()
    with runner.record_parallel(env, tmp_path) as rec:
        rec.reset(seed=1)
        actions = {agent: rec.action_space(agent).sample() for agent in rec.agents}
        rec.step(actions)
    (step,) = official(rec.run.recording, "/train/step")
    for agent, taken in actions.items():
        assert np.array_equal(getattr(step.action, agent), taken)


def test_names_that_protobuf_has_not_are_changed_by_the_rule():
    keys = ["a b", "a_b", "aB", "1", "é", "", "x_raw", "x"]
    parts = {key or " ": {"type": "Box", "dtype": "<f4", "shape": []} for key in keys}
    field = space_field(2, "action", {"type": "Dict", "spaces": parts})
    names = [part.stored_name for part in field.parts]
    assert names == ["a_b", "a_b_2", "aB_3", "_1", "_", "__2", "x_raw", "x_2"]
    layout = layout_of(
        "loop",
        1,
        0,
        '{"observation": {"type": "Discrete", "n": 2, "dtype": "<i8", "shape": []}, '
        '"action": {"type": "Box", "dtype": "<f4", "shape": [2]}}',
    )
    assert b"next_observation" in file_descriptor_set(layout.message(schema.TRAIN_STEP))


@pytest.mark.parametrize(
    "change",
    [lambda data: data[:-1], lambda data: data + b"\0", lambda data: data.replace(b"abc", b"ab\xff")],
)
def test_messages_of_varying_size_that_no_recorder_writes_are_refused(change):
    text, number = (
        {"type": "Text", "max_length": 9},
        {"type": "Discrete", "n": 2, "dtype": "<i8", "shape": []},
    )
    layout = layout_of("loop", 1, 0, json.dumps({"observation": text, "action": number}))
    message = layout.message(schema.TRAIN_STEP)
    rows = np.zeros(1, layout.row_dtype(schema.TRAIN_STEP))
    rows["action"][0], rows["next_observation"][0] = bytes(8), b"\3\0\0\0abc"
    (payload,) = encode_rows(message, rows)
    (back,) = decode_rows(message, [(0, payload)])
    assert back["next_observation"] == b"\3\0\0\0abc"
    with pytest.raises(RecordingError):
        decode_rows(message, [(0, change(payload))])


def test_a_space_of_thousands_of_parts_is_recorded_and_read(tmp_path):
    observation = spaces.Dict({f"k{i}": spaces.Text(2) for i in range(1900)})
    path, seen = loop_over(observation, spaces.Discrete(2), tmp_path)
    check_integrity(path)
    with open_recording(path) as recording:
        *_, last = recording.train.transitions()
        assert recording.train.steps.count() == len(seen)
    assert last["next_observation"] == seen[-1][1]


def test_parts_with_equal_names_are_numbered_quickly_and_too_many_are_refused():
    parts = {chr(0x4E00 + i): {"type": "Box", "dtype": "<f4", "shape": []} for i in range(4096)}
    field = space_field(2, "action", {"type": "Dict", "spaces": parts})
    assert [part.stored_name for part in field.parts[:3]] == ["_", "__2", "__3"]
    many = {chr(0x4E00 + i): {"type": "Tuple", "spaces": []} for i in range(5000)}
    with pytest.raises(RecordingError, match="5,000 parts, expected 4,096 at most"):
        leaves_of({"type": "Dict", "spaces": many}, "a space")


def test_a_number_that_is_cut_in_a_message_of_varying_size_is_refused():
    text, number = {"type": "Text", "max_length": 9}, {"type": "Box", "dtype": "<f8", "shape": [2]}
    layout = layout_of("loop", 1, 0, json.dumps({"observation": number, "action": text}))
    message = layout.message(schema.TRAIN_STEP)
    rows = np.zeros(1, layout.row_dtype(schema.TRAIN_STEP))
    rows["action"][0], rows["next_observation"][0] = b"\1\0\0\0a", bytes(16)
    (payload,) = encode_rows(message, rows)
    for size in range(len(payload)):
        with pytest.raises(RecordingError):
            decode_rows(message, [(0, payload[:size])])


def test_tags_that_other_readers_would_not_know_are_damage(tmp_path):
    class Sensors(Any):
        def __init__(self):
            parts = {"at": spaces.Box(-1, 1, (2,), np.float32), "lit": spaces.Discrete(2)}
            super().__init__(spaces.Dict(parts), spaces.Discrete(2))

    with runner.record(Sensors(), tmp_path / "runs") as rec:
        rec.reset(seed=1)
        for _ in range(5):
            rec.step(1)

    def change(records):
        stored = records.view(np.uint8).reshape(len(records), -1)
        at = records.dtype.fields["next_observation"][1]
        assert stored[2, at] == 0x0A  # the tag of `at`, the first part
        stored[2, at] = 0x1A
        return records

    odd = altered(rec.run.recording, tmp_path / "odd.mcap", schema.TRAIN_STEP, change)
    with pytest.raises(RecordingError, match="tags that no recorder writes"):
        check_integrity(odd)
