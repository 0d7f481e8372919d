"""Whatever a loop does, and whenever its recording is flushed, the file holds what the loop saw."""

from __future__ import annotations

import random
import tempfile
from collections import defaultdict

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import runner
from runner.execution.verify import verify
from runner.recording import schema
from runner.recording.reader import open_recording
from tests.runner.loops.making import Rooms

PHASES = ("train", "eval")
MAKERS = (
    lambda: gymnasium.make("CartPole-v1", max_episode_steps=9),
    lambda: gymnasium.make("FrozenLake-v1", max_episode_steps=9),
    lambda: Rooms(with_text=True),
)
DTYPES = (np.float64, np.float32, np.int64, np.bool_)


def flat(value):
    """Return a value of any space as lists and numbers."""
    if isinstance(value, dict):
        return {key: flat(part) for key, part in value.items()}
    if isinstance(value, np.void):
        return {key: flat(value[key]) for key in value.dtype.names}
    if isinstance(value, tuple):
        return {str(i): flat(part) for i, part in enumerate(value)}
    return value if isinstance(value, str) else np.asarray(value).tolist()


def extras_of(draw, names, batch=()):
    """Return values of some names; a name has one dtype and shape."""
    chosen = [k for k in range(names) if draw.random() < 0.6]
    shapes = [(*batch, *((), (2,), (2, 3))[k % 3]) for k in chosen]
    return {
        f"name {k}": np.array(100 * np.random.default_rng(k).random(shape), DTYPES[k % 4])
        for k, shape in zip(chosen, shapes, strict=True)
    }


def recorded_extras(recording, phase):
    """Return the recorded extras by step and name."""
    return {
        int(row["step"]): {name: row["values"][name].tolist() for name in names if row["given"][name]}
        for block in recording.phase(phase).extras.blocks()
        if (names := block["values"].dtype.names)
        for row in block
    }


@pytest.fixture(autouse=True)
def flushed_all_the_time(monkeypatch):
    monkeypatch.setattr("runner.loops.loop.FLUSH_SECONDS", 0.002)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from(MAKERS), st.sampled_from((10, 200)))
def test_a_loop_is_recorded_as_it_was_seen(seed, make, length):
    draw = random.Random(seed)
    steps, resets, extras = defaultdict(list), defaultdict(list), defaultdict(dict)
    checkpoints, logged, names, phase, over = [], [], 0, "train", True
    rates = {kind: draw.choice((0, 0.02, 0.2)) for kind in ("phase", "reset", "name", "log", "checkpoint")}
    extra_rate, note_rate = draw.choice((0, 0.1, 1)), draw.choice((0, 0.3))
    with tempfile.TemporaryDirectory() as folder:
        with runner.record(make(), folder, chunk_steps=256) as rec:
            rec.action_space.seed(draw.randrange(99))
            for k in range(length):
                happens = {kind for kind, rate in rates.items() if draw.random() < rate}
                names = min(names + ("name" in happens), 8)
                if "phase" in happens:
                    phase, over = PHASES[phase == "train"], True
                with rec.phase(phase):
                    if over or "reset" in happens:
                        seen = rec.reset(seed=draw.choice((None, k)))[0]
                        resets[phase].append((len(steps[phase]), flat(seen)))
                    own = extras_of(draw, names) if draw.random() < extra_rate else None
                    action = rec.action_space.sample()
                    seen, reward, terminated, truncated, _ = rec.step(action, extras=own)
                    over = terminated or truncated
                    number = len(steps[phase])
                    steps[phase].append((flat(action), flat(seen), reward, terminated, truncated))
                    extras[phase][number] = dict(own or {})
                    if draw.random() < note_rate and (own := extras_of(draw, names)):
                        rec.note_step(own)
                        extras[phase][number] |= own
                    if "log" in happens:
                        rec.log("loss", k / 7)
                        logged.append((phase, number + 1, k / 7))
                    if "checkpoint" in happens:
                        digest = rec.checkpoint("policy", b"%d" % draw.randrange(3))
                        checkpoints.append((phase, number + 1, digest))
        with open_recording(rec.run.recording) as recording:
            for each in PHASES:
                names_of = (
                    ("action", "next_state") if recording.has_states else ("action", "next_observation")
                )
                fields = (*names_of, "rewards", "terminated", "truncated")
                found = [
                    tuple(flat(row[name]) for name in fields) for row in recording.phase(each).transitions()
                ]
                assert found == [(a, o, [r], te, tr) for a, o, r, te, tr in steps[each]]
                found = [
                    (row["step"], flat(row["observation"])) for row in recording.phase(each).reset_values()
                ]
                assert found == resets[each]
                expected = {
                    step: {name: value.tolist() for name, value in own.items()}
                    for step, own in extras[each].items()
                    if own
                }
                assert recorded_extras(recording, each) == expected
            found = [
                (row["phase"], row["step"], row["value"])
                for row in recording.table(schema.SCALAR_TOPIC).decoded()
            ]
            assert found == logged
        found = [(one.phase, one.step, one.digest) for one in rec.run.checkpoints()]
        assert found == checkpoints
        assert verify(rec.run.recording).sound


@settings(max_examples=12, deadline=None)
@given(
    st.integers(0, 2**32),
    st.sampled_from(("NextStep", "SameStep", "Disabled")),
    st.sampled_from((10, 200)),
)
def test_a_loop_over_a_vector_is_recorded_as_it_was_seen(seed, mode, length):
    draw = random.Random(seed)
    n = draw.randrange(1, 4)
    envs = gymnasium.vector.SyncVectorEnv(
        [MAKERS[0]] * n, autoreset_mode=gymnasium.vector.AutoresetMode(mode)
    )
    rewards, actions, after, ends = [], [], [], []
    extras, names, over = {}, 0, np.ones(n, np.bool_)
    note_rate, name_rate = draw.choice((0, 0.3)), draw.choice((0.02, 0.3))
    with tempfile.TemporaryDirectory() as folder:
        with runner.record_vector(envs, folder, chunk_steps=256) as rec:
            rec.reset(seed=draw.randrange(99))
            rec.action_space.seed(draw.randrange(99))
            for k in range(length):
                names = min(names + (draw.random() < name_rate), 8)
                if k and mode == "Disabled" and over.any():
                    rec.reset(options={"reset_mask": over.copy()})
                action, own = rec.action_space.sample(), extras_of(draw, names, (n,))
                seen, reward, terminated, truncated, info = rec.step(action, extras=own)
                over = terminated | truncated
                if mode == "SameStep" and over.any():
                    seen = np.where(
                        over[:, np.newaxis],
                        np.stack(
                            [
                                last if last is not None else seen[i]
                                for i, last in enumerate(info["final_obs"])
                            ]
                        ),
                        seen,
                    )
                if draw.random() < note_rate and (more := extras_of(draw, names, (n,))):
                    rec.note_step(more)
                    own |= more
                if own:
                    for i in range(n):
                        extras[k * n + i] = {name: value[i].tolist() for name, value in own.items()}
                actions += action.tolist()
                after += seen.tolist()
                rewards += reward.tolist()
                ends += over.tolist()
        with open_recording(rec.run.recording) as recording:
            rows = [row for block in recording.train.steps.rows() for row in block]
            assert [row["action"].tolist() for row in rows] == actions
            assert [row["next_observation"].tolist() for row in rows] == after
            assert [row["rewards"][0] for row in rows] == rewards
            assert [bool(row["terminated"] or row["truncated"]) for row in rows] == ends
            assert recorded_extras(recording, "train") == extras
        assert verify(rec.run.recording).sound
