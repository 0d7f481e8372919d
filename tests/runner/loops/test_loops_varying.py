"""Values that vary in size: read by number and in any order, also beyond what a repair lost."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import runner
from runner.errors import RecordingError
from runner.recording.reader import open_recording
from runner.recording.repair import repair
from tests.runner.loops.making import Rooms

STEPS, CHUNK = 1_200, 256


@pytest.fixture(scope="module")
def rooms(tmp_path_factory):
    with runner.record(Rooms(with_text=True), tmp_path_factory.mktemp("rooms"), chunk_steps=CHUNK) as rec:
        rec.action_space.seed(3)
        is_over = True
        for _ in range(STEPS):
            if is_over:
                rec.reset(seed=1)
            *_, terminated, truncated, _ = rec.step(rec.action_space.sample())
            is_over = terminated or truncated
    return rec.run.recording


def numbers(table, wanted):
    return [number for rows in table.numbered(wanted) for number in rows["step"].tolist()]


def test_any_steps_are_read_by_their_numbers(rooms):
    with open_recording(rooms) as recording:
        steps = recording.train.steps
        assert len(steps) > 2
        for wanted in (
            range(STEPS),
            range(STEPS - 3, STEPS),
            range(CHUNK - 6, CHUNK + 4),
            range(5, STEPS - 100),
            range(9, 9),
        ):
            assert numbers(steps, wanted) == list(wanted)
        episodes = np.concatenate([rows["episode"] for rows in steps.rows()])
        for episode in (0, 1, int(episodes[-1])):
            assert steps.first_from("episode", episode) == np.searchsorted(episodes, episode)
        assert steps.first_from("episode", int(episodes[-1]) + 1) == steps.count() == STEPS


def test_steps_around_a_hole_are_those_of_their_numbers(rooms, tmp_path):
    path = tmp_path / "hole.mcap"
    data = bytearray(rooms.read_bytes())
    with open_recording(rooms) as recording:
        entry = recording.train.steps.entry(1)
    data[entry.offset + entry.length // 2] ^= 255
    path.write_bytes(data)
    repair(path)
    with open_recording(path) as recording:
        steps = recording.train.steps
        left = [number for rows in steps.rows() for number in rows["step"].tolist()]
        before, after = next((a, b) for a, b in itertools.pairwise(left) if b != a + 1)
        assert numbers(steps, range(before, after + 2)) == [before, after, after + 1]
        assert steps.one(after)["step"] == after
        assert recording.lost == {"/train/step": [[before + 1, after]]}
        assert steps.count() == STEPS
        with pytest.raises(RecordingError, match=f"number {before + 1:,} was lost"):
            steps.one(before + 1)
